"""Lets the modules of this package compute with expressions for a while, by other meanings of a few names.

Most of numpy asks its arguments what to do (`__array_ufunc__`, `__array_function__`). What does not are functions that
make arrays, the decisions of `plant.contract.lanes`, and memos: while code is recorded, these names mean others.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import _lru_cache_wrapper
from threading import RLock
from typing import Any, Final

import numpy as np

from servobench.fmus.trace import branches, faults, functions, ufuncs
from servobench.fmus.trace.array import Traced, as_traced, spread
from servobench.plant.contract import checks, lanes

PACKAGE: Final = "servobench."
OWN: Final = "servobench.fmus."
_LOCK = RLock()
Traced.ufunc = staticmethod(ufuncs.carry_out)
Traced.function = staticmethod(functions.carry_out)


class _Numpy:
    """numpy, except for what makes arrays."""

    ndarray = (np.ndarray, Traced)  # for isinstance

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - anything of numpy
        return getattr(np, name)

    @staticmethod
    def asarray(value: Any, dtype: Any = None, **options: Any) -> Any:  # noqa: ANN401 - as numpy's
        if isinstance(value, Traced):
            return value
        if isinstance(value, (list, tuple)) and any(isinstance(each, Traced) for each in value):
            return np.stack([as_traced(each) for each in value])
        return np.asarray(value, dtype=_real(dtype), **options)

    @staticmethod
    def array(value: Any, dtype: Any = None, **options: Any) -> Any:  # noqa: ANN401 - as numpy's
        same = _Numpy.asarray(value, dtype)
        return same.copy() if isinstance(same, Traced) else np.array(value, dtype=_real(dtype), **options)

    @staticmethod
    def ascontiguousarray(value: Any) -> Any:  # noqa: ANN401 - as numpy's
        return value if isinstance(value, Traced) else np.ascontiguousarray(value)

    @staticmethod
    def float64(value: Any) -> Any:  # noqa: ANN401 - as numpy's
        return value if isinstance(value, Traced) else np.float64(value)

    @staticmethod
    def zeros(shape: Any, dtype: Any = np.float64) -> Traced:  # noqa: ANN401 - as numpy's
        return Traced.plain(np.zeros(shape, dtype=_real(dtype)))

    empty = zeros

    @staticmethod
    def full(shape: Any, value: Any, dtype: Any = None) -> Traced:  # noqa: ANN401 - as numpy's
        if isinstance(value, Traced):
            return value.arranged(np.broadcast_to(value.places, shape)).copy()
        return Traced.plain(np.full(shape, value, dtype=_real(dtype)))

    @staticmethod
    def take(array: Any, indices: Any, **options: Any) -> Any:  # noqa: ANN401 - as numpy's
        return np.take(as_traced(array) if isinstance(indices, Traced) else array, indices, **options)

    @staticmethod
    def broadcast_to(array: Any, shape: Any) -> Traced:  # noqa: ANN401 - as numpy's
        return spread(as_traced(array), tuple(np.atleast_1d(shape)) if isinstance(shape, int) else shape)


def _real(dtype: Any) -> Any:  # noqa: ANN401 - as numpy's
    return np.float64 if dtype is _Numpy.float64 else dtype


_NUMPY: Final = _Numpy()
_MEANINGS: Final[tuple[tuple[Any, Any], ...]] = (
    (np, _NUMPY),
    (lanes.branch, branches.branch),
    (lanes.repeat, branches.repeat),
    (checks.is_finite, faults.is_finite),
)


@contextmanager
def recording() -> Iterator[None]:
    """Let numpy code of this package compute with expressions within."""
    changed: list[tuple[dict[str, Any], str, Any]] = []
    meanings = {id(old): new for old, new in _MEANINGS}
    with _LOCK:
        try:
            for name, module in list(sys.modules.items()):
                if not name.startswith(PACKAGE) or name.startswith(OWN):
                    continue
                space = vars(module)
                for key, value in list(space.items()):
                    new = meanings.get(id(value), _without_memo(value))
                    if new is not None:
                        changed.append((space, key, value))
                        space[key] = new
            yield
        finally:
            for space, key, value in changed:
                space[key] = value


def _without_memo(value: Any) -> Callable[..., Any] | None:  # noqa: ANN401 - anything in a module
    """Return the function behind a memo, which must not keep expressions."""
    return value.__wrapped__ if isinstance(value, _lru_cache_wrapper) else None
