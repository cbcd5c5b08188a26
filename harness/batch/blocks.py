"""The lower half of the driver: blocks of runs, carried out in this process or by workers.

The runs of a block advance together, one control period after the other, where they are alike enough for that; all
others go one by one. A run has the same row either way, but for the times of its steps, which only a run that goes by
itself has.

A block that kills its process (an FMU may) is carried out again run by run, so that only the run that did it is lost;
so is a block that takes longer than the time limit of a single run. As a block is never slower than its runs one by
one, that costs at most the time of the runs once more.
"""

from __future__ import annotations

import contextlib
import math
import pickle
from collections import deque
from collections.abc import Hashable, Iterable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final

from servobench.harness.batch.workers import Workers
from servobench.harness.config.own import OwnController
from servobench.harness.config.registry import offering
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run import episode
from servobench.harness.run.ending import CRASHED, TIMED_OUT, Ending
from servobench.harness.run.episode import RunResult, failed
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolved import ResolvedRun

BLOCK: Final = 128  # [runs] that advance together: more of them leave the cache of a processor
CHUNK: Final = 8  # [runs] one by one: a crash costs at most so many, and messages and files cost little
LOST: Final = "the run killed the process that carried it out"


@dataclass(frozen=True)
class Cell:
    """A run and its further columns in the table of runs."""

    request: RunRequest
    columns: Mapping[str, Any] = field(default_factory=dict)  # such as the place along the axis that a sweep varies
    picture: bool = False  # keep what the camera saw last


@dataclass(frozen=True)
class Job:
    """A cell with its settings."""

    index: int  # of the cell in its plan
    cell: Cell
    run: ResolvedRun
    kind: Hashable | None = None  # runs of one kind may advance together; None: the run goes by itself


@dataclass(frozen=True)
class Block:
    """Consecutive runs, and controllers that users gave."""

    jobs: tuple[Job, ...]
    own: tuple[OwnController, ...] = ()
    together: bool = False  # whether the runs advance together

    @property
    def index(self) -> int:
        """Index of the first run."""
        return self.jobs[0].index

    def singly(self) -> list[Block]:
        """Return each run as a block of its own."""
        return [Block((job,), self.own) for job in self.jobs]


def even_size(count: int, workers: int, most: int = BLOCK) -> int:
    """Return how many of `count` runs to put into a block: at most `most`, and the same share for all workers."""
    rounds = math.ceil(count / (workers * most))
    return math.ceil(count / (workers * max(rounds, 1)))


def cut(jobs: Iterable[Job], size: int, chunk: int = CHUNK, own: tuple[OwnController, ...] = ()) -> Iterator[Block]:
    """Yield jobs in blocks of one kind and consecutive indices.

    Args:
        jobs: the runs, in the order of their indices.
        size: at most so many runs advance together.
        chunk: at most so many runs that go one by one are in a block.
        own: controllers that users gave.
    """
    gathered: list[Job] = []
    for job in jobs:
        most = chunk if job.kind is None else size
        last = gathered[-1] if gathered else job
        if gathered and (len(gathered) >= most or job.index != last.index + 1 or job.kind != last.kind):
            yield Block(tuple(gathered), own, last.kind is not None)
            gathered = []
        gathered.append(job)
    if gathered:
        yield Block(tuple(gathered), own, gathered[0].kind is not None)


def carry_out_blocks(
    blocks: Iterable[Block], workers: Workers, *, steps: bool = False, keep: Path | None = None, debug: bool = False
) -> Iterator[tuple[Block, list[RunResult]]]:
    """Carry out blocks and yield each, whole or run by run, with its results as it finishes, in any order.

    Args:
        blocks: the runs; each block is asked for when a worker is about to need it.
        workers: where.
        steps: return the tables of steps too.
        keep: results folder in which trained networks are kept beside the runs.
        debug: raise what makes a run crash; runs stay in this process.
    """
    if workers.submit is None or debug:
        for block in blocks:
            yield block, _carry_out(block, steps, keep, debug)
        return
    waiting, again = iter(blocks), deque[Block]()
    finished: SimpleQueue[tuple[Block, Any]] = SimpleQueue()
    under_way = 0
    while True:
        while under_way < workers.window and (task := again.popleft() if again else next(waiting, None)):
            future = workers.submit(_unpack, _pack(task, steps, keep))
            future.add_done_callback(lambda done, task=task: finished.put((task, done)))
            under_way += 1
        if not under_way:
            return
        block, future = finished.get()
        under_way -= 1
        outcome = _outcome(block, future, workers)
        if outcome is None:
            again.extend(block.singly())
        else:
            yield block, outcome


def _outcome(block: Block, future: Any, workers: Workers) -> list[RunResult] | None:  # noqa: ANN401 - of pebble or Dask
    """Return the results of a block; None if it died with several runs, which are to be carried out one by one."""
    try:
        answer: list[RunResult] | Ending = future.result()
    except workers.lost:
        answer = Ending(CRASHED, LOST)
    except TimeoutError:
        answer = Ending(TIMED_OUT, f"the run took longer than {workers.run_timeout:g} s")
    except BrokenProcessPool as error:
        raise ConfigurationError(
            "the worker processes cannot be started; a script that starts several must keep its calls below "
            "`if __name__ == '__main__':`"
        ) from error
    if not isinstance(answer, Ending):
        return answer
    return [_failed(block.jobs[0].cell, answer)] if len(block.jobs) == 1 else None


def _pack(block: Block, steps: bool, keep: Path | None) -> bytes:
    sources = tuple(each.source for each in block.own if each.source is not None)
    try:
        return pickle.dumps((sources, pickle.dumps((block, steps, keep))))
    except Exception as error:
        what = f"the run {block.jobs[0].cell.request.run_id} cannot be sent to another process"
        raise ConfigurationError(f"{what}: {error}; use one worker") from error


def _unpack(task: bytes) -> list[RunResult] | Ending:
    """Carry out a task in a worker; where it cannot be read, such as without its plug-in, return why."""
    try:
        sources, content = pickle.loads(task)
        for source in sources:
            source.load()  # so that the classes of its settings are found
        block, steps, keep = pickle.loads(content)
    except Exception as error:  # noqa: BLE001 - of a plug-in
        return Ending.of(error)
    return _carry_out(block, steps, keep)


def _carry_out(block: Block, steps: bool, keep: Path | None, debug: bool = False) -> list[RunResult]:
    with offering(block.own):
        if block.together:
            # Where a run cannot even be built, each is carried out by itself, and the row of that run says why.
            with contextlib.suppress(Exception, SystemExit):
                together = episode.carry_out_together([job.run for job in block.jobs], keep=keep)
                return [_with_columns(job.cell, result) for job, result in zip(block.jobs, together, strict=True)]
        return [_carry_out_run(job, steps, keep, debug) for job in block.jobs]


def _carry_out_run(job: Job, steps: bool, keep: Path | None, debug: bool) -> RunResult:
    try:
        result = episode.carry_out(job.run, steps=steps, picture=job.cell.picture, keep=keep, debug=debug)
    except (Exception, SystemExit) as error:
        if debug:
            raise
        return _failed(job.cell, Ending.of(error))  # whatever a plug-in does, the others go on
    return _with_columns(job.cell, result)


def _with_columns(cell: Cell, result: RunResult) -> RunResult:
    return replace(result, row={**result.row, **cell.columns})


def _failed(cell: Cell, ending: Ending) -> RunResult:
    return _with_columns(cell, failed(cell.request, ending))
