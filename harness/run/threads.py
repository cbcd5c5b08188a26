"""One thread for linear algebra: the same sums, and so the same bits, on any number of processors."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager

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
