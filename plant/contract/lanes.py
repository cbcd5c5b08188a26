"""Many runs side by side: arrays with leading axes, a lane a run; a single run has no leading axis.

Parts are written once, over arrays (..., n): a single run is the batch of shape `()`. An action in some lanes
only goes through `branch`, so that no part writes a mask. A state is a tree of arrays: named tuples, tuples and
dataclasses, of which every array has the leading axes; all other values in them are shared by all lanes. A number of a
single run is a scalar of numpy, which costs a tenth of an array without axes: `array[()]` makes the one of the other.

A lane has the same bits beside any neighbours, as long as no leading axis becomes an axis of a matrix: products
are `@`, `numpy.matvec`, `numpy.vecmat` and `numpy.vecdot`, and sums run over the last, contiguous axes.
"""

import math
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from threadpoolctl import ThreadpoolController

from servobench.plant.contract.checks import AnyArray, FloatArray, IntArray

Tree = TypeVar("Tree")
Lanes = Any  # an index of the leading axes
_found: list[tuple[int, ThreadpoolController]] = []


def map_arrays(function: Callable[..., Any], tree: Tree, *others: Tree) -> Tree:
    """Return the tree with `function` applied to its arrays, and to those at the same place of the other trees."""
    mapped: Tree = tree
    if isinstance(tree, (np.ndarray, np.generic)):  # numpy makes numbers of arrays without axes
        mapped = function(tree, *others)
    elif isinstance(tree, tuple):
        make: Any = getattr(tree, "_make", tuple)
        mapped = make([map_arrays(function, *each) for each in zip(tree, *others, strict=True)])
    elif is_dataclass(tree) and not isinstance(tree, type):
        mapped = object.__new__(type(tree))
        for name in (field.name for field in fields(tree)):
            object.__setattr__(
                mapped,
                name,
                map_arrays(function, *(getattr(each, name) for each in (tree, *others))),
            )
    return mapped


def take(tree: Tree, lanes: Lanes) -> Tree:
    """Return a tree with the indexed lanes; a single number gives the tree of a single run."""
    return map_arrays(lambda array: array[lanes], tree)


def stack(trees: Sequence[Tree]) -> Tree:
    """Return the trees of single runs as one with a leading axis; values other than arrays are those of the first."""
    return map_arrays(lambda *arrays: np.stack(arrays), *trees)


def branch(
    chosen: npt.ArrayLike,
    function: Callable[..., Tree],
    tree: Tree,
    *arguments: Any,  # noqa: ANN401
) -> Tree:
    """Return `function(tree, *arguments)` in the chosen lanes and `tree` in all others.

    Args:
        chosen: (...), bool.
        function: returns a tree like its first argument; it gets only the chosen lanes, along one axis.
        tree: the values that may change.
        arguments: further trees that the function needs.
    """
    mask = np.asarray(chosen)
    if mask.ndim == 0:
        return function(tree, *arguments) if chosen else tree
    count = np.count_nonzero(mask)
    if count == 0:
        return tree
    if count == mask.size:
        return function(tree, *arguments)
    lanes = np.nonzero(mask)
    before = take(tree, lanes)

    def replaced(array: FloatArray, values: FloatArray, old: FloatArray) -> FloatArray:
        if values is old:
            return array
        new = array.copy()
        new[lanes] = values
        return new

    return map_arrays(
        replaced, tree, function(before, *(take(each, lanes) for each in arguments)), before
    )


def repeat(
    condition: Callable[[Tree], npt.ArrayLike],
    function: Callable[[Tree], Tree],
    tree: Tree,
    at_most: int,
) -> Tree:
    """Apply `function` up to `at_most` times in the lanes in which a condition still holds, and return the tree.

    Args:
        condition: of a tree, (...), bool.
        function: as in `branch`.
        tree: at the beginning.
        at_most: times after which it certainly holds no more.
    """
    for _ in range(at_most):
        chosen = np.asarray(condition(tree))
        if not chosen.any():
            break
        tree = branch(chosen, function, tree)
    return tree


def pick(array: AnyArray, index: IntArray, axes: int = 0) -> AnyArray:
    """Return the entries at one index for each lane, along the first axis after the leading ones.

    Args:
        array: (..., k, *).
        index: (..., †), from 0 to k − 1.
        axes: how many axes of `index`, †, are no leading axes.

    Returns:
        (..., †, *).
    """
    leading = np.ndim(index) - axes
    if leading == 0:
        return array[index]
    lead, (length, *rest) = array.shape[:leading], array.shape[leading:]
    first = length * np.arange(math.prod(lead)).reshape(lead + (1,) * axes)
    return np.asarray(array.reshape(-1, *rest).take(first + index, axis=0))


def where(chosen: npt.ArrayLike, one: FloatArray, other: FloatArray) -> FloatArray:
    """Return `one` in the chosen lanes, (...), and `other` elsewhere; both may have further axes."""
    mask = np.asarray(chosen)
    further = max(np.ndim(one), np.ndim(other)) - mask.ndim
    mask = mask.reshape(mask.shape + (1,) * further)
    return np.where(mask, one, other)


def outer(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a bᵀ, (..., m, n), for a (..., m) and b (..., n)."""
    return np.einsum("...i,...j->...ij", a, b)  # a third faster than a product of views


def matrix(*rows: Sequence[FloatArray]) -> FloatArray:
    """Return matrices, (..., m, n), given the entries of m rows, (...) each."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def nearest_rotation(M: FloatArray) -> FloatArray:
    """Return the rotation R, (..., m, m), nearest to M, (..., m, m), in the Frobenius norm: it maximises trace(RᵀM).

    Raises:
        LinAlgError: an M has no singular value decomposition.
    """
    left, _, right = np.linalg.svd(M)
    R = left @ right
    return branch(np.linalg.det(R) < 0.0, _reflected, R, left, right)


def _reflected(R: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    """Return the product with the sign of the smallest singular value changed, so that the determinant is 1."""
    signs = np.ones(R.shape[-1])
    signs[-1] = -1.0
    return (left * signs) @ right


def norm(x: FloatArray) -> FloatArray:
    """Return ‖x‖, (...), for x (..., n)."""
    return np.sqrt(np.vecdot(x, x))


def entries(M: FloatArray) -> FloatArray:
    """Return the entries of matrices (..., m, n), row by row, (..., mn)."""
    return M.reshape(*M.shape[:-2], -1)


def solve(A: FloatArray, b: FloatArray) -> FloatArray:
    """Return A⁻¹ b, (..., n), for A (..., n, n) and b (..., n)."""
    return np.asarray(np.linalg.solve(A, b[..., None])[..., 0], dtype=np.float64)


def plus_diagonal(A: FloatArray, value: npt.ArrayLike) -> FloatArray:
    """Return A + diag(value), (..., n, n), for A (..., n, n) and one number, (n,) or (..., n)."""
    rows = value if isinstance(value, float) else np.atleast_1d(value)[..., None, :]
    return A + _identity(A.shape[-1]) * rows


@cache
def _identity(size: int) -> FloatArray:
    identity = np.eye(size)
    identity.flags.writeable = False
    return identity


def find_libraries() -> ThreadpoolController:
    """Return the loaded libraries that have threads, those of linear algebra among them."""
    _found[:] = [(len(sys.modules), ThreadpoolController())]
    return _found[0][1]


def one_thread() -> AbstractContextManager[object]:
    """Return a context in which linear algebra runs on one thread.

    The search for libraries takes milliseconds, so it is repeated only if a module was imported since the last one.
    """
    if not _found or _found[0][0] != len(sys.modules):
        find_libraries()
    return _found[0][1].limit(limits=1)
