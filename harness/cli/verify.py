"""The command `servobench verify`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from servobench.harness.cli import options
from servobench.harness.cli.terminal import console, say


def verify(folder: Annotated[Path, typer.Argument(help="Results folder.")]) -> None:
    """Check that a results folder holds what was written.

    Names each file that is damaged, and what to type. The exit code is 1 if there is one.
    """
    from servobench.harness.batch.integrity import examine
    from servobench.harness.batch.lock import current_holder
    from servobench.harness.batch.results import missing_line

    holder = current_holder(folder)
    if holder is not None:
        say(f"{folder} is being written by {holder}")
    found = examine(folder)
    for finding in found.findings:
        line = f"{folder / finding.name} {finding.what}: {finding.remedy}"
        say(line)
    if line := missing_line(found.runs, found.wanted):
        say(line)
    if found.findings:
        sys.exit(options.FAILED)
    console.print(f"{found.files} files are what was written, {found.runs} runs", markup=False, highlight=False)
