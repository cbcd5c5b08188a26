"""The columns without which a table is none of runs or steps, whoever made it."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path
from typing import Final

import pandas as pd

from servobench.harness.config.settings import ConfigurationError

NEEDED: Final = {
    "runs": ("run_id", "plant", "controller", "task", "mismatch", "seed", "status"),
    "steps": ("run_id", "time_s", "error_norm"),
}
RUN_ID: Final = re.compile(r"[A-Za-z0-9=+_-][A-Za-z0-9.=+_-]*")  # also the name of a file: no separator, no ".."


def lacking(kind: str, columns: Collection[str]) -> str:
    """Return which columns a table of runs or steps lacks that it needs, as a predicate; empty where it has all."""
    missing = [name for name in NEEDED[kind] if name not in columns]
    return f"lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}" if missing else ""


def refuse_lacking(path: Path, kind: str, columns: Collection[str]) -> None:
    """Refuse a table that is none of runs or steps.

    Raises:
        ConfigurationError: names the table and what it lacks.
    """
    if lack := lacking(kind, columns):
        raise ConfigurationError(f"{path} is no table of {kind}: it {lack}")


def refuse_nameless(path: Path, runs: pd.DataFrame) -> None:
    """Refuse a table of runs in which a run is not identified, or its identifier is unfit for the name of a file.

    Raises:
        ConfigurationError: names the table, the column and the row.
    """
    for name in NEEDED["runs"]:
        if (empty := runs[name].isna()).any():
            raise ConfigurationError(f"{path} is no table of runs: row {int(empty.to_numpy().argmax())} has no {name}")
    for row, run_id in enumerate(runs["run_id"]):
        if not isinstance(run_id, str) or RUN_ID.fullmatch(run_id) is None:
            raise ConfigurationError(
                f"{path} is no table of runs: the run_id of row {row}, {str(run_id)[:60]!r}, is unfit for the name of "
                "a file; it has letters, digits and . = + _ - only, and does not begin with a dot"
            )
