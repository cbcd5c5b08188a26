"""A system in discrete time as C, recorded from a pure step of numpy code.

Most of numpy asks its arguments for their implementation (`__array_ufunc__`, `__array_function__`). Functions that make
arrays, the decisions of `plant.contract.lanes` and memos do not: while code is recorded, these names are replaced in
all modules of this package but its FMUs.
"""

import ctypes
import inspect
import sys
import tempfile
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import _lru_cache_wrapper, cached_property
from math import prod
from pathlib import Path
from threading import RLock
from traceback import walk_tb
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from servobench.fmus.compiler import compile_library, describe_compiler, this_platform
from servobench.fmus.controllers import branches
from servobench.fmus.controllers.arrays import (
    DTYPES,
    Buffer,
    NotTraceable,
    Traced,
    as_traced,
    spread,
)
from servobench.fmus.controllers.branches import leaves_of, with_leaves
from servobench.fmus.controllers.emission import program
from servobench.fmus.controllers.functions import carry_out
from servobench.fmus.controllers.program import STORE, Node, add, block, source
from servobench.fmus.product import committed
from servobench.plant.contract import checks, lanes
from servobench.plant.contract.cache import COMPILED, cached, key_of
from servobench.plant.contract.checks import FloatArray, Shape

Inputs: TypeAlias = Mapping[str, Any]
Shapes: TypeAlias = Mapping[str, tuple[Shape, str]]
PACKAGE = "servobench."
OWN = "servobench.fmus."
HEADERS = ("controller.h", "linear_algebra.h")
# Numbers do not depend on the level of optimisation, and the functions are called from Python.
CHECKED = ("-O1", "-fvisibility=default")
# The loop over systems side by side
SIDE_BY_SIDE = """#include "controller.h"

#define ALL(name) \\
    void name##_all(long count, double *x, const double *u, double *y, double *codes) \\
    {{ \\
        for (long i = 0; i < count; i++) codes[i] = controller_##name(x + i * {}, u + i * {}, y + i * {}); \\
    }}

ALL(start)
ALL(step)
"""
_LOCK = RLock()
Traced.function = staticmethod(carry_out)


class _Numpy:
    """numpy, except for the functions that make arrays."""

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
        if isinstance(same, Traced):
            return same.copy()
        return np.array(value, dtype=_real(dtype), **options)

    @staticmethod
    def ascontiguousarray(value: Any) -> Any:  # noqa: ANN401 - as numpy's
        if isinstance(value, Traced):
            return value
        return np.ascontiguousarray(value)

    @staticmethod
    def float64(value: Any) -> Any:  # noqa: ANN401 - as numpy's
        if isinstance(value, Traced):
            return value
        return np.float64(value)

    @staticmethod
    def zeros(shape: Any, dtype: Any = np.float64) -> Traced:  # noqa: ANN401 - as numpy's
        return Traced.plain(np.zeros(shape, dtype=_real(dtype)))

    empty = zeros

    @staticmethod
    def full(shape: Any, value: Any, dtype: Any = None) -> Traced:  # noqa: ANN401 - as numpy's
        if isinstance(value, Traced):
            return spread(value, shape).copy()
        return Traced.plain(np.full(shape, value, dtype=_real(dtype)))

    @staticmethod
    def take(array: Any, indices: Any, **options: Any) -> Any:  # noqa: ANN401 - as numpy's
        if isinstance(indices, Traced):
            array = as_traced(array)
        return np.take(array, indices, **options)

    @staticmethod
    def broadcast_to(array: Any, shape: Any) -> Traced:  # noqa: ANN401 - as numpy's
        return spread(as_traced(array), shape)


def _real(dtype: Any) -> Any:  # noqa: ANN401 - as numpy's
    """Return a type of numpy's; `float64` of recorded code is `_Numpy.float64`."""
    if dtype is _Numpy.float64:
        return np.float64
    return dtype


_MEANINGS: tuple[tuple[Any, Any], ...] = (
    (np, _Numpy()),
    (lanes.branch, branches.branch),
    (lanes.repeat, branches.repeat),
    (checks.is_finite, branches.is_finite),
)


@contextmanager
def recording(modules: Container[str] = ()) -> Iterator[None]:
    """Record numpy code of this package, and of some modules, within the context: it computes with traced arrays."""
    changed = []
    meanings = {id(old): new for old, new in _MEANINGS}
    with _LOCK:
        try:
            for name, module in list(sys.modules.items()):
                own = name.startswith(PACKAGE) and not name.startswith(OWN)
                if not own and name not in modules:
                    continue
                space = vars(module)
                for key, value in list(space.items()):
                    new = meanings.get(id(value))
                    if new is None and isinstance(value, _lru_cache_wrapper):
                        new = value.__wrapped__  # A memo must not keep traced arrays.
                    if new is not None:
                        changed.append((space, key, value))
                        space[key] = new
            yield
        finally:
            for space, key, value in changed:
                space[key] = value


