"""Numpy's functions other than ufuncs over traced arrays: arrangement, choice, sums, linear algebra.

Linear algebra is that of `linear_algebra.h`; a matrix that LAPACK would refuse is noted as a fault.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from servobench.fmus.controllers.arrays import (
    NotTraceable,
    Traced,
    as_numbers,
    as_traced,
    choose,
    elementwise,
    joined,
    reduced,
)
from servobench.fmus.controllers.branches import NOT_DEFINITE, note_fault
from servobench.fmus.controllers.program import CALL, computed

ARRANGES = frozenset(
    {
        np.reshape, np.swapaxes, np.moveaxis, np.transpose, np.diagonal, np.repeat, np.broadcast_to, np.flip,
        np.squeeze, np.expand_dims, np.ravel, np.tile, np.roll, np.atleast_1d, np.atleast_2d, np.matrix_transpose,
    }
)  # fmt: skip
"""Functions that rearrange entries: they apply to the table of places as to the numbers."""


def carry_out(
    function: Callable[..., Any], arguments: Sequence[Any], options: Mapping[str, Any]
) -> Any:  # noqa: ANN401
    """Carry out a function of numpy with at least one traced array among its arguments.

    Raises:
        NotTraceable: it has no exported form.
    """
    if not _is_computed([arguments, options]):
        plain_arguments = [as_numbers(value) for value in arguments]
        plain_options = {name: as_numbers(value) for name, value in options.items()}
        return function(*plain_arguments, **plain_options)
    if function in ARRANGES:
        first, *rest = arguments
        places = function(first.places, *rest, **options)
        return first.arranged(places)
    if function not in FUNCTIONS:
        name = getattr(function, "__name__", str(function))
        raise NotTraceable(f"it calls numpy.{name}, which has no exported form")
    return FUNCTIONS[function](*arguments, **options)


def _is_computed(value: Any) -> bool:  # noqa: ANN401 - any tree
    if isinstance(value, Traced):
        return not value.constant
    if isinstance(value, Mapping):
        return any(_is_computed(each) for each in value.values())
    if isinstance(value, (list, tuple)):
        return any(_is_computed(each) for each in value)
    return False


def _joining(function: Callable[..., Any]) -> Callable[..., Traced]:
    return lambda arrays, axis=0: joined(arrays, lambda tables: function(tables, axis=axis))


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


def _mean(array: Any, axis: Any = None, keepdims: bool = False) -> Traced:  # noqa: ANN401 - as numpy's
    total = reduced("add", array, axis, keepdims)
    return elementwise("divide", total, np.size(array) / max(total.size, 1))


def _reduction(name: str) -> Callable[..., Traced]:
    return lambda array, axis=None, keepdims=False, initial=None, dtype=None: reduced(
        name, array, axis, keepdims, initial
    )


def _last_axis(array: Any, axis: int | None) -> Traced:  # noqa: ANN401 - as numpy's
    """Return an array with an axis moved to the end; all entries in one row for None."""
    if axis is None:
        return as_traced(np.ravel(array))
    return as_traced(np.moveaxis(array, axis, -1))


def _argmax(array: Any, axis: int | None = None) -> Traced:  # noqa: ANN401 - as numpy's
    place = call("place_of_largest", 1, _last_axis(array, axis)[..., None])[..., 0]
    place.kind = "i"
    return place


def _cumsum(array: Any, axis: int | None = None) -> Traced:  # noqa: ANN401 - as numpy's
    rows = _last_axis(array, axis)
    total = rows[..., 0]
    sums = [total]
    for k in range(1, rows.shape[-1]):
        total = elementwise("add", total, rows[..., k])
        sums.append(total)
    summed = _joining(np.stack)(sums, axis=-1)
    if axis is None:
        return summed
    return summed.arranged(np.moveaxis(summed.places, -1, axis))


def _take(array: Any, indices: Any, axis: int | None = None, **options: Any) -> Traced:  # noqa: ANN401 - as numpy's
    table = as_traced(array)
    if not isinstance(indices, Traced) or indices.constant:
        places = np.take(table.places, np.asarray(indices), axis=axis, **options)
        return table.arranged(places)
    if axis not in {None, 0}:
        raise NotTraceable(
            "it takes entries along an inner axis by an index that is known in the run only"
        )
    if axis is None:
        table = table.reshape(-1)
    return table[indices]


def _diff(array: Any, n: int = 1, axis: int = -1) -> Traced:  # noqa: ANN401 - as numpy's
    rows = as_traced(np.moveaxis(array, axis, 0))
    for _ in range(n):
        rows = elementwise("subtract", rows[1:], rows[:-1])
    return rows.arranged(np.moveaxis(rows.places, 0, axis))


def _clip(array: Any, a_min: Any = None, a_max: Any = None, **bounds: Any) -> Traced:  # noqa: ANN401 - as numpy's
    low = bounds.get("min", a_min)
    high = bounds.get("max", a_max)
    result = as_traced(array)
    if low is not None:
        result = elementwise("maximum", result, low)
    if high is not None:
        result = elementwise("minimum", result, high)
    return result


def _dot(a: Any, b: Any) -> Traced:  # noqa: ANN401 - as numpy's
    one = as_traced(a)
    other = as_traced(b)
    of_vectors = one.ndim == 1 and other.ndim == 1
    return np.vecdot(one, other) if of_vectors else np.matmul(one, other)


def _cross(a: Any, b: Any, axis: int = -1) -> Traced:  # noqa: ANN401 - as numpy's
    one = as_traced(np.moveaxis(a, axis, -1))
    other = as_traced(np.moveaxis(b, axis, -1))
    if {one.shape[-1], other.shape[-1]} != {3}:
        raise NotTraceable(
            "it calls numpy.cross, of which only products of three numbers each have an exported form"
        )
    # y z′ − z y′, z x′ − x z′, x y′ − y x′
    yzx = [1, 2, 0]
    zxy = [2, 0, 1]
    product = one[..., yzx] * other[..., zxy] - one[..., zxy] * other[..., yzx]
    return as_traced(np.moveaxis(product, -1, axis))


def _einsum(subscripts: str, a: Any, b: Any) -> Traced:  # noqa: ANN401 - as numpy's
    if subscripts != "...i,...j->...ij":
        raise NotTraceable(
            f'it calls numpy.einsum("{subscripts}"), of which only products a bᵀ have an exported form'
        )
    return elementwise("multiply", as_traced(a)[..., :, None], as_traced(b)[..., None, :])


def _where(condition: Any, *values: Any) -> Traced:  # noqa: ANN401 - as numpy's
    if len(values) != 2:
        raise NotTraceable("it looks for places by numbers that are known in the run only")
    return choose(condition, *values)


def call(name: str, result: int, *arrays: Traced) -> Traced:
    """Return the results, (..., result), of a function of `linear_algebra.h` for each matrix of stacks.

    Args:
        name: of the function.
        result: size of what it writes.
        arrays: (..., m, n), its arguments; it gets the sizes of the last one.
    """
    lead = np.broadcast_shapes(*(array.shape[:-2] for array in arrays))
    operands = [array.operand((*lead, *array.shape[-2:])) for array in arrays]
    shape = (*lead, result)
    return Traced.of(computed(CALL, operands, shape, (name, *arrays[-1].shape[-2:])), shape)


def solve(A: Any, b: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return A⁻¹ b, with b (..., n, k), or (n,)."""
    left = as_traced(A)
    right = as_traced(b)
    if right.ndim == 1:
        return solve(left, right[:, None])[..., 0]
    n, k = right.shape[-2:]
    solution = call("solve", n * k, left, right)
    return solution.reshape((*solution.shape[:-1], n, k))


