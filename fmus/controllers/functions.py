"""Numpy's functions other than ufuncs over arrays of expressions: arrangement, choice, sums, linear algebra.

Linear algebra works matrix by matrix; a matrix that LAPACK would refuse is noted as a fault.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import combinations
from typing import Any, Final, NamedTuple

import casadi
import numpy as np

from servobench.fmus.controllers.arrays import (
    Expression,
    NotTraceable,
    Traced,
    as_numbers,
    as_traced,
    choose,
    elementwise,
    joined,
    reduced,
    spread,
)
from servobench.fmus.controllers.branches import NOT_DEFINITE, note_fault

# Sweeps of Jacobi rotations, which converge quadratically: six reach rounding errors.
SWEEPS: Final = 10
ARRANGES: Final = frozenset(
    {
        np.reshape, np.swapaxes, np.moveaxis, np.transpose, np.diagonal, np.repeat, np.broadcast_to, np.flip,
        np.squeeze, np.expand_dims, np.ravel, np.tile, np.roll, np.atleast_1d, np.atleast_2d, np.matrix_transpose,
    }
)  # fmt: skip
"""Functions that rearrange entries: they apply to the table of places as to the numbers."""


def carry_out(
    function: Callable[..., Any], arguments: Sequence[Any], options: Mapping[str, Any]
) -> Any:  # noqa: ANN401
    """Carry out a function of numpy with at least one array of expressions among its arguments.

    Raises:
        NotTraceable: it has no expression.
    """
    if not _has_expressions([arguments, options]):
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


def _has_expressions(value: Any) -> bool:  # noqa: ANN401 - any tree
    if isinstance(value, Traced):
        return not value.constant
    if isinstance(value, Mapping):
        return any(_has_expressions(each) for each in value.values())
    if isinstance(value, (list, tuple)):
        return any(_has_expressions(each) for each in value)
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


def _extreme(name: str) -> Callable[..., Traced]:
    """Return the function that finds the first entry along an axis that none exceeds by a comparison of its name."""

    def find(array: Any, axis: int | None = None) -> Traced:  # noqa: ANN401 - as numpy's
        rows = _last_axis(array, axis)
        best = rows[..., 0]
        place = Traced.plain(np.zeros(rows.shape[:-1], dtype=np.int_))
        for k in range(1, rows.shape[-1]):
            exceeds = elementwise(name, rows[..., k], best)
            best = choose(exceeds, rows[..., k], best)
            place = choose(exceeds, k, place)
        place.kind = "i"
        return place

    return find


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
    product: Traced = np.vecdot(one, other) if of_vectors else np.matmul(one, other)
    return product


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


def each_matrix(function: Callable[..., tuple[Any, ...]], *arrays: Traced) -> list[Traced]:
    """Apply a function of CasADi's matrices to each matrix of stacks, and return the stacks of its results.

    Args:
        function: of expressions (m, n), which returns some.
        arrays: (..., m, n).
    """
    lead = np.broadcast_shapes(*(array.shape[:-2] for array in arrays))
    stacks = []
    for array in arrays:
        sizes = array.shape[-2:]
        stacks.append(spread(array, (*lead, *sizes)).reshape(-1, *sizes))
    results = []
    for matrices in zip(*stacks, strict=True):
        arguments = [_matrix(each) for each in matrices]
        results.append(function(*arguments))
    # One stack of matrices for each of the results of a call.
    joined_results = []
    for matrices in zip(*results, strict=True):
        column = casadi.vertcat(*(casadi.vec(each.T) for each in matrices))
        joined_results.append(Traced.of(column, (*lead, *matrices[0].shape)))
    return joined_results


def _matrix(array: Traced) -> Expression:
    """Return an array (m, n) as a matrix of CasADi, which counts entries column by column."""
    rows, columns = array.shape
    return casadi.reshape(array.flat(), columns, rows).T


def solve(A: Any, b: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return A⁻¹ b, with b (..., n, k), or (n,)."""
    left = as_traced(A)
    right = as_traced(b)
    if right.ndim == 1:
        return solve(left, right[:, None])[..., 0]
    return each_matrix(lambda one, other: (casadi.solve(one, other, "qr"),), left, right)[0]


