"""The processes below one: who they are, what they hold, how they end; and what binds a process to the one above.

The one module that imports psutil. On Linux a process can adopt what its descendants leave behind, so that also a child
that was started in a session of its own, with its parent gone, stays below the process that answers for it.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import time
from pathlib import Path
from typing import Final

import psutil

LINUX: Final = sys.platform == "linux"
SET_DEATH_SIGNAL, ADOPT_ORPHANS = 1, 36  # of prctl(2)
END_TIME: Final = 5.0  # [s] at most until all processes below this one have ended
END_PAUSE: Final = 0.01  # [s] between two looks at what is left of them


def lead_session() -> None:
    """Leave the terminal and its Ctrl-C behind; all processes that are started from now on can be told by it."""
    if hasattr(os, "setsid"):
        with contextlib.suppress(OSError):  # it leads one
            os.setsid()


def adopt_orphans() -> None:
    """Become the parent of each descendant whose parent ends, where the system can do that."""
    if LINUX:
        _prctl(ADOPT_ORPHANS, 1)


def end_with(parent: int) -> None:
    """Let the system end this process as soon as its parent ends, where it can do that.

    Args:
        parent: process id of the parent, which may have ended before this call.
    """
    if LINUX:
        _prctl(SET_DEATH_SIGNAL, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)


def _prctl(option: int, value: int) -> None:
    ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def descendants(process: int) -> list[int]:
    """Return the ids of all processes below one."""
    found, waiting = [], [process]
    while waiting:
        children = _children(waiting.pop())
        found += children
        waiting += children
    return found


def _children(process: int) -> list[int]:
    """Return the ids of the children of a process; Linux tells them without a look at every process of the machine."""
    if LINUX:
        try:
            lists = [(task / "children").read_text() for task in Path(f"/proc/{process}/task").iterdir()]
        except (FileNotFoundError, ProcessLookupError):
            if Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").exists():
                return []  # it has ended
        else:
            return [int(word) for text in lists for word in text.split()]
    try:
        return [child.pid for child in psutil.Process(process).children()]
    except psutil.Error:
        return []


def resident_memory(processes: list[int]) -> int:
    """Return the memory [bytes] that processes hold; what they share counts for each."""
    return sum(_memory(process, "rss") for process in processes)


def own_memory(processes: list[int]) -> int:
    """Return the memory [bytes] that processes hold, each with its share of what it has in common with others."""
    return sum(_memory(process, "pss" if LINUX else "uss") for process in processes)


def _memory(process: int, kind: str) -> int:
    try:
        of = psutil.Process(process)
        return int(getattr(of.memory_info() if kind == "rss" else of.memory_full_info(), kind))
    except psutil.Error:
        return 0


def machine_memory() -> int:
    """Return the memory [bytes] of this machine."""
    return int(psutil.virtual_memory().total)


def limit_addresses(most: int) -> None:
    """Refuse this process, and each that it starts, more than `most` further bytes of addresses, where that works.

    Not all addresses are memory: what drives graphics cards reserves hundreds of gigabytes of them.
    """
    if not LINUX:
        return
    import resource  # noqa: PLC0415 - not on Windows

    used = psutil.Process().memory_info().vms
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    soft = used + most
    if hard == resource.RLIM_INFINITY or soft < hard:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def leave_no_core() -> None:
    """Let a crash of this process write no image of its memory, which takes seconds and the disk."""
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource  # noqa: PLC0415 - not on Windows

        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))


def end_descendants() -> None:
    """End all processes below this one, also those that they start meanwhile."""
    deadline = time.monotonic() + END_TIME
    while (left := descendants(os.getpid())) and time.monotonic() < deadline:
        for number in (signal.SIGSTOP, signal.SIGKILL) if hasattr(signal, "SIGSTOP") else (signal.SIGTERM,):
            for process in left:
                with contextlib.suppress(OSError):
                    os.kill(process, number)
        collect_ended(left)
        time.sleep(END_PAUSE)


def collect_ended(processes: list[int]) -> None:
    """Take ended children of this process out of the system's table; others are left alone."""
    for process in processes:
        with contextlib.suppress(ChildProcessError, AttributeError):
            os.waitpid(process, os.WNOHANG)
