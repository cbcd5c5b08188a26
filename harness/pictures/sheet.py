"""Tables for the template of the report: intervals apart from values, headings in groups, methods in pairs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import groupby
from typing import Any, Final, NamedTuple

import pandas as pd
from markupsafe import Markup, escape

from servobench.controllers.methods import PUBLISHED
from servobench.harness.analysis.groups import WHICH
from servobench.harness.analysis.statistics import MISSING

ESTIMATE: Final = re.compile(r"(?P<value>[^\[\]]+) \[(?P<low>[^,\[\]]+), (?P<high>[^,\[\]]+)\]")
NUMBER: Final = re.compile(r"[-+]?(\d|∞|–$)")
BREAKS: Final = re.compile(r"([_:+=/,.])")  # signs after which a long name may go on in the next line
TICKED: Final = re.compile(r"`([^`]*)`")
CONTROLLER: Final = (WHICH, "controller")
INFINITE: Final = "∞"
LENGTHY: Final = 24  # letters of a word that may be broken anywhere
FEW, SOME = 4, 8  # columns: up to FEW fit on a phone, up to SOME on a tablet


class Cell(NamedTuple):
    """A cell of a table."""

    text: str
    interval: str = ""  # of the number; empty without one
    number: bool = False  # whether it is to be read as a number
    link: str = ""  # address within the page; empty without one

    @property
    def lengthy(self) -> bool:
        """Whether it has a word that has to be broken where there is little room."""
        return any(len(word) > LENGTHY for word in BREAKS.sub(" ", self.text).split())


class SheetRow(NamedTuple):
    """A row of cells."""

    cells: list[Cell]  # one a column
    begins: bool  # whether another method begins with it
    published: bool  # whether it is a method as published
    name: str = ""  # identifier of the row in the page; empty without one


class Sheet(NamedTuple):
    """A table."""

    groups: list[tuple[str, int]]  # title and number of columns of each group of columns; empty without groups
    headings: list[tuple[str, str]]  # of each column: name, unit
    rows: list[SheetRow]
    size: str  # `few`, `some` or `many` columns, for the width at which rows become cards
    pairs: bool  # whether every group has two columns, which stay side by side in a card


def sheet(table: pd.DataFrame, *, linked: bool = False) -> Sheet:
    """Return a table for the template.

    Args:
        table: its columns are headings or pairs (group, heading).
        linked: the first column counts runs: its cells link to `#run-<number>`.
    """
    columns = [(str(name[0]), str(name[1])) if isinstance(name, tuple) else (WHICH, str(name)) for name in list(table)]
    groups = [(name, len(list(own))) for name, own in groupby(group for group, _ in columns)]
    headings = [_heading(heading) for _, heading in columns]
    size = "few" if len(columns) <= FEW else "some" if len(columns) <= SOME else "many"
    pairs = len(groups) > 1 and [count for _, count in groups] == [1, *[2] * (len(groups) - 1)]
    rows = list(_rows(table, columns, linked=linked))
    return Sheet(groups if len(groups) > 1 else [], headings, rows, size, pairs)


def breakable(text: object) -> Markup:
    """Return escaped text that may be broken after signs such as `_` and `:`."""
    return Markup("<wbr>").join(escape(part) for part in BREAKS.sub("\\1\0", str(text)).split("\0"))


def marked(text: object) -> Markup:
    """Return escaped text in which words between backticks are set as code."""
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if i % 2 else escape(part)
        for i, part in enumerate(TICKED.split(str(text)))
    )


def plain(value: Any) -> str:  # noqa: ANN401 - a cell of any table
    """Return a value as a reader wants it: no name of Python's for nothing, infinity or truth."""
    if isinstance(value, list | tuple | set | dict):
        return str(value)
    if pd.isna(value):
        return MISSING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}".replace("inf", "∞")
    return str(value)


def _rows(table: pd.DataFrame, columns: list[tuple[str, str]], *, linked: bool) -> Iterator[SheetRow]:
    place = columns.index(CONTROLLER) if CONTROLLER in columns else None
    before = None
    for values in table.itertuples(index=False, name=None):
        cells = [_cell(plain(value)) for value in values]
        owner = None if place is None else str(values[place])
        method = None if owner is None else owner.removesuffix(PUBLISHED)
        name = f"run-{values[0]}" if linked else ""
        if linked:
            cells[0] = Cell(cells[0].text, number=True, link=f"#{name}")
        yield SheetRow(cells, method != before, bool(owner and owner.endswith(PUBLISHED)), name)
        before = method


def _cell(text: str) -> Cell:
    match = ESTIMATE.fullmatch(text)
    if match and {match["value"][0], match["low"], match["high"]} == {INFINITE}:  # an interval from ∞ to ∞ says nothing
        return Cell(INFINITE, number=True)
    if match:
        return Cell(match["value"], f"{match['low']} to {match['high']}", number=True)
    return Cell(text, number=NUMBER.match(text) is not None)


def _heading(text: str) -> tuple[str, str]:
    name, bracket, unit = text.partition(" [")
    return name, unit.removesuffix("]") if bracket else ""
