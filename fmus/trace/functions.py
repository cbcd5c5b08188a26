"""Numpy's functions that are no ufuncs over arrays of expressions: arrangement, choice, sums, solutions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import casadi
import numpy as np

from servobench.fmus.trace import algebra
from servobench.fmus.trace.array import NotTraceable, Traced, as_traced, joined
from servobench.fmus.trace.ufuncs import choose, elementwise, reduced

ARRANGES: Final = frozenset(
    {
        np.reshape, np.swapaxes, np.moveaxis, np.transpose, np.diagonal, np.repeat, np.broadcast_to, np.flip,
        np.squeeze, np.expand_dims, np.ravel, np.tile, np.roll, np.atleast_1d, np.atleast_2d, np.matrix_transpose,
    }
)  # fmt: skip
"""What does the same to the table of places as to the numbers."""


def carry_out(function: Callable[..., Any], arguments: Sequence[Any], options: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Carry out a function of numpy with at least one array of expressions among its arguments.

    Raises:
        NotTraceable: it has no expression.
    """
    if not _has_expressions([arguments, options]):
        return function(*_plain(list(arguments)), **{name: _plain(value) for name, value in options.items()})
    if function in ARRANGES:
        first, *rest = arguments
        return first.arranged(function(first.places, *rest, **options))
    if function not in FUNCTIONS:
        name = getattr(function, "__name__", str(function))
        raise NotTraceable(f"it calls numpy.{name}, which has no exported form")
    return FUNCTIONS[function](*arguments, **options)


def _has_expressions(value: Any) -> bool:  # noqa: ANN401 - any tree
    if isinstance(value, Traced):
        return not value.constant
    values = value.values() if isinstance(value, Mapping) else value if isinstance(value, (list, tuple)) else ()
    return any(_has_expressions(each) for each in values)


def _plain(value: Any) -> Any:  # noqa: ANN401 - any tree
    if isinstance(value, Traced):
        return value.numbers()
    return type(value)(_plain(each) for each in value) if type(value) in {list, tuple} else value


def _concatenate(arrays: Sequence[Any], axis: int = 0) -> Traced:
    return joined(arrays, lambda tables: np.concatenate(tables, axis=axis))


def _stack(arrays: Sequence[Any], axis: int = 0) -> Traced:
    return joined(arrays, lambda tables: np.stack(tables, axis=axis))


def _like(value: float) -> Callable[..., Traced]:
    def filled(array: Any, dtype: Any = None, shape: Any = None) -> Traced:  # noqa: ANN401 - as numpy's
        wanted = np.full(np.shape(array) if shape is None else shape, value)
        kind = array.dtype if dtype is None else dtype
        return Traced.plain(wanted.astype(kind))

    return filled


def _full_like(array: Any, fill_value: Any, dtype: Any = None) -> Traced:  # noqa: ANN401 - as numpy's
    new = _like(0.0)(array, dtype)
    new[...] = fill_value
    return new


def _sum(array: Any, axis: Any = None, dtype: Any = None, keepdims: bool = False) -> Traced:  # noqa: ANN401
    del dtype
    return reduced("add", array, axis, keepdims)


def _mean(array: Any, axis: Any = None, keepdims: bool = False) -> Traced:  # noqa: ANN401 - as numpy's
    total = _sum(array, axis, None, keepdims)
    return elementwise("divide", total, np.size(array) / max(total.size, 1))


def _reduction(name: str) -> Callable[..., Traced]:
    def reduction(array: Any, axis: Any = None, keepdims: bool = False, initial: Any = None) -> Traced:  # noqa: ANN401
        return reduced(name, array, axis, keepdims, initial)

    return reduction


def _extreme(name: str) -> Callable[..., Traced]:
    """Return the function that finds the first entry along an axis that none exceeds by a comparison of its name."""

    def find(array: Any, axis: int | None = None) -> Traced:  # noqa: ANN401 - as numpy's
        table = as_traced(array)
        rows = table.reshape(-1) if axis is None else table.arranged(np.moveaxis(table.places, axis, -1))
        best, place = rows[..., 0], Traced.plain(np.zeros(rows.shape[:-1], dtype=np.int_))
        for k in range(1, rows.shape[-1]):
            exceeds = elementwise(name, rows[..., k], best)
            best, place = choose(exceeds, rows[..., k], best), choose(exceeds, k, place)
        place.kind = "i"
        return place

    return find


