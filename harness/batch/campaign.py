"""The one driver of all batches: runs into one results folder, resumable, with every failure of a run as a row.

`compare`, `sweep`, `robustness` and `claims` are campaigns; `tune` uses the lower half, `carry_out_chunks`. Runs go to
workers in chunks. Each finished chunk becomes a part of the results folder, written by this process; what is there
counts. A campaign that is resumed carries out the runs that are missing, so that its tables are those of an undisturbed
one, wall-clock columns aside.

A run that kills its process (an FMU may), or takes longer than the time limit, becomes a row that says so. If it was
one of a chunk, the runs of that chunk are carried out again one by one, so that the others are not lost.
"""

from __future__ import annotations

import pickle
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final

from servobench.controllers.controller import ControllerEntry
from servobench.harness.batch import results
from servobench.harness.batch.compare import Batch, refuse_tuning_seeds
from servobench.harness.batch.manifest import describe_batch
from servobench.harness.batch.workers import Workers, open_workers
from servobench.harness.config.registry import offering
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.harness.run import episode
from servobench.harness.run.episode import CRASHED, TIMED_OUT, RunResult, describe_error, failed_row
from servobench.harness.run.experiment import build_once
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolved import ResolvedRun, known_sections, resolve_sections, select

CHUNK: Final = 8  # [runs] without steps; a crash costs at most so many, and messages and files cost little
LOST: Final = "the run killed the process that carried it out"
Row = dict[str, Any]


@dataclass(frozen=True)
class Cell:
    """A run and its further columns in the table of runs."""

    request: RunRequest
    columns: Mapping[str, Any] = field(default_factory=dict)  # such as the place along the axis that a sweep varies
    picture: bool = False  # keep what the camera saw last


@dataclass(frozen=True)
class Chunk:
    """Consecutive cells with their settings, and controllers that the registry does not know."""

    index: int  # of the first cell
    jobs: tuple[tuple[Cell, ResolvedRun], ...]
    entries: tuple[ControllerEntry, ...] = ()

    def singly(self) -> list[Chunk]:
        """Return each run as a chunk of its own."""
        return [Chunk(self.index + i, (job,), self.entries) for i, job in enumerate(self.jobs)]


@dataclass(frozen=True)
class Campaign:
    """Runs that share their settings and end in one results folder."""

    cells: Sequence[Cell]  # in the order of the table
    settings: Settings  # overrides of the defaults
    steps: bool = False  # keep the table of steps, too
    entries: tuple[ControllerEntry, ...] = ()  # controllers that the registry does not know


def comparison(batch: Batch, settings: Settings, entries: tuple[ControllerEntry, ...] = ()) -> Campaign:
    """Return the campaign of a comparison, with steps and, for the first seed, what the camera saw last."""
    cells = [Cell(request, picture=request.seed == min(batch.seeds)) for request in batch.requests()]
    return Campaign(cells, settings, steps=True, entries=entries)


class Observer:
    """What a campaign reports on its way; this one does nothing."""

    def training(self, share: float, what: str) -> None:
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
    scheduler: str | None = None  # address of a Dask scheduler; None for processes of this machine
    run_timeout: float | None = None  # [s] time limit of a run; None for no limit
    resume: bool = False  # carry out what is missing in the folder
    observer: Observer = field(default_factory=Observer)  # receives the progress

    def of_part(self, folder: Path) -> Execution:
        """Return how a part of a study is carried out: one that was not begun cannot be resumed."""
        return replace(self, resume=self.resume and folder.exists())


def carry_out(campaign: Campaign, folder: Path, how: Execution = Execution()) -> None:
    """Check and carry out the runs of a campaign and put its tables together.

    Ctrl-C raises KeyboardInterrupt; finished runs are kept, and the same call with `resume` continues.

    Args:
        campaign: the runs.
        folder: new folder for the results; to resume, one that holds those of the same campaign.
        how: where the runs are carried out and what receives the progress.

    Raises:
        ConfigurationError: a campaign that cannot be carried out, or a folder that cannot be used.
    """
    with offering(campaign.entries):
        sections = check_campaign(campaign, how.observer)
    manifest = describe_batch([cell.request for cell in campaign.cells], sections, steps=campaign.steps)
    if how.resume:
        results.read_manifest(folder)
    names = {"plants": manifest["plants"], "controllers": manifest["controllers"]}
    with (
        open_workers(how.workers, how.scheduler, how.run_timeout, **names) as place,
        results.locked(folder, new=not how.resume),
    ):
        if how.resume:
            check_same_campaign(folder, manifest, how.observer)
        else:
            results.create_folder(folder, manifest)
        if (folder / results.PARTS).is_dir():
            done = results.finished_runs(folder)
            how.observer.begin(len(campaign.cells), len(done))
            size = 1 if campaign.steps or how.run_timeout is not None else CHUNK
            keep = folder if campaign.steps and place.local else None
            chunks = _missing_chunks(campaign, sections, done, size)
            for chunk, outcome in carry_out_chunks(chunks, place, steps=campaign.steps, keep=keep):
                results.write_part(folder, chunk.index, outcome)
                how.observer.finished([result.row for result in outcome])
        results.collect(folder)


