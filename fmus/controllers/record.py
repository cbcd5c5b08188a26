"""A system in discrete time as CasADi functions, recorded from a pure step of numpy code.

Most of numpy asks its arguments for their implementation (`__array_ufunc__`, `__array_function__`). Functions that make
arrays, the decisions of `plant.contract.lanes` and memos do not: while code is recorded, these names are replaced in
all modules of this package but its FMUs.
"""

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import _lru_cache_wrapper
from math import prod
from pathlib import Path
from threading import RLock
from traceback import walk_tb
from typing import Any, Final, TypeAlias

import casadi
import numpy as np

from servobench.fmus.controllers import branches
from servobench.fmus.controllers.arrays import Expression, NotTraceable, Traced, as_traced, spread
from servobench.fmus.controllers.branches import frame, leaves_of, symbols_like, with_leaves
from servobench.fmus.controllers.functions import carry_out
from servobench.plant.contract import checks, lanes

Inputs: TypeAlias = Mapping[str, Any]
Shapes: TypeAlias = Mapping[str, tuple[tuple[int, ...], str]]
PACKAGE: Final = "servobench."
OWN: Final = "servobench.fmus."
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
            return value.arranged(np.broadcast_to(value.places, shape)).copy()
        return Traced.plain(np.full(shape, value, dtype=_real(dtype)))

    @staticmethod
    def take(array: Any, indices: Any, **options: Any) -> Any:  # noqa: ANN401 - as numpy's
        if isinstance(indices, Traced):
            array = as_traced(array)
        return np.take(array, indices, **options)

    @staticmethod
    def broadcast_to(array: Any, shape: Any) -> Traced:  # noqa: ANN401 - as numpy's
        if isinstance(shape, int):
            shape = (shape,)
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
    """Record numpy code of this package within the context: it computes with expressions."""
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
                        new = value.__wrapped__  # A memo must not keep expressions.
                    if new is not None:
                        changed.append((space, key, value))
                        space[key] = new
            yield
        finally:
            for space, key, value in changed:
                space[key] = value


@dataclass(frozen=True)
class Recorded:
    """A system x(0) = start(u), (x, y) ← step(x, u)."""

    start: Any  # CasADi function u -> x, code
    step: Any  # CasADi function x, u -> x, y, code; a code that is not 0 is that of a fault, as in `branches`

    @property
    def states(self) -> int:
        """Number of entries of the state."""
        return int(self.start.numel_out(0))


def record(
    system: Any,  # noqa: ANN401 - any system
    start: Callable[[Any, Inputs], Any],
    step: Callable[[Any, Any, Inputs], tuple[Any, Any]],
    inputs: Shapes,
) -> Recorded:
    """Record a system.

    Args:
        system: first argument of both functions; a copy of it is used, whose memos may keep expressions.
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
            values, u = _inputs(inputs)
            with frame() as faults:
                first = start(own, values)
            outputs = [_column(first), faults.code]
            begin = casadi.Function("controller_start", [u], outputs, {"cse": True})
            return Recorded(begin, _recorded_step(own, step, inputs, first))
    except NotTraceable as error:
        raise NotTraceable(f"{_where_it_failed(error)}: {error}") from error
    except RuntimeError as error:  # raised by CasADi
        said = str(error).partition("\n")[0]
        raise NotTraceable(
            f"{_where_it_failed(error)}: CasADi cannot express it ({said})"
        ) from error


def _recorded_step(
    system: Any,  # noqa: ANN401 - as `record`
    step: Callable[[Any, Any, Inputs], tuple[Any, Any]],
    inputs: Shapes,
    first: Any,  # noqa: ANN401 - any tree
) -> Any:  # noqa: ANN401 - a function of CasADi
    """Return the function that computes a step from a state like the `first`."""
    values, u = _inputs(inputs)
    leaves = leaves_of(first)
    symbols = symbols_like(leaves)
    with frame() as faults:
        state, output = step(system, with_leaves(first, symbols), values)
    new = leaves_of(state)
    if [np.shape(leaf) for leaf in new] != [np.shape(leaf) for leaf in leaves]:
        raise NotTraceable("its state has other sizes later than at the start")
    # All arrays of the state become parts of one column x.
    ends = np.cumsum([0, *(symbol.size for symbol in symbols)]).tolist()
    x = casadi.MX.sym("x", ends[-1])
    parts = casadi.vertsplit(x, ends)
    results = [_column(state), as_traced(output).flat(), faults.code]
    arrays = [symbol.buffer.content for symbol in symbols]
    results = casadi.substitute(results, arrays, parts)
    return casadi.Function("controller_step", [x, u], results, {"cse": True})


def _inputs(inputs: Shapes) -> tuple[dict[str, Traced], Expression]:
    """Return the inputs as arrays by name, and the column u of symbols that they are parts of."""
    u = casadi.MX.sym("u", sum(prod(shape) for shape, _ in inputs.values()))
    values = {}
    first = 0
    for name, (shape, kind) in inputs.items():
        end = first + prod(shape)
        part = u[first:end]
        if kind == "b":
            part = part != 0.0
        values[name] = Traced.of(part, shape, kind)
        first = end
    return values, u


def _column(tree: Any) -> Expression:  # noqa: ANN401 - any tree
    """Return all arrays of a tree as one column."""
    return casadi.vertcat(*(as_traced(leaf).flat() for leaf in leaves_of(tree)))


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
