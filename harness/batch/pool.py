"""Guards and the threads that talk to them: tasks are handed out, answers come back as a future.

A guard that was ended, be it by a plug-in, is started anew; what it was at ends as a row, not the batch.
"""

from __future__ import annotations

import contextlib
import pickle
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from queue import SimpleQueue
from typing import Any, Final

from servobench.harness.batch import processes
from servobench.harness.batch.guard import ALIVE, DONE, ENDED, LOST, START_TIME, End, Limits, Task, keep_guard
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.result import CRASHED, TIMED_OUT, Ending

GUARD_START: Final = 1800.0  # [s] until a guard has imported servobench: a machine may be busy, and a batch long
GRACE: Final = 30.0  # [s] more than the time limit, after which a guard that says nothing is ended, too
STOP_TIME: Final = 4.0  # [s] that guards have to end what is below them


@dataclass(frozen=True)
class Answer:
    """What came back from a task: one item after the other, and how it ended if it did not come to its end."""

    items: list[Any] = field(default_factory=list)
    end: End | None = None


class Pool:
    """Worker processes, each behind a guard, which start with the first task.

    Args:
        count: of guards.
        limits: of each run.
        modules: that guards import once.
    """

    def __init__(self, count: int, limits: Limits, modules: Sequence[str]) -> None:
        self._count, self._limits, self._modules = count, limits, modules
        self._waiting: SimpleQueue[tuple[Future[Answer], Task, Callable[[Any], None] | None] | None] = SimpleQueue()
        self._guards: list[Guarded] = []
        self._threads: list[threading.Thread] = []
        self._stopped = False

    def submit(self, task: Task, hear: Callable[[Any], None] | None = None) -> Future[Answer]:
        """Hand a task out.

        Args:
            task: what to carry out.
            hear: receives the items instead of the answer, in another thread.
        """
        if len(self._threads) < self._count:
            self._guards.append(Guarded(self._limits, self._modules))
            self._threads.append(threading.Thread(target=self._serve, args=(self._guards[-1],), daemon=True))
            self._threads[-1].start()
        future: Future[Answer] = Future()
        self._waiting.put((future, task, hear))
        return future

    def stop(self) -> None:
        """End everything; tasks that were not carried out have no answer."""
        self._stopped = True
        for _ in self._threads:
            self._waiting.put(None)
        for guard in self._guards:
            guard.ask_to_end()
        for guard in self._guards:
            guard.end()

    def _serve(self, guard: Guarded) -> None:
        while (taken := self._waiting.get()) is not None and not self._stopped:
            future, task, hear = taken
            try:
                answer = guard.carry_out(task, hear)
            except BaseException as error:  # noqa: BLE001 - told where the result is asked for
                if not self._stopped:
                    future.set_exception(error)
            else:
                future.set_result(answer)


class Guarded:
    """A guard as seen from here.

    Args:
        limits: of each run.
        modules: that it imports once.
        copied: whether it is a copy of this process where the system has such, which nothing else may be busy in.
    """

    def __init__(self, limits: Limits, modules: Sequence[str], *, copied: bool = False) -> None:
        self._limits, self._modules, self._copied = limits, modules, copied
        self._lock, self._ended = threading.Lock(), False
        self._process: BaseProcess | None = None
        self._link: Connection | None = None

    def carry_out(self, task: Task, hear: Callable[[Any], None] | None) -> Answer:
        """Carry one task out; `hear` receives the items instead of the answer.

        Raises:
            ConfigurationError: no process can be started.
        """
        answer = Answer()
        link = self._start()
        silence = None if self._limits.time is None else max(self._limits.time, START_TIME) + GRACE
        try:
            link.send_bytes(pickle.dumps(task))
            while True:
                if not link.poll(silence):
                    return Answer(answer.items, self._give_up(TIMED_OUT, f"the run took longer than {silence:g} s"))
                message = link.recv_bytes()
                kind, content = message[:1], message[1:]
                if kind == DONE:
                    return answer
                if kind == ENDED:
                    return Answer(answer.items, pickle.loads(content))
                if kind != ALIVE:
                    (hear or answer.items.append)(pickle.loads(content))
        except (EOFError, OSError):
            return Answer(answer.items, self._give_up(CRASHED, LOST))
        except (pickle.UnpicklingError, AttributeError, ImportError, IndexError, TypeError, ValueError) as error:
            return Answer(answer.items, self._give_up(CRASHED, f"what the run gave back cannot be read: {error}"))

    def ask_to_end(self) -> None:
        """Ask the guard to end what is below it, and itself."""
        with self._lock:
            self._ended = True
            if self._process is not None:
                self._process.terminate()

    def end(self) -> None:
        """Wait until the guard has ended."""
        with self._lock:
            if self._process is not None:
                self._process.join(STOP_TIME)
                self._process.kill()
                self._process.join()

    def _give_up(self, status: str, reason: str) -> End:
        """End a guard that is gone or that says nothing any more."""
        self._drop()
        return End(Ending(status, reason), certain=False, alone=True)

    def _start(self) -> Connection:
        """Return the link to a guard that runs."""
        if self._link is not None:
            return self._link
        copied = self._copied and processes.LINUX
        context = get_context("fork") if copied else get_context("spawn")
        ours, theirs = context.Pipe()
        inherited = (ours,) if copied else ()
        process: BaseProcess = context.Process(
            target=keep_guard, args=(theirs, self._limits, tuple(self._modules), inherited)
        )
        with self._lock:
            if self._ended:
                raise EOFError
            with _interrupts_blocked(), warnings.catch_warnings():  # a process inherits the former
                warnings.simplefilter("ignore", DeprecationWarning)  # of Python 3.12: threads of libraries, which wait
                process.start()
            self._process = process
        theirs.close()
        if fault := _start_fault(ours):
            ours.close()
            self._drop()
            raise ConfigurationError(fault)
        self._link = ours
        return ours

    def _drop(self) -> None:
        """End a guard that is gone or of no use, so that nothing waits for it when this process ends."""
        with self._lock:
            if self._process is not None:
                self._process.kill()
                self._process.join()
            self._process = self._link = None


def _start_fault(link: Connection) -> str:
    """Wait until a guard has started and return why it has not; empty if it has."""
    with contextlib.suppress(EOFError, OSError):
        if not link.poll(GUARD_START):
            return f"a worker process has not started within {GUARD_START:g} s"
        if link.recv_bytes() == ALIVE:
            return ""
    return (
        "the worker processes cannot be started; a script that starts some must keep its calls below "
        "`if __name__ == '__main__':`"
    )


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Hold Ctrl-C back in this thread and in processes that are started meanwhile."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
