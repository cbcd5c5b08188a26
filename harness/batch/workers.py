"""Where runs are carried out: in this process, in worker processes of this machine, or on a Dask cluster.

The one module that imports pebble and Dask. A pool of pebble replaces a single process that died, or that had to be
ended because its task took too long; the other tasks are not affected.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.synchronize import Semaphore
from threading import Event
from typing import Any, Final

from pebble import ProcessExpired, ProcessPool

from servobench.harness.config.own import OwnController
from servobench.harness.config.registry import find_controller, find_plant
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.config.source import SourceFile

MAX_DEFAULT_WORKERS: Final = 8
SCHEDULER_TIMEOUT: Final = 10.0  # [s], until a scheduler and its first worker answer
MAX_START_TIME: Final = 10.0  # [s], that a process may take to start before it is stopped all the same
TASKS_PER_WORKER: Final = 2  # handed out at a time, so that no worker waits for its next task


@dataclass(frozen=True)
class Workers:
    """A place where runs are carried out."""

    submit: Callable[..., Any] | None = None  # as `submit` of an executor; None: runs stay in this process
    count: int = 1  # number of tasks that are carried out at a time
    lost: tuple[type[BaseException], ...] = ()  # what a future raises if the process that carried out its task died
    run_timeout: float | None = None  # [s] time limit of a task; None for no limit

    @property
    def window(self) -> int:
        """How many tasks are handed out at a time."""
        return TASKS_PER_WORKER * self.count

    @property
    def local(self) -> bool:
        """Whether all runs happen on this machine, where they can read and write its files."""
        return self.submit is None or ProcessExpired in self.lost


def default_workers() -> int:
    """Return the number of worker processes that are used where none is given."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(MAX_DEFAULT_WORKERS, available)


@contextlib.contextmanager
def open_workers(
    count: int | None = None,
    scheduler: str | None = None,
    run_timeout: float | None = None,
    *,
    plants: Iterable[str] = (),
    controllers: Iterable[str] = (),
    own: Sequence[OwnController] = (),
) -> Iterator[Workers]:
    """Yield workers; their processes start with the first task and end with the context.

    Args:
        count: number of processes on this machine; with 1 and no time limit runs are carried out in this process.
            None for the number of processors.
        scheduler: address of a Dask scheduler, such as "tcp://127.0.0.1:8786"; None for processes of this machine.
        run_timeout: [s] time limit of a run, after which its process is ended; None for no limit.
        plants: names of plants that a process imports before its first run, outside the time limit.
        controllers: names of controllers, likewise.
        own: controllers that users gave, likewise.

    Raises:
        ConfigurationError: Dask is not installed, its scheduler does not answer or has no workers, or a time limit is
            asked for on a cluster.
    """
    if scheduler is not None and count is not None:
        raise ConfigurationError("--workers are processes of this machine; with --scheduler the cluster has its own")
    count = count or default_workers()
    if scheduler is not None:
        if run_timeout is not None:
            raise ConfigurationError("--run-timeout works with processes of this machine only, not with --scheduler")
        with _open_cluster(scheduler) as workers:
            yield workers
    elif count == 1 and run_timeout is None:
        yield Workers()
    else:
        names = (tuple(plants), tuple(controllers), tuple(each.source for each in own if each.source is not None))
        context = get_context("spawn")
        ready, asked = context.Semaphore(0), Event()
        pool = ProcessPool(count, context=context, initializer=_warm_up, initargs=(ready, *names))

        def submit(function: Callable[..., Any], *arguments: object) -> Any:  # noqa: ANN401 - a future
            asked.set()
            with _interrupts_blocked():  # the first task starts the processes, which inherit the blocked signal
                return pool.schedule(function, arguments, timeout=run_timeout)

        try:
            yield Workers(submit, count, (ProcessExpired,), run_timeout)
            if asked.is_set():
                _wait_until(ready, count)
        finally:
            pool.stop()  # type: ignore[no-untyped-call]
            pool.join()


def _wait_until(ready: Semaphore, count: int) -> None:
    """Wait until `count` processes have started: one that is stopped while it starts may print a traceback."""
    deadline = time.monotonic() + MAX_START_TIME
    for _ in range(count):
        if not ready.acquire(timeout=max(0.0, deadline - time.monotonic())):
            return


def _warm_up(
    ready: Semaphore, plants: Sequence[str], controllers: Sequence[str], sources: Sequence[SourceFile]
) -> None:
    """Import what runs need, and say so; what cannot be imported is left to the run, whose row says so."""
    ready.release()
    import_module("servobench.harness.run.episode")
    for find, names in ((find_plant, plants), (find_controller, controllers)):
        for name in names:
            with contextlib.suppress(Exception):
                find(name)
    for source in sources:
        with contextlib.suppress(ConfigurationError):
            source.load()


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Hold Ctrl-C back; processes and threads that are started meanwhile never receive it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _open_cluster(scheduler: str) -> Iterator[Workers]:
    if not re.fullmatch(r"(?:[a-z]+://)?\S+:\d+", scheduler):
        raise ConfigurationError(f"--scheduler needs an address such as tcp://127.0.0.1:8786, got {scheduler!r}")
    from distributed import Client, KilledWorker  # noqa: PLC0415 - only the extra cluster brings it

    try:
        client = Client(scheduler, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigurationError(
            f"the scheduler {scheduler} does not answer; start one with `dask scheduler` and name its address"
        ) from error
    try:
        try:
            client.wait_for_workers(1, timeout=SCHEDULER_TIMEOUT)
        except TimeoutError as error:
            raise ConfigurationError(
                f"the scheduler {scheduler} has no workers; start some with `dask worker {scheduler} --nthreads 1`"
            ) from error

        def submit(function: Callable[..., Any], *arguments: object) -> Any:  # noqa: ANN401 - a future
            return client.submit(function, *arguments, pure=False)

        threads = sum(client.nthreads().values())
        yield Workers(submit, threads, (KilledWorker,))
    finally:
        client.close()
