"""The command `servobench report`: one page about a results folder."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from servobench.harness.cli import selection
from servobench.harness.cli.options import MetricsOption, option
from servobench.harness.cli.terminal import console, say

SLOW_REPORT = 20.0  # [s], beyond which the time that a report took is printed


def report(
    folder: Annotated[Path, typer.Argument(help="Results folder of run, compare or sweep.")],
    out: Annotated[
        Path | None, option("FILE", "The page; default: report.html in the folder.")
    ] = None,
    metric: MetricsOption = None,
) -> None:
    """Write one page about a results folder.

    With figures, sortable tables and paths to turn; it needs no network.
    """
    from servobench.harness.apps.report.page import write_report
    from servobench.harness.batch.results import ResultsFolder

    opened = ResultsFolder(folder)
    selection.add_metrics(opened, metric)
    say(opened.describe_missing())
    began = time.monotonic()
    with console.status("making the report"):
        path = write_report(opened, out)
        opened.vouch([path])
    seconds = time.monotonic() - began
    took = f", made in {seconds:.0f} s" if seconds > SLOW_REPORT else ""
    say(f"report: {path} ({path.stat().st_size / 1e6:.1f} MB{took})")
