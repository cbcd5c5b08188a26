"""Figures of numbers, a row a controller: what each run came to, and how long steps take."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from servobench.harness.analysis.comparison import settling_times
from servobench.harness.analysis.measures import MEASURES
from servobench.harness.pictures.ensembles import Ensembles
from servobench.harness.pictures.panels import Styles
from servobench.harness.pictures.style import TEXT, WIDTH
from servobench.harness.run.ending import COMPLETED
from servobench.plant.checks import FloatArray

SETTLING, NEVER = "settling_time_s", 1.3  # and where a run without a value stands, over the largest value
ACCURACY: Final = (SETTLING, "rms_error_evaluated")
EFFORT: Final = ("control_effort_rad", "saturation_fraction")
SMOOTHNESS: Final = ("joint_acceleration_rms_rad_s2", "joint_jerk_rms_rad_s3", "command_switches")
PERCENTILES = (1.0, 25.0, 50.0, 75.0, 99.0)
LINE: Final = 0.165  # [in] a controller
WIDE_RANGE: Final = 30.0  # largest over smallest value from which on an axis is logarithmic


class _Dots(NamedTuple):
    """A measure of the table of runs as it is drawn."""

    column: str
    label: str
    factor: float


def draw_measures(runs: pd.DataFrame, columns: Sequence[str], styles: Styles) -> Figure | None:
    """Draw measures of every run, a column a task, a row a measure, a line a controller; None without values.

    A bar is the median over runs. Runs that never settled stand at the right edge and are counted there.

    Args:
        runs: of one plant and mismatch.
        columns: of the table of runs; those without any value are left out.
        styles: controller -> style.
    """
    rows = [_dots(name, runs) for name in columns if name in runs and runs[name].notna().any()]
    if not rows:
        return None
    tasks, names = runs["task"].unique().tolist(), runs["controller"].unique().tolist()
    height = 0.55 + LINE * max(4, len(names))
    figure = Figure(figsize=(WIDTH, 0.65 + len(rows) * height), layout="constrained")
    parts = np.atleast_1d(np.array(figure.subfigures(len(rows), 1), dtype=object))
    for part, row in zip(parts, rows, strict=True):
        panels = part.subplots(1, len(tasks), sharey=True, squeeze=False)[0]
        for axes, task in zip(panels, tasks, strict=True):
            _draw_dots(axes, runs[runs["task"] == task], names, styles, row)
            axes.set_title(task)
        panels[0].set_ylim(len(names) - 0.4, -0.6)
        part.supxlabel(row.label, fontsize=TEXT)
    notes = ["bar: median"] if runs.groupby(["task", "controller"]).size().max() > 1 else []
    notes += ["hollow: the run ended early"] if (runs["status"] != COMPLETED).any() else []
    if rows[0].column == SETTLING and _unsettled(runs).any():
        notes.append("at the right edge and counted: never settled")
    if notes:
        figure.supxlabel("; ".join(notes), fontsize=TEXT - 0.5)
    return figure


def draw_step_times(tasks: Mapping[str, Ensembles], styles: Styles) -> Figure | None:
    """Draw how long a controller's step takes: 1 to 99 % as a line, the middle half as a bar; None without values.

    Steps that take longer than the control period are marked and counted.
    """
    names = list(dict.fromkeys(name for ensembles in tasks.values() for name in ensembles))
    times = {name: np.concatenate([e[name].step_time for e in tasks.values() if name in e]) for name in names}
    known = {name: values for name, values in times.items() if len(values)}
    if not known:
        return None
    periods = [ensemble.period for ensembles in tasks.values() for ensemble in ensembles.values()]
    limit = 1e6 * max([period for period in periods if math.isfinite(period)], default=math.nan)
    figure = Figure(figsize=(WIDTH, 1.15 + 0.24 * max(3, len(known))), layout="constrained")
    axes = figure.add_subplot()
    top = 1.4 * max(np.max(values) for values in known.values())
    for i, (name, values) in enumerate(known.items()):
        _draw_times(axes, i, values, limit, styles, name)
    axes.annotate("median, 99 %, largest", (1.01, 1.0), xycoords="axes fraction", va="bottom", fontsize=TEXT - 0.5,
                  xytext=(0, 2), textcoords="offset points")  # fmt: skip
    if math.isfinite(limit):
        top = max(top, 1.6 * limit)
        axes.axvline(limit, color="black", linestyle=(0, (2, 2)), linewidth=1.0)
        axes.axvspan(limit, top, facecolor="0.93", edgecolor="0.75", hatch="////", linewidth=0.0, zorder=0)
        axes.annotate(f"control period, {limit / 1000:g} ms", (limit, 1.0), xycoords=("data", "axes fraction"),
                      ha="right", va="bottom", fontsize=TEXT - 0.5, xytext=(0, 2),
                      textcoords="offset points")  # fmt: skip
    axes.set(xscale="log", yticks=range(len(known)), yticklabels=list(known), xlabel="time of a controller's step [µs]")
    axes.set_xlim(right=top)
    axes.set_ylim(len(known) - 0.4, -0.6)
    axes.xaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, _: f"{value:,.0f}"))
    return figure


def _draw_times(axes: Axes, i: int, values: FloatArray, limit: float, styles: Styles, name: str) -> None:
    low, first, middle, third, high = np.percentile(values, PERCENTILES)
    style, largest, late = styles[name], float(values.max()), int(np.count_nonzero(values > limit))
    axes.plot([low, high], [i, i], color=style.colour, linewidth=1.2, marker="|", markersize=7)
    axes.plot([first, third], [i, i], color=style.colour, linewidth=6.0, solid_capstyle="butt", alpha=0.45)
    axes.plot(middle, i, color=style.colour, marker=style.marker or "o", markersize=6.0, markeredgecolor="black",
              markerfacecolor=style.face)  # fmt: skip
    words = f"{_short(middle)}, {_short(high)}, {_short(largest)}"
    if late:
        axes.plot(largest, i, color="black", marker="X", markersize=6.5, linestyle="")
        words += f"\n{late} of {len(values)} steps too slow"
    axes.annotate(words, (1.01, i), xycoords=("axes fraction", "data"), va="center", fontsize=TEXT - 0.5,
                  fontweight="bold" if late else None, linespacing=1.0)  # fmt: skip


def _short(microseconds: float) -> str:
    """Return a time with its unit and at most three digits."""
    return f"{microseconds:.0f} µs" if microseconds < 999.5 else f"{microseconds / 1000.0:.3g} ms"


def _dots(column: str, runs: pd.DataFrame) -> _Dots:
    unit, factor = MEASURES[column].scale(runs)
    name = MEASURES[column].name
    if column == "rms_error_evaluated":
        name = "RMS error of the judged part: end of a move, last lap of a curve"
    if column == "command_switches":
        name, unit = "sign switches of large commands", "count"
    return _Dots(column, f"{name} [{unit}]", factor)


def _unsettled(runs: pd.DataFrame) -> pd.Series[bool]:
    """Return which moves never settled."""
    moves = runs.reindex(columns=["task_kind"])["task_kind"] != "curve"
    return moves & settling_times(runs).isna()


def _draw_dots(axes: Axes, runs: pd.DataFrame, names: list[str], styles: Styles, row: _Dots) -> None:
    """Draw a measure of the runs of one task."""
    values = row.factor * runs[row.column].astype(float)
    never = _unsettled(runs) if row.column == SETTLING else pd.Series(False, runs.index)
    values = values.where(~never)
    if row.column == SETTLING:
        values = values.where(runs.reindex(columns=["task_kind"])["task_kind"] != "curve")
    largest, least = float(values.max()), float(values.min())
    wide = least > 0.0 and largest / least > WIDE_RANGE
    edge = largest * (NEVER if never.any() else 1.06) if largest > 0.0 else 1.0
    if wide:
        edge = largest * (largest / least) ** 0.08
    if values.isna().all() and not never.any():
        axes.tick_params(axis="x", bottom=False, labelbottom=False)
        axes.text(0.5, 0.5, "does not apply", transform=axes.transAxes, ha="center", va="center", color="0.4",
                  fontsize=TEXT - 1.0)  # fmt: skip
    for i, name in enumerate(names):
        own, style = runs["controller"] == name, styles[name]
        for completed in (True, False):
            chosen = own & ((runs["status"] == COMPLETED) == completed)
            points = values.where(~never, edge)[chosen].dropna().to_numpy()
            if len(points) == 0:  # an empty line that is not clipped would count as a mark at the origin
                continue
            face = style.colour if completed else "none"
            axes.plot(points, np.full(len(points), i), color=style.colour, marker=style.marker or "o", linestyle="",
                      markersize=4.5, markerfacecolor=face, markeredgewidth=0.7, alpha=0.55, clip_on=False)  # fmt: skip
        middle = values[own].fillna(math.inf).median() if row.column == SETTLING else values[own].median()
        if own.sum() > 1 and math.isfinite(middle):
            axes.plot(middle, i, color="black", marker="|", markersize=9, markeredgewidth=1.6, linestyle="")
        if never[own].any():
            axes.annotate(f"{never[own].sum()} of {own.sum()}", (edge, i), ha="right", va="center", xytext=(-5, 0),
                          textcoords="offset points", fontsize=TEXT - 2.0)  # fmt: skip
    axes.set_yticks(range(len(names)), names)
    if wide:
        axes.set_xscale("log")
        axes.set_xlim(least / (edge / largest), edge)
        axes.xaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(mpl.ticker.NullFormatter())
    else:
        axes.set_xlim(0.0, edge)
        axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(4))
