"""The lower half of the driver: blocks of runs, carried out here, in isolated processes or by an executor of others.

The runs of a block advance together, one control period after the other, where they are alike enough for that; all
others go one by one. A run has the same row either way, but for the times of its steps, which only a run that goes by
itself has.

A run that kills its process, takes too long or needs too much memory is a row; the runs before it in its block are
kept, those after it go on. Of a block that advances together, each run is carried out again by itself; so is a run that
may have suffered from an earlier one in the same process. As a block is never slower than its runs one by one, that
costs at most the time of the runs once more. The one module that imports Dask.
"""

import contextlib
import json
import logging
import math
import pickle
import re
import sys
import threading
import time
from base64 import b64decode, b64encode
from collections import deque
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from dataclasses import astuple, dataclass, replace
from functools import partial
from io import BytesIO
from itertools import groupby, islice
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Self

import numpy as np

from servobench.controllers.networks.fit import Progress
from servobench.harness.batch.isolation import (
    SILENT,
    TALKATIVE,
    Answer,
    End,
    Pool,
    Task,
    Tell,
    Work,
    Workers,
)
from servobench.harness.batch.plan import Cell
from servobench.harness.batch.processes import Bounds, Limits, available_processors, can_watch
from servobench.harness.config import registry
from servobench.harness.config.source import SourceFile, check_present_folder
from servobench.harness.run import episode
from servobench.harness.run.own_metrics import METRIC_REGISTRY
from servobench.harness.run.rehearsal import build_once
from servobench.harness.run.resolution import ResolvedRun
from servobench.harness.run.result import COMPLETED, CRASHED, LOST, Ending, RunResult, ends_batch
from servobench.plant.contract.checks import AnyArray
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.settings import REMARKS, remark
from servobench.plant.fmu.release import delayed_releases

BLOCK = 256  # [runs] that advance together: networks of more of them leave the cache of a processor
RUN_ID = "run_id"
TASKS_PER_WORKER = 2  # handed out at a time, so that no worker waits for its next task
CHUNK = 8  # [runs] one by one: a crash costs at most so many, and messages and files cost little
Packed = tuple[tuple[SourceFile, ...], bytes]  # files of users, and the rest of a task, pickled


@dataclass(frozen=True)
class Job:
    """A cell with its settings."""

    index: int  # index of the cell in its plan
    cell: Cell
    run: ResolvedRun
    kind: Hashable | None = (
        None  # runs of one kind may advance together; None: the run goes by itself
    )
    metrics: tuple[str, ...] = ()  # metrics of users, which are computed of its steps

    @property
    def owner(self) -> str:
        """Whose code the run carries out: names of plant, controller and metrics; empty for that of this package."""
        plant, controller = self.cell.request.plant, self.cell.request.controller
        foreign = registry.is_foreign_plant(
            plant, trusted=not getattr(self.run.plant, "isolate", True)
        )
        if foreign or self.metrics or registry.is_foreign_controller(controller):
            return " ".join((plant, controller, *self.metrics))
        return ""


@dataclass(frozen=True)
class Block:
    """Consecutive runs, and controllers and plants that users gave."""

    jobs: tuple[Job, ...]
    own: tuple[registry.Offer, ...] = ()
    together: bool = False  # whether the runs advance together
    fresh: bool = False  # whether they want a process in which no run has been

    def part(self, begin: int, end: int | None = None, *, fresh: bool = False) -> Self:
        """Return some of the runs as a block."""
        return replace(self, jobs=self.jobs[begin:end], fresh=fresh)


def even_size(count: int, workers: int, most: int = BLOCK) -> int:
    """Return how many of `count` runs to put into a block: at most `most`, and the same share for all workers."""
    rounds = math.ceil(count / (workers * most))
    return math.ceil(count / (workers * max(rounds, 1)))


def cut(
    jobs: Iterable[Job], size: int, chunk: int = CHUNK, own: tuple[registry.Offer, ...] = ()
) -> Iterator[Block]:
    """Yield jobs in blocks of one kind, one owner and consecutive indices.

    Args:
        jobs: the runs, in the order of their indices.
        size: at most so many runs advance together.
        chunk: at most so many runs that go one by one are in a block.
        own: controllers and plants that users gave.
    """
    for (_, kind, _), alike in groupby(
        enumerate(jobs), lambda at: (at[1].index - at[0], at[1].kind, at[1].owner)
    ):
        while gathered := tuple(job for _, job in islice(alike, chunk if kind is None else size)):
            yield Block(gathered, own, kind is not None)


