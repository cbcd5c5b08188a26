"""The lower half of the driver: blocks of runs, carried out in this process or by workers.

The runs of a block advance together, one control period after the other, where they are alike enough for that; all
others go one by one. A run has the same row either way, but for the times of its steps, which only a run that goes by
itself has.

A run that kills its process, takes too long or needs too much memory is a row; the runs before it in its block are
kept, those after it go on. Of a block that advances together, each run is carried out again by itself; so is a run that
may have suffered from an earlier one in the same process. As a block is never slower than its runs one by one, that
costs at most the time of the runs once more.
"""

from __future__ import annotations

import contextlib
import math
import pickle
from collections import deque
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final

from servobench.controllers.networks.fit import Progress
from servobench.harness.batch.guard import LOST, End, Task, Tell
from servobench.harness.batch.plan import Cell
from servobench.harness.batch.pool import Answer
from servobench.harness.batch.workers import Workers
from servobench.harness.config.registry import (
    Offer,
    find_controller,
    find_plant,
    is_foreign_controller,
    is_foreign_plant,
    offering,
)
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run import episode
from servobench.harness.run.experiment import build_once
from servobench.harness.run.resolution import ResolvedRun
from servobench.harness.run.result import CRASHED, Ending, RunResult, ends_batch

BLOCK: Final = 128  # [runs] that advance together: more of them leave the cache of a processor
CHUNK: Final = 8  # [runs] one by one: a crash costs at most so many, and messages and files cost little


@dataclass(frozen=True)
class Job:
    """A cell with its settings."""

    index: int  # of the cell in its plan
    cell: Cell
    run: ResolvedRun
    kind: Hashable | None = None  # runs of one kind may advance together; None: the run goes by itself

    @property
    def owner(self) -> str:
        """Whose code the run carries out: the names of its plant and controller; empty for that of this package."""
        plant, controller = self.cell.request.plant, self.cell.request.controller
        foreign = is_foreign_plant(plant, trusted=not getattr(self.run.plant, "isolate", True))
        return f"{plant} {controller}" if foreign or is_foreign_controller(controller) else ""


@dataclass(frozen=True)
class Block:
    """Consecutive runs, and controllers and plants that users gave."""

    jobs: tuple[Job, ...]
    own: tuple[Offer, ...] = ()
    together: bool = False  # whether the runs advance together
    fresh: bool = False  # whether they want a process in which no run has been

    @property
    def index(self) -> int:
        """Index of the first run."""
        return self.jobs[0].index

    def singly(self) -> list[Block]:
        """Return each run as a block of its own."""
        return [replace(self, jobs=(job,), together=False) for job in self.jobs]

    def part(self, begin: int, end: int | None = None, *, fresh: bool = False) -> Block:
        """Return some of the runs as a block."""
        return replace(self, jobs=self.jobs[begin:end], fresh=fresh)


def even_size(count: int, workers: int, most: int = BLOCK) -> int:
    """Return how many of `count` runs to put into a block: at most `most`, and the same share for all workers."""
    rounds = math.ceil(count / (workers * most))
    return math.ceil(count / (workers * max(rounds, 1)))


def cut(jobs: Iterable[Job], size: int, chunk: int = CHUNK, own: tuple[Offer, ...] = ()) -> Iterator[Block]:
    """Yield jobs in blocks of one kind, one owner and consecutive indices.

    Args:
        jobs: the runs, in the order of their indices.
        size: at most so many runs advance together.
        chunk: at most so many runs that go one by one are in a block.
        own: controllers and plants that users gave.
    """
    gathered: list[Job] = []
    for job in jobs:
        most = chunk if job.kind is None else size
        last = gathered[-1] if gathered else job
        follows = job.index == last.index + 1 and job.kind == last.kind and job.owner == last.owner
        if gathered and (len(gathered) >= most or not follows):
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
            results: list[RunResult] = []
            _carry_out(block, results.append, steps, keep, debug)
            yield block, results
        return
    waiting, again = iter(blocks), deque[Block]()
    finished: SimpleQueue[tuple[Block, Any]] = SimpleQueue()
    under_way = 0
    while True:
        while under_way < workers.window and (given := again.popleft() if again else next(waiting, None)):
            packed = _pack(given, steps, keep)
            future = workers.submit(Task(_carry_out_packed, packed, given.jobs[0].owner, given.fresh))
            future.add_done_callback(lambda done, block=given: finished.put((block, done)))
            under_way += 1
        if not under_way:
            return
        block, future = finished.get()
        under_way -= 1
        done, rest = _outcome(block, future, workers)
        again.extend(rest)
        if done:
            yield block.part(0, len(done)), done


