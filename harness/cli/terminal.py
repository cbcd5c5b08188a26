"""The console that all commands print to, and tables on it."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, NoReturn

from rich.console import Console

if TYPE_CHECKING:
    import pandas as pd

TERMINATED = 128 + signal.SIGTERM  # exit code

LEFT = ("controller", "mismatch", "noise", "latency", "period", "pair", "failures", "outcome")  # columns of words
WHOLE = ("controller", "pair")  # columns whose words are not broken over lines
UNBROKEN = ("outcome",)  # columns of which no word is broken

console = Console()


@contextlib.contextmanager
def cleaning_up_when_terminated() -> Iterator[None]:
    """Let SIGTERM end the command as Ctrl-C does, such that nothing half written and no other program is left."""

    def stop(_number: int, _frame: object) -> NoReturn:
        sys.stderr.write("servobench: terminated\n")
        raise SystemExit(TERMINATED)

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def print_tables(tables: Iterable[tuple[str, pd.DataFrame]], legend: str = "") -> None:
    """Print tables of text with their titles, and a legend below all of them."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    for title, rows in tables:
        table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        for name in rows.columns:
            words = [len(word) for cell in rows[name] for word in str(cell).split()] if name in UNBROKEN else []
            width = max([15 * (name == "controller"), *words]) or None
            table.add_column(name, justify="left" if name in LEFT else "right", no_wrap=name in WHOLE, min_width=width)
        for row in rows.itertuples(index=False):
            table.add_row(*row)
        console.print(table)
    if legend:
        console.print(legend)


def print_json(value: object) -> None:
    """Print a value as JSON."""
    console.print(json.dumps(value, indent=2, ensure_ascii=False), soft_wrap=True, markup=False, highlight=False)


def print_markdown(tables: Iterable[tuple[str, pd.DataFrame]]) -> None:
    """Print tables of text as Markdown."""
    for title, rows in tables:
        lines = [f"{title}:", "", "| " + " | ".join(rows.columns) + " |", "|---" * len(rows.columns) + "|"]
        lines += ["| " + " | ".join(row) + " |" for row in rows.itertuples(index=False)]
        console.print("\n".join(lines) + "\n", soft_wrap=True, markup=False, highlight=False)