def carry_out_blocks(
    blocks: Iterable[Block],
    workers: Workers,
    *,
    steps: bool = False,
    keep: Path | None = None,
    debug: bool = False,
) -> Iterator[tuple[Block, list[RunResult]]]:
    """Carry out blocks and yield each, whole or run by run, with its results as it finishes, in any order.

    Args:
        blocks: the runs; each block is asked for when a worker is about to need it.
        workers: where.
        steps: return the tables of steps too.
        keep: results folder in which trained networks are kept beside the runs.
        debug: raise the error of a run that crashes; runs stay in this process.
    """
    if workers.submit is None or debug:
        for block in blocks:
            results: list[RunResult] = []
            _carry_out(block, results.append, steps, keep, debug)
            yield block, results
        return
    waiting, again, suspects = iter(blocks), deque[Block](), deque[Block]()
    finished: SimpleQueue[tuple[Block, Any]] = SimpleQueue()
    under_way, most = 0, TASKS_PER_WORKER * workers.count
    while True:
        while under_way < most and (given := again.popleft() if again else next(waiting, None)):
            future = workers.submit(_task(_carry_out_there, given, steps, keep))
            future.add_done_callback(lambda done, block=given: finished.put((block, done)))
            under_way += 1
        if not under_way and not suspects:
            return
        if not under_way:
            again.append(suspects.popleft())  # alone: a worker may die of any of its tasks
            continue
        try:
            block, future = finished.get(timeout=LOOK_EVERY)
        except Empty:
            workers.check()
            continue
        under_way -= 1
        done, rest = _outcome(block, future, workers)
        for each in rest:
            (suspects if each.fresh and workers.lost else again).append(each)
        if done:
            yield block.part(0, len(done)), done


def _outcome(
    block: Block, future: Future[Answer | bytes], workers: Workers
) -> tuple[list[RunResult], list[Block]]:
    """Return the results of the first runs of a block, and in blocks the runs that are still to be carried out."""
    try:
        answer = _received(future)
    except workers.lost:
        answer = Answer([], _crash(LOST))
    match answer.items:
        case [{"unreadable": [str(status), str(reason), str(trace)]}] if status != COMPLETED:
            return [_failed(job, Ending(status, reason, trace)) for job in block.jobs], []
    done, end = list[RunResult](), answer.end
    try:
        done.extend(_unpacked(block.jobs, answer.items))
    except (TypeError, ValueError, RecursionError) as error:
        end = _crash(f"the answer of the run cannot be read: {error}")
    if len(answer.items) > len(block.jobs):
        done.clear()
        end = _crash(TALKATIVE)
    if len(done) == len(block.jobs):
        return done, []
    if end is None:
        end = _crash(SILENT)
    single = replace(block, together=False)
    if not done and len(block.jobs) > 1 and (block.together or workers.lost):
        return [], [single.part(at, at + 1) for at in range(len(block.jobs))]
    at = len(done)
    rest = [single.part(at + 1)] if at + 1 < len(block.jobs) else []
    if not end.certain and not block.fresh:  # a fresh block is one run, and its own second attempt
        return done, [single.part(at, at + 1, fresh=True), *rest]
    return [*done, _failed(block.jobs[at], end.ending)], rest


def _crash(reason: str) -> End:
    """Return the end of a run that may have suffered from an earlier one."""
    return End(Ending(CRASHED, reason), certain=False)


def _received(future: Future[Answer | bytes]) -> Answer:
    """Return the answer of a worker, which comes from elsewhere as one text."""
    told = future.result()
    if isinstance(told, Answer):
        return told
    return Answer(json.loads(told))


