"""Numpy's linear algebra over arrays of expressions, matrix by matrix; what LAPACK refuses is a fault."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Final, NamedTuple

import casadi
import numpy as np

from servobench.fmus.trace.array import Expression, NotTraceable, Traced, as_traced
from servobench.fmus.trace.faults import NOT_DEFINITE, note_fault
from servobench.fmus.trace.ufuncs import choose, elementwise, reduced

SWEEPS: Final = 10  # of Jacobi rotations, which converge quadratically: six are enough for rounding errors to remain


def each_matrix(function: Callable[..., tuple[Any, ...]], *arrays: Traced) -> list[Traced]:
    """Return the results of a function of matrices, given and returned as CasADi has them, for each of stacks of them.

    Args:
        function: of expressions (m, n), which returns some.
        arrays: (..., m, n).
    """
    lead = np.broadcast_shapes(*(array.shape[:-2] for array in arrays))
    stacks = []
    for array in arrays:
        places = np.broadcast_to(array.places, (*lead, *array.shape[-2:])).reshape(-1, *array.shape[-2:])
        stacks.append([_matrix(array.arranged(one)) for one in places])
    results = [function(*matrices) for matrices in zip(*stacks, strict=True)]
    arranged = []
    for k, first in enumerate(results[0]):
        content = casadi.vertcat(*(casadi.vec(result[k].T) for result in results))
        arranged.append(Traced.of(content, (*lead, *first.shape)))
    return arranged


def _matrix(array: Traced) -> Expression:
    rows, columns = array.shape
    return casadi.reshape(array.flat(), columns, rows).T


def solve(A: Any, b: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return A⁻¹ b, with b (..., n, k), or (n,)."""
    left, right = as_traced(A), as_traced(b)
    if right.ndim == 1:
        return solve(left, right[:, None])[..., 0]
    return each_matrix(lambda one, other: (casadi.solve(one, other, "qr"),), left, right)[0]


def inverse(A: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return A⁻¹, (..., n, n)."""
    return solve(A, np.eye(np.shape(A)[-1]))


def cholesky(A: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return the lower factor, (..., n, n); what is not positive definite is a fault."""
    table = as_traced(A)
    factor = _cholesky(table.shape[-1])
    roots, least = each_matrix(factor, table)
    note_fault(elementwise("logical_not", elementwise("greater", least, 0.0)), NOT_DEFINITE)
    return roots


@cache
def _cholesky(size: int) -> Any:  # noqa: ANN401 - a function of CasADi
    """Return the function that gives L and the least pivot; NaN where there is none."""
    A, L = casadi.SX.sym("A", size, size), casadi.SX.zeros(size, size)
    least = casadi.SX(np.inf)
    for j in range(size):
        pivot = A[j, j] - casadi.sumsqr(L[j, :j]) if j else A[j, j]
        least = casadi.if_else(pivot < least, pivot, casadi.if_else(pivot >= least, least, pivot))
        L[j, j] = casadi.sqrt(pivot)
        for i in range(j + 1, size):
            done = casadi.dot(L[i, :j], L[j, :j]) if j else 0.0
            L[i, j] = (A[i, j] - done) / L[j, j]
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
        raise NotTraceable("it calls numpy.linalg.svd of a matrix that is not square without full_matrices=False")
    function = _svd(max(m, n), min(m, n))
    if m >= n:
        U, values, V = each_matrix(function, table)
    else:
        V, values, U = each_matrix(function, table.mT)
    values = values[..., 0]
    return Svd(U, values, V.mT) if compute_uv else values


@cache
def _svd(rows: int, columns: int) -> Any:  # noqa: ANN401 - a function of CasADi
    """Return the function that gives U (rows, columns), singular values and V of a tall matrix."""
    sweep, sort = _sweep(rows, columns), _sorted(rows, columns)
    A = casadi.MX.sym("A", rows, columns)
    own, turned = A, casadi.MX(casadi.DM.eye(columns))
    for _ in range(SWEEPS):
        own, turned = sweep(own, casadi.densify(turned))
    return casadi.Function(f"svd_{rows}_{columns}", [A], list(sort(own, turned)))


def _sweep(rows: int, columns: int) -> Any:  # noqa: ANN401 - a function of CasADi
    """Return the function that rotates each pair of columns once, and those of V alike."""
    A, V = casadi.SX.sym("A", rows, columns), casadi.SX.sym("V", columns, columns)
    own, turned = casadi.horzsplit(A), casadi.horzsplit(V)
    for p in range(columns):
        for q in range(p + 1, columns):
            c, s = _rotation(own[p], own[q])
            for part in (own, turned):
                part[p], part[q] = c * part[p] - s * part[q], s * part[p] + c * part[q]
    return casadi.Function(f"sweep_{rows}_{columns}", [A, V], [casadi.horzcat(*own), casadi.horzcat(*turned)])


def _sorted(rows: int, columns: int) -> Any:  # noqa: ANN401 - a function of CasADi
    """Return the function that makes U, singular values and V of columns that are orthogonal."""
    A, V = casadi.SX.sym("A", rows, columns), casadi.SX.sym("V", columns, columns)
    own, turned = casadi.horzsplit(A), casadi.horzsplit(V)
    sizes = [casadi.sqrt(casadi.sumsqr(column)) for column in own]
    for p in range(columns):
        for q in range(p + 1, columns):
            swapped = sizes[p] < sizes[q]
            for part in (own, turned, sizes):
                one, other = part[p], part[q]
                part[p], part[q] = casadi.if_else(swapped, other, one), casadi.if_else(swapped, one, other)
    left = [casadi.if_else(size > 0.0, column / size, 0.0) for column, size in zip(own, sizes, strict=True)]
    if rows == columns == 3:  # also where the least value is nothing but a rounding error
        across = casadi.cross(left[0], left[1])
        left[2] = casadi.if_else(casadi.dot(across, left[2]) < 0.0, -across, across)
    outputs = [casadi.horzcat(*left), casadi.vertcat(*sizes), casadi.horzcat(*turned)]
    return casadi.Function(f"sorted_{rows}_{columns}", [A, V], [casadi.densify(each) for each in outputs])


def _rotation(one: Expression, other: Expression) -> tuple[Expression, Expression]:
    """Return cosine and sine of the rotation that makes two columns orthogonal."""
    product = casadi.dot(one, other)
    zeta = (casadi.sumsqr(other) - casadi.sumsqr(one)) / (2.0 * product)
    t = casadi.if_else(zeta >= 0.0, 1.0, -1.0) / (casadi.fabs(zeta) + casadi.sqrt(1.0 + zeta * zeta))
    t = casadi.if_else(product == 0.0, 0.0, t)
    c = 1.0 / casadi.sqrt(1.0 + t * t)
    return c, c * t


def pseudo_inverse(a: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return A⁺, (..., n, m), with numpy's bound below which a singular value counts as 0."""
    U, values, Vh = svd(a, full_matrices=False)
    bound = 1e-15 * reduced("maximum", values, axis=-1, keepdims=True)
    large = elementwise("greater", values, bound)
    inverted = choose(large, elementwise("divide", 1.0, choose(large, values, 1.0)), 0.0)
    result: Traced = np.matmul(Vh.mT, inverted[..., None] * U.mT)
    return result
