"""Limits of runs, and the processes below one: their ids, their memory, their end, their ties to the one above.

The one module that imports psutil. On Linux a process can adopt the orphans among its descendants, so that a child that
was started in a session of its own, with its parent gone, also stays below the process that answers for it.
"""

import contextlib
import ctypes
import math
import os
import re
import resource
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from multiprocessing import parent_process, resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NoReturn

import psutil

from servobench.harness.batch.container import memory_limit, processor_limit

LINUX = sys.platform == "linux"  # other systems: macOS is provided for
SET_DEATH_SIGNAL, ADOPT_ORPHANS = 1, 36  # options of prctl(2)
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # parameters of mallopt(3)
KEPT_MEMORY = 2**30  # [bytes] freed memory that a worker keeps
# [bytes] from which on a block has pages of its own; glibc takes no larger threshold
LARGEST_BLOCK = 2**25
FOREIGN_TIME = 600.0  # [s] time limit of a run of foreign code where none is given
FOREIGN_SHARE = 0.8  # share of the memory for all concurrent runs of foreign code
# [bytes] for each of them at least, on a machine that is no container
LEAST_FOREIGN_MEMORY = 2 * 10**9
# [s] until all processes below this one have ended, and between two checks
END_TIME, END_PAUSE = (5.0, 0.01)
STAND_PAUSE = 0.05  # [s] between two looks at a child that may be stopped
OWN_TIME = 1.0  # [s] for a child to end by itself once the parent has ended


@dataclass(frozen=True)
class Limits:
    """Resources of a run; infinity for no limit."""

    time: float = math.inf  # [s] from one answer to the next
    memory: float = math.inf  # [bytes] memory of a run and the processes that it starts
    addresses: bool = (
        False  # refuse each process more than this memory at once, even if it never touches it
    )


@dataclass(frozen=True)
class Bounds:
    """Resources of the runs of a batch as a user gives them, and whether code of users stays out of this process."""

    run_timeout: float | None = (
        None  # [s] time limit of a run, inf for none; None for the usual one
    )
    run_memory: float | None = (
        None  # [bytes] memory limit of a run, inf for none; None for the usual one
    )
    isolate: bool = True  # carry runs of plug-ins and foreign FMUs out in isolated processes

    def limits(self, count: int, *, foreign: bool) -> Limits:
        """Return the limits of each of `count` concurrent runs; foreign code has some even where none are given."""
        usual = Limits(FOREIGN_TIME, _foreign_memory(count)) if foreign else Limits()
        time = usual.time if self.run_timeout is None else self.run_timeout
        memory = usual.memory if self.run_memory is None else self.run_memory
        return Limits(time, memory, addresses=self.run_memory is not None)


def _foreign_memory(count: int) -> float:
    """Return the memory limit [bytes] of each of `count` concurrent runs of foreign code."""
    machine = float(psutil.virtual_memory().total)
    memory = FOREIGN_SHARE * min(machine, memory_limit())
    share = memory / count
    if (
        memory_limit() < machine
    ):  # A container ends processes at its limit, whereas a machine can swap.
        return share
    return max(share, min(LEAST_FOREIGN_MEMORY, memory))


def available_processors() -> int:
    """Return the number of whole processors that this process may use, at least one."""
    count = len(os.sched_getaffinity(0)) if LINUX else os.cpu_count() or 1
    return max(1, math.floor(min(count, processor_limit())))


def lead_session() -> None:
    """Leave the terminal and its Ctrl-C behind."""
    with contextlib.suppress(OSError):  # it leads one
        os.setsid()