def _task(
    function: Work,
    block: Block,
    steps: bool = False,
    keep: Path | None = None,
) -> Task:
    """Return the task of a block; files of users are loaded first, so that the classes of their settings are found."""
    sources = tuple(each.source for each in block.own if each.source is not None)
    try:
        packed = pickle.dumps((sources, pickle.dumps((block, steps, keep))))
    except Exception as error:
        run_id = block.jobs[0].cell.request.run_id
        raise ConfigurationError(
            f"the run {run_id} cannot be sent to another process: {error}; use one worker"
        ) from error
    task = Task(function, packed, block.jobs[0].owner, block.fresh)
    if function is _carry_out_there:
        return replace(task, answers=len(block.jobs))
    return task


def build_block(block: Block, submit: Callable[..., Any], progress: Progress) -> None:
    """Build the run of a block in a worker and throw it away, as `build_once` does here.

    Args:
        block: one run.
        submit: of workers.
        progress: called with the finished share of a training of networks.

    Raises:
        ConfigurationError: a setting that cannot be used. If the worker ends instead, the run will say so.
    """
    refused = []

    def hear(told: object) -> None:
        match told:
            case [float(share), str(subject)]:
                progress(share, subject)
            case ["remark", str(text)]:
                remark(text)
            case str(refusal):
                refused.append(refusal)

    for item in _received(
        submit(_task(_build, block), hear)
    ).items:  # of workers elsewhere, whose answers come at once
        hear(item)
    if refused:
        raise ConfigurationError(refused[0])


def _build(packed: Packed, tell: Tell) -> None:
    """Build a run in a worker and report the training of its networks, and a wrong configuration."""
    with delayed_releases():
        try:
            block, *_ = _receive(packed)
            tell(None)
            with registry.offering(block.own):
                build_once(block.jobs[0].run, lambda share, subject: tell([float(share), subject]))
        except ConfigurationError as error:
            tell(str(error))
        for text in REMARKS:
            tell(["remark", text])


def _carry_out_there(packed: Packed, tell: Tell) -> None:
    """Carry a block out in a worker; where it cannot be read, for instance without its plug-in, report why."""
    try:
        block, steps, keep = _receive(packed)
    except Exception as error:  # noqa: BLE001 - of a plug-in
        tell({"unreadable": astuple(Ending.of(error))})
        return
    tell(None)  # the time limit begins after the imports
    with delayed_releases() as release:

        def answer(result: RunResult) -> None:
            tell(pack_result(result))
            release()

        _carry_out(block, answer, steps, keep, debug=False)


def _receive(packed: Packed) -> tuple[Block, bool, Path | None]:
    """Return the content of a task, and import its plant and controller; the row tells of one that cannot be.

    Raises:
        ConfigurationError: a class of the user's is not there where its file is imported.
    """
    sources, content = packed
    for source in sources:
        source.load()
    try:
        unpacked: tuple[Block, bool, Path | None] = pickle.loads(content)
    except AttributeError as error:
        raise ConfigurationError(
            f"a worker process lacks a class: {error}; define it above `if __name__ == '__main__':`, as workers import "
            "the file without the lines below, or compare with workers=1 and without limits"
        ) from error
    block, request = unpacked[0], unpacked[0].jobs[0].cell.request
    with registry.offering(block.own), contextlib.suppress(BaseException):
        registry.find_plant(request.plant)
        registry.find_controller(request.controller)
    return unpacked


def _carry_out(
    block: Block, tell: Callable[[RunResult], None], steps: bool, keep: Path | None, debug: bool
) -> None:
    """Carry a block out and tell the result of each run."""
    with registry.offering(block.own):
        together = []
        if block.together:
            # Where a run cannot even be built, each is carried out by itself, and the row of that run says why.
            with contextlib.suppress(Exception, SystemExit):
                together = episode.carry_out_together([job.run for job in block.jobs], keep=keep)
        for job, result in zip(block.jobs, together, strict=False):
            tell(_with_columns(job.cell, result))
        for job in block.jobs[len(together) :]:
            try:
                metrics = [METRIC_REGISTRY.find(name) for name in job.metrics]
                result = episode.carry_out(
                    job.run,
                    steps=steps,
                    picture=job.cell.picture,
                    keep=keep,
                    debug=debug,
                    metrics=metrics,
                )
            except BaseException as error:
                if debug or ends_batch(error):
                    raise
                # A plug-in may raise anything; the other runs go on
                tell(_failed(job, Ending.of(error)))
            else:
                tell(_with_columns(job.cell, result))


