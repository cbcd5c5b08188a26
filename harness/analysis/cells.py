"""A cell of a table: text for a reader, plain values for a program."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import pandas as pd

from servobench.harness.analysis.statistics import Estimate

Row: TypeAlias = "dict[str, Cell]"


@dataclass(frozen=True)
class Cell:
    """A value and how it is written."""

    value: str | float | Estimate
    spec: str = ""  # of `format`

    def __str__(self) -> str:
        """Return it as a reader gets it."""
        text = format(self.value, self.spec)
        return text.replace("inf", "∞") if isinstance(self.value, float) else text

    def plain(self) -> object:
        """Return it as JSON can have it: an estimate with its ends, None for no number, "inf" for infinity."""
        if isinstance(self.value, Estimate):
            ends = {"value": self.value.value, "low": self.value.low, "high": self.value.high}
            return {name: _plain(number) for name, number in ends.items()} | {"count": self.value.count}
        return self.value if isinstance(self.value, str) else _plain(self.value)


def _plain(number: float) -> object:
    return None if math.isnan(number) else number if math.isfinite(number) else str(float(number))


def as_text(rows: list[Row]) -> pd.DataFrame:
    """Return a table of text."""
    return pd.DataFrame([{name: str(cell) for name, cell in row.items()} for row in rows])


def as_plain(rows: list[Row]) -> list[dict[str, object]]:
    """Return rows of plain values."""
    return [{name: cell.plain() for name, cell in row.items()} for row in rows]
