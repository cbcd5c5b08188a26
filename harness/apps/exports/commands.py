"""The command on the steps of a results folder for other tools: `export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servobench.harness.cli import selection
from servobench.harness.cli.options import ShownOption, named_option, option
from servobench.harness.cli.terminal import say


def export(
    folder: Annotated[
        Path, typer.Argument(help="Results folder of run or compare, which keep steps.")
    ],
    out: Annotated[Path, option("FOLDER", "New folder for the files.")],
    format_: Annotated[
        str,
        named_option(
            "--format", "NAME", "csv, or mcap: bags for Foxglove, rerun and ROS 2 (extra bag)."
        ),
    ] = "csv",
    run: Annotated[
        str | None, named_option("--run", "RUN_ID", "One run alone; default: all.")
    ] = None,
    controllers: ShownOption = "all",
) -> None:
    """Write the steps of runs for other tools, a file a run."""
    from servobench.harness.apps.exports.exports import export_folder
    from servobench.harness.batch.logs import find_run
    from servobench.harness.batch.results import ResultsFolder

    opened = ResultsFolder(folder)
    runs = opened.runs()
    if run is not None:
        chosen = find_run(opened, run)["run_id"]
        runs = runs[runs["run_id"] == chosen]
    runs = runs[runs["controller"].isin(selection.split_shown(controllers, runs))]
    say(opened.describe_missing())
    files = export_folder(opened, out, format_, runs)
    say(f"{len(files)} files in {out}")
