"""Numpy's ufuncs over arrays of expressions: entry by entry, reduced, and the products of matrices."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi
import numpy as np

from servobench.fmus.trace.array import Expression, NotTraceable, Traced, as_traced, spread

Operation = Callable[..., Expression]
LARGEST = float(np.finfo(np.float64).max)


def _rounded(x: Expression) -> Expression:
    """Return the nearest whole number; of two the even one."""
    nearest = casadi.floor(x + 0.5)
    tie = casadi.logic_and(nearest - x == 0.5, casadi.fmod(nearest, 2.0) != 0.0)
    return nearest - tie


def _remainder(x: Expression, y: Expression) -> Expression:
    return x - y * casadi.floor(x / y)


ARITHMETIC: Mapping[str, Operation] = {
    "add": lambda x, y: x + y, "subtract": lambda x, y: x - y, "multiply": lambda x, y: x * y,
    "divide": lambda x, y: x / y, "power": lambda x, y: x**y, "negative": lambda x: -x, "positive": lambda x: x,
    "absolute": casadi.fabs, "fabs": casadi.fabs, "square": lambda x: x * x, "sqrt": casadi.sqrt, "exp": casadi.exp,
    "expm1": casadi.expm1, "log": casadi.log, "log1p": casadi.log1p, "sin": casadi.sin, "cos": casadi.cos,
    "tan": casadi.tan, "arcsin": casadi.asin, "arccos": casadi.acos, "arctan": casadi.atan, "arctan2": casadi.atan2,
    "sinh": casadi.sinh, "cosh": casadi.cosh, "tanh": casadi.tanh, "hypot": casadi.hypot, "sign": casadi.sign,
    "copysign": casadi.copysign, "floor": casadi.floor, "ceil": casadi.ceil, "rint": _rounded,
    "maximum": casadi.fmax, "minimum": casadi.fmin, "remainder": _remainder,
    "floor_divide": lambda x, y: casadi.floor(x / y), "reciprocal": lambda x: 1.0 / x,
}  # fmt: skip
COMPARISONS: Mapping[str, Operation] = {
    "less": lambda x, y: x < y, "less_equal": lambda x, y: x <= y, "greater": lambda x, y: x > y,
    "greater_equal": lambda x, y: x >= y, "equal": lambda x, y: x == y, "not_equal": lambda x, y: x != y,
    "logical_and": casadi.logic_and, "logical_or": casadi.logic_or, "logical_not": casadi.logic_not,
    "isfinite": lambda x: casadi.fabs(x) <= LARGEST,
    "isnan": lambda x: casadi.logic_not(casadi.fabs(x) <= np.inf),
}  # fmt: skip
OF_TRUTH: Mapping[str, str] = {"bitwise_and": "logical_and", "bitwise_or": "logical_or", "invert": "logical_not"}
FROM_TRUTH = {"add": 0.0, "multiply": 1.0, "maximum": -np.inf, "minimum": np.inf, "logical_or": 0.0, "logical_and": 1.0}


def carry_out(ufunc: np.ufunc, method: str, inputs: Sequence[Any], options: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Carry out a ufunc, or a reduction by one, with at least one array of expressions.

    Raises:
        NotTraceable: it has no expression.
    """
    options = dict(options)
    outputs = options.pop("out", None)
    options.pop("dtype", None)
    if all(not isinstance(each, Traced) or each.constant for each in inputs):
        numbers = [each.numbers() if isinstance(each, Traced) else each for each in inputs]
        result = getattr(ufunc, method)(*numbers, **_plain(options, outputs))
    elif method == "__call__":
        result = _called(ufunc, inputs, options, outputs)
    elif method == "reduce":
        result = reduced(ufunc.__name__, inputs[0], **options)
    else:
        raise NotTraceable(f"it calls numpy.{ufunc.__name__}.{method}, which has no exported form")
    if outputs is None:
        return result
    if not isinstance(outputs[0], Traced):
        raise NotTraceable(f"numpy.{ufunc.__name__} writes to an array of numbers")
    outputs[0][...] = result
    return outputs[0]


def _plain(options: Mapping[str, Any], outputs: Any) -> dict[str, Any]:  # noqa: ANN401 - as numpy's
    """Return the options of a ufunc of numbers; where it writes only to some entries, those before are numbers too."""
    plain = {name: value.numbers() if isinstance(value, Traced) else value for name, value in options.items()}
    if "where" in plain and outputs is not None:
        plain["out"] = np.array(outputs[0].numbers())
    return plain


def _called(ufunc: np.ufunc, inputs: Sequence[Any], options: Mapping[str, Any], outputs: Any) -> Traced:  # noqa: ANN401
    name = ufunc.__name__
    if name in PRODUCTS:
        return PRODUCTS[name](*map(as_traced, inputs))
    result = elementwise(name, *inputs)
    chosen = options.get("where", True)
    return result if chosen is True else choose(chosen, result, outputs[0])