@dataclass(frozen=True)
class Recorded:
    """A system x(0) = start(u), (x, y) ← step(x, u), as C.

    It is compiled for this machine when it is called for the first time, and kept in the user's cache. Arrays may have
    leading axes, of systems side by side. All functions return the code of a fault as well, 0 for none.
    """

    source: str
    states: int  # number of entries of the state
    inputs: int
    outputs: int
    flags: tuple[str, ...] = CHECKED  # given to the compiler

    def start(self, u: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return x, (..., states), and codes for inputs (..., inputs)."""
        x = np.empty((*np.shape(u)[:-1], self.states))
        _, codes = self._carry_out("start", x, u)
        return x, codes

    def step(self, x: npt.ArrayLike, u: npt.ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the new x, y and codes."""
        new = np.array(x, dtype=np.float64)
        return new, *self.advance(new, u)

    def advance(self, x: FloatArray, u: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Overwrite x, (..., states) without gaps, with the new one; return y, (..., outputs), and codes, (...)."""
        return self._carry_out("step", x, u)

    def prepare(self) -> None:
        """Compile it unless that was done.

        Raises:
            ValueError: no compiler, or no folder of one's own for code.
        """
        _ = self._library

    def _carry_out(
        self, name: str, x: FloatArray, u: npt.ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        given = np.ascontiguousarray(u, dtype=np.float64)
        lead = given.shape[:-1]
        y = np.empty((*lead, self.outputs))
        codes = np.empty(lead)
        function = getattr(self._library, f"{name}_all")
        places = (ctypes.c_void_p(each.ctypes.data) for each in (x, given, y, codes))
        function(ctypes.c_long(codes.size), *places)
        return y, codes

    @cached_property
    def _library(self) -> ctypes.CDLL:
        target = this_platform()
        name = f"controller{target.suffix}"
        loop = SIDE_BY_SIDE.format(self.states, self.inputs, self.outputs)
        sources = {"controller.c": self.source, "side_by_side.c": loop}
        headers = {header: committed("controller", header) for header in HEADERS}

        def make(folder: Path) -> None:
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
                for file, text in (sources | headers).items():
                    Path(scratch, file).write_text(text, encoding="utf-8")
                compile_library(Path(scratch), list(sources), target, folder / name, self.flags)

        key = key_of(sources, headers, self.flags, describe_compiler(target))
        return ctypes.CDLL(str(cached(COMPILED, key, make) / name))


def record(
    system: Any,  # noqa: ANN401 - any system
    start: Callable[[Any, Inputs], Any],
    step: Callable[[Any, Any, Inputs], tuple[Any, Any]],
    inputs: Shapes,
    *,
    shared: Any = None,  # noqa: ANN401 - anything
    modules: Container[str] = (),
) -> Recorded:
    """Record a system.

    Args:
        system: first argument of both functions; a copy of it is used, whose memos may keep traced arrays.
        start: system, inputs -> state, a tree of arrays.
        step: system, state, inputs -> new state of the same form, and the output.
        inputs: shape and kind of each, in the order of the columns of u.
        shared: a part of the system that is not copied, such as a function with a lock that no step calls.
        modules: with code of users that the step calls.

    Raises:
        NotTraceable: it cannot be recorded; names the function that stands in the way.
    """
    try:
        own = deepcopy(system, {id(shared): shared})
    except TypeError as error:
        raise NotTraceable(
            "it holds something that is no formula, such as a solver; take another law"
        ) from error
    given = sum(prod(shape) for shape, _ in inputs.values())
    try:
        with recording(modules):
            with block() as beginning:
                tree = start(own, _inputs(inputs, given))
                first = leaves_of(tree)
                _store("x", first)
            with block() as period:
                x = source("x", sum(np.size(leaf) for leaf in first))
                state, output = step(
                    own, with_leaves(tree, _parts(x, first)), _inputs(inputs, given)
                )
                new = leaves_of(state)
                _store("y", [output])
                _store("x", new)
    except NotTraceable as error:
        raise NotTraceable(f"{_where_it_failed(error)}: {error}") from error
    if [np.shape(leaf) for leaf in new] != [np.shape(leaf) for leaf in first]:
        raise NotTraceable("its state has other sizes later than at the start")
    text = program({"controller_start": beginning, "controller_step": period})
    return Recorded(text, x.size, given, np.size(output))


def _inputs(inputs: Shapes, size: int) -> dict[str, Traced]:
    """Return the inputs as arrays by name, which are parts of the column u."""
    parts = _parts(source("u", size), [np.empty(shape) for shape, _ in inputs.values()])
    kinds = [DTYPES[kind] for _, kind in inputs.values()]
    return dict(zip(inputs, map(Traced.astype, parts, kinds), strict=True))


def _parts(x: Node, leaves: Sequence[Any]) -> list[Traced]:
    """Return arrays like some others as the parts of a column."""
    found = []
    first = 0
    for leaf in leaves:
        places = first + np.arange(np.size(leaf)).reshape(np.shape(leaf))
        found.append(Traced(Buffer(x), places, leaf.dtype.kind))
        first += places.size
    return found


def _store(name: str, leaves: Sequence[Any]) -> None:
    """Record that arrays are written to a column one after the other."""
    first = 0
    for leaf in leaves:
        add(STORE, [as_traced(leaf).operand()], (), (name, first))
        first += np.size(leaf)


def _where_it_failed(error: BaseException) -> str:
    """Return the innermost function outside of the recorder that an error came through."""
    found = "the code"
    own = Path(__file__).parent
    for place, _ in walk_tb(error.__traceback__):
        code = place.f_code
        module = str(place.f_globals.get("__name__", ""))
        if Path(code.co_filename).parent != own and "servobench" in module:
            found = f"{code.co_qualname} in {inspect.getmodulename(code.co_filename)}"
    return found