def _outcome(block: Block, future: Any, workers: Workers) -> tuple[list[RunResult], list[Block]]:  # noqa: ANN401 - or Dask's
    """Return the results of the first runs of a block, and in blocks the runs that are still to be carried out."""
    try:
        answer: Answer = future.result()
    except workers.lost:
        answer = Answer([], End(Ending(CRASHED, LOST), certain=True))
    done, end = list(answer.items), answer.end
    if done and isinstance(done[0], Ending):
        return [_failed(job.cell, done[0]) for job in block.jobs], []
    if end is None:
        return done, []
    if not done and len(block.jobs) > 1 and block.together:
        return [], block.singly()
    single = replace(block, together=False)
    rest = single.part(len(done), fresh=True)
    if not end.certain and not (block.fresh and len(block.jobs) == 1):
        return done, rest.singly() if end.alone else [rest]
    done.append(_failed(block.jobs[len(done)].cell, end.ending))
    return done, [single.part(len(done))] if len(done) < len(block.jobs) else []


def _pack(block: Block, steps: bool, keep: Path | None) -> bytes:
    sources = tuple(each.source for each in block.own if each.source is not None)
    try:
        return pickle.dumps((sources, pickle.dumps((block, steps, keep))))
    except Exception as error:
        what = f"the run {block.jobs[0].cell.request.run_id} cannot be sent to another process"
        raise ConfigurationError(f"{what}: {error}; use one worker") from error


def build_block(block: Block, workers: Workers, progress: Progress) -> None:
    """Build the run of a block in a worker and throw it away, as `build_once` does here.

    Args:
        block: one run.
        workers: processes of this machine.
        progress: called with the share of a training of networks that is done.

    Raises:
        ConfigurationError: a setting that cannot be used. If the worker ends instead, the run will say so.
    """
    refused: list[str] = []

    def hear(told: tuple[float, str] | str) -> None:
        if isinstance(told, str):
            refused.append(told)
        else:
            progress(*told)

    if workers.submit is None:
        raise ValueError("workers must have processes, got none")
    workers.submit(Task(_build, _pack(block, False, None), block.jobs[0].owner), hear).result()
    if refused:
        raise ConfigurationError(refused[0])


def _build(task: bytes, tell: Tell) -> None:
    """Build a run in a worker and tell how far its networks are trained, and what is configured wrongly."""
    block, *_ = _unpack(task)
    with offering(block.own):
        _load(block)
        tell(None)
        try:
            build_once(block.jobs[0].run, lambda share, what: tell((share, what)))
        except ConfigurationError as error:
            tell(str(error))


def _carry_out_packed(task: bytes, tell: Tell) -> None:
    """Carry a block out in a worker; where it cannot be read, such as without its plug-in, tell why."""
    try:
        block, steps, keep = _unpack(task)
    except Exception as error:  # noqa: BLE001 - of a plug-in
        tell(Ending.of(error))
        return
    with offering(block.own):
        _load(block)
    tell(None)  # the time limit begins after what is imported once
    _carry_out(block, tell, steps, keep)


def _unpack(task: bytes) -> tuple[Block, bool, Path | None]:
    sources, content = pickle.loads(task)
    for source in sources:
        source.load()  # so that the classes of its settings are found
    unpacked: tuple[Block, bool, Path | None] = pickle.loads(content)
    return unpacked


def _load(block: Block) -> None:
    """Import the plant and the controller of a block; of one that cannot be imported the row tells."""
    request = block.jobs[0].cell.request
    with contextlib.suppress(BaseException):
        find_plant(request.plant)
        find_controller(request.controller)


def _carry_out(block: Block, tell: Tell, steps: bool, keep: Path | None, debug: bool = False) -> None:
    """Carry a block out and tell the result of each run."""
    with offering(block.own):
        together: list[RunResult] = []
        if block.together:
            # Where a run cannot even be built, each is carried out by itself, and the row of that run says why.
            with contextlib.suppress(Exception, SystemExit):
                together = episode.carry_out_together([job.run for job in block.jobs], keep=keep)
        for job, result in zip(block.jobs, together, strict=False):
            tell(_with_columns(job.cell, result))
        for job in block.jobs[len(together) :]:
            tell(_carry_out_run(job, steps, keep, debug))


def _carry_out_run(job: Job, steps: bool, keep: Path | None, debug: bool) -> RunResult:
    try:
        result = episode.carry_out(job.run, steps=steps, picture=job.cell.picture, keep=keep, debug=debug)
    except BaseException as error:
        if debug or ends_batch(error):
            raise
        return _failed(job.cell, Ending.of(error))  # whatever a plug-in does, the others go on
    return _with_columns(job.cell, result)


def _with_columns(cell: Cell, result: RunResult) -> RunResult:
    return replace(result, row={**result.row, **cell.columns})


def _failed(cell: Cell, ending: Ending) -> RunResult:
    return _with_columns(cell, RunResult.failed(episode.identity(cell.request), ending))
