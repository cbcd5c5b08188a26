"""The command `servobench report`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

console = Console()


def report(
    folder: Annotated[Path, typer.Argument(help="Results folder of run, compare, sweep or claims.")],
    out: Annotated[Path | None, typer.Option(help="The page; default report.html in the folder.")] = None,
) -> None:
    """Turn a results folder into one page with figures, tables and paths to turn, to be opened without a network."""
    make_report(folder, out)


def make_report(folder: Path, out: Path | None = None) -> None:
    """Write the report and tell its path; if that took long, also how long."""
    from servobench.harness.pictures.report import SLOW, write_report  # noqa: PLC0415 - the notebook tools take a second to import

    began = time.monotonic()
    with console.status("making the report"):
        path = write_report(folder, out)
    seconds = time.monotonic() - began
    took = f", made in {seconds:.0f} s" if seconds > SLOW else ""
    console.print(f"report: {path} ({path.stat().st_size / 1e6:.1f} MB{took})", soft_wrap=True, markup=False)