def elementwise(name: str, *inputs: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return a ufunc of its name, entry by entry."""
    arrays = [as_traced(each) for each in inputs]
    if name in OF_TRUTH and all(each.kind == "b" for each in arrays):
        name = OF_TRUTH[name]
    if name in COMPARISONS:
        return mapped(COMPARISONS[name], arrays, "b")
    if name not in ARITHMETIC:
        raise NotTraceable(f"it calls numpy.{name}, which has no exported form")
    whole = all(each.kind != "f" for each in arrays) and name != "divide"
    return mapped(ARITHMETIC[name], arrays, "i" if whole else "f")


def mapped(operation: Operation, arrays: Sequence[Traced], kind: str) -> Traced:
    """Return an operation, entry by entry, of arrays that are broadcast against each other."""
    shape = np.broadcast_shapes(*(each.shape for each in arrays))
    size = int(np.prod(shape))
    if size == 0:
        return Traced.of(casadi.MX(0, 1), shape, kind)
    parts = [each.flat() if each.size == 1 else spread(each, shape).flat() for each in arrays]
    result = operation(*parts)
    if result.numel() != size:
        result = casadi.repmat(result, size, 1)
    return Traced.of(result, shape, kind)


def choose(chosen: Any, one: Any, other: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return `one` where chosen, else `other`."""
    arrays = [as_traced(each) for each in (chosen, one, other)]
    kind = max((each.kind for each in arrays[1:]), key="bif".index)
    return mapped(casadi.if_else, arrays, kind)


def reduced(name: str, array: Any, axis: Any = 0, keepdims: bool = False, initial: Any = None) -> Traced:  # noqa: ANN401
    """Return the reduction by a ufunc of its name over axes, None for all."""
    if name in OF_TRUTH:
        name = OF_TRUTH[name]
    if name not in FROM_TRUTH:
        raise NotTraceable(f"it calls numpy.{name}.reduce, which has no exported form")
    table = as_traced(array)
    axes = tuple(range(table.ndim)) if axis is None else (axis,) if isinstance(axis, int) else tuple(axis)
    axes = tuple(each % table.ndim for each in axes)
    kept = tuple(size for i, size in enumerate(table.shape) if i not in axes)
    length = int(np.prod([table.shape[i] for i in axes]))
    count = int(np.prod(kept))
    last = table.arranged(np.moveaxis(table.places, axes, range(-len(axes), 0)).reshape(count, length))
    kind = "b" if name.startswith("logical") else "i" if table.kind in "bi" else "f"
    operation = ARITHMETIC.get(name) or COMPARISONS[name]
    result: Expression
    if name == "add" and length:
        result = casadi.vec(casadi.sum1(casadi.reshape(last.flat(), length, count)))
    else:
        result = last[:, 0].flat() if length else casadi.MX(casadi.DM(np.full(count, FROM_TRUTH[name])))
        for j in range(1, length):
            result = operation(result, last[:, j].flat())
    if name.startswith("logical") and length == 1:
        result = result != 0.0
    if initial is not None:
        result = operation(result, float(initial))
    shape = tuple(1 if i in axes else size for i, size in enumerate(table.shape)) if keepdims else kept
    return Traced.of(result, shape, kind)


def matmul(a: Traced, b: Traced) -> Traced:
    """Return a @ b, (..., i, j); vectors as numpy has them."""
    if a.ndim == 1:
        return matmul(a[None, :], b)[..., 0, :]
    if b.ndim == 1:
        return matmul(a, b[:, None])[..., 0]
    (i, k), j = a.shape[-2:], b.shape[-1]
    if b.shape[-2] != k:
        raise ValueError(f"matmul: {a.shape} does not fit {b.shape}")
    lead = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    left, right = spread(a, (*lead, i, k)).reshape(-1, i, k), spread(b, (*lead, k, j)).reshape(-1, k, j)
    if 0 in (i, j, k) or len(left) == 0:
        return Traced.of(casadi.MX.zeros(int(np.prod((*lead, i, j))), 1), (*lead, i, j))
    # Row-major entries are the column-major ones of the transpose, and (A B)ᵀ = Bᵀ Aᵀ.
    products = [
        casadi.vec(casadi.mtimes(casadi.reshape(B.flat(), j, k), casadi.reshape(A.flat(), k, i)))
        for A, B in zip(left, right, strict=True)
    ]
    return Traced.of(casadi.vertcat(*products), (*lead, i, j))


def vecdot(a: Traced, b: Traced) -> Traced:
    """Return a·b over the last axis, (...)."""
    if a.ndim == 1 == b.ndim:
        return Traced.of(casadi.dot(a.flat(), b.flat()), ())
    return reduced("add", elementwise("multiply", a, b), axis=-1)


PRODUCTS: Mapping[str, Callable[[Traced, Traced], Traced]] = {
    "matmul": matmul,
    "vecdot": vecdot,
    "matvec": lambda A, x: matmul(A, x[..., None])[..., 0],
    "vecmat": lambda x, A: matmul(x[..., None, :], A)[..., 0, :],
}