def inverse(A: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return A⁻¹, (..., n, n)."""
    return solve(A, np.eye(np.shape(A)[-1]))


def cholesky(A: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return the lower factor, (..., n, n); a matrix that is not positive definite is a fault."""
    table = as_traced(A)
    entries = int(np.prod(table.shape[-2:]))
    factor = call("cholesky", entries + 1, table)
    # A pivot that is NaN is not positive, either.
    definite = elementwise("greater", factor[..., entries], 0.0)
    note_fault(elementwise("logical_not", definite), NOT_DEFINITE)
    return factor[..., :entries].reshape(table.shape)


def determinant(A: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return the determinants, (...), as the products of eliminated pivots."""
    return call("determinant", 1, as_traced(A))[..., 0]


class Svd(NamedTuple):
    """U (..., m, k), singular values (..., k), the largest first, and Vᵀ (..., k, n), with k the smaller of m and n."""

    U: Traced
    S: Traced
    Vh: Traced


def svd(a: Any, full_matrices: bool = True, compute_uv: bool = True) -> Svd | Traced:  # noqa: ANN401 - as numpy's
    """Return the singular value decomposition by one-sided Jacobi rotations.

    Raises:
        NotTraceable: square factors of a matrix that is not square.
    """
    table = as_traced(a)
    m, n = table.shape[-2:]
    if full_matrices and compute_uv and m != n:
        raise NotTraceable(
            "it calls numpy.linalg.svd of a matrix that is not square without full_matrices=False"
        )
    # The factors of the transpose are those of the matrix, in the opposite order.
    wide = m < n
    tall = table.mT if wide else table
    rows, columns = tall.shape[-2:]
    # Uᵀ, V and the singular values are columns of the result.
    factors = call("svd", (rows + columns + 1) * columns, tall)
    split = rows * columns
    lead = factors.shape[:-1]
    values = factors[..., split + columns * columns :]
    if not compute_uv:
        return values
    U = factors[..., :split].reshape((*lead, columns, rows))
    V = factors[..., split : split + columns * columns].reshape((*lead, columns, columns))
    if wide:
        return Svd(V.mT, values, U)
    return Svd(U.mT, values, V)


def pseudo_inverse(a: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return A⁺, (..., n, m), with numpy's bound below which a singular value counts as 0."""
    U, values, Vh = svd(a, full_matrices=False)
    bound = 1e-15 * reduced("maximum", values, axis=-1, keepdims=True)
    large = elementwise("greater", values, bound)
    divisors = choose(large, values, 1.0)
    inverted = choose(large, elementwise("divide", 1.0, divisors), 0.0)
    return np.matmul(Vh.mT, inverted[..., None] * U.mT)


FUNCTIONS: Mapping[Any, Callable[..., Any]] = {
    np.concatenate: _joining(np.concatenate), np.stack: _joining(np.stack),
    np.where: _where, np.take: _take, np.diff: _diff,
    np.zeros_like: _like(0.0), np.empty_like: _like(0.0), np.ones_like: _like(1.0), np.full_like: _full_like,
    np.sum: _reduction("add"), np.mean: _mean, np.max: _reduction("maximum"), np.min: _reduction("minimum"),
    np.any: _reduction("logical_or"), np.all: _reduction("logical_and"),
    np.argmin: lambda array, axis=None: _argmax(-array, axis), np.argmax: _argmax, np.cumsum: _cumsum,
    np.clip: _clip, np.dot: _dot, np.cross: _cross, np.linalg.cross: _cross, np.einsum: _einsum,
    np.trace: lambda array, *axes, **named: reduced("add", np.diagonal(array, *axes, **named), axis=-1),
    np.count_nonzero: lambda array, axis=None: reduced("add", elementwise("not_equal", array, 0.0), axis),
    np.copy: lambda array: as_traced(array).copy(),
    np.shape: lambda array: array.shape, np.ndim: lambda array: array.ndim, np.size: lambda array: array.size,
    np.linalg.solve: solve, np.linalg.inv: inverse, np.linalg.cholesky: cholesky,
    np.linalg.svd: svd, np.linalg.pinv: pseudo_inverse, np.linalg.det: determinant,
}  # fmt: skip
