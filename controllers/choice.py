"""A choice between two values, run by run."""

import numpy.typing as npt

from servobench.plant.contract.lanes import Tree, branch


def choose(chosen: npt.ArrayLike, one: Tree, other: Tree) -> Tree:
    """Return `one` in the chosen lanes, (...), and `other` in the rest; both are trees of arrays of the same form."""
    return branch(chosen, _replaced, other, one)


def _replaced(_: Tree, new: Tree) -> Tree:
    return new
