"""The command `servobench export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servobench.harness.cli.terminal import console, say


def export(
    folder: Annotated[Path, typer.Argument(help="Results folder of run or compare, which keep steps.")],
    out: Annotated[Path, typer.Option(help="New folder for the files.")],
    format_: Annotated[
        str, typer.Option("--format", help="csv, or mcap (Foxglove, readers of MCAP; extra mcap).")
    ] = "csv",
) -> None:
    """Write the steps of runs for other tools, a file a run."""
    from servobench.harness.analysis.exports import export_folder
    from servobench.harness.batch import results

    if missing := results.describe_missing(folder):
        say(missing)
    files = export_folder(folder, out, format_)
    console.print(f"{len(files)} files in {out}", markup=False, highlight=False)
