"""The command `servobench statistics`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import pandas as pd
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from servobench.harness.analysis.judgement import compare_controllers, judge_controllers, places
from servobench.harness.batch import results

console = Console()


def statistics(
    folder: Annotated[Path, typer.Argument(help="Results folder of a run, comparison or sweep.")],
    metric: Annotated[
        str | None, typer.Option(help="Column that pairs are compared by; default: settling time, on curves RMS error.")
    ] = None,
    never: Annotated[
        float | None, typer.Option(help="What a run without a value counts as in pairs; default: twice the largest.")
    ] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print tables for a page.")] = False,
) -> None:
    """Judge the controllers of a folder: rates, medians, tails, failures, paired differences, with 95 % intervals."""
    for words, runs in places(results.load_runs(folder)):
        for title, table in ((words, judge_controllers(runs)), ("pairs", compare_controllers(runs, metric, never))):
            if len(table):
                _print_markdown(title, table) if markdown else console.print(_terminal(title, table))


def _terminal(title: str, table: pd.DataFrame) -> Table:
    shown = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for heading in table.columns:
        shown.add_column(heading, no_wrap=heading in ("controller", "pair"), min_width=8)
    for row in table.itertuples(index=False):
        shown.add_row(*row)
    return shown


def _print_markdown(title: str, table: pd.DataFrame) -> None:
    lines = [f"{title}:", "", "| " + " | ".join(table.columns) + " |", "|---" * len(table.columns) + "|"]
    lines += ["| " + " | ".join(row) + " |" for row in table.itertuples(index=False)]
    console.print("\n".join(lines) + "\n", soft_wrap=True, markup=False, highlight=False)
