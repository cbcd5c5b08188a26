"""The one driver of all batches: runs into one results folder, resumable, with every failure of a run as a row.

`compare`, `sweep`, `robustness` and `suite` are campaigns; `tune` uses the lower half, the module `blocks`. Each
finished block of runs becomes a part of the results folder, written by this process. A campaign that is resumed carries
out the runs without a part, so that its tables are those of an undisturbed one, wall-clock columns aside. Runs are made
when they are needed, so that the memory of this process does not grow with their number.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, pairwise
from operator import attrgetter
from pathlib import Path

import pandas as pd

from servobench.harness.batch import store
from servobench.harness.batch.blocks import (
    BLOCK,
    CHUNK,
    Block,
    Job,
    build_block,
    carry_out_blocks,
    cut,
    even_size,
    open_workers,
)
from servobench.harness.batch.differences import check_same_batch
from servobench.harness.batch.integrity import check_resumable, mend, restore_manifest
from servobench.harness.batch.isolation import Workers
from servobench.harness.batch.lock import check_empty, is_unused, locked
from servobench.harness.batch.looks import Looks
from servobench.harness.batch.manifest import describe_batch
from servobench.harness.batch.plan import Batch, Cell, Grid, Survey, refuse_tuning_seeds, survey
from servobench.harness.batch.processes import Bounds
from servobench.harness.batch.results import Manifest, ResultsFolder, load_runs, wanted_runs
from servobench.harness.batch.tables import writing
from servobench.harness.config.registry import Offer, offered
from servobench.harness.config.settings import Settings
from servobench.harness.run.lanes import side_by_side_key
from servobench.harness.run.rehearsal import build_once
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import (
    ResolvedRun,
    Sections,
    check_settings,
    resolve_sections,
    select,
    share_settings,
)
from servobench.harness.run.result import RunResult
from servobench.harness.run.variations import ROLES, Row
from servobench.plant.contract.dependence import reasons_for_no_effect
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import remark

_MakeJobs = Callable[[Iterable[int]], Iterator[Job]]


@dataclass(frozen=True)
class Campaign:
    """Runs that share their settings and end in one results folder."""

    cells: Sequence[Cell]  # in the order of the table
    settings: Settings  # overrides of the defaults
    steps: bool = False  # keep the table of steps, too
    timed: bool = False  # each run goes by itself, so that its steps have times
    metrics: tuple[str, ...] = ()  # names of metrics of users; each run goes by itself, too
    on_tuning_seeds: bool = False  # it may have robots on which methods were tuned, for an audit
    looks: Looks | None = None  # when it may end before all runs; None for a fixed number


def comparison(batch: Batch, settings: Settings) -> Campaign:
    """Return the campaign of a comparison, with steps and, for the first seed, the last image of the camera."""
    first = min(batch.seeds)
    cells = Grid(lambda request: Cell(request, picture=request.seed == first), batch.requests())
    return Campaign(cells, settings, steps=True)


class Observer:
    """Receives the progress of a campaign; this one does nothing."""

    def training(self, share: float, subject: str) -> None:
        """Receive how much of a training of networks is done, from 0 to 1."""

    def begin(self, total: int, done: int) -> None:
        """Receive the number of all runs and of those that are there already."""

    def finished(self, rows: Sequence[Row]) -> None:
        """Receive rows that are on disk now."""

    def note(self, text: str) -> None:
        """Receive one line for the user."""


@dataclass(frozen=True)
class Execution:
    """How the runs of a campaign are carried out."""

    workers: int | None = None  # number of processes; None for the number of processors
    scheduler: str | Executor | None = (
        None  # Dask's address, or an executor; None for processes of this machine
    )
    bounds: Bounds = field(default_factory=Bounds)  # resources of a run
    resume: bool = False  # carry out the runs that are missing in the folder
    observer: Observer = field(default_factory=Observer)  # receives the progress
    block: int = BLOCK  # [runs] that advance together at most; 1: each by itself, with the times of its steps
    debug: bool = (
        False  # raise the error of a run that crashes; the runs go one by one in this process
    )
    part: tuple[int, int] = (
        1,
        1,
    )  # (3, 40): the third of forty parts of the runs only, all of about one size


def carry_out(campaign: Campaign, folder: Path, how: Execution = Execution()) -> None:
    """Check and carry out the runs of a campaign and put its tables together.

    Ctrl-C raises KeyboardInterrupt; finished runs are kept, and the same call with `resume` continues.

    Args:
        campaign: the runs.
        folder: new folder for the results; to resume, one that holds those of the same campaign.
        how: place and observer of the runs.

    Raises:
        ConfigurationError: a campaign that cannot be carried out, or a folder that cannot be used.
    """
    if not how.resume:
        check_empty(folder, can_resume=len(campaign.cells) > 1)
    elif not is_unused(folder):
        check_resumable(ResultsFolder(folder))
    runs = survey(Grid(attrgetter("request"), campaign.cells))
    if how.part[1] > runs.count:
        raise ConfigurationError(
            f"a batch of {runs.count} runs has at most {runs.count} parts, got {how.part[1]}"
        )
    own = offered([*runs.sections, *campaign.metrics])
    bounds = replace(how.bounds, isolate=how.bounds.isolate and not how.debug)
    trusted = [
        name
        for name, section in campaign.settings.sections.items()
        if section.get("isolate") is False
    ]
    opening = open_workers(
        how.workers,
        how.scheduler,
        bounds,
        plants=runs.plants,
        controllers=runs.controllers,
        own=own,
        trusted=trusted,
        steps=campaign.steps,
    )
    with opening as place:
        _carry_out_at(place, campaign, runs, own, folder, how)


def carry_out_parts(
    parts: Mapping[str, Campaign], folder: Path, how: Execution
) -> dict[str, pd.DataFrame]:
    """Carry out the campaigns of a study, each in a folder of its name, and return their tables of runs.

    Raises:
        ConfigurationError: as `carry_out`.
    """
    for name, campaign in parts.items():
        carry_out(campaign, folder / name, how)
    return {name: load_runs(folder / name) for name in parts}


def _carry_out_at(
    place: Workers,
    campaign: Campaign,
    runs: Survey,
    own: tuple[Offer, ...],
    folder: Path,
    how: Execution,
) -> None:
    """Check and carry out a campaign at a place."""
    sections = check_campaign(campaign, runs, how.observer, place)
    alone = how.debug or campaign.steps or campaign.timed or campaign.metrics
    together = how.block > 1 and not alone
    jobs = partial(_jobs, campaign, sections, together)
    side_by_side = (
        _side_by_side([select(request, sections) for request in runs.examples]) if together else {}
    )
    asked = None
    if campaign.looks is not None:
        asked = campaign.looks.record
    manifest = describe_batch(
        runs,
        sections,
        campaign.settings.sections,
        side_by_side,
        own,
        steps=campaign.steps,
        until_decided=asked,
    )
    for name, engine in manifest["engines"].items():
        how.observer.note(f"{name}: {engine}")
    opened = ResultsFolder(folder)
    with locked(folder) as lock:
        if lock.stale is not None:
            how.observer.note(f"note: {folder} was left by {lock.stale}; its lock is free")
        # Under the lock: another process may have begun meanwhile
        resumed = how.resume and not is_unused(folder)
        if resumed:
            _resume(opened, manifest, how.observer)
        else:
            if how.resume:
                how.observer.note(f"note: {folder} holds no runs to continue; all are carried out")
            store.create_folder(folder, manifest)
        if not resumed or not opened.is_whole(wanted_runs(manifest)):
            for block, outcome in _carry_out_missing(campaign, jobs, own, opened, place, how):
                with writing(folder):
                    lock.check()  # the folder may have been removed
                store.write_part(folder, block.jobs[0].index, outcome, manifest["campaign"])
                how.observer.finished([result.row for result in outcome])
            if campaign.looks and how.part == (1, 1):
                manifest["until_decided"]["runs"] = sum(map(len, opened.finished_runs()))
                store.write_manifest(folder, manifest)
        store.put_together(opened, manifest)


def _resume(folder: ResultsFolder, manifest: Manifest, observer: Observer) -> None:
    """Refuse a folder of another batch, and mend one of this batch before anything is computed."""
    restored = restore_manifest(folder, manifest)
    check_same_batch(folder, manifest, observer.note, remedy="give another folder as `out`")
    manifest["until_decided"] = folder.manifest.get("until_decided", {})
    mended = list(mend(folder, manifest))
    if restored:
        mended.insert(0, restored)
    for line in mended:
        observer.note(f"note: {line}")


def check_campaign(
    campaign: Campaign, runs: Survey, observer: Observer, place: Workers
) -> Sections:
    """Refuse runs that are impossible, before anything is written; networks that are needed are trained.

    The examples among the runs are built and thrown away; in a worker process where code of users is built, which may
    fail as it likes: then its runs say so.

    Returns:
        The typed settings of the runs by section.

    Raises:
        ConfigurationError: a name, setting or mismatch that cannot be used, or a seed that is kept for tuning.
    """
    if not campaign.on_tuning_seeds:
        refuse_tuning_seeds(chain.from_iterable(runs.seeds))
    check_settings(campaign.settings, runs.sections)
    check_effects(campaign.settings, runs.examples, steps=campaign.steps)
    sections = resolve_sections(runs.examples, campaign.settings)
    _remark_on_idle(campaign.settings, [select(request, sections) for request in runs.examples])
    for index, request in enumerate(runs.examples):
        job = Job(index, Cell(request), select(request, sections))
        if job.owner and place.submit is not None:
            with contextlib.suppress(*place.lost):  # the run will say so
                build_block(Block((job,), offered(runs.sections)), place.submit, observer.training)
        else:
            build_once(job.run, observer.training)
    return sections


def _jobs(
    campaign: Campaign, sections: Sections, together: bool, indices: Iterable[int]
) -> Iterator[Job]:
    """Yield the jobs of some cells; runs that differ in seed only share their settings, and may advance together."""
    run: ResolvedRun | None = None
    for index in indices:
        cell = campaign.cells[index]
        if run is not None and share_settings(run.request, cell.request):
            run = ResolvedRun(cell.request, run.run, run.plant, run.controller, run.task)
        else:
            run = select(cell.request, sections)
            key = side_by_side_key(run) if together else None
        yield Job(index, cell, run, None if cell.picture else key, campaign.metrics)


def _side_by_side(runs: Iterable[ResolvedRun]) -> dict[str, list[str]]:
    """Return by plant the controllers of those of some runs that advance together."""
    found: dict[str, dict[str, None]] = {}
    for run in runs:
        if side_by_side_key(run) is not None:
            found.setdefault(run.request.plant, {})[run.request.controller] = None
    return {plant: list(controllers) for plant, controllers in found.items()}


def _carry_out_missing(
    campaign: Campaign,
    jobs: _MakeJobs,
    own: tuple[Offer, ...],
    folder: ResultsFolder,
    place: Workers,
    how: Execution,
) -> Iterator[tuple[Block, list[RunResult]]]:
    """Carry out the runs whose part is not in the folder; yield each block with its results."""
    begin, end = (
        len(campaign.cells) * number // how.part[1] for number in (how.part[0] - 1, how.part[0])
    )
    ends: tuple[int, ...] = (len(campaign.cells),)
    if campaign.looks is not None:
        ends = campaign.looks.ends
    keep = folder.path if campaign.steps and not place.cluster else None
    for start, stop in pairwise((0, *ends)):
        own_share = range(max(start, begin), max(start, begin, min(stop, end)))
        gaps, missing, done = _gaps(campaign, folder, own_share)
        if not done + missing:
            continue
        how.observer.begin(done + missing, done)
        size = even_size(missing, place.count, how.block)
        blocks = cut(jobs(gaps), size, 1 if campaign.steps else CHUNK, own)
        yield from carry_out_blocks(blocks, place, steps=campaign.steps, keep=keep, debug=how.debug)


def _gaps(
    campaign: Campaign, folder: ResultsFolder, share: range
) -> tuple[Iterable[int], int, int]:
    """Return the indices of the missing runs of a share, their number, and that of those in the folder."""
    there = (
        range(max(each.start, share.start), min(each.stop, share.stop))
        for each in folder.finished_runs()
    )
    done = list(filter(None, there))  # a block of another part may reach over the borders
    finished = sum(map(len, done))
    ends = [range(share.start, share.start), *done, range(share.stop, share.stop)]
    gaps = chain.from_iterable(range(one.stop, next_one.start) for one, next_one in pairwise(ends))
    if campaign.looks is None:
        return gaps, len(share) - finished, finished
    runs = pd.DataFrame()
    if folder.part_indices():
        runs = folder.runs(parts=True)
    is_needed = campaign.looks.goes_on(runs)
    needed = [index for index in gaps if is_needed(campaign.cells[index].request)]
    return needed, len(needed), finished


def check_effects(settings: Settings, examples: Sequence[RunRequest], *, steps: bool) -> None:
    """Refuse assignments and variations of settings that are read but change nothing here.

    Args:
        settings: overrides of the defaults.
        examples: runs with every plant in every condition.
        steps: the table of steps is kept.

    Raises:
        ConfigurationError: names the first of them and says why.
    """
    for section, name, words in _given(settings, examples):
        key, why = f"{section}.{name}", ""
        own = [run for run in examples if section in ("run", run.plant, run.controller, run.task)]
        if key == "run.full_jacobian" and not steps:
            why = "this command keeps no steps, which hold the Jacobians"
        elif key == "run.camera_moves_at" and not any(
            run.mismatch.size("camera_move") for run in examples
        ):
            why = "no mismatch moves the camera, as camera_move=90deg does"
        elif words.startswith("--set") and own and all(run.varies(key) for run in own):
            why = f"all runs vary {key}"
        if why:
            raise ConfigurationError(f"{words} has no effect: {why}")


def _remark_on_idle(settings: Settings, runs: Sequence[ResolvedRun]) -> None:
    """Remark on assignments to settings and variations that count only together with another setting."""
    for section, key, words in _given(settings, [run.request for run in runs]):
        idle = [
            reasons_for_no_effect(getattr(run, role), key)
            for run in runs
            for role in ROLES
            if section == getattr(run.request, role)
            or (section == role and run.request.varies(f"{role}.{key}"))
        ]
        if idle and all(idle):
            found = " and ".join(f"{section}.{name} is {value}" for name, value in idle[0].items())
            remark(f"{words} has no effect while {found}")


def _given(settings: Settings, examples: Iterable[RunRequest]) -> list[tuple[str, str, str]]:
    """Return section, key and words of assignments and, by role, of settings that some of the runs vary."""
    varied = dict.fromkeys(key for run in examples for key, _ in run.varied)
    assigned = [(section, key, f"--set {text}") for section, key, text in settings.assigned]
    parts = (key.partition(".") for key in varied)
    return [*assigned, *((role, name, f"varying {role}.{name}") for role, _, name in parts)]
