"""How the share of settled runs changes with what varies: a mismatch's size, noise, latency, control period."""

from __future__ import annotations

import re

import pandas as pd
from matplotlib.figure import Figure

from servobench.harness.analysis.comparison import settled_share
from servobench.harness.analysis.statistics import NO_ESTIMATE
from servobench.harness.pictures.panels import Styles, add_legend, label_rows, panel_grid
from servobench.harness.pictures.places import draw_curves
from servobench.harness.pictures.style import TEXT, WIDE, Layout

SIZED_AXIS = re.compile(r"^(?P<axis>[a-z_ ]+)=(?P<magnitude>[0-9.eE+-]+)(?P<unit>[a-zA-Z%°]*)$")
NUMBERS = {"noise_factor": ("noise factor", 1.0), "latency_s": ("latency [ms]", 1e3), "period_s": ("period [ms]", 1e3)}


def draw_conditions(runs: pd.DataFrame, styles: Styles, layout: Layout = WIDE) -> Figure | None:
    """Draw the share of settled runs with its 95 % Wilson interval over each condition that varies, if one does."""
    sweeps = _sweeps(runs)
    if not sweeps:
        return None
    figure, panels = panel_grid(len(sweeps), 2.5, layout)
    for axes, (label, part) in zip(panels, sweeps.items(), strict=True):
        shares = {key: settled_share(own) for key, own in part.groupby(["controller", "size"])}
        names, sizes = part["controller"].unique(), sorted(part["size"].unique())
        values = {name: [shares.get((name, size), NO_ESTIMATE) for size in sizes] for name in names}
        draw_curves(axes, sizes, values, styles, top=104.0)
        axes.set_xlabel(label)
    label_rows(panels, "settled runs [%]")
    figure.suptitle("How many moves settle over what is varied; bands are 95 % intervals", fontsize=TEXT + 1.0)
    add_legend(figure, panels)
    return figure


def _sweeps(runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return for each condition with at least two sizes the runs concerned, with the column `size`.

    Where a sweep says along which axis a run stands, the axes are its own, and the numbers that vary at one place of
    an axis; else the mismatches are read, and runs without mismatch have size 0 on each axis.
    """
    none = runs.head(0)
    places = [runs] if "axis" not in runs else [own for _, own in runs.groupby(["axis", "magnitude"], dropna=False)]
    sweeps = {
        label: runs.assign(size=factor * runs[name].astype(float))
        for name, (label, factor) in NUMBERS.items()
        if name in runs and any(own[name].nunique() > 1 for own in places)
    }
    if "axis" not in runs or (runs["axis"].fillna("") == "").all():
        none = runs[runs["mismatch"] == "none"].assign(size=0.0)
        runs = runs.assign(**runs["mismatch"].str.extract(SIZED_AXIS))
    along = runs[runs["axis"].fillna("") != ""]
    along = along.assign(size=along["magnitude"].astype(float))
    for (axis, unit), group in along.groupby(["axis", "unit"], sort=False):
        name = str(axis).replace("_", " ")
        sweeps[f"{name} [{unit}]" if unit else name] = pd.concat([none, group]) if len(none) else group
    known = {label: part.dropna(subset=["size"]) for label, part in sweeps.items()}
    return {label: part for label, part in known.items() if part["size"].nunique() > 1}