def _with_columns(cell: Cell, result: RunResult) -> RunResult:
    return replace(result, row={**result.row, **cell.columns})


def _failed(job: Job, ending: Ending) -> RunResult:
    return _with_columns(job.cell, RunResult.failed(episode.identity(job.run), ending))


def pack_result(result: RunResult) -> dict[str, Any]:
    """Return a result as JSON values, which a process can read without executing code of the sender."""
    steps = (
        None
        if result.steps is None
        else result.steps.drop(columns=RUN_ID, errors="ignore").to_records(index=False)
    )
    return {"row": result.row, "steps": _pack_array(steps), "picture": _pack_array(result.picture),
            "trace": result.trace}  # fmt: skip


def pack_together(items: Sequence[Any]) -> dict[str, Any]:
    """Return answers as one table of columns; empty where columns differ, or a run has steps or a picture."""
    rows = [item["row"] for item in items]
    if len(set(map(tuple, rows))) > 1 or any(item["steps"] or item["picture"] for item in items):
        return {}
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    return {"columns": columns, "traces": [item["trace"] for item in items]}


def _unpacked(jobs: Sequence[Job], items: Sequence[Any]) -> Iterator[RunResult]:
    """Return the results of runs from the answers of a worker, one for each run or one table for all of them.

    Raises:
        ValueError: the next answer is not the result of its run.
    """
    match items:
        case [{"columns": dict(columns), "traces": list(traces)}]:
            return _unpack_together(jobs, columns, traces)
    # Runs with steps, and wrong ones, are read one by one.
    with contextlib.suppress(Exception):
        return iter(list(_unpack_together(jobs, **pack_together(items))))
    return (unpack_result(job, item) for job, item in zip(jobs, items, strict=False))


def _unpack_together(
    jobs: Sequence[Job], columns: Mapping[str, Any], traces: list[Any]
) -> Iterator[RunResult]:
    from servobench.harness.batch import consistency  # noqa: PLC0415 - as below

    if not set(map(type, traces)) <= {str}:
        raise ValueError("its traces are no texts")
    _check_columns(jobs, columns)
    for job, trace, *values in zip(jobs, traces, *columns.values(), strict=True):
        row = dict(zip(columns, values, strict=True))
        if wrong := consistency.find_contradiction(row, None, job.run.run.period):
            raise ValueError(wrong)
        yield RunResult(row, None, trace=trace)


def _check_columns(jobs: Sequence[Job], columns: Mapping[str, Sequence[Any]]) -> None:
    """Refuse columns, a value for each of some runs, that are not those of the table of these runs.

    Raises:
        ValueError: names the first wrong column.
    """
    from servobench.harness.batch import tables  # noqa: PLC0415 - pandas, which workers do without

    known = _failed(jobs[0], Ending()).row
    if missing := known.keys() - columns.keys():
        raise ValueError(f"it lacks {min(missing)}")
    wanted_rows = [{**episode.wanted_columns(job.run), **job.cell.columns} for job in jobs]
    if any(row.keys() != wanted_rows[0].keys() for row in wanted_rows):
        raise ValueError("its runs have different columns")
    own = wanted_rows[0].keys() - {"robot"}
    for name in own:
        wanted_values = [row[name] for row in wanted_rows]
        if json.dumps(columns[name]) != json.dumps(wanted_values):  # NaN is NaN, but 1 not 1.0
            raise ValueError("it is that of another run")
    for name, values in columns.items():
        wanted = str if name in tables.TEXTS else float
        fit = {wanted, type(None)}
        if name in known:
            wanted = type(known[name])
            fit = {wanted}
        if name not in own and not fit.issuperset(map(type, values)):
            value = next(each for each in values if type(each) not in fit)
            raise ValueError(
                f"its {name} is {str(value)[:60]!r}, wanted a value of type {wanted.__name__}"
            )
    for name, most in tables.MOST.items():
        for value in columns.get(name, ()):
            if value is not None and (value < 0 or value > most):
                raise ValueError(f"its {name} is {value:g}")
    if wrong := tables.unfit_names(tuple(columns)):
        raise ValueError(f"it {wrong}")


