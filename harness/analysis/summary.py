"""The table that a comparison ends with: a row for each controller in each task."""

from __future__ import annotations

import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table

from servobench.harness.analysis.statistics import column_of, settling_times
from servobench.harness.run.episode import COMPLETED

KEYS = ["plant", "mismatch", "task", "controller"]


def summarise(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each plant, mismatch, task and controller, in the order in which they first appear.

    Columns: runs, completed, settled (within 5 mm), median settling time [s], median overshoot, median RMS error of the
    evaluated part [m], median path length ratio, median controller time [µs].
    """
    rows = []
    for key, group in runs.groupby(KEYS, sort=False):
        row = dict(zip(KEYS, key, strict=True))
        row["runs"] = len(group)
        row["completed"] = int((group["status"] == COMPLETED).sum())
        row["settled"] = int(settling_times(group).notna().sum())
        for name in (
            "settling_time_s",
            "overshoot",
            "rms_error_evaluated",
            "path_length_ratio",
            "controller_time_median_us",
        ):
            row[name] = column_of(group, name).median()
        rows.append(row)
    return pd.DataFrame(rows)


def summary_tables(runs: pd.DataFrame) -> Group:
    """Return the summary for the terminal, a table for each plant, mismatch and task."""
    tables = []
    for (plant, mismatch, task), group in summarise(runs).groupby(["plant", "mismatch", "task"], sort=False):
        table = Table(title=f"{task} on {plant}, {mismatch}", title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
        table.add_column("controller", no_wrap=True, min_width=15)
        for heading in ("done", "settled", "after\ns", "overshoot\n%", "RMS end\nmm", "path\nratio", "step\nµs"):
            table.add_column(heading, justify="right", no_wrap=True)
        for row in group.to_dict("records"):
            table.add_row(
                row["controller"],
                f"{row['completed']}/{row['runs']}",
                f"{row['settled']}/{row['runs']}",
                _number(row["settling_time_s"], 1.0, 2),
                _number(row["overshoot"], 100.0, 0),
                _number(row["rms_error_evaluated"], 1000.0, 1),
                _number(row["path_length_ratio"], 1.0, 2),
                _number(row["controller_time_median_us"], 1.0, 0),
            )
        tables.append(table)
    legend = "done: reached the last period; settled: came within 5 mm and stayed; the rest are medians over runs"
    return Group(*tables, legend)


def _number(value: float, factor: float, digits: int) -> str:
    return "–" if pd.isna(value) else f"{value * factor:.{digits}f}"
