"""How the share of settled runs changes with what a folder varies: a mismatch's size, the noise, the latency."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from harness.figures.panels import Styles, add_legend
from harness.statistics import success_rate

MAGNITUDE = re.compile(r"^(?P<axis>[a-z_ ]+)=(?P<size>[0-9.eE+-]+)(?P<unit>[a-zA-Z%°]*)$")
NUMBERS = {"noise_factor": "noise factor", "latency_periods": "latency [periods]"}


def draw_conditions(runs: pd.DataFrame, styles: Styles) -> Figure | None:
    """Draw the share of settled runs with its 95 % Wilson interval over each condition that varies; None if none does.

    Args:
        runs: rows of the table of runs, with the column `settled` added.
        styles: of the controllers.
    """
    sweeps = _sweeps(runs)
    if not sweeps:
        return None
    columns = min(3, len(sweeps))
    rows = -(-len(sweeps) // columns)
    figure = Figure(figsize=(1.0 + 3.2 * columns if columns > 1 else 6.0, 1.0 + 2.5 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    for axes, (label, part) in zip(panels, sweeps.items(), strict=False):
        spread = 0.012 * float(np.ptp(part["size"]))
        for i, (name, group) in enumerate(part.groupby("controller", sort=False)):
            counts = group.groupby("size")["settled"].agg(["sum", "count"])
            rates = [success_rate(int(total), int(count)) for total, count in counts.to_numpy()]
            share = 100.0 * np.array([rate.value for rate in rates])
            low, high = (100.0 * np.array([getattr(rate, end) for rate in rates]) for end in ("low", "high"))
            bars = np.clip(np.stack([share - low, high - share]), 0.0, None)
            style = styles[str(name)].line_arguments(1) | {"markevery": None}
            shift = spread * (i - 0.5 * (part["controller"].nunique() - 1))  # intervals beside, not upon each other
            axes.errorbar(counts.index + shift, share, yerr=bars, label=name, capsize=2, elinewidth=0.8, **style)
        axes.set(xlabel=label, ylim=(-4, 104))
    for i, axes in enumerate(panels):
        axes.set_visible(i < len(sweeps))
        if i % columns == 0:
            axes.set_ylabel("settled runs [%]")
    add_legend(figure, [axes for axes in panels if axes.get_visible()])
    return figure


def _sweeps(runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return for each condition with at least two sizes the runs concerned, with the column `size`.

    Where a sweep says along which axis a run stands, the axes are its own; else the mismatches are read.
    """
    axes = runs["axis"].fillna("") if "axis" in runs else pd.Series("", index=runs.index)
    if (axes != "").any():
        own = runs[axes != ""]
        words = own["axis"].str.replace("_", " ") + "=" + own["magnitude"]
        return _along_axes(own, words)
    sweeps = {
        label: runs[runs[name].notna()].assign(size=runs[name].dropna().astype(float))
        for name, label in NUMBERS.items()
        if name in runs and runs[name].nunique() > 1
    }
    return sweeps | _along_axes(runs, runs["mismatch"])


def _along_axes(runs: pd.DataFrame, words: pd.Series[str]) -> dict[str, pd.DataFrame]:
    """Return the runs of each axis with at least two sizes; `words` say axis and size of each run, `links=10%`."""
    matches = words.map(MAGNITUDE.match)
    found = runs[matches.notna()].assign(
        axis=[match["axis"] for match in matches if match],
        unit=[match["unit"] for match in matches if match],
        size=[float(match["size"]) for match in matches if match],
    )
    none = runs[words == "none"].assign(size=0.0)
    sweeps = {}
    for (axis, unit), group in found.groupby(["axis", "unit"], sort=False):
        part = pd.concat([none, group]) if len(none) else group
        if part["size"].nunique() > 1:
            sweeps[f"{str(axis).replace('_', ' ')} [{unit}]" if unit else str(axis)] = part
    return sweeps
