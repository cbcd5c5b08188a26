"""Decisions and faults of recorded code: C takes one of two ways, as the code did, and reports a fault by its code.

Decisions are those of `plant.contract.lanes`. Numpy code raises where its numbers are of no use. A recorded step cannot
be left in its middle: it goes on, and returns the code of a fault beside its results, 0 for none.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from servobench.fmus.controllers.arrays import Buffer, NotTraceable, Traced, as_traced
from servobench.fmus.controllers.program import BREAK, COPY, FAULT, MERGE, WAY, Way, add, block
from servobench.plant.contract.lanes import map_arrays, take

Tree = TypeVar("Tree")
NOT_FINITE = 1  # code of a fault: the estimate or the command is not finite
NOT_DEFINITE = 2  # likewise: a covariance is not positive definite


def note_fault(wrong: Any, code: int) -> None:  # noqa: ANN401 - an array of truth
    """Note that something is wrong where an entry is true."""
    add(FAULT, [as_traced(wrong).operand()], (), code)


def is_finite(array: Any) -> bool:  # noqa: ANN401 - an array
    """Return that an array is finite; one that a program computes notes a fault."""
    if isinstance(array, Traced) and not array.constant:
        note_fault(np.logical_not(np.isfinite(array)), NOT_FINITE)
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


def _own(tree: Tree) -> Tree:
    """Return a tree with buffers of its own, so that what is written to them stays within a way."""

    def own(leaf: Any) -> Any:  # noqa: ANN401 - an array
        if isinstance(leaf, Traced):
            return Traced(Buffer(leaf.buffer.content), leaf.places, leaf.kind)
        return leaf

    return map_arrays(own, tree)


def branch(chosen: Any, function: Callable[..., Tree], tree: Tree, *arguments: Any) -> Tree:  # noqa: ANN401
    """Return `function(tree, *arguments)` if `chosen`, else `tree`; see `servobench.plant.contract.lanes.branch`.

    Raises:
        NotTraceable: the shape of a result depends on the run.
    """
    if not isinstance(chosen, Traced) or chosen.constant:
        if chosen:
            return function(tree, *arguments)
        return tree
    if chosen.ndim:
        return _side_by_side(chosen, function, tree, *arguments)
    inside = _own(tree)
    condition = chosen.operand()
    with block() as way:
        result = function(inside, *(_own(each) for each in arguments))
    after = leaves_of(result)
    before = leaves_of(inside)
    if [np.shape(leaf) for leaf in after] != [np.shape(leaf) for leaf in before]:
        raise NotTraceable(f"the shape of the result of {_name(function)} depends on the run")
    decision = Way(way)
    add(WAY, [condition], (), decision)
    merged = leaves_of(tree)
    for k, (new, old) in enumerate(zip(after, before, strict=True)):
        if new is not old:
            merged[k] = _merged(decision, as_traced(new), as_traced(merged[k]))
    return with_leaves(tree, merged)


def _merged(way: Way, new: Traced, old: Traced) -> Traced:
    """Return the new array where a way was taken, else the old one."""
    node = add(MERGE, [new.operand(), old.operand()], new.shape)
    way.merges.append(node)
    return Traced.of(node, new.shape, max(new.kind, old.kind, key="bif".index))


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
    """Apply a function for as long as a condition holds; see `servobench.plant.contract.lanes.repeat`."""
    carried = [_copied(leaf) for leaf in leaves_of(tree)]
    inside = with_leaves(tree, carried)
    with block() as body:
        add(BREAK, [as_traced(condition(_own(inside))).operand()], ())
        after = [_copied(leaf) for leaf in leaves_of(function(_own(inside)))]
    way = Way(body, at_most)
    add(WAY, [], (), way)
    merged = [_merged(way, new, old) for new, old in zip(after, carried, strict=True)]
    return with_leaves(tree, merged)


def _copied(leaf: Any) -> Traced:  # noqa: ANN401 - an array
    array = as_traced(leaf)
    return Traced.of(add(COPY, [array.operand()], array.shape), array.shape, array.kind)


def _name(function: Any) -> str:  # noqa: ANN401 - any callable
    return str(getattr(function, "__qualname__", function))
