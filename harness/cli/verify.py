"""The command `servobench verify`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from servobench.harness.cli import options
from servobench.harness.cli.terminal import console


def verify(folder: Annotated[Path, typer.Argument(help="Results folder.")]) -> None:
    """Check that a results folder holds what was written.

    Names each file that is damaged, and what to type. The exit code is 1 if there is one.
    """
    from servobench.harness.batch.integrity import examine
    from servobench.harness.batch.lock import current_holder

    holder = current_holder(folder)
    if holder is not None:
        console.print(f"{folder} is being written by {holder}", soft_wrap=True, markup=False, highlight=False)
    found = examine(folder)
    for finding in found.findings:
        line = f"{folder / finding.name} {finding.what}: {finding.remedy}"
        console.print(line, soft_wrap=True, markup=False, highlight=False)
    if found.runs < found.wanted:
        wanting = f"{found.runs} of {found.wanted} runs are there: --resume carries out the others"
        console.print(wanting, soft_wrap=True, markup=False, highlight=False)
    if found.findings:
        sys.exit(options.FAILED)
    console.print(f"{found.files} files are what was written, {found.runs} runs", markup=False, highlight=False)