def _cumsum(array: Any, axis: int | None = None) -> Traced:  # noqa: ANN401 - as numpy's
    table = as_traced(array)
    rows = table.reshape(-1) if axis is None else table.arranged(np.moveaxis(table.places, axis, -1))
    sums = [rows[..., 0]]
    for k in range(1, rows.shape[-1]):
        sums.append(elementwise("add", sums[-1], rows[..., k]))
    summed = _stack(sums, axis=-1)
    return summed if axis is None else summed.arranged(np.moveaxis(summed.places, -1, axis))


def _take(array: Any, indices: Any, axis: int | None = None, **options: Any) -> Traced:  # noqa: ANN401 - as numpy's
    table = as_traced(array)
    if not isinstance(indices, Traced) or indices.constant:
        return table.arranged(np.take(table.places, np.asarray(indices), axis=axis, **options))
    if axis not in {None, 0}:
        raise NotTraceable("it takes entries along an inner axis by an index that is known in the run only")
    return (table.reshape(-1) if axis is None else table)[indices]


def _trace(array: Any, offset: int = 0, axis1: int = 0, axis2: int = 1) -> Traced:  # noqa: ANN401 - as numpy's
    table = as_traced(array)
    return reduced("add", table.arranged(np.diagonal(table.places, offset, axis1, axis2)), axis=-1)


def _diff(array: Any, n: int = 1, axis: int = -1) -> Traced:  # noqa: ANN401 - as numpy's
    table = as_traced(array)
    for _ in range(n):
        rows = np.moveaxis(table.places, axis, 0)
        later, former = (table.arranged(np.moveaxis(part, 0, axis)) for part in (rows[1:], rows[:-1]))
        table = elementwise("subtract", later, former)
    return table


def _clip(array: Any, a_min: Any = None, a_max: Any = None, **bounds: Any) -> Traced:  # noqa: ANN401 - as numpy's
    low, high = bounds.get("min", a_min), bounds.get("max", a_max)
    result = as_traced(array)
    result = result if low is None else elementwise("maximum", result, low)
    return result if high is None else elementwise("minimum", result, high)


def _dot(a: Any, b: Any) -> Traced:  # noqa: ANN401 - as numpy's
    one, other = as_traced(a), as_traced(b)
    if one.ndim == 1 == other.ndim:
        return Traced.of(casadi.dot(one.flat(), other.flat()), ())
    return np.matmul(one, other)  # type: ignore[no-any-return]


def _where(condition: Any, *values: Any) -> Traced:  # noqa: ANN401 - as numpy's
    if len(values) != 2:
        raise NotTraceable("it looks for places by numbers that are known in the run only")
    return choose(condition, *values)


def _count_nonzero(array: Any, axis: Any = None) -> Traced:  # noqa: ANN401 - as numpy's
    return reduced("add", elementwise("not_equal", array, 0.0), axis)


FUNCTIONS: Final[Mapping[Any, Callable[..., Any]]] = {
    np.concatenate: _concatenate, np.stack: _stack, np.where: _where, np.take: _take, np.diff: _diff,
    np.zeros_like: _like(0.0), np.empty_like: _like(0.0), np.ones_like: _like(1.0), np.full_like: _full_like,
    np.sum: _sum, np.mean: _mean, np.max: _reduction("maximum"), np.min: _reduction("minimum"),
    np.any: _reduction("logical_or"), np.all: _reduction("logical_and"),
    np.argmin: _extreme("less"), np.argmax: _extreme("greater"), np.cumsum: _cumsum, np.trace: _trace,
    np.clip: _clip, np.dot: _dot, np.count_nonzero: _count_nonzero,
    np.copy: lambda array: as_traced(array).copy(),
    np.shape: lambda array: array.shape, np.ndim: lambda array: array.ndim, np.size: lambda array: array.size,
    np.linalg.solve: algebra.solve, np.linalg.inv: algebra.inverse, np.linalg.cholesky: algebra.cholesky,
    np.linalg.svd: algebra.svd, np.linalg.pinv: algebra.pseudo_inverse, np.linalg.det: algebra.determinant,
}  # fmt: skip
