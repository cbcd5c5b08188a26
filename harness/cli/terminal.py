"""The console that all commands print to, and tables on it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from rich.console import Console

if TYPE_CHECKING:
    import pandas as pd

LEFT = ("controller", "mismatch", "noise", "latency", "pair", "failures", "outcome")  # columns of words
WHOLE = ("controller", "pair", "outcome")  # columns whose words are not broken over lines

console = Console()


def print_tables(tables: Iterable[tuple[str, pd.DataFrame]], legend: str = "") -> None:
    """Print tables of text with their titles, and a legend below all of them."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    for title, rows in tables:
        table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
        for name in rows.columns:
            width = 15 if name == "controller" else None
            table.add_column(name, justify="left" if name in LEFT else "right", no_wrap=name in WHOLE, min_width=width)
        for row in rows.itertuples(index=False):
            table.add_row(*row)
        console.print(table)
    if legend:
        console.print(legend)


def print_markdown(tables: Iterable[tuple[str, pd.DataFrame]]) -> None:
    """Print tables of text as Markdown."""
    for title, rows in tables:
        lines = [f"{title}:", "", "| " + " | ".join(rows.columns) + " |", "|---" * len(rows.columns) + "|"]
        lines += ["| " + " | ".join(row) + " |" for row in rows.itertuples(index=False)]
        console.print("\n".join(lines) + "\n", soft_wrap=True, markup=False, highlight=False)