def inverse(A: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return A⁻¹, (..., n, n)."""
    return solve(A, np.eye(np.shape(A)[-1]))


def cholesky(A: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return the lower factor, (..., n, n); a matrix that is not positive definite is a fault."""
    table = as_traced(A)
    factor = _cholesky(table.shape[-1])
    roots, least = each_matrix(factor, table)
    # A pivot that is NaN is not positive, either.
    definite = elementwise("greater", least, 0.0)
    note_fault(elementwise("logical_not", definite), NOT_DEFINITE)
    return roots


@cache
def _cholesky(size: int) -> Any:  # noqa: ANN401 - a function of CasADi
    """Return the function that gives L and the least pivot; NaN where there is none."""
    A = casadi.SX.sym("A", size, size)
    L = casadi.SX.zeros(size, size)
    least = casadi.SX(np.inf)
    for j in range(size):
        pivot = A[j, j]
        if j > 0:
            pivot = pivot - casadi.sumsqr(L[j, :j])
        # A pivot that is NaN compares false with everything, and becomes the least one.
        not_smaller = casadi.if_else(pivot >= least, least, pivot)
        least = casadi.if_else(pivot < least, pivot, not_smaller)
        L[j, j] = casadi.sqrt(pivot)
        for i in range(j + 1, size):
            eliminated = casadi.dot(L[i, :j], L[j, :j]) if j else 0.0
            L[i, j] = (A[i, j] - eliminated) / L[j, j]
    return casadi.Function(f"cholesky_{size}", [A], [casadi.densify(L), least])


def determinant(A: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return the determinants, (...), as the products of eliminated pivots."""
    table = as_traced(A)
    function = _determinant(table.shape[-1])
    return each_matrix(lambda one: (function(one),), table)[0][..., 0, 0]


@cache
def _determinant(size: int) -> Any:  # noqa: ANN401 - a function of CasADi
    A = casadi.SX.sym("A", size, size)
    return casadi.Function(f"determinant_{size}", [A], [casadi.det(A)])


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
    function = _svd(max(m, n), min(m, n))
    if m >= n:
        U, values, V = each_matrix(function, table)
    else:
        V, values, U = each_matrix(function, table.mT)
    values = values[..., 0]
    if compute_uv:
        return Svd(U, values, V.mT)
    return values


@cache
def _svd(rows: int, columns: int) -> Any:  # noqa: ANN401 - a function of CasADi
    """Return the function that gives U (rows, columns), singular values and V of a tall matrix."""
    sweep = _sweep(rows, columns)
    sort = _sorted(rows, columns)
    A = casadi.MX.sym("A", rows, columns)
    own = A
    turned = casadi.MX(casadi.DM.eye(columns))
    for _ in range(SWEEPS):
        own, turned = sweep(own, casadi.densify(turned))
    return casadi.Function(f"svd_{rows}_{columns}", [A], list(sort(own, turned)))


def _sweep(rows: int, columns: int) -> Any:  # noqa: ANN401 - a function of CasADi
    """Return the function that rotates each pair of columns once, and those of V alike."""
    A = casadi.SX.sym("A", rows, columns)
    V = casadi.SX.sym("V", columns, columns)
    own = casadi.horzsplit(A)
    turned = casadi.horzsplit(V)
    for p, q in combinations(range(columns), 2):
        c, s = _rotation(own[p], own[q])
        for part in (own, turned):
            one = part[p]
            other = part[q]
            part[p] = c * one - s * other
            part[q] = s * one + c * other
    outputs = [casadi.horzcat(*own), casadi.horzcat(*turned)]
    return casadi.Function(f"sweep_{rows}_{columns}", [A, V], outputs)


def _sorted(rows: int, columns: int) -> Any:  # noqa: ANN401 - a function of CasADi
    """Return the function that makes U, singular values and V of columns that are orthogonal."""
    A = casadi.SX.sym("A", rows, columns)
    V = casadi.SX.sym("V", columns, columns)
    own = casadi.horzsplit(A)
    turned = casadi.horzsplit(V)
    sizes = [casadi.sqrt(casadi.sumsqr(column)) for column in own]
    for p, q in combinations(range(columns), 2):
        swapped = sizes[p] < sizes[q]
        for part in (own, turned, sizes):
            one = part[p]
            other = part[q]
            part[p] = casadi.if_else(swapped, other, one)
            part[q] = casadi.if_else(swapped, one, other)
    left = []
    for column, size in zip(own, sizes, strict=True):
        left.append(casadi.if_else(size > 0.0, column / size, 0.0))
    if rows == columns == 3:
        # U is orthogonal also where the least value is only a rounding error.
        across = casadi.cross(left[0], left[1])
        opposite = casadi.dot(across, left[2]) < 0.0
        left[2] = casadi.if_else(opposite, -across, across)
    factors = [casadi.horzcat(*left), casadi.vertcat(*sizes), casadi.horzcat(*turned)]
    outputs = [casadi.densify(each) for each in factors]
    return casadi.Function(f"sorted_{rows}_{columns}", [A, V], outputs)


def _rotation(one: Expression, other: Expression) -> tuple[Expression, Expression]:
    """Return cosine and sine of the rotation that makes two columns orthogonal."""
    product = casadi.dot(one, other)
    zeta = (casadi.sumsqr(other) - casadi.sumsqr(one)) / (2.0 * product)
    # t = tan of the angle, the smaller root of t² + 2 ζ t − 1 = 0
    sign = casadi.if_else(zeta >= 0.0, 1.0, -1.0)
    t = sign / (casadi.fabs(zeta) + casadi.sqrt(1.0 + zeta * zeta))
    t = casadi.if_else(product == 0.0, 0.0, t)
    c = 1.0 / casadi.sqrt(1.0 + t * t)
    return c, c * t


def pseudo_inverse(a: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return A⁺, (..., n, m), with numpy's bound below which a singular value counts as 0."""
    U, values, Vh = svd(a, full_matrices=False)
    bound = 1e-15 * reduced("maximum", values, axis=-1, keepdims=True)
    large = elementwise("greater", values, bound)
    divisors = choose(large, values, 1.0)
    inverted = choose(large, elementwise("divide", 1.0, divisors), 0.0)
    result: Traced = np.matmul(Vh.mT, inverted[..., None] * U.mT)
    return result


FUNCTIONS: Final[Mapping[Any, Callable[..., Any]]] = {
    np.concatenate: _joining(np.concatenate), np.stack: _joining(np.stack),
    np.where: _where, np.take: _take, np.diff: _diff,
    np.zeros_like: _like(0.0), np.empty_like: _like(0.0), np.ones_like: _like(1.0), np.full_like: _full_like,
    np.sum: _reduction("add"), np.mean: _mean, np.max: _reduction("maximum"), np.min: _reduction("minimum"),
    np.any: _reduction("logical_or"), np.all: _reduction("logical_and"),
    np.argmin: _extreme("less"), np.argmax: _extreme("greater"), np.cumsum: _cumsum,
    np.clip: _clip, np.dot: _dot, np.cross: _cross, np.linalg.cross: _cross, np.einsum: _einsum,
    np.trace: lambda array, *axes, **named: reduced("add", np.diagonal(array, *axes, **named), axis=-1),
    np.count_nonzero: lambda array, axis=None: reduced("add", elementwise("not_equal", array, 0.0), axis),
    np.copy: lambda array: as_traced(array).copy(),
    np.shape: lambda array: array.shape, np.ndim: lambda array: array.ndim, np.size: lambda array: array.size,
    np.linalg.solve: solve, np.linalg.inv: inverse, np.linalg.cholesky: cholesky,
    np.linalg.svd: svd, np.linalg.pinv: pseudo_inverse, np.linalg.det: determinant,
}  # fmt: skip