def check_campaign(campaign: Campaign, observer: Observer) -> dict[str, Any]:
    """Refuse what cannot be run, before anything is written; networks that are needed are trained.

    Runs are built and thrown away until every plant was built with every mismatch, noise factor, latency and
    controller, and every task once.

    Returns:
        The typed settings of the runs by section.

    Raises:
        ConfigurationError: a name, setting or mismatch that cannot be used, a run that is asked for twice, or a seed
            that is kept for tuning.
    """
    requests = {cell.request.run_id: cell.request for cell in campaign.cells}
    if len(requests) < len(campaign.cells):
        counts = Counter(cell.request.run_id for cell in campaign.cells)
        raise ConfigurationError(f"the run {counts.most_common(1)[0][0]} is asked for twice")
    refuse_tuning_seeds(request.seed for request in requests.values())
    names = {name for request in requests.values() for name in (request.plant, request.controller)}
    campaign.settings.check_sections([*known_sections(), *names])
    sections = resolve_sections(requests.values(), campaign.settings)
    built: set[tuple[object, ...]] = set()
    for request in requests.values():
        conditions = (request.mismatch, request.noise_factor, request.latency_periods)
        new = {(request.plant, *conditions), (request.plant, request.controller), (request.task,)} - built
        if new:
            build_once(select(request, sections), observer.training)
            built |= new
    return sections


def check_same_campaign(folder: Path, manifest: Mapping[str, Any], observer: Observer) -> None:
    """Refuse to resume with other runs or settings.

    Raises:
        ConfigurationError: not a results folder, or one of other runs or settings.
    """
    there = results.read_manifest(folder)
    if there.get("campaign") != manifest["campaign"]:
        raise ConfigurationError(f"{folder} holds results of other runs or settings; name another folder with --out")
    for key, what in (("git_commit", "commit"), ("packages", "packages")):
        if there.get(key) != manifest[key]:
            observer.note(f"note: {folder} was begun with other {what}; later runs may differ")


def carry_out_chunks(
    chunks: Iterable[Chunk], workers: Workers, *, steps: bool = False, keep: Path | None = None
) -> Iterator[tuple[Chunk, list[RunResult]]]:
    """Carry out chunks of runs and yield each, whole or run by run, with its results as it finishes, in any order.

    Args:
        chunks: the runs.
        workers: where.
        steps: return the tables of steps too.
        keep: results folder in which trained networks are kept beside the runs.
    """
    waiting = deque(chunks)
    if workers.submit is None:
        for chunk in waiting:
            yield chunk, _carry_out(chunk, steps, keep)
        return
    finished: SimpleQueue[tuple[Chunk, Any]] = SimpleQueue()
    under_way = 0
    while waiting or under_way:
        while waiting and under_way < workers.window:
            chunk = waiting.popleft()
            future = workers.submit(_unpack, _pack(chunk, steps, keep))
            future.add_done_callback(lambda done, chunk=chunk: finished.put((chunk, done)))
            under_way += 1
        chunk, future = finished.get()
        under_way -= 1
        outcome = _outcome(chunk, future, workers)
        if outcome is None:
            waiting.extendleft(reversed(chunk.singly()))
        else:
            yield chunk, outcome


def _outcome(chunk: Chunk, future: Any, workers: Workers) -> list[RunResult] | None:  # noqa: ANN401 - of pebble or Dask
    """Return the results of a chunk; None if it died with several runs, which are to be carried out one by one."""
    try:
        answer: list[RunResult] | str = future.result()
    except workers.lost:
        status, reason = CRASHED, LOST
    except TimeoutError:
        status, reason = TIMED_OUT, f"the run took longer than {workers.run_timeout:g} s"
    except BrokenProcessPool as error:
        raise ConfigurationError(
            "the worker processes cannot be started; a script that starts several must keep its calls below "
            "`if __name__ == '__main__':`"
        ) from error
    else:
        if not isinstance(answer, str):
            return answer
        status, reason = CRASHED, answer
    return [_failed(chunk.jobs[0][0], status, reason)] if len(chunk.jobs) == 1 else None


def _missing_chunks(campaign: Campaign, sections: dict[str, Any], done: set[int], size: int) -> Iterator[Chunk]:
    """Yield the runs that are not in `done` in chunks of at most `size` consecutive runs."""
    chunks: list[list[int]] = []
    for index in (i for i in range(len(campaign.cells)) if i not in done):
        if chunks and chunks[-1][-1] == index - 1 and len(chunks[-1]) < size:
            chunks[-1].append(index)
        else:
            chunks.append([index])
    for own in chunks:
        cells = [campaign.cells[i] for i in own]
        yield Chunk(own[0], tuple((cell, select(cell.request, sections)) for cell in cells), campaign.entries)


def _pack(chunk: Chunk, steps: bool, keep: Path | None) -> bytes:
    try:
        return pickle.dumps((chunk, steps, keep))
    except Exception as error:
        what = f"the run {chunk.jobs[0][0].request.run_id} cannot be sent to another process"
        raise ConfigurationError(f"{what}: {error}; use one worker") from error


def _unpack(task: bytes) -> list[RunResult] | str:
    """Carry out a task in a worker; where it cannot be read, such as without its plug-in, return why."""
    try:
        chunk, steps, keep = pickle.loads(task)
    except Exception as error:  # noqa: BLE001 - of a plug-in
        return describe_error(error)
    return _carry_out(chunk, steps, keep)


def _carry_out(chunk: Chunk, steps: bool, keep: Path | None) -> list[RunResult]:
    with offering(chunk.entries):
        return [_carry_out_run(cell, run, steps, keep) for cell, run in chunk.jobs]


def _carry_out_run(cell: Cell, run: ResolvedRun, steps: bool, keep: Path | None) -> RunResult:
    try:
        result = episode.carry_out(run, steps=steps, picture=cell.picture, keep=keep)
    except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever a plug-in does, the others go on
        return _failed(cell, CRASHED, describe_error(error))
    return RunResult({**result.row, **cell.columns}, result.steps, result.picture)


def _failed(cell: Cell, status: str, reason: str) -> RunResult:
    return RunResult({**failed_row(cell.request, status, reason), **cell.columns}, None)