def begin(modules: Iterable[str], module: str, function: str, *arguments: object) -> None:
    """Call a function in a child of this process, which stands over it: a run knows the child only, and may stop it.

    Both end with their parent, from before the long imports on.

    Args:
        modules: imported first, if they can be.
        module: in which the function is.
        function: its name.
        arguments: of the function.
    """
    # Until it has a handler of its own, a copy would do what its parent does
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    lead_session()
    _prctl(SET_DEATH_SIGNAL, signal.SIGCONT)  # in case that it was stopped
    adopt_orphans()
    own = os.getpid()
    child = os.fork()
    if child:
        _stand_over(child)
    lead_session()
    end_with_parent(own)
    for name in (*modules, module):
        with contextlib.suppress(Exception):
            import_module(name)
    getattr(sys.modules[module], function)(*arguments)


def forget_tracker() -> None:
    """Close the link to the process that tracks resources for the parent, and start another one where one is needed."""
    tracker: Any = resource_tracker._resource_tracker
    if tracker._fd is not None:
        with contextlib.suppress(OSError):
            os.close(tracker._fd)
    tracker._fd = None
    tracker._pid = None


def adopt_orphans() -> None:
    """Become the parent of each descendant whose parent ends."""
    _prctl(ADOPT_ORPHANS, 1)


def keep_freed_memory() -> None:
    """Let this process and its copies keep the memory that they free, where their C library is glibc.

    A block of runs needs the same arrays in each period. By default large ones go back to the system when they are
    freed, and the next ones begin with a fault for each page.
    """
    if not LINUX:
        return
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(MMAP_THRESHOLD, LARGEST_BLOCK)
        set_option(TRIM_THRESHOLD, KEPT_MEMORY)


def _stand_over(child: int) -> NoReturn:
    """Continue a child process whenever it is stopped, and end as it does, or when the parent has ended.

    Nothing below this process outlives it.
    """
    # The child's end of its link must be the only one
    os.closerange(3, resource.getrlimit(resource.RLIMIT_NOFILE)[0])
    signal.signal(signal.SIGTERM, lambda *_: send([child], signal.SIGTERM))
    parent = parent_process()
    deadline = math.inf
    status = None
    while status is None and time.monotonic() < deadline:
        time.sleep(STAND_PAUSE)
        changed, how = os.waitpid(child, os.WNOHANG | os.WUNTRACED)
        if changed and os.WIFSTOPPED(how):
            send([child], signal.SIGCONT)
        elif changed:
            status = how
        if deadline == math.inf and (parent is None or os.getppid() != parent.pid):
            deadline = time.monotonic() + OWN_TIME
    end_descendants()
    if status is None:
        os._exit(1)
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        with contextlib.suppress(OSError, ValueError):  # no handler of SIGKILL can be set
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(abs(code))


def end_with_parent(parent: int) -> None:
    """End this process as soon as its parent ends, which may have ended before this call.

    The signal comes with the end of the thread that made this process: the parent has but one.
    """
    _prctl(SET_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def limit_silence(descriptor: int, seconds: int) -> None:
    """Let a read from an end of a pipe of two directions fail after some seconds without a byte."""
    pause = struct.pack("ll", seconds, 0)  # a timeval
    with socket.socket(fileno=os.dup(descriptor)) as end:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, pause)


def hang_up(descriptor: int) -> None:
    """Let both ends of a pipe of two directions, and all their copies, read its end."""
    with socket.socket(fileno=os.dup(descriptor)) as end:
        end.shutdown(socket.SHUT_RDWR)


def _prctl(option: int, value: int) -> None:
    if LINUX:
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def descendants(process: int) -> list[int]:
    """Return the ids of all processes below one."""
    if not _lists_children():
        return _ask(process, lambda top: [each.pid for each in top.children(recursive=True)]) or []
    found = []
    waiting = [process]
    while waiting:
        children = _children(waiting.pop())
        found += children
        waiting += children
    return found


@cache
def _lists_children() -> bool:
    """Return whether the system lists the children of a process; otherwise each process names its parent.

    macOS has no such lists, nor has gVisor or a kernel without CONFIG_PROC_CHILDREN.
    """
    try:
        Path("/proc/thread-self/children").read_text(encoding="ascii")
    except OSError:
        return False
    return True


