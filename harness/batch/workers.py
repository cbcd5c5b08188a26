"""Where runs are carried out: in this process, in worker processes of this machine, or on a Dask cluster.

The one module that imports Dask.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any, Final

from servobench.harness.batch.processes import Bounds, Limits
from servobench.harness.batch.sandbox import POSSIBLE, Answer, Pool, Task, Workers
from servobench.harness.config.registry import Offer, is_foreign_controller, is_foreign_plant, own_modules
from servobench.harness.config.settings import ConfigurationError

MAX_DEFAULT_WORKERS: Final = 8
SCHEDULER_TIMEOUT: Final = 10.0  # [s], until a scheduler and its first worker answer
MODULES: Final = ("servobench.harness.run.episode", "servobench.harness.batch.blocks")  # that a worker imports once


def default_workers() -> int:
    """Return the number of worker processes that are used where none is given."""
    if not POSSIBLE:
        return 1
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(MAX_DEFAULT_WORKERS, available)


def can_travel(own: Sequence[Offer]) -> bool:
    """Return whether a worker process can receive controllers that users gave."""
    try:
        pickle.dumps(own)
    except Exception:  # noqa: BLE001 - code of users may raise anything
        return False
    return True


@contextlib.contextmanager
def open_workers(
    count: int | None = None,
    scheduler: str | None = None,
    bounds: Bounds = Bounds(),  # noqa: B008 - it is frozen
    *,
    plants: Iterable[str] = (),
    controllers: Iterable[str] = (),
    own: Sequence[Offer] = (),
    trusted: Collection[str] = (),
) -> Iterator[Workers]:
    """Yield workers; their processes start with the first task and end with the context.

    Args:
        count: number of processes on this machine; with 1, methods of this package on its plants are carried out in
            this process unless a limit is given. None for the number of processors.
        scheduler: address of a Dask scheduler, such as "tcp://127.0.0.1:8786"; None for processes of this machine.
        bounds: resources of a run.
        plants: names of the plants of the runs.
        controllers: names of the controllers.
        own: controllers and plants that users gave.
        trusted: names of FMUs that may share a process with the code of this package.

    Raises:
        ConfigurationError: Dask is not installed, its scheduler does not answer or has no workers, or a limit is asked
            for on a cluster.
    """
    if scheduler is not None and count is not None:
        raise ConfigurationError("--workers are processes of this machine; with --scheduler the cluster has its own")
    count = count or default_workers()
    if scheduler is not None:
        for option, value in (("--run-timeout", bounds.run_timeout), ("--run-memory", bounds.run_memory)):
            if value is not None:
                raise ConfigurationError(f"{option} works with processes of this machine only, not with --scheduler")
        with _open_cluster(scheduler) as workers:
            yield workers
        return
    plants, controllers = tuple(plants), tuple(controllers)
    foreign = any(is_foreign_plant(name, trusted=name in trusted) for name in plants)
    foreign = foreign or any(map(is_foreign_controller, controllers))
    limits = bounds.limits(count, foreign=foreign and bounds.isolate and can_travel(own))
    if not POSSIBLE and (count > 1 or bounds.run_timeout is not None or bounds.run_memory is not None):
        raise ConfigurationError("worker processes and limits of runs need a system that can copy processes: use Linux")
    if not POSSIBLE or (count == 1 and limits == Limits()):
        yield Workers()
        return
    pool = Pool(count, limits, (*MODULES, *own_modules(plants, controllers)))
    try:
        yield Workers(pool.submit, count)
    finally:
        pool.stop()


@contextlib.contextmanager
def _open_cluster(scheduler: str) -> Iterator[Workers]:
    if not re.fullmatch(r"(?:[a-z]+://)?\S+:\d+", scheduler):
        raise ConfigurationError(f"--scheduler needs an address such as tcp://127.0.0.1:8786, got {scheduler!r}")
    from distributed import Client, KilledWorker  # noqa: PLC0415 - only the extra cluster brings it

    try:
        client = Client(scheduler, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigurationError(
            f"the scheduler {scheduler} does not answer; start one with `dask scheduler --host 127.0.0.1` and name "
            "its address"
        ) from error
    try:
        try:
            client.wait_for_workers(1, timeout=SCHEDULER_TIMEOUT)
        except TimeoutError as error:
            raise ConfigurationError(
                f"the scheduler {scheduler} has no workers; start some with `dask worker {scheduler} --nthreads 1`"
            ) from error

        def submit(task: Task) -> Any:  # noqa: ANN401 - a future
            return client.submit(_gather, task, pure=False)

        threads = sum(client.nthreads().values())
        yield Workers(submit, threads, cluster=True, lost=(KilledWorker,))
    finally:
        client.close()


def _gather(task: Task) -> Answer:
    """Carry a task out on a cluster."""
    answer = Answer()
    task.carry_out(lambda item: None if item is None else answer.items.append(item))
    return answer