def unpack_result(job: Job, told: object) -> RunResult:
    """Return the result of a run from the answer of a worker, in which code of users may have falsified anything.

    Raises:
        ValueError: it is not the result of this run.
    """
    from servobench.harness.batch import consistency, tables  # noqa: PLC0415 - as above

    match told:
        case {
            "row": dict(row), "steps": str() | None as steps, "picture": str() | None as picture, "trace": str(trace)
        }:  # fmt: skip
            pass
        case _:
            raise ValueError("it is not the result of a run")
    _check_columns([job], {name: [value] for name, value in row.items()})
    image = _unpack_array(picture)
    if image is not None and (
        image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size
    ):
        raise ValueError("its picture is no image")
    records = _unpack_array(steps)
    table = None if records is None else tables.steps_of_run(records, row[RUN_ID])
    with configuration_errors("", KeyError, TypeError):
        wrong = consistency.find_contradiction(row, table, job.run.run.period)
    if wrong:
        raise ValueError(wrong)
    return RunResult(row, table, image, trace)


def _pack_array(array: AnyArray | None) -> str | None:
    if array is None:
        return None
    content = BytesIO()
    np.save(content, array, allow_pickle=False)
    return b64encode(content.getvalue()).decode("ascii")


def _unpack_array(text: str | None) -> AnyArray | None:
    """Return the array of a text; a ValueError if it is that of none."""
    if text is None:
        return None
    with configuration_errors(
        "", EOFError, MemoryError, OverflowError, RecursionError, SyntaxError, TypeError
    ):
        array: AnyArray = np.lib.format.read_array(BytesIO(b64decode(text)), allow_pickle=False)
    return array


MAX_DEFAULT_WORKERS = 8
ABSENCE_TIME = 120.0  # [s] without any worker, after which none is awaited any more
LOOK_EVERY = 2.0  # [s] between two looks at the workers
SCHEDULER_TIMEOUT = 10.0  # [s], until a scheduler and its first worker answer
# Imported once
MODULES = ("servobench.harness.run.episode", "servobench.harness.batch.blocks", "numpy.ma")
# Held by the one task that a process of an executor carries out at a time
ONE_TASK = threading.Lock()


@contextlib.contextmanager
def open_workers(
    count: int | None = None,
    scheduler: str | Executor | None = None,
    bounds: Bounds = Bounds(),  # noqa: B008 - it is frozen
    *,
    plants: Collection[str] = (),
    controllers: Collection[str] = (),
    own: Sequence[registry.Offer] = (),
    trusted: Collection[str] = (),
    steps: bool = False,
) -> Iterator[Workers]:
    """Yield workers; their processes start with the first task and end with the context.

    Args:
        count: number of processes on this machine; with 1, methods of this package on its plants are carried out in
            this process unless a limit is given. None for the number of processors. With an executor, the number of
            its workers.
        scheduler: address of a Dask scheduler, such as "tcp://127.0.0.1:8786", or an executor whose workers are
            processes with servobench; None for processes of this machine.
        bounds: resources of a run.
        plants: names of the plants of the runs.
        controllers: names of the controllers.
        own: controllers and plants that users gave.
        trusted: names of FMUs that may share a process with the code of this package.
        steps: whether runs return their tables of steps, for which workers import pandas once, as for code of users.

    Raises:
        ConfigurationError: Dask is not installed, its scheduler does not answer or has no workers, a limit is asked
            for elsewhere, or an executor has threads.
    """
    if isinstance(scheduler, str) and count is not None:
        raise ConfigurationError(
            "--workers are processes of this machine; with --scheduler the cluster has its own"
        )
    count = count or min(MAX_DEFAULT_WORKERS, available_processors())
    if scheduler is not None:
        if bounds.run_timeout is not None or bounds.run_memory is not None:
            raise ConfigurationError(
                "limits of time and memory are for processes of this machine, not for a cluster"
            )
        place = (
            _open_cluster(scheduler)
            if isinstance(scheduler, str)
            else contextlib.nullcontext(scheduler)
        )
        try:
            with place as executor:
                yield _workers_of(executor, count)
        except (BrokenExecutor, CancelledError) as error:
            again = (
                " with --resume (if it has it)"
                if isinstance(scheduler, str)
                else " with out and resume=True"
            )
            raise ConfigurationError(
                f"the workers ended: {str(error).rstrip('.') or 'no scheduler answers'}; finished runs are kept, and "
                f"the same call{again} carries out the others; on this machine a run that kills its process is a row"
            ) from error
        return
    foreign = any(registry.is_foreign_plant(name, trusted=name in trusted) for name in plants)
    foreign |= any(map(registry.is_foreign_controller, controllers))
    foreign |= any(each.word == "metric" for each in own)
    limits = bounds.limits(count, foreign=foreign and bounds.isolate and registry.can_travel(own))
    if count == 1 and limits == Limits():
        yield Workers()
        return
    check_present_folder()
    if limits.memory < math.inf and not can_watch():
        remark(
            "the memory and the processes of a run cannot be watched here, only its time: /proc does not say them"
        )
    modules = [*MODULES, *registry.own_modules(plants, controllers)]
    if steps or foreign:
        modules.append("pandas")
    pool = Pool(count, limits, modules)
    try:
        yield Workers(pool.submit, count)
    finally:
        pool.stop()


