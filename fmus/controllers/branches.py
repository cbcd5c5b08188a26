"""Decisions and faults of recorded code: C takes one of two ways, as the code did, and reports a fault by its code.

Decisions are those of `plant.contract.lanes`. Numpy code raises where its numbers are of no use. A recorded step cannot
be left in its middle: it goes on, and returns the code of a fault beside its results, 0 for none. Functions that are
recorded on their own, such as the ways of a branch, collect their faults in a frame each.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from typing import Any, Final, TypeVar

import casadi
import numpy as np

from servobench.fmus.controllers.arrays import Expression, NotTraceable, Traced, as_traced
from servobench.plant.contract.lanes import map_arrays, take

Tree = TypeVar("Tree")
NOT_FINITE: Final = 1  # code of a fault: the estimate or the command is not finite
NOT_DEFINITE: Final = 2  # likewise: a covariance is not positive definite
_NUMBERS = count()


@dataclass
class Frame:
    """The faults of a function that is being recorded."""

    # Code of the worst fault, an expression.
    code: Expression = field(default_factory=lambda: casadi.MX(0.0))


_FRAMES: list[Frame] = []


@contextmanager
def frame() -> Iterator[Frame]:
    """Collect the faults within."""
    own = Frame()
    _FRAMES.append(own)
    try:
        yield own
    finally:
        _FRAMES.pop()


def note_fault(wrong: Any, code: int) -> None:  # noqa: ANN401 - an array of truth
    """Note that something is wrong where an entry is true."""
    note_code(casadi.mmax(code * as_traced(wrong).flat()))


def note_code(code: Expression) -> None:
    """Note a fault by its code, 0 for none."""
    _FRAMES[-1].code = casadi.fmax(_FRAMES[-1].code, code)


def is_finite(array: Any) -> bool:  # noqa: ANN401 - an array
    """Return that an array is finite; an expression that is not is a fault."""
    if isinstance(array, Traced) and not array.constant:
        wrong: Any = np.logical_not(np.isfinite(array))
        note_fault(wrong, NOT_FINITE)
        return True
    return bool(np.isfinite(np.asarray(array)).all())


def leaves_of(tree: Any) -> list[Any]:  # noqa: ANN401 - any tree
    """Return the arrays of a tree, in order."""
    leaves: list[Any] = []
    map_arrays(leaves.append, tree)
    return leaves


def with_leaves(tree: Tree, leaves: list[Any]) -> Tree:
    """Return a tree of the same form with other arrays."""
    rest = iter(leaves)
    return map_arrays(lambda _: next(rest), tree)


def symbols_like(leaves: list[Any]) -> list[Traced]:
    """Return an array of symbols for each array."""
    symbols = []
    for k, leaf in enumerate(leaves):
        symbol = casadi.MX.sym(f"x{k}", int(np.size(leaf)))
        symbols.append(Traced.of(symbol, np.shape(leaf), leaf.dtype.kind))
    return symbols


def branch(chosen: Any, function: Callable[..., Tree], tree: Tree, *arguments: Any) -> Tree:  # noqa: ANN401
    """Return `function(tree, *arguments)` if `chosen`, else `tree`; see `servobench.plant.contract.lanes.branch`.

    Raises:
        NotTraceable: the function uses expressions that are not among its arguments.
    """
    if not isinstance(chosen, Traced) or chosen.constant:
        if chosen:
            return function(tree, *arguments)
        return tree
    if chosen.ndim:
        return _side_by_side(chosen, function, tree, *arguments)
    given = leaves_of((tree, arguments))
    places = [k for k, leaf in enumerate(given) if isinstance(leaf, Traced) and not leaf.constant]
    symbols = symbols_like([given[k] for k in places])
    own = list(given)
    for k, symbol in zip(places, symbols, strict=True):
        own[k] = symbol
    # Both ways are recorded with symbols in place of all expressions that they are given.
    inside, among = with_leaves((tree, arguments), own)
    before = leaves_of(inside)
    with frame() as faults:
        result = function(inside, *among)
    after = leaves_of(result)
    if [np.shape(leaf) for leaf in after] != [np.shape(leaf) for leaf in before]:
        raise NotTraceable(f"the shape of the result of {_name(function)} depends on the run")
    changed = [k for k, (new, old) in enumerate(zip(after, before, strict=True)) if new is not old]
    inputs = [symbol.buffer.content for symbol in symbols]
    ways = []
    for leaves, code in ((after, faults.code), (before, casadi.MX(0.0))):
        outputs = [as_traced(leaves[k]).flat() for k in changed]
        ways.append(_function(function, inputs, [*outputs, code]))
    switch = casadi.Function.if_else(f"branch{next(_NUMBERS)}", *ways)
    values = [given[k].flat() for k in places]
    *results, code = switch.call([chosen.flat(), *values])
    note_code(code)
    merged = leaves_of(tree)
    for k, expression in zip(changed, results, strict=True):
        kinds = (as_traced(after[k]).kind, as_traced(before[k]).kind)
        kind = max(kinds, key="bif".index)
        merged[k] = Traced.of(expression, np.shape(before[k]), kind)
    return with_leaves(tree, merged)


def _side_by_side(
    chosen: Traced,
    function: Callable[..., Tree],
    tree: Tree,
    *arguments: Any,  # noqa: ANN401
) -> Tree:
    """Return the results of `branch` for each lane by itself."""
    results = []
    for lane in np.ndindex(chosen.shape):
        own = [take(each, lane) for each in arguments]
        results.append(branch(chosen[lane], function, take(tree, lane), *own))

    def side_by_side(*lanes: Any) -> Any:  # noqa: ANN401 - arrays
        return np.stack(lanes).reshape((*chosen.shape, *lanes[0].shape))

    return map_arrays(side_by_side, *results)


def repeat(
    condition: Callable[[Tree], Any], function: Callable[[Tree], Tree], tree: Tree, at_most: int
) -> Tree:
    """Apply a function for as long as a condition holds; see `servobench.plant.contract.lanes.repeat`.

    One pass is recorded and called `at_most` times.
    """
    leaves = leaves_of(tree)
    symbols = symbols_like(leaves)
    inside = with_leaves(tree, symbols)
    with frame() as faults:
        after = leaves_of(branch(condition(inside), function, inside))
    inputs = [symbol.buffer.content for symbol in symbols]
    outputs = [as_traced(leaf).flat() for leaf in after]
    once = _function(function, inputs, [*outputs, faults.code])
    columns = [as_traced(leaf).flat() for leaf in leaves]
    for _ in range(at_most):
        *columns, code = once(*columns)
        note_code(code)
    results = []
    for column, leaf in zip(columns, after, strict=True):
        results.append(Traced.of(column, np.shape(leaf), as_traced(leaf).kind))
    return with_leaves(tree, results)


def _function(function: Any, inputs: list[Any], outputs: list[Any]) -> Any:  # noqa: ANN401 - of CasADi
    try:
        return casadi.Function(f"way{next(_NUMBERS)}", inputs, outputs, {"cse": True})
    except RuntimeError as error:
        raise NotTraceable(f"{_name(function)} uses more of the run than its arguments") from error


def _name(function: Any) -> str:  # noqa: ANN401 - any callable
    return str(getattr(function, "__qualname__", function))
