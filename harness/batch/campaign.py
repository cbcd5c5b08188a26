"""The one driver of all batches: runs into one results folder, resumable, with every failure of a run as a row.

`compare`, `sweep`, `robustness` and `claims` are campaigns; `tune` uses the lower half, `carry_out_chunks`. Runs go to
workers in chunks. Each finished chunk becomes a part of the results folder, written by this process; what is there
counts. A campaign that is resumed carries out the runs that are missing, so that its tables are those of an undisturbed
one, wall-clock columns aside.

A run that kills its process (an FMU may), or takes longer than the time limit, becomes a row that says so. If it was
one of a chunk, the runs of that chunk are carried out again one by one, so that the others are not lost.
"""

from __future__ import annotations

import hashlib
import json
import pickle
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final

from servobench.controllers.controller import ControllerEntry
from servobench.harness.batch import results
from servobench.harness.batch.compare import Batch, check_batch
from servobench.harness.batch.manifest import describe_batch
from servobench.harness.batch.workers import Workers, open_workers
from servobench.harness.config.registry import offering
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.harness.run.episode import RunResult, crashed_row, run_experiment
from servobench.harness.run.request import RunRequest

CHUNK: Final = 8  # [runs] without steps; a crash costs at most so many, and messages and files cost little
LOST: Final = "the run killed the process that carried it out"
TIMED_OUT: Final = "timed_out"
Row = dict[str, Any]


@dataclass(frozen=True)
class Cell:
    """A run and its further columns in the table of runs.

    Attributes:
        request: the run.
        columns: names and values, such as the place along the axis that a sweep varies.
        picture: keep what the camera saw last.
    """

    request: RunRequest
    columns: Mapping[str, Any] = field(default_factory=dict)
    picture: bool = False


@dataclass(frozen=True)
class Chunk:
    """Consecutive runs with common settings.

    Attributes:
        index: of the first run.
        cells: the runs.
        settings: overrides of the defaults.
        entries: controllers that the registry does not know.
    """

    index: int
    cells: tuple[Cell, ...]
    settings: Settings
    entries: tuple[ControllerEntry, ...] = ()

    def singly(self) -> list[Chunk]:
        """Return each run as a chunk of its own."""
        return [Chunk(self.index + i, (cell,), self.settings, self.entries) for i, cell in enumerate(self.cells)]


@dataclass(frozen=True)
class Campaign:
    """Runs that share their settings and end in one results folder.

    Attributes:
        cells: the runs, in the order of the table.
        settings: overrides of the defaults.
        steps: keep the table of steps too.
        entries: controllers that the registry does not know.
    """

    cells: Sequence[Cell]
    settings: Settings
    steps: bool = False
    entries: tuple[ControllerEntry, ...] = ()


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


def carry_out(
    campaign: Campaign,
    folder: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    run_timeout: float | None = None,
    resume: bool = False,
    observer: Observer | None = None,
) -> None:
    """Check and carry out the runs of a campaign and put its tables together.

    Ctrl-C raises KeyboardInterrupt; finished runs are kept, and the same call with `resume` continues.

    Args:
        campaign: the runs.
        folder: new folder for the results; with `resume` one that holds those of the same campaign.
        workers: number of processes; None for the number of processors.
        scheduler: address of a Dask scheduler; None for processes of this machine.
        run_timeout: [s] time limit of a run; None for no limit.
        resume: carry out what is missing in the folder.
        observer: receives the progress.

    Raises:
        ConfigurationError: a campaign that cannot be carried out, or a folder that cannot be used.
    """
    watcher = observer or Observer()
    with offering(campaign.entries):
        check_campaign(campaign, watcher)
        manifest = describe_campaign(campaign)
    if resume:
        results.read_manifest(folder)
    names = {"plants": manifest["plants"], "controllers": manifest["controllers"]}
    with open_workers(workers, scheduler, run_timeout, **names) as place, results.locked(folder, new=not resume):
        if resume:
            check_same_campaign(folder, manifest, watcher)
        else:
            results.create_folder(folder, manifest)
        if (folder / results.PARTS).is_dir():
            done = results.finished_runs(folder)
            watcher.begin(len(campaign.cells), len(done))
            chunks = _missing_chunks(campaign, done, single=campaign.steps or run_timeout is not None)
            keep = folder if campaign.steps and place.local else None
            for chunk, outcome in carry_out_chunks(chunks, place, steps=campaign.steps, keep=keep):
                results.write_part(folder, chunk.index, outcome)
                watcher.finished([result.row for result in outcome])
        results.collect(folder)


