"""Children of this process: they share what it has in memory, and whatever befalls them does not befall it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from multiprocessing import get_context

FORK = get_context("fork")


def ended(work: Callable[[], object]) -> int:
    """Do something in a child; return its exit code, 1 after an error, or the negative number of a signal."""
    child = FORK.Process(target=work)
    child.start()
    child.join()
    return child.exitcode


def answered(work: Callable[[], object], seconds: float | None = None):
    """Return what a function returns in a child, None without an answer in time, and how the child ended."""
    ours, theirs = FORK.Pipe(duplex=False)

    def answer_and_leave() -> None:
        theirs.send(work())
        os._exit(0)  # whatever threads and handlers the work has left

    child = FORK.Process(target=answer_and_leave)
    child.start()
    theirs.close()
    answer = None
    with ours, contextlib.suppress(EOFError):
        if ours.poll(seconds):
            answer = ours.recv()
        else:
            child.kill()
    child.join()
    return answer, child.exitcode
