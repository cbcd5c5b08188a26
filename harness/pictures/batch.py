"""Figures over all runs of a folder or over a group of them: effort and saturation, joint speeds, time a step takes."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from servobench.harness.pictures.panels import Styles, add_legend
from servobench.harness.pictures.tracks import Track, Tracks, each
from servobench.harness.run.ending import COMPLETED

EFFORT = (("control_effort_rad", 1.0, "control effort [rad]"), ("saturation_fraction", 100.0, "saturated periods [%]"))
COMMAND = "joint_velocity_command_"
PERCENTILES = (1.0, 25.0, 50.0, 75.0, 99.0)


def draw_effort(runs: pd.DataFrame, styles: Styles) -> Figure | None:
    """Draw control effort and saturation of each run, a column a task, a line a controller; None without values."""
    rows = [row for row in EFFORT if row[0] in runs and runs[row[0]].notna().any()]
    if not rows:
        return None
    tasks = runs["task"].unique().tolist()
    names = runs["controller"].unique().tolist()
    figure = Figure(
        figsize=(max(6.0, 2.2 + 1.9 * len(tasks)), 1.2 + len(rows) * (0.6 + 0.2 * len(names))), layout="constrained"
    )
    panels = figure.subplots(len(rows), len(tasks), sharey=True, squeeze=False)
    for line, (column, factor, label) in zip(panels, rows, strict=True):
        for axes, task in zip(line, tasks, strict=True):
            _draw_values(axes, runs[runs["task"] == task], names, styles, column, factor)
            axes.set_xlabel(label)
    for axes, task in zip(panels[0], tasks, strict=True):
        axes.set_title(task)
    panels[0, 0].invert_yaxis()
    if (runs["status"] != COMPLETED).any():
        figure.supxlabel("hollow: the run ended early", fontsize=8)
    return figure


def draw_step_times(tasks: dict[str, Tracks], styles: Styles) -> Figure | None:
    """Draw how long a controller's step takes: 1 to 99 % as a line, the middle half as a bar; None without values."""
    times: dict[str, list[np.ndarray]] = {}
    period = 0.0
    for tracks in tasks.values():
        for name, track in tracks.items():
            times.setdefault(name, []).append(track.column("controller_time_us"))
            period = max(period, float(np.median(np.diff(track.time))) if len(track.time) > 1 else 0.0)
    known = {name: np.concatenate(parts) for name, parts in times.items()}
    known = {name: values[values > 0.0] for name, values in known.items() if (values > 0.0).any()}
    if not known:
        return None
    figure = Figure(figsize=(7.5, 1.3 + 0.32 * len(known)), layout="constrained")
    axes = figure.add_subplot()
    for i, (name, values) in enumerate(known.items()):
        low, first, middle, third, high = np.percentile(values, PERCENTILES)
        style = styles[name]
        axes.plot([low, high], [i, i], color=style.colour, linewidth=1.2, marker="|", markersize=8)
        axes.plot([first, third], [i, i], color=style.colour, linewidth=7.0, solid_capstyle="butt", alpha=0.45)
        axes.plot(middle, i, color=style.colour, marker=style.marker or "o", markersize=6.5, markeredgecolor="black")
        axes.annotate(f"{middle:.0f}, {high:.0f}", (1.01, i), xycoords=("axes fraction", "data"), va="center",
                      fontsize=8)  # fmt: skip
    if period > 0.0:
        axes.axvline(1e6 * period, color="0.4", linestyle=(0, (2, 2)), linewidth=0.9)
        axes.annotate("control period", (1e6 * period, 1.0), xycoords=("data", "axes fraction"), ha="right",
                      va="bottom", fontsize=8, color="0.4", xytext=(0, 2), textcoords="offset points")  # fmt: skip
    axes.set(xscale="log", yticks=range(len(known)), yticklabels=list(known), xlabel="time of a controller's step [µs]")
    axes.set_ylim(len(known) - 0.4, -0.6)
    axes.xaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axes.annotate("median, 99 %", (1.01, 1.0), xycoords="axes fraction", va="bottom", fontsize=8, xytext=(0, 2),
                  textcoords="offset points")  # fmt: skip
    return figure


def draw_joint_speeds(tracks: Tracks, styles: Styles) -> Figure | None:
    """Draw the commanded speed of each joint over time, of a long run at its end; None without values."""
    tracks = each(Track.closing, tracks)
    known = [[name for name in track.table.columns if name.startswith(COMMAND)] for track in tracks.values()]
    columns = max(known, key=len)
    if not columns:
        return None
    rows = -(-len(columns) // 2)
    figure = Figure(figsize=(8.0, 1.0 + 1.7 * rows), layout="constrained")
    panels = figure.subplots(rows, 2, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, column in zip(panels, columns, strict=False):
        for name, track in tracks.items():
            style = styles[name].line_arguments(len(track.table)) | {"linewidth": 1.0, "markersize": 3.5}
            axes.plot(track.time, track.column(column), label=name, **style)
        axes.set_title(column.removeprefix(COMMAND).removesuffix("_rad_s"))
    for axes in panels[len(columns) :]:
        axes.set_visible(False)
    for axes in panels[max(0, len(columns) - 2) : len(columns)]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("time [s]")
    figure.supylabel("commanded joint speed [rad/s]", fontsize=9)
    add_legend(figure, panels[: len(columns)])
    return figure


def _draw_values(axes: Axes, runs: pd.DataFrame, names: list[str], styles: Styles, column: str, factor: float) -> None:
    for i, name in enumerate(names):
        chosen = runs[runs["controller"] == name]
        style = styles[name]
        for completed, group in chosen.groupby(chosen["status"] == COMPLETED):
            values = factor * group[column].to_numpy(dtype=np.float64)
            face = style.colour if completed else "none"
            axes.plot(values, np.full(len(values), i), color=style.colour, marker=style.marker or "o", linestyle="",
                      markersize=5.5, markerfacecolor=face, alpha=0.8)  # fmt: skip
    axes.set_yticks(range(len(names)), names)
    largest = float((factor * runs[column]).max())
    axes.set_xlim(0.0, 1.08 * largest if largest > 0.0 else 1.0)