@contextlib.contextmanager
def _open_cluster(scheduler: str) -> Iterator[Executor]:
    if not re.fullmatch(r"(?:[a-z]+://)?\S+:\d+", scheduler):
        raise ConfigurationError(
            f"--scheduler needs an address such as tcp://127.0.0.1:8786, got {scheduler!r}"
        )
    import asyncio  # noqa: PLC0415 - a batch on this machine does without

    from distributed import Client  # noqa: PLC0415 - only the extra cluster brings it

    # It reports the end of a scheduler with traces
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        asyncio.run(_call(scheduler))
        client = Client(scheduler, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
    except (
        OSError,
        ValueError,
        TypeError,
        MemoryError,
    ) as error:  # the bytes of another program may pass for a size
        raise ConfigurationError(
            f"the scheduler {scheduler} does not answer; start one with `dask scheduler --host 127.0.0.1` and name "
            "its address"
        ) from error
    with contextlib.closing(client):
        try:
            client.wait_for_workers(1, timeout=SCHEDULER_TIMEOUT)
        except TimeoutError as error:
            raise ConfigurationError(
                f"the scheduler {scheduler} has no workers; start some with `dask worker {scheduler} --nthreads 1`"
            ) from error
        yield client.get_executor(pure=False)


async def _call(scheduler: str) -> None:
    """Connect to a scheduler once: a client that cannot connect would go on trying while it is destroyed."""
    import distributed  # noqa: PLC0415 - as above

    link = await distributed.comm.connect(scheduler, timeout=SCHEDULER_TIMEOUT)
    await link.close()


def _workers_of(executor: Executor, count: int) -> Workers:
    """Return the workers of an executor, `count` where it does not say how many it has."""
    if isinstance(executor, ThreadPoolExecutor):
        raise ConfigurationError(
            "an executor must have processes: threads would share the state of solvers and files"
        )
    lost: tuple[type[BaseException], ...] = ()
    check = Workers.check
    if (dask := sys.modules.get("distributed")) and isinstance(
        executor, dask.cfexecutor.ClientExecutor
    ):
        count, lost = sum(executor._client.nthreads().values()) or count, (dask.KilledWorker,)
        check = partial(_check_presence, executor._client, [])
    count = getattr(executor, "_max_workers", None) or count
    return Workers(
        lambda task, _hear=None: executor.submit(_gather, task),
        count,
        cluster=True,
        lost=lost,
        check=check,
    )


def _check_presence(client: Any, seen: list[float]) -> None:  # noqa: ANN401 - of Dask
    """Refuse to wait for workers that were there and have been away for long; `seen` keeps when they were there."""
    now = time.monotonic()
    with contextlib.suppress(OSError, RuntimeError, ValueError):  # futures tell of a lost scheduler
        if client.nthreads():
            seen[:] = [now]
    if seen and now - seen[0] > ABSENCE_TIME:
        raise BrokenExecutor(f"none has come back for {ABSENCE_TIME:g} s")


def _gather(task: Task) -> bytes:
    """Carry a task out elsewhere; its answers travel as one table. Threads of a process take turns."""
    items = []
    with ONE_TASK:
        task.carry_out(lambda item: None if item is None else items.append(item))
    if task.answers == len(items) > 1 and (table := pack_together(items)):
        items = [table]
    return json.dumps(items).encode()
