"""What a command says about runs that failed, and the exit code that follows from it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

from servobench.harness.cli.options import FAILED
from servobench.harness.cli.terminal import console

if TYPE_CHECKING:
    import pandas as pd

MAX_FAULTS: Final = 10  # runs that failed, each on a line of its own


def print_faults(runs: pd.DataFrame) -> None:
    """Print why runs failed, a line each; of many the first ones."""
    from servobench.harness.run.result import COMPLETED

    for row in runs[runs["status"] != COMPLETED].head(MAX_FAULTS).to_dict("records"):
        line = f"{row['run_id']}: {row['status']}: {row['reason']}"
        console.print(line, soft_wrap=True, markup=False, highlight=False)


def judge(folder: Path, *, strict: bool) -> None:
    """Say how many runs of a finished batch failed and where their traces are; end with exit code 1 if that counts.

    Args:
        folder: its results.
        strict: whether a run that failed makes the command fail.
    """
    from servobench.harness.batch import results
    from servobench.harness.run.result import COMPLETED

    statuses = [table["status"] for table in results.iterate_runs(folder, ("status",))]
    count, failed = sum(map(len, statuses)), sum(int((status != COMPLETED).sum()) for status in statuses)
    if not failed:
        return
    line = f"{failed} of {count} run{'s' if count > 1 else ''} failed; why, with traces: {folder / results.FAILURES}"
    console.print(line, soft_wrap=True, markup=False, highlight=False)
    if strict:
        sys.exit(FAILED)
