"""How the share of settled runs changes with what a folder varies: a mismatch's size, the noise, the latency."""

from __future__ import annotations

import re

import pandas as pd
from matplotlib.figure import Figure

from servobench.harness.analysis.comparison import settled_share
from servobench.harness.analysis.statistics import NO_ESTIMATE, Estimate
from servobench.harness.pictures.panels import Styles, add_legend, draw_places, label_rows, panel_grid

MAGNITUDE = re.compile(r"^(?P<axis>[a-z_ ]+)=(?P<size>[0-9.eE+-]+)(?P<unit>[a-zA-Z%°]*)$")
NUMBERS = {"noise_factor": "noise factor", "latency_periods": "latency [periods]"}


def draw_conditions(runs: pd.DataFrame, styles: Styles) -> Figure | None:
    """Draw the share of settled runs with its 95 % Wilson interval over each condition that varies; None if none does.

    Args:
        runs: rows of the table of runs.
        styles: of the controllers.
    """
    sweeps = _sweeps(runs)
    if not sweeps:
        return None
    figure, panels = panel_grid(len(sweeps), 2.5)
    for axes, (label, part) in zip(panels, sweeps.items(), strict=True):
        cells = dict(iter(part.groupby(["controller", "size"])))
        names, sizes = part["controller"].unique(), sorted(part["size"].unique())
        shares = {name: [_share(cells.get((name, size))) for size in sizes] for name in names}
        draw_places(axes, sizes, shares, styles, joined=True)
        axes.set(xlabel=label, ylim=(-4, 104))
    label_rows(panels, "settled runs [%]")
    add_legend(figure, panels)
    return figure


def _share(runs: pd.DataFrame | None) -> Estimate:
    return NO_ESTIMATE if runs is None else settled_share(runs)


def _sweeps(runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return for each condition with at least two sizes the runs concerned, with the column `size`.

    Where a sweep says along which axis a run stands, the axes are its own; else the mismatches are read.
    """
    if "axis" in runs and (runs["axis"].fillna("") != "").any():
        own = runs[runs["axis"].fillna("") != ""]
        return _along_axes(own.assign(size=own["magnitude"]), own.head(0))
    sweeps = {
        label: runs[runs[name].notna()].assign(size=runs[name].dropna().astype(float))
        for name, label in NUMBERS.items()
        if name in runs and runs[name].nunique() > 1
    }
    words = runs["mismatch"].map(MAGNITUDE.match)
    found = runs[words.notna()].assign(
        axis=[match["axis"] for match in words if match],
        unit=[match["unit"] for match in words if match],
        size=[float(match["size"]) for match in words if match],
    )
    return sweeps | _along_axes(found, runs[runs["mismatch"] == "none"].assign(size=0.0))


def _along_axes(found: pd.DataFrame, none: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the runs of each axis with at least two sizes; those without mismatch, `none`, have size 0 on each."""
    sweeps = {}
    for (axis, unit), group in found.groupby(["axis", "unit"], sort=False):
        part = pd.concat([none, group]) if len(none) else group
        if part["size"].nunique() > 1:
            name = str(axis).replace("_", " ")
            sweeps[f"{name} [{unit}]" if unit else name] = part
    return sweeps
