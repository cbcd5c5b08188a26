"""A system in discrete time as C, recorded from a pure step of numpy code.

Most of numpy asks its arguments for their implementation (`__array_ufunc__`, `__array_function__`). Functions that make
arrays, the decisions of `plant.contract.lanes` and memos do not: while code is recorded, these names are replaced in
all modules of this package but its FMUs.
"""

import ctypes
import inspect
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import _lru_cache_wrapper, cached_property
from math import prod
from pathlib import Path
from threading import RLock
from traceback import walk_tb
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt

from servobench.fmus.compiler import compile_library, this_platform
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
from servobench.plant.contract.checks import FloatArray

Inputs: TypeAlias = Mapping[str, Any]
Shapes: TypeAlias = Mapping[str, tuple[tuple[int, ...], str]]
PACKAGE: Final = "servobench."
OWN: Final = "servobench.fmus."
HEADERS: Final = ("controller.h", "linear_algebra.h")
# Numbers do not depend on the level of optimisation, and the functions are called from Python.
CHECKED: Final = ("-O1", "-fvisibility=default")
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


_MEANINGS: Final[tuple[tuple[Any, Any], ...]] = (
    (np, _Numpy()),
    (lanes.branch, branches.branch),
    (lanes.repeat, branches.repeat),
    (checks.is_finite, branches.is_finite),
)


@contextmanager
def recording() -> Iterator[None]:
    """Record numpy code of this package within the context: it computes with traced arrays."""
    changed = []
    meanings = {id(old): new for old, new in _MEANINGS}
    with _LOCK:
        try:
            for name, module in list(sys.modules.items()):
                if not name.startswith(PACKAGE) or name.startswith(OWN):
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

    It is compiled for this machine when it is called for the first time. Both functions return the code of a fault as
    well, 0 for none.
    """

    source: str
    states: int  # number of entries of the state
    outputs: int

    def start(self, u: npt.ArrayLike) -> tuple[FloatArray, float]:
        """Return x and a code."""
        return self._called("start", np.empty(self.states), u)[::2]

    def step(self, x: npt.ArrayLike, u: npt.ArrayLike) -> tuple[FloatArray, FloatArray, float]:
        """Return x, y and a code."""
        return self._called("step", np.array(x, dtype=np.float64), u)

    def _called(
        self, name: str, x: FloatArray, u: npt.ArrayLike
    ) -> tuple[FloatArray, FloatArray, float]:
        y = np.empty(self.outputs)
        arrays = (x, np.ascontiguousarray(u, dtype=np.float64), y)
        function = getattr(self._library, f"controller_{name}")
        function.restype = ctypes.c_double
        return x, y, function(*(ctypes.c_void_p(each.ctypes.data) for each in arrays))

    @cached_property
    def _library(self) -> ctypes.CDLL:
        target = this_platform()
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
            folder = Path(name)
            for header in HEADERS:
                (folder / header).write_text(committed("controller", header), encoding="utf-8")
            (folder / "controller.c").write_text(self.source, encoding="utf-8")
            library = folder / f"controller{target.suffix}"
            compile_library(folder, ["controller.c"], target, library, CHECKED)
            return ctypes.CDLL(str(library))


def record(
    system: Any,  # noqa: ANN401 - any system
    start: Callable[[Any, Inputs], Any],
    step: Callable[[Any, Any, Inputs], tuple[Any, Any]],
    inputs: Shapes,
) -> Recorded:
    """Record a system.

    Args:
        system: first argument of both functions; a copy of it is used, whose memos may keep traced arrays.
        start: system, inputs -> state, a tree of arrays.
        step: system, state, inputs -> new state of the same form, and the output.
        inputs: shape and kind of each, in the order of the columns of u.

    Raises:
        NotTraceable: it cannot be recorded; names the function that stands in the way.
    """
    try:
        own = deepcopy(system)
    except TypeError as error:
        raise NotTraceable(
            "it holds something that is no formula, such as a solver; take another law"
        ) from error
    try:
        with recording():
            with block() as beginning:
                tree = start(own, _inputs(inputs))
                first = leaves_of(tree)
                _store("x", first)
            with block() as period:
                x = source("x", sum(np.size(leaf) for leaf in first))
                state, output = step(own, with_leaves(tree, _parts(x, first)), _inputs(inputs))
                new = leaves_of(state)
                _store("y", [output])
                _store("x", new)
    except NotTraceable as error:
        raise NotTraceable(f"{_where_it_failed(error)}: {error}") from error
    if [np.shape(leaf) for leaf in new] != [np.shape(leaf) for leaf in first]:
        raise NotTraceable("its state has other sizes later than at the start")
    text = program({"controller_start": beginning, "controller_step": period})
    return Recorded(text, x.size, np.size(output))


def _inputs(inputs: Shapes) -> dict[str, Traced]:
    """Return the inputs as arrays by name, which are parts of the column u."""
    u = source("u", sum(prod(shape) for shape, _ in inputs.values()))
    values = {}
    first = 0
    for name, (shape, kind) in inputs.items():
        part = Traced(Buffer(u), first + np.arange(prod(shape)).reshape(shape))
        values[name] = part.astype(DTYPES[kind])
        first += prod(shape)
    return values


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
