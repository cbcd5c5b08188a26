"""The commands that show results, `statistics | report`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from servobench.harness.cli.terminal import console, print_json, print_markdown, print_tables

SLOW_REPORT = 20.0  # [s], beyond which the time that a report took is printed


def statistics(
    folder: Annotated[Path, typer.Argument(help="Results folder of a run, comparison or sweep.")],
    metric: Annotated[
        str | None,
        typer.Option(
            help="Column of the table of runs by which pairs are compared; default: settling time, on curves RMS error."
        ),
    ] = None,
    never: Annotated[
        float | None,
        typer.Option(help="Value for a run that has none, such as one that never settled; default: twice the largest."),
    ] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print the tables as Markdown.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for other programs.")] = False,
) -> None:
    """Judge the controllers of a folder, with 95 % intervals.

    Rates, medians, tails, failures and paired differences.
    """
    from servobench.harness.analysis.tables import as_plain, statistics_rows, statistics_tables
    from servobench.harness.batch import results
    from servobench.harness.config.settings import ConfigurationError

    if markdown and as_json:
        raise ConfigurationError("--markdown and --json are two ways to print the same; give one of them")
    runs = results.load_runs(folder)
    if as_json:
        print_json(
            [
                {"place": place, "controllers": as_plain(controllers), "pairs": as_plain(pairs)}
                for place, controllers, pairs in statistics_rows(runs, metric, never)
            ]
        )
        return
    tables = statistics_tables(runs, metric, never)
    print_markdown(tables) if markdown else print_tables(tables)


def report(
    folder: Annotated[Path, typer.Argument(help="Results folder of run, compare, sweep or claims.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The page; default: report.html in the folder.")
    ] = None,
) -> None:
    """Write one page about a results folder.

    With figures, sortable tables and paths to turn; it needs no network.
    """
    make_report(folder, out)


def make_report(folder: Path, out: Path | None = None) -> None:
    """Write the report and print its path and, if it took long, the time."""
    from servobench.harness.pictures.report import write_report

    began = time.monotonic()
    with console.status("making the report"):
        path = write_report(folder, out)
    seconds = time.monotonic() - began
    took = f", made in {seconds:.0f} s" if seconds > SLOW_REPORT else ""
    console.print(f"report: {path} ({path.stat().st_size / 1e6:.1f} MB{took})", soft_wrap=True, markup=False)