def check_campaign(campaign: Campaign, observer: Observer) -> None:
    """Refuse what cannot be run, before anything is written; networks that are needed are trained.

    Raises:
        ConfigurationError: a name, setting or mismatch that cannot be used, or a run that is asked for twice.
    """
    by_condition: dict[tuple[float, int | None], list[RunRequest]] = {}
    seen: set[str] = set()
    for request in (cell.request for cell in campaign.cells):
        if request.run_id in seen:
            raise ConfigurationError(f"the run {request.run_id} is asked for twice")
        seen.add(request.run_id)
        by_condition.setdefault((request.noise_factor, request.latency_periods), []).append(request)
    for (noise, latency), requests in by_condition.items():
        check_batch(Batch.around(requests), campaign.settings, observer.training, noise, latency)


def describe_campaign(campaign: Campaign) -> dict[str, Any]:
    """Return the manifest: that of a batch, the number of runs, and a digest by which `resume` recognises them."""
    manifest = describe_batch([cell.request for cell in campaign.cells], campaign.settings)
    identity = {
        "runs": [cell.request.run_id for cell in campaign.cells],
        "configuration": manifest["configuration"],
        **({"steps": True} if campaign.steps else {}),
    }
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode()).hexdigest()
    return {**manifest, "run_count": len(campaign.cells), "campaign": digest}


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
            future = workers.submit(_unpack, pickle.dumps((chunk, steps, keep)))
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
        results_of_chunk: list[RunResult] = future.result()
    except workers.lost:
        status, reason = "crashed", LOST
    except TimeoutError:
        status, reason = TIMED_OUT, f"the run took longer than {workers.run_timeout:g} s"
    except BrokenProcessPool as error:
        raise ConfigurationError(
            "the worker processes cannot be started; a script that starts several must keep its calls below "
            "`if __name__ == '__main__':`"
        ) from error
    else:
        return results_of_chunk
    return [_failed(chunk.cells[0], status, reason)] if len(chunk.cells) == 1 else None


def _missing_chunks(campaign: Campaign, done: set[int], *, single: bool) -> list[Chunk]:
    """Return the runs that are not in `done` in chunks of consecutive runs."""
    size = 1 if single else CHUNK
    chunks: list[list[int]] = []
    for index in (i for i in range(len(campaign.cells)) if i not in done):
        if chunks and chunks[-1][-1] == index - 1 and len(chunks[-1]) < size:
            chunks[-1].append(index)
        else:
            chunks.append([index])
    return [Chunk(own[0], tuple(campaign.cells[i] for i in own), campaign.settings, campaign.entries) for own in chunks]


def _unpack(task: bytes) -> list[RunResult]:
    """Carry out a task in a worker; what cannot be read there must not kill it."""
    return _carry_out(*pickle.loads(task))


def _carry_out(chunk: Chunk, steps: bool, keep: Path | None) -> list[RunResult]:
    with offering(chunk.entries):
        return [_carry_out_run(cell, chunk.settings, steps, keep) for cell in chunk.cells]


def _carry_out_run(cell: Cell, settings: Settings, steps: bool, keep: Path | None) -> RunResult:
    try:
        result = run_experiment(cell.request, settings, steps=steps, picture=cell.picture, keep=keep)
    except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever a plug-in does, the others go on
        return _failed(cell, "crashed", f"{type(error).__name__}: {' '.join(str(error).split())}")
    return RunResult({**result.row, **cell.columns}, result.steps, result.picture)


def _failed(cell: Cell, status: str, reason: str) -> RunResult:
    row = {**crashed_row(cell.request, reason), "status": status, **cell.columns}
    return RunResult(row, None)
