"""How numbers are computed in a run: on one thread, for the same bits on any number of processors, and checked."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

import numpy as np
from threadpoolctl import ThreadpoolController

_found: list[tuple[int, ThreadpoolController]] = []


def one_thread() -> AbstractContextManager[object]:
    """Return a context in which linear algebra runs on one thread.

    The search for libraries takes milliseconds, so it is repeated only if a module was imported since the last one.
    """
    modules = len(sys.modules)
    if not _found or _found[0][0] != modules:
        _found[:] = [(modules, ThreadpoolController())]
    context: AbstractContextManager[object] = _found[0][1].limit(limits=1)
    return context


@contextmanager
def careful() -> Iterator[None]:
    """One thread, and an error where a number leaves its range."""
    with one_thread(), np.errstate(divide="raise", over="raise", invalid="raise"):
        yield
