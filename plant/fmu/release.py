"""The release of instances of FMUs, which a worker process delays until the results of a run are in safety.

A library may end or hang its process when its instances are freed or when it is unloaded. A run has ended well before.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Timer
from typing import TypeAlias

RELEASE_TIME = 5.0  # [s] for all instances of a run, after which their process is ended
Act: TypeAlias = Callable[[], None]
_delayed: list[list[Act]] = []  # a list for each context


def release(act: Act) -> None:
    """Call `act`, which frees instances: now, or later within a context of `delayed_releases`."""
    if _delayed:
        _delayed[-1].append(act)
    else:
        act()


@contextmanager
def delayed_releases() -> Iterator[Act]:
    """Yield the function that carries out the releases that were asked for so far; the context ends with it, too."""
    waiting: list[Act] = []

    def carry_out() -> None:
        if not waiting:
            return
        limit = Timer(RELEASE_TIME, os._exit, (1,))
        limit.start()
        while waiting:
            waiting.pop()()
        limit.cancel()

    _delayed.append(waiting)
    try:
        yield carry_out
    finally:
        carry_out()
        _delayed.remove(waiting)
