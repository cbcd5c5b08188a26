"""The processes below one: their ids, their memory, their end; and the ties of a process to the one above.

The one module that imports psutil. On Linux a process can adopt the orphans among its descendants, so that a child
that was started in a session of its own, with its parent gone, also stays below the process that answers for it.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import psutil

LINUX: Final = sys.platform == "linux"
LISTED: Final = Path("/proc/thread-self/children").exists()  # whether the system lists the children of a process
SET_DEATH_SIGNAL, ADOPT_ORPHANS = 1, 36  # of prctl(2)
END_TIME, END_PAUSE = 5.0, 0.01  # [s] until all processes below this one have ended, and between two checks


def lead_session() -> None:
    """Leave the terminal and its Ctrl-C behind."""
    with contextlib.suppress(OSError):  # it leads one
        os.setsid()


def adopt_orphans() -> None:
    """Become the parent of each descendant whose parent ends."""
    _prctl(ADOPT_ORPHANS, 1)


def end_with(parent: int) -> None:
    """End this process as soon as its parent ends, which may have ended before this call."""
    _prctl(SET_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def wake_without_parent() -> None:
    """Continue this process when its parent ends, in case that it was stopped."""
    _prctl(SET_DEATH_SIGNAL, signal.SIGCONT)


def _prctl(option: int, value: int) -> None:
    if LINUX:
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
    """Return the ids of the children of a process."""
    try:
        if LISTED:
            lists = [(task / "children").read_text() for task in Path(f"/proc/{process}/task").iterdir()]
            return [int(word) for text in lists for word in text.split()]
        return [child.pid for child in psutil.Process(process).children()]
    except (FileNotFoundError, ProcessLookupError, psutil.Error):  # it has ended
        return []


def resident_memory(processes: Iterable[int]) -> int:
    """Return the memory [bytes] that processes hold; shared memory counts for each."""
    return sum(_memory(process, "rss") for process in processes)


def own_memory(processes: Iterable[int]) -> int:
    """Return the memory [bytes] that processes hold, each with its part of shared memory."""
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


def limit_resources(memory: int | None) -> None:
    """Write no image of the memory after a crash, and refuse this process more than `memory` further addresses.

    Not all addresses are memory: drivers of graphics cards reserve hundreds of gigabytes of them.
    """
    import resource  # noqa: PLC0415 - not on Windows

    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    if memory is not None and LINUX:
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        soft = psutil.Process().memory_info().vms + memory
        if hard == resource.RLIM_INFINITY or soft < hard:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def is_stopped(process: int | None) -> bool:
    """Return whether a process was stopped by a signal."""
    try:
        return bool(psutil.Process(process).status() == psutil.STATUS_STOPPED)
    except psutil.Error:
        return False


def end_descendants() -> None:
    """End all processes below this one, including those that they start meanwhile."""
    deadline = time.monotonic() + END_TIME
    while (left := descendants(os.getpid())) and time.monotonic() < deadline:
        send(left, signal.SIGSTOP)
        send(left, signal.SIGKILL)
        collect_ended(left)
        time.sleep(END_PAUSE)


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