def _children(process: int) -> list[int]:
    """Return the ids of the children of a process, as the system lists them."""
    found: list[int] = []
    with contextlib.suppress(OSError):  # The process has ended.
        for thread in Path(f"/proc/{process}/task").iterdir():
            with contextlib.suppress(OSError):  # The thread has ended.
                words = (thread / "children").read_text(encoding="ascii")
                found += map(int, words.split())
    return found


def can_watch() -> bool:
    """Return whether this system says which processes are below one, as limits of memory and processes need it."""
    return bool(_ask(os.getpid(), lambda own: own.ppid()) == os.getppid())


def resident_memory(processes: Iterable[int]) -> int:
    """Return the memory [bytes] that processes hold; shared memory counts for each."""
    return sum(_ask(process, lambda each: each.memory_info().rss) or 0 for process in processes)


def own_memory(processes: Iterable[int]) -> int:
    """Return the memory [bytes] of processes, each with its part of shared memory, or all where it is unknown."""
    part = "pss" if LINUX else "uss"
    total = 0
    for process in processes:
        held = _ask(process, lambda each: each.memory_full_info())
        total += getattr(held, part, None) or resident_memory([process])
    return total


def _ask(process: int, question: Callable[[psutil.Process], Any]) -> Any:  # noqa: ANN401 - any answer
    """Return the answer of the system about a process; None if it has ended."""
    try:
        return question(psutil.Process(process))
    except psutil.Error:
        return None


def limit_resources(memory: float) -> None:
    """Write no image of the memory after a crash, and refuse this process more than `memory` further addresses.

    Not all addresses are memory: drivers of graphics cards reserve hundreds of gigabytes of them.
    """
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    if memory < math.inf and LINUX:
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        # The largest number of the system
        soft = min(psutil.Process().memory_info().vms + int(memory), sys.maxsize)
        if hard == resource.RLIM_INFINITY or soft < hard:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def end_descendants() -> None:
    """End all processes below this one, including those that they start meanwhile."""
    deadline = time.monotonic() + END_TIME
    while (left := descendants(os.getpid())) and time.monotonic() < deadline:
        send(left, signal.SIGSTOP)
        send(left, signal.SIGKILL)
        collect_ended(left)
        time.sleep(END_PAUSE)


def wake(child: BaseProcess | None) -> None:
    """Continue a child process in case that a signal has stopped it."""
    if child is not None and child.pid is not None:
        send([child.pid], signal.SIGCONT)


def await_end(child: BaseProcess, seconds: float) -> int | None:
    """Wait for a child process to end, some seconds at most, and return its exit code; None if it goes on.

    `child.join` would trust a pipe to which code of users can write.
    """
    deadline = time.monotonic() + seconds
    while child.exitcode is None and time.monotonic() < deadline:
        time.sleep(END_PAUSE)
    return child.exitcode


def send(processes: Iterable[int], number: signal.Signals) -> None:
    """Send a signal to processes; those that have ended are left out."""
    for process in processes:
        with contextlib.suppress(OSError):
            os.kill(process, number)


def collect_ended(processes: Iterable[int]) -> None:
    """Reap terminated child processes; others are left alone."""
    for process in processes:
        with contextlib.suppress(ChildProcessError):
            os.waitpid(process, os.WNOHANG)


def read_size(text: str) -> float:
    """Return the number of bytes that a text such as "500MB", "2GB" or "inf" names.

    Raises:
        ValueError: it names none.
    """
    if text.strip().lower() == "inf":
        return math.inf
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]?)i?B\s*", text, re.IGNORECASE)
    if found is None or not float(found[1]):
        raise ValueError(
            f"a memory limit is a size such as 500MB or 2GB, or inf for none; got {text!r}"
        )
    return int(float(found[1]) * 1000 ** " KMGT".index(found[2].upper() or " "))


def show_size(size: float) -> str:
    """Return a number of bytes as a user writes it."""
    for unit, one in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size >= one:
            return f"{size / one:.3g} {unit}"
    return f"{size:g} B"
