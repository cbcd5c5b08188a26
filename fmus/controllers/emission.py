"""Writes programs of whole arrays as functions in C.

Entries are read where they are: an operand is a place in an array and steps along its axes, so that views, broadcasting
and transposes cost nothing. An operation with one reader becomes a part of its expression. A decision writes to the
place of the numbers that it replaces, unless these are read later; where they are few, they are kept elsewhere.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from typing import NamedTuple

import numpy as np

from servobench.fmus.controllers.arrays import ARITHMETIC, COMPARISONS, EMPTY_REDUCTIONS
from servobench.fmus.controllers.program import (
    BREAK,
    EFFECTS,
    FAULT,
    JOIN,
    MAP,
    MERGE,
    NUMBERS,
    REDUCE,
    WAY,
    Block,
    Node,
    Operand,
    Places,
    parts,
)
from servobench.plant.contract.checks import AnyArray, Shape

# Share of an array up to which entries that are read after it is overwritten are kept elsewhere.
KEPT_SHARE = 0.3
INPUTS = "u"  # array of the caller that is never written to
FILE = """/* Generated from recorded numpy code; not meant to be edited. */
#include "controller.h"
#include "linear_algebra.h"

{static}

{functions}
"""
FUNCTION = """double {name}(double *x, const double *u, double *y)
{{
double fault = 0.0;
{lines}
return fault;
}}
"""


class Entries(NamedTuple):
    """Entries of an array in C."""

    array: str
    places: Places


class Value(NamedTuple):
    """An expression in C."""

    text: str  # with {} for each of the entries
    entries: list[Entries]


class Use(NamedTuple):
    """A reader of a node."""

    reader: Node
    block: Block  # in which it reads
    epoch: int
    size: int  # number of entries that it reads


class Read(NamedTuple):
    """When which entries of a node are read."""

    position: int
    places: Places


def program(functions: Mapping[str, Block]) -> str:
    """Return the C file of some functions."""
    tables: dict[str, str] = {}
    texts = []
    for name, block in functions.items():
        writer = Writer(tables)
        writer.mark(block)
        writer.schedule(block)
        writer.emit(block)
        writer.finish()
        texts.append(FUNCTION.format(name=name, lines="\n".join(writer.lines)))
    static = [f"static const {text.replace('[', f' {name}[')};" for text, name in tables.items()]
    return FILE.format(static="\n".join(static), functions="\n".join(texts))


@dataclass
class Writer:
    """Writes one function."""

    tables: dict[str, str]  # names of static arrays by their text without name
    lines: list[str] = field(default_factory=list)
    uses: dict[Node, list[Use]] = field(
        default_factory=dict
    )  # readers of the nodes that are needed
    positions: dict[Node, int] = field(default_factory=dict)  # in the order of the lines
    ends: dict[Block, int] = field(default_factory=dict)
    reads: dict[Node, list[Read]] = field(default_factory=lambda: defaultdict(list))
    found: dict[Node, Entries] = field(default_factory=dict)  # where nodes are
    # All nodes that ever were in an array.
    residents: dict[str, list[Node]] = field(default_factory=lambda: defaultdict(list))
    # Entries of nodes that were overwritten, and where they are now.
    kept: dict[Node, list[Entries]] = field(default_factory=lambda: defaultdict(list))
    stored: list[tuple[Entries, Entries]] = field(default_factory=list)  # at the end
    clock: int = 0
    arrays: int = 0

    def mark(self, block: Block) -> None:
        """Note the readers of all nodes that are needed, from the last one on."""
        for node in reversed(block.nodes):
            if node.operation == WAY:
                self.mark_way(node)
            elif node.operation != MERGE and (node in self.uses or node.operation in EFFECTS):
                self.use(node, node.operands, block, node.epoch)

    def mark_way(self, node: Node) -> None:
        """Note the readers of the nodes of a way, and of those that it leaves as they are."""
        way = node.detail
        inside = way.block
        for merge in way.merges:
            if merge in self.uses or way.passes:
                self.use(merge, merge.operands[:1], inside, inside.epoch)
                self.use(merge, merge.operands[1:], node.block, node.epoch + 1)
        if has_effects(inside) or any(merge in self.uses for merge in way.merges):
            self.mark(inside)
            self.use(node, node.operands, node.block, node.epoch)

    def use(self, reader: Node, operands: Sequence[Operand], block: Block, epoch: int) -> None:
        """Note a reader."""
        self.uses.setdefault(reader, [])
        for node, places in operands:
            self.uses.setdefault(node, []).append(Use(reader, block, epoch, places.size))

    def is_inside(self, node: Node) -> bool:
        """Return whether a node is a part of the expression of its only reader."""
        if node.operation not in {MAP, JOIN} or len(self.uses[node]) != 1:
            return False
        reader, block, epoch, size = self.uses[node][0]
        if node.operation == JOIN and reader.operation in {MAP, REDUCE, WAY, BREAK, FAULT}:
            return False
        return block is node.block and epoch == node.epoch and size <= node.size

    def schedule(self, block: Block) -> None:
        """Note when which entries are read."""
        for node in block.nodes:
            if node not in self.uses or node.operation == MERGE or self.is_inside(node):
                continue
            self.clock += 1
            self.positions[node] = self.clock
            for operand in node.operands:
                self.note(operand)
            if node.operation == WAY:
                self.schedule_way(node)
        self.ends[block] = self.clock

    def schedule_way(self, node: Node) -> None:
        """Note when a way reads."""
        way = node.detail
        merges = [merge for merge in way.merges if merge in self.uses]
        before = {node: len(reads) for node, reads in self.reads.items()}
        self.schedule(way.block)
        self.clock += 1
        if way.passes:
            # What was there before a loop is read until its end, except for what it changes.
            changed = [merge.operands[1].node for merge in merges]
            for each, reads in self.reads.items():
                if not each.block.is_within(way.block) and each not in changed:
                    reads += [
                        Read(self.clock, places) for _, places in reads[before.get(each, 0) :]
                    ]
        for merge in merges:
            new, old = merge.operands
            self.clock += 1
            self.note(old)
            self.clock += 1
            self.note(new)
            self.positions[merge] = self.clock

    def note(self, operand: Operand) -> None:
        """Note that entries are read now, and those that they are made of in the same expression."""
        node = operand.node
        places = operand.flat
        inside = self.is_inside(node)
        if not inside:
            self.reads[node].append(Read(self.clock, places))
        if node.operation == JOIN:
            for part, _, among in parts(node, places):
                self.note(Operand(part.node, part.flat[among]))
        elif inside:
            for each in node.operands:
                self.note(Operand(each.node, each.flat[places]))

    def array(self, size: int) -> Entries:
        """Return a new array."""
        name = f"t{self.arrays}"
        self.arrays += 1
        self.lines.append(f"double {name}[{max(size, 1)}];")
        return Entries(name, np.arange(size))

    def table(self, kind: str, numbers: AnyArray) -> str:
        """Return the name of a static array of numbers."""
        texts = ", ".join(map(literal, numbers.reshape(-1).tolist()))
        return self.tables.setdefault(f"{kind}[] = {{{texts}}}", f"c{len(self.tables)}")

    def place(self, node: Node, entries: Entries) -> Entries:
        """Note where a node is."""
        self.found[node] = entries
        self.residents[entries.array].append(node)
        return entries

    def value(self, operand: Operand) -> Value:
        """Return entries as an expression."""
        node = operand.node
        places = operand.flat
        if node in self.found:
            return Value("{}", [self.where(node, places)])
        if node.operation == NUMBERS:
            numbers = node.detail[places]
            if np.unique(numbers.view(np.int64)).size == 1:
                return Value(literal(numbers.tolist()[0]), [])
            return Value("{}", [Entries(self.table("double", node.detail), places)])
        return self.mapped(node, places)

    def mapped(self, node: Node, places: Places) -> Value:
        """Return entries of an operation, entry by entry."""
        read = [each._replace(places=each.flat[places]) for each in node.operands]
        values = [self.value(each) for each in read]
        text = node.detail.format(*(each.text for each in values))
        return Value(text, [entries for each in values for entries in each.entries])

    def where(self, node: Node, places: Places) -> Entries:
        """Return where entries of a node are."""
        for array, kept in self.kept[node]:
            if np.isin(places, kept).all():
                return Entries(array, np.searchsorted(kept, places))
        array, table = self.found[node]
        return Entries(array, table[places])

    def overwritten(self, operand: Operand, node: Node) -> Entries | None:
        """Return where entries are if a node may overwrite them; the few that are read later are kept elsewhere."""
        if operand.node not in self.found:
            return None
        array, places = self.where(operand.node, operand.flat)
        if array != self.found[operand.node].array or array == INPUTS:
            return None
        target = Entries(array, places)
        late = self.later_reads(target, self.positions[node])
        count = np.unique(places).size
        kept = sum(np.unique(read.places).size for _, read in late)
        last = max((read.position for _, read in late), default=0)
        if count < places.size or kept > KEPT_SHARE * count or last > self.ends[node.block]:
            return None
        for each, read in late:
            table = np.unique(read.places)
            own = self.array(table.size)
            self.assign(own, Value("{}", [self.where(each, table)]), table.shape)
            self.kept[each].insert(0, Entries(own.array, table))
        return target

    def later_reads(self, target: Entries, position: int) -> list[tuple[Node, Read]]:
        """Return what is read of entries after a position."""
        late = []
        for node in self.residents[target.array]:
            overlap = np.isin(self.found[node].places, target.places)
            late += [
                (node, read)
                for read in self.reads[node]
                if read.position > position
                and overlap[read.places].any()
                and self.where(node, read.places).array == target.array
            ]
        return late

    def write(self, target: Entries, operand: Operand, shape: Sequence[int]) -> None:
        """Write entries (shape) to places that may be overwritten, also if some of these are among the entries."""
        pieces = self.pieces(target.places, operand, tuple(shape))
        for places, value, _ in pieces:
            for array, table in value.entries:
                same = np.array_equal(table, places)
                if array == target.array and not same and np.isin(table, target.places).any():
                    self.assign(target, Value("{}", [self.copied(operand)]), shape)
                    return
        for places, value, form in pieces:
            self.assign(Entries(target.array, places), value, form)

    def pieces(
        self, places: Places, operand: Operand, shape: Shape
    ) -> list[tuple[Places, Value, Shape]]:
        """Return values and shapes for places, by parts of joined arrays."""
        node = operand.node
        if node.operation != JOIN or node in self.found:
            return [(places, self.value(operand), shape)]
        found = []
        for part, among, inside in parts(node, operand.flat):
            form: Shape = among.shape
            if np.array_equal(inside, np.arange(part.places.size)):
                form = part.places.shape
            own = Operand(part.node, part.flat[inside])
            found += self.pieces(places[among], own, form)
        return found

    def copied(self, operand: Operand) -> Entries:
        """Return a new array with entries."""
        own = self.array(operand.places.size)
        self.write(own, operand, operand.places.shape)
        return own

    def assign(self, target: Entries, value: Value, shape: Sequence[int]) -> None:
        """Write a value (shape) to places."""
        if value.text == "{}":
            array, places = value.entries[0]
            if array == target.array and np.array_equal(places, target.places):
                return
        self.each("{} = " + value.text + ";", [target, *value.entries], tuple(shape))

    def each(self, text: str, entries: Sequence[Entries], shape: Shape) -> None:
        """Write a statement for each of some entries (shape)."""
        size = prod(shape)
        if size == 0:
            return
        form = shape
        if all(steps_of(each.places.reshape(-1)) for each in entries):
            form = (size,)
        if size == 1:
            form = ()
        self.lines += looped(form, [text.format(*self.texts(entries, form))])

    def texts(self, entries: Sequence[Entries], shape: Shape) -> list[str]:
        """Return entries in loops over a shape."""
        rows = [prod(shape[k + 1 :]) for k in range(len(shape))]
        texts = []
        for array, places in entries:
            steps = steps_of(places.reshape(shape))
            if steps is None:
                texts.append(f"{array}[{self.table('int', places)}[{index(0, rows)}]]")
            else:
                texts.append(f"{array}[{index(places.reshape(-1)[0], steps)}]")
        return texts

    def condition(self, operand: Operand) -> str:
        """Return one entry as an expression."""
        value = self.value(operand)
        return value.text.format(*self.texts(value.entries, ()))

    def emit(self, block: Block) -> None:
        """Write a block."""
        for node in block.nodes:
            if node in self.positions and node.operation != MERGE:
                getattr(self, f"emit_{node.operation}")(node)

    def emit_input(self, node: Node) -> None:
        """Find an array of the caller."""
        self.place(node, Entries(node.detail, np.arange(node.size)))

    def emit_map(self, node: Node) -> None:
        """Write an operation, entry by entry."""
        value = self.mapped(node, np.arange(node.size))
        self.assign(self.place(node, self.array(node.size)), value, node.shape)

    def emit_copy(self, node: Node) -> None:
        """Write a copy."""
        self.place(node, self.copied(node.operands[0]))

    def emit_join(self, node: Node) -> None:
        """Write operands one after the other."""
        self.place(node, self.copied(Operand(node, np.arange(node.size))))

    def emit_put(self, node: Node) -> None:
        """Overwrite places, of a copy if need be."""
        before, values = node.operands
        own = self.overwritten(before, node) or self.copied(before)
        targets = own.places[np.array(node.detail)]
        self.write(Entries(own.array, targets), values, values.places.shape)
        self.place(node, own)

    def emit_reduce(self, node: Node) -> None:
        """Write sums and the like over the last axes."""
        kept = node.shape
        value = self.value(node.operands[0])
        shape = node.operands[0].places.shape
        reduced = shape[len(kept) :]
        array, places = self.place(node, self.array(node.size))
        along = np.repeat(places, prod(reduced))
        result, *texts = self.texts([Entries(array, along), *value.entries], shape)
        term = value.text.format(*texts)
        if node.detail == "add" and len(reduced) == 1:
            inner = [f"SUM({result}, i{len(kept)}, {reduced[0]}, {term})"]
        else:
            operation = ARITHMETIC.get(node.detail) or COMPARISONS[node.detail]
            step = [f"{result} = {operation.format(result, term)};"]
            start = literal(EMPTY_REDUCTIONS[node.detail])
            inner = [f"{result} = {start};", *looped(reduced, step, len(kept))]
        self.lines += looped(kept, inner)

    def emit_call(self, node: Node) -> None:
        """Call a function of the library for each of some matrices."""
        name, *sizes = node.detail
        count = prod(node.shape[:-1])
        arguments = [str(size) for size in sizes]
        for operand in node.operands:
            own = None
            if operand.node in self.found:
                own = self.where(operand.node, operand.flat)
            if own is None or not np.array_equal(
                own.places, own.places[0] + np.arange(own.places.size)
            ):
                own = self.copied(operand)
            arguments.append(f"{own.array} + {index(own.places[0], [own.places.size // count])}")
        result = self.place(node, self.array(node.size))
        arguments.append(f"{result.array} + {index(0, [node.shape[-1]])}")
        self.lines += looped((count,), [f"{name}({', '.join(arguments)});"])

    def emit_way(self, node: Node) -> None:
        """Write a way of a decision, or a loop."""
        way = node.detail
        merges = [merge for merge in way.merges if merge in self.positions]
        places = []
        otherwise = []
        for merge in merges:
            new, old = merge.operands
            own = self.overwritten(old, merge)
            if own is None:
                own = self.overwritten(new, merge) or self.array(merge.size)
                otherwise.append((own, old, merge.shape))
            else:
                self.forget(own, self.positions[merge] - 1)
            places.append(own)
        if way.passes:
            self.lines.append(f"for (int pass = 0; pass < {way.passes}; pass++) {{")
        else:
            self.lines.append(f"if ({self.condition(node.operands[0])}) {{")
        self.emit(way.block)
        waiting = []
        for own, merge in zip(places, merges, strict=True):
            if self.later_reads(own, self.positions[merge]):
                # What the way itself put there is the new value of another merge.
                waiting.append((own, self.copied(merge.operands[0])))
            else:
                self.write(own, merge.operands[0], merge.shape)
        for own, new in waiting:
            self.assign(own, Value("{}", [new]), new.places.shape)
        if otherwise:
            self.lines.append("} else {")
        for own, old, shape in otherwise:
            self.write(own, old, shape)
        self.lines.append("}")
        for own, merge in zip(places, merges, strict=True):
            self.place(merge, own)

    def forget(self, entries: Entries, position: int) -> None:
        """Forget what is read at a position: it stays where it is."""
        for node in self.residents[entries.array]:
            self.reads[node] = [read for read in self.reads[node] if read.position != position]

    def emit_break(self, node: Node) -> None:
        """Leave a loop where a condition does not hold."""
        self.lines.append(f"if (!({self.condition(node.operands[0])})) break;")

    def emit_fault(self, node: Node) -> None:
        """Note the code of a fault, of the worst one if there are several."""
        operand = node.operands[0]
        value = self.value(operand)
        text = f"if ({value.text} && fault < {node.detail}) fault = {node.detail};"
        self.each(text, value.entries, operand.places.shape)

    def emit_store(self, node: Node) -> None:
        """Write to an array of the caller, at the end if numbers there are read later."""
        operand = node.operands[0]
        name, first = node.detail
        target = Entries(name, first + np.arange(operand.places.size))
        if self.later_reads(target, self.positions[node]):
            self.stored.append((target, self.copied(operand)))
        else:
            self.write(target, operand, operand.places.shape)

    def finish(self) -> None:
        """Write what waited for the end."""
        for target, own in self.stored:
            self.assign(target, Value("{}", [own]), own.places.shape)


def looped(shape: Sequence[int], lines: Sequence[str], first: int = 0) -> list[str]:
    """Return lines in loops over a shape, whose indices are numbered from the `first` one on."""
    own = list(lines)
    for k, size in reversed(list(enumerate(shape, first))):
        own = [f"for (int i{k} = 0; i{k} < {size}; i{k}++) {{", *own, "}"]
    return own


def has_effects(block: Block) -> bool:
    """Return whether a block does more than to compute numbers."""
    return any(
        node.operation in EFFECTS or (node.operation == WAY and has_effects(node.detail.block))
        for node in block.nodes
    )


def steps_of(places: Places) -> tuple[int, ...] | None:
    """Return the step along each axis of a table of places, or None if its entries do not lie in rows."""
    first = places.reshape(-1)[0]
    expected = first
    steps = []
    for axis, size in enumerate(places.shape):
        second = places.take(min(1, size - 1), axis).reshape(-1)[0]
        steps.append(int(second - first))
        expected = np.add.outer(expected, steps[-1] * np.arange(size))
    if np.array_equal(expected, places):
        return tuple(steps)
    return None


def index(first: int, steps: Sequence[int]) -> str:
    """Return an index in loops."""
    terms = [f"{step} * i{k}" for k, step in enumerate(steps) if step != 0]
    return " + ".join([str(first), *terms])


def literal(value: float) -> str:
    """Return a number in C."""
    return f"({value!r})".replace("inf", "INFINITY").replace("nan", "NAN")
