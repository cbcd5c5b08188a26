"""Programs of whole arrays: what recorded numpy code computes, in its order, as nodes in blocks.

A node is a column of numbers that is computed once. An operand is a node with a table of places, the entries of it that
are read; views, broadcasting and transposes are tables only. A block is the inside of a decision or of a loop.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import prod
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from servobench.plant.contract.checks import AnyArray, IntArray, Shape

Places: TypeAlias = IntArray

NUMBERS = "numbers"  # detail: the numbers
INPUT = "input"  # detail: name of the array of the caller
MAP = "map"  # entry by entry; detail: C with braces for the operands
REDUCE = "reduce"  # sums and the like over the last axes; detail: name of the ufunc
JOIN = "join"  # operands one after the other; detail: order in which they are read, if it is another one
PUT = "put"  # first operand, with the second one written to places; detail: these places
COPY = "copy"  # in an array of its own
CALL = "call"  # function of `linear_algebra.h`; detail: its name and sizes
FAULT = "fault"  # notes a fault where an entry is not zero; detail: its code
STORE = (
    "store"  # writes to an array of the caller; detail: its name, and the place of the first entry
)
WAY = "way"  # what a decision on the operand does, or a loop; detail: `Way`
BREAK = "break"  # leaves the loop where the operand is zero
MERGE = "merge"  # first operand where a way was taken, else the second one
EFFECTS = frozenset({FAULT, STORE, BREAK})


class Operand(NamedTuple):
    """Entries of a node."""

    node: Node
    places: Places

    @property
    def flat(self) -> Places:
        """The places in one row."""
        return self.places.reshape(-1)


@dataclass(eq=False)
class Node:
    """A column of numbers."""

    operation: str
    operands: tuple[Operand, ...]
    shape: Shape
    block: Block
    epoch: int  # number of decisions and overwritten arrays before it in its block
    detail: Any = None

    @property
    def size(self) -> int:
        """Number of entries."""
        return prod(self.shape)


@dataclass(eq=False)
class Block:
    """Nodes in the order in which they are computed."""

    outer: Block | None = None
    nodes: list[Node] = field(default_factory=list)
    epoch: int = 0
    known: dict[Any, Node] = field(default_factory=dict)

    def find(self, key: Any) -> Node | None:  # noqa: ANN401 - any key
        """Return the same computation of this block, or of one around it."""
        if key in self.known:
            return self.known[key]
        if self.outer is None:
            return None
        return self.outer.find(key)

    def is_within(self, other: Block) -> bool:
        """Return whether it is another block, or inside it."""
        if self is other or self.outer is None:
            return self is other
        return self.outer.is_within(other)


@dataclass(eq=False)
class Way:
    """What a decision does, or each pass of a loop."""

    block: Block
    passes: int = 0  # most passes of a loop
    merges: list[Node] = field(default_factory=list)


_BLOCKS: list[Block] = []


@contextmanager
def block() -> Iterator[Block]:
    """Record into a block within."""
    own = Block(_BLOCKS[-1] if _BLOCKS else None)
    _BLOCKS.append(own)
    try:
        yield own
    finally:
        _BLOCKS.pop()


def add(
    operation: str,
    operands: Sequence[Operand],
    shape: Shape,
    detail: Any = None,  # noqa: ANN401
) -> Node:
    """Record a node at the end of the present block."""
    own = _BLOCKS[-1]
    node = Node(operation, tuple(operands), shape, own, own.epoch, detail)
    own.nodes.append(node)
    if operation in {WAY, PUT}:
        own.epoch += 1
    return node


def computed(
    operation: str,
    operands: Sequence[Operand],
    shape: Shape,
    detail: Any = None,  # noqa: ANN401
) -> Node:
    """Return a node without effects; the same computation is recorded once."""
    own = _BLOCKS[-1]
    tables = [(id(each.node), each.places.tobytes()) for each in operands]
    key = (operation, detail, shape, *tables)
    found = own.find(key)
    if found is None:
        found = add(operation, operands, shape, detail)
        own.known[key] = found
    return found


def numbers(values: AnyArray) -> Node:
    """Return a node of plain numbers."""
    column = np.array(values, dtype=np.float64).reshape(-1)
    root = _BLOCKS[0]
    key = (NUMBERS, column.tobytes())
    if key not in root.known:
        root.known[key] = Node(NUMBERS, (), column.shape, root, 0, column)
    return root.known[key]


def source(name: str, size: int) -> Node:
    """Return a node of an array of the caller."""
    return add(INPUT, (), (size,), name)


def parts(node: Node, places: Places) -> Iterator[tuple[Operand, Places, Places]]:
    """Yield the operands that entries of a join are read from, which of the entries these are, and the places there."""
    if node.detail:
        places = np.array(node.detail)[places]
    first = 0
    for part in node.operands:
        end = first + part.places.size
        among = np.flatnonzero((places >= first) & (places < end))
        if among.size:
            yield part, among, places[among] - first
        first = end


def operand(node: Node, places: Places) -> Operand:
    """Return entries of a node; those of one part of a join are entries of that part."""
    if node.operation == JOIN and places.size:
        part, among, inside = next(parts(node, places.reshape(-1)))
        if among.size == places.size:
            return operand(part.node, part.flat[inside].reshape(places.shape))
    return Operand(node, np.ascontiguousarray(places).reshape(places.shape))
