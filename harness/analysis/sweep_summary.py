"""The tables that a sweep ends with: how often each controller settled, a row for each place of the sweep."""

from __future__ import annotations

import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table

from servobench.harness.analysis.statistics import settling_times

PLACE = ["mismatch", "noise_factor", "latency_periods"]


def sweep_tables(runs: pd.DataFrame) -> Group:
    """Return tables for the terminal, one for each plant and task: share of runs settled within 5 mm."""
    tables: list[Table | str] = []
    controllers = list(dict.fromkeys(runs["controller"]))
    table_rows = runs.assign(settled=settling_times(runs).notna())
    for (plant, task), group in table_rows.groupby(["plant", "task"], sort=False):
        table = Table(title=f"{task} on {plant}: settled, %", title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
        for heading in ("mismatch", "noise", "latency"):
            table.add_column(heading)
        for name in (*controllers, "runs"):
            table.add_column(name, justify="right", no_wrap=True)
        for (mismatch, noise, latency), cell in group.assign(
            latency_periods=group["latency_periods"].map(lambda value: "–" if pd.isna(value) else f"{value:g}")
        ).groupby(PLACE, sort=False):
            share = 100.0 * cell.groupby("controller")["settled"].mean()
            counts = cell["controller"].value_counts()
            table.add_row(
                str(mismatch),
                f"{noise:g}",
                str(latency),
                *(f"{share[name]:.1f}" if name in share else "–" for name in controllers),
                f"{counts.max()}",
            )
        tables.append(table)
    return Group(*tables, "settled: came within 5 mm and stayed; noise: factor; latency: periods, – as configured")
