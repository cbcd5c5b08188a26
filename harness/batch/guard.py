"""A worker is two processes: a guard, and below it the process that carries runs out, whatever becomes of that one.

    this process ── task ──> guard ── task ──> runner      the runner's answers go back the same way, one by one
                             imports servobench, no plug-in; counts time, memory and processes of all below it

The runner is a copy of the guard, so a new one takes milliseconds on Linux (elsewhere it is started anew). It is ended,
with every process below the guard, when a run takes too long, holds too much or kills it; when the code of users
changes, so that no plug-in finds what another left behind; when a task is over and left processes behind or much memory
in use; and when the link to this process closes, be it because this process was killed.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import math
import os
import pickle
import re
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import IO, Any, Final, TypeAlias

from servobench.harness.batch import processes
from servobench.harness.run.result import CRASHED, OUT_OF_MEMORY, TIMED_OUT, Ending

LOST: Final = "the run killed the process that carried it out"
LOOK_EVERY: Final = 0.25  # [s] between two looks at time, memory and processes
START_TIME: Final = 60.0  # [s] at least until a runner has loaded what a task needs
TRACE_TIME: Final = 0.3  # [s] for a trace of where a run hangs
MAX_PROCESSES: Final = 256  # below a guard: more are a run that starts copies of itself
MAX_ANSWER: Final = 2**30  # [bytes] of one answer: a larger length is no length
KEPT_SHARE: Final = 0.5  # of the memory limit that a runner may hold between two tasks
STANDARD_ERROR: Final = 2  # its descriptor
ITEM, ALIVE, DONE, ENDED = b"i", b"a", b"d", b"e"  # first byte of a message upwards

Tell: TypeAlias = Callable[[Any], None]  # hands an answer up; None is but a sign of life


@dataclass(frozen=True)
class Limits:
    """What a run may take; None for no limit."""

    time: float | None = None  # [s] from one answer to the next
    memory: int | None = None  # [bytes] of a run and the processes that it starts
    addresses: bool = False  # refuse each process more than this memory at once, also such as it never touches


@dataclass(frozen=True)
class Task:
    """A function and its argument, with what the guard must know."""

    function: Callable[[bytes, Tell], None]
    argument: bytes
    owner: str = ""  # whose code it runs: that of different owners never shares a runner; "" for this package
    fresh: bool = False  # wants a runner that carried out nothing before


@dataclass(frozen=True)
class End:
    """How a task ended that did not come to its end."""

    ending: Ending
    certain: bool  # whether what it was at did it, and no earlier run of the same runner
    alone: bool = False  # whether to be certain each run must be a task by itself: answers may have been lost


def keep_guard(link: Connection, limits: Limits, modules: Sequence[str], inherited: Sequence[Connection] = ()) -> None:
    """Be a guard: take tasks from a link until it closes.

    Args:
        link: to the process that has the tasks.
        limits: of each run.
        modules: imported once; those of users are left to the runner.
        inherited: the other ends of links, which a copy of the process that has the tasks must not keep open.
    """
    for each in inherited:
        each.close()
    processes.lead_session()
    processes.adopt_orphans()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    for name in modules:
        with contextlib.suppress(Exception):
            import_module(name)
    gc.freeze()  # so that runners go on sharing the memory of what is imported
    guard = _Guard(link, limits)
    try:
        link.send_bytes(ALIVE)
        guard.serve()
    except (EOFError, OSError):  # the other side has ended
        pass
    finally:
        guard.end_runner()


class _Guard:
    def __init__(self, link: Connection, limits: Limits) -> None:
        self._link, self._limits = link, limits
        self._runner: Any = None
        self._below: Connection | None = None
        self._owner, self._answers = "", 0
        self._trace: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the guard lives

    def serve(self) -> None:
        """Carry tasks out until the link closes."""
        while True:
            task: Task = pickle.loads(self._link.recv_bytes())
            below = self._ready(task)
            try:
                below.send_bytes(pickle.dumps((task.function, task.argument)))
                end = self._watch(below)
            except (EOFError, OSError):
                end = self._find_end()
            if end is None:
                self._link.send_bytes(DONE)
                if self._is_used_up(task):
                    self.end_runner()
            else:
                self._link.send_bytes(ENDED + pickle.dumps(end))

    def _ready(self, task: Task) -> Connection:
        """Return the link to a runner that may carry out a task."""
        used = self._answers > 0
        if self._below is not None and not (task.owner != self._owner or (task.fresh and used)):
            return self._below
        self.end_runner()
        context = get_context("fork") if processes.LINUX else get_context("spawn")
        self._below, theirs = context.Pipe()
        self._trace.seek(0)
        self._trace.truncate()
        trace = self._trace.fileno() if processes.LINUX else None
        inherited = (self._link, self._below) if processes.LINUX else ()
        self._runner = context.Process(target=_be_runner, args=(theirs, inherited, os.getpid(), self._limits, trace))
        self._runner.start()
        theirs.close()
        self._owner, self._answers = task.owner, 0
        return self._below

    def _watch(self, below: Connection) -> End | None:
        """Pass the answers of the runner on until it is done; return how it ended if it did not get there."""
        limit = self._limits.time
        patience, since = (None if limit is None else max(limit, START_TIME)), time.monotonic()
        watched = limit is not None or self._limits.memory is not None
        while True:
            ready = wait([below, self._link], LOOK_EVERY if watched else None)
            if below in ready:
                message = below.recv_bytes(MAX_ANSWER)
                if message[:1] == DONE:
                    return None
                self._answers += message[:1] == ITEM
                patience, since = limit, time.monotonic()
                self._link.send_bytes(message)
            elif self._link in ready:  # nobody sends a second task: the other side has ended
                sys.exit(1)
            elif patience is not None and time.monotonic() - since > patience:
                return self._end(TIMED_OUT, f"the run took longer than {patience:g} s", ask=True)
            elif (end := self._check_processes()) is not None:
                return end

    def _check_processes(self) -> End | None:
        """Look at memory and number of what is below; end it if it is too much."""
        all_below = processes.descendants(os.getpid())
        if len(all_below) > MAX_PROCESSES:
            return self._end(CRASHED, f"the run started more than {MAX_PROCESSES} processes")
        most = self._limits.memory
        if most is not None and processes.resident_memory(all_below) > most and processes.own_memory(all_below) > most:
            certain = not self._answers
            return self._end(OUT_OF_MEMORY, f"the run held more than {show_size(most)} of memory", certain=certain)
        processes.collect_ended([each for each in all_below if each != self._runner.pid])
        return None

    def _end(self, status: str, reason: str, *, certain: bool = True, ask: bool = False) -> End:
        """End the runner and all below it."""
        if ask and processes.LINUX:
            with contextlib.suppress(OSError):
                os.kill(self._runner.pid, signal.SIGUSR1)
                time.sleep(TRACE_TIME)
        self.end_runner()
        return End(Ending(status, reason, self._read_trace()), certain)

    def _find_end(self) -> End:
        """Return how a runner ended that is gone, or whose link is."""
        certain = not self._answers
        runner = self._runner
        runner.join(TRACE_TIME)
        code = runner.exitcode
        self.end_runner()
        return End(Ending(CRASHED, f"{LOST}{_describe_exit(code)}", self._read_trace()), certain)

    def _is_used_up(self, task: Task) -> bool:
        """Return whether a runner left something behind that its next task should not meet."""
        if not task.owner and self._limits.memory is None:
            return False
        all_below = processes.descendants(os.getpid())
        most = self._limits.memory
        return len(all_below) > 1 or (most is not None and processes.resident_memory(all_below) > KEPT_SHARE * most)

    def end_runner(self) -> None:
        """End the runner and every process that runs have left behind."""
        if self._below is not None:
            self._below.close()
            self._below = None
        if self._runner is not None:
            self._runner.kill()
            self._runner.join(processes.END_TIME)
            self._runner = None
        processes.end_descendants()

    def _read_trace(self) -> str:
        self._trace.seek(0)
        return self._trace.read(4096).decode(errors="replace").strip()


def _be_runner(
    link: Connection, inherited: Sequence[Connection], parent: int, limits: Limits, trace: int | None
) -> None:
    """Be a runner: take tasks from the guard until it is gone."""
    processes.lead_session()
    processes.end_with(parent)
    for each in inherited:
        each.close()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_SETMASK, set())
    processes.leave_no_core()
    if trace is not None:
        faulthandler.enable(trace, all_threads=False)
        faulthandler.register(signal.SIGUSR1, trace, all_threads=False)
    with Path(os.devnull).open() as nothing:
        os.dup2(nothing.fileno(), 0)  # what waits for the keyboard ends at once
    if limits.memory is not None and limits.addresses:
        processes.limit_addresses(limits.memory)
    own = os.getpid()

    def tell(item: Any) -> None:  # noqa: ANN401 - any answer
        if os.getpid() != own:
            os._exit(0)  # a copy of this process, which a plug-in forked and let go on
        link.send_bytes(ALIVE if item is None else ITEM + pickle.dumps(item))

    try:
        while True:
            function, argument = pickle.loads(link.recv_bytes())
            function(argument, tell)
            if os.getpid() != own:
                os._exit(0)
            link.send_bytes(DONE)
    except BaseException:  # noqa: BLE001 - the link was cut, or the interpreter is no longer what it was
        with contextlib.suppress(BaseException):
            os.write(STANDARD_ERROR if trace is None else trace, traceback.format_exc().encode())
    os._exit(1)


def _describe_exit(code: int | None) -> str:
    """Return what an exit code adds to a reason."""
    if code is None:
        return ": it cut its link"
    if code >= 0:
        return f": exit code {code}"
    with contextlib.suppress(ValueError):
        return f": {signal.Signals(-code).name}"
    return f": signal {-code}"


def read_size(text: str) -> float:
    """Return the number of bytes that a text such as "500MB", "2GB" or "inf" names.

    Raises:
        ValueError: it names none.
    """
    if text.strip().lower() == "inf":
        return math.inf
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]?)i?B\s*", text, re.IGNORECASE)
    if found is None or not float(found[1]):
        raise ValueError(f"a memory limit is a size such as 500MB or 2GB, or inf for none; got {text!r}")
    return int(float(found[1]) * 1000 ** " KMGT".index(found[2].upper() or " "))


def show_size(size: int) -> str:
    """Return a number of bytes as a user writes it."""
    for unit, one in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size >= one:
            return f"{size / one:.3g} {unit}"
    return f"{size} B"
