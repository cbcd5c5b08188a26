"""Figures of a comparison: for each plant, mismatch and task the runs of one seed, all controllers together."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from harness import results
from harness.configuration import ConfigurationError
from harness.figures.style import MethodStyle, method_styles
from harness.metrics import SETTLING_BAND

FOLDER = "figures"
MILLI = 1000.0


def draw_figures(folder: Path) -> list[Path]:
    """Draw the figures of a results folder into its folder `figures`.

    Args:
        folder: a results folder; the first seed of each group is drawn.

    Returns:
        The files.

    Raises:
        ConfigurationError: not a results folder.
    """
    runs = results.load_runs(folder)
    (folder / FOLDER).mkdir(exist_ok=True)
    paths = []
    for (plant, mismatch, task), group in runs.groupby(["plant", "mismatch", "task"], sort=False):
        chosen = group[group["seed"] == group["seed"].min()]
        try:
            steps = results.load_steps(folder, chosen["run_id"].tolist())
        except ConfigurationError:  # no run of the group reached its first step
            continue
        tracks = {
            row["controller"]: track
            for row in chosen.to_dict("records")
            if len(track := steps[steps["run_id"] == row["run_id"]].dropna(axis=1, how="all"))
        }
        title = f"{task} on {plant}, mismatch {mismatch}, seed {chosen['seed'].iloc[0]}"
        stem = re.sub(r"[^A-Za-z0-9.=+_-]", "_", f"{plant}_{task}_{mismatch}")
        for kind, draw in (
            ("error", _draw_error),
            ("features", _draw_features),
            ("trajectory", _draw_trajectory),
            ("joint_speeds", _draw_joint_speeds),
        ):
            with mpl.rc_context({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3, "axes.axisbelow": True}):
                figure = draw(tracks, method_styles(list(tracks)))
                figure.suptitle(title, fontsize=10)
                path = folder / FOLDER / f"{kind}_{stem}.png"
                figure.savefig(path, dpi=150)
            paths.append(path)
    return paths


def _draw_error(tracks: dict[str, pd.DataFrame], styles: dict[str, MethodStyle]) -> Figure:
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for name, track in tracks.items():
        axes.semilogy(
            track["time_s"], MILLI * track["error_norm_m"], label=name, **styles[name].line_arguments(len(track))
        )
    axes.axhline(MILLI * SETTLING_BAND, color="0.4", linewidth=0.8, linestyle=(0, (2, 2)))
    axes.annotate("5 mm", (1.0, MILLI * SETTLING_BAND), xycoords=("axes fraction", "data"), fontsize=8, color="0.4",
                  xytext=(3, 0), textcoords="offset points", va="center")  # fmt: skip
    axes.yaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set(xlabel="time [s]", ylabel="true error norm [mm]")
    _add_legend(figure, axes)
    return figure


def _draw_features(tracks: dict[str, pd.DataFrame], styles: dict[str, MethodStyle]) -> Figure:
    columns = [name for name in next(iter(tracks.values())).columns if name.startswith("true_feature_")]
    figure = Figure(figsize=(7.0, 1.3 + 1.6 * len(columns)), layout="constrained")
    panels = np.atleast_1d(figure.subplots(len(columns), 1, sharex=True))
    for axes, column in zip(panels, columns, strict=True):
        feature = column.removeprefix("true_feature_")
        for name, track in tracks.items():
            axes.plot(track["time_s"], track[column], label=name, **styles[name].line_arguments(len(track)))
        longest = max(tracks.values(), key=len)
        axes.plot(
            longest["time_s"],
            longest[f"reference_{feature}"],
            color="black",
            linewidth=2.5,
            alpha=0.3,
            label="reference",
        )
        name, _, unit = feature.rpartition("_")
        axes.set_ylabel(f"{name} [{unit}]")
    panels[-1].set_xlabel("time [s]")
    _add_legend(figure, panels[0])
    return figure


def _draw_trajectory(tracks: dict[str, pd.DataFrame], styles: dict[str, MethodStyle]) -> Figure:
    """Draw the paths in space as the camera sees them: x right, y down, depth away from the reader."""
    figure = Figure(figsize=(7.0, 5.6), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    kinds = [name for name in next(iter(tracks.values())).columns if name.startswith("true_feature_")][:3]
    if len(kinds) < 3:
        axes.text2D(0.5, 0.5, "fewer than three features", transform=axes.transAxes, ha="center")
        return figure
    for name, track in tracks.items():
        points = track[kinds].to_numpy()
        axes.plot(*points.T, label=name, **styles[name].line_arguments(len(track)))
    longest = max(tracks.values(), key=len)
    reference = longest[[kind.replace("true_feature", "reference") for kind in kinds]].to_numpy()
    start = longest[kinds].to_numpy()[0]
    axes.scatter(*start, color="black", marker="s", s=35, label="start", zorder=10)
    if np.ptp(reference, axis=0).max() > 0.0:
        axes.plot(*reference.T, color="black", linewidth=2.5, alpha=0.3, label="reference")
    else:
        axes.scatter(*reference[0], color="black", marker="*", s=90, label="target", zorder=10)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z (depth) [m]")
    axes.zaxis.labelpad = 12.0
    axes.set_title(" ")  # keeps the figure's title off the axis label
    axes.set_aspect("equal", adjustable="datalim")
    axes.view_init(elev=-62.0, azim=-90.0, roll=0.0)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(mpl.ticker.MaxNLocator(4))
    _add_legend(figure, axes)
    return figure


def _draw_joint_speeds(tracks: dict[str, pd.DataFrame], styles: dict[str, MethodStyle]) -> Figure:
    columns = [name for name in next(iter(tracks.values())).columns if name.startswith("joint_velocity_command_")]
    rows = -(-len(columns) // 2)
    figure = Figure(figsize=(8.0, 1.0 + 1.7 * rows), layout="constrained")
    panels = figure.subplots(rows, 2, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, column in zip(panels, columns, strict=False):
        for name, track in tracks.items():
            style = styles[name].line_arguments(len(track)) | {"linewidth": 1.0, "markersize": 3.5}
            axes.plot(track["time_s"], track[column], label=name, **style)
        axes.set_title(column.removeprefix("joint_velocity_command_").removesuffix("_rad_s"), fontsize=9)
    for axes in panels[len(columns) :]:
        axes.set_visible(False)
    for axes in panels[len(columns) - 2 : len(columns)]:
        axes.set_xlabel("time [s]")
    figure.supylabel("commanded joint speed [rad/s]", fontsize=9)
    _add_legend(figure, panels[0])
    return figure


def _add_legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(5, len(labels)), frameon=False, fontsize=8)
