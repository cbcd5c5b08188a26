"""What a single pair of axes shows: an error, a feature, a path in space; and the legend below all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from servobench.harness.analysis.statistics import Estimate
from servobench.harness.pictures.style import MethodStyle
from servobench.harness.pictures.tracks import Track, Tracks, label_of, longest
from servobench.plant.checks import FloatArray

ENDED, END = "run ended early", "|"  # and its marker, which no method has
CAMERA_TILT = -62.0  # deg; −90 looks along the optical axis, from which depth could not be seen
SPREAD = 0.5  # share of the distance between two places over which the marks of the methods are spread
ROW = 3  # panels
EXACT = 1e-9  # relative error below which an estimate counts as the truth
LEAST_DEPTH = 0.4  # of the widest axis, so that a flat path does not hide the depth axis
DESIRED: dict[str, Any] = {"color": "black", "linewidth": 3.0, "alpha": 0.3, "label": "desired"}
END_MARK: dict[str, Any] = {"marker": END, "markersize": 14, "markeredgewidth": 2.0, "linestyle": "", "zorder": 12,
                            "gid": ENDED}  # fmt: skip

Styles = dict[str, MethodStyle]


def draw_error(axes: Axes, tracks: Tracks, styles: Styles) -> None:
    """Draw the norm of the true error over time, logarithmic, with the band in which a run counts as settled."""
    first = next(iter(tracks.values()))
    _draw_over_time(axes, tracks, styles, Track.error)
    mark_settling_band(axes, first)
    axes.set_ylabel(f"true error [{first.error_unit[0]}]")
    scale_by_size(axes)


def mark_settling_band(axes: Axes, track: Track) -> None:
    """Draw the error within which a run counts as settled, where the table of runs tells it."""
    if np.isfinite(track.settling_band):
        label = f"settling band, {track.settling_band:g} {track.error_unit[0]}"
        axes.axhline(track.settling_band, color="0.4", linewidth=0.9, linestyle=(0, (2, 2)), label=label)


def draw_jacobian(axes: Axes, tracks: Tracks, styles: Styles) -> None:
    """Draw the relative error of the estimated Jacobian over time, logarithmic."""
    exact = [name for name, track in tracks.items() if np.nanmax(track.column("jacobian_error"), initial=0.0) < EXACT]
    others = {name: track for name, track in tracks.items() if name not in exact}
    _draw_over_time(axes, others, styles, lambda track: 100.0 * track.column("jacobian_error"))
    for name in exact:
        axes.plot([], [], label=f"{name} (exact)", **styles[name].line_arguments(1))
    axes.set_ylabel("Jacobian error [%]")
    scale_by_size(axes)


def draw_feature(axes: Axes, tracks: Tracks, styles: Styles, feature: str) -> None:
    """Draw a feature as it was measured, and the desired one."""
    whole = longest(tracks)
    axes.plot(whole.time, whole.column(f"reference_{feature}"), **DESIRED)
    _draw_over_time(axes, tracks, styles, lambda track: track.column(f"feature_{feature}"))
    axes.set_ylabel(f"measured\n{label_of(feature)}")


def draw_path(axes: Axes3D, tracks: Tracks, styles: Styles) -> None:
    """Draw the true paths as the camera sees them, tilted a little: x right, y down, depth away from the reader."""
    whole = longest(tracks)
    if len(whole.features) < 3:
        axes.set_axis_off()
        axes.text2D(0.5, 0.5, "fewer than three features", transform=axes.transAxes, ha="center")
        return
    reference = whole.vectors("reference_")[:, :3]
    if not whole.point_to_point:
        axes.plot(*reference.T, **DESIRED)
    for name, track in tracks.items():
        points = _finite_rows(track.vectors("true_feature_")[:, :3])
        if len(points):
            axes.plot(*points.T, label=name, **styles[name].path_arguments(points))
            if not track.completed:
                axes.plot(*points[-1:].T, color=styles[name].colour, **END_MARK)
    _draw_ends(axes, whole, reference)
    _label_space(axes, whole.features)


def draw_places(
    axes: Axes,
    places: Sequence[float],
    values: Mapping[str, Sequence[Estimate]],
    styles: Mapping[str, MethodStyle],
    *,
    joined: bool,
) -> None:
    """Draw an estimate with its interval for each method at each place.

    Args:
        axes: where.
        places: abscissae, ascending; marks are spread over a part of the first distance.
        values: method -> an estimate a place; an infinite one is left out, an infinite end leaves the picture.
        styles: method -> style.
        joined: connect the marks of a method by a line.
    """
    width = SPREAD * (places[1] - places[0] if len(places) > 1 else 1.0)
    for k, (name, estimates) in enumerate(values.items()):
        style = styles[name]
        shift = width * ((k + 0.5) / len(values) - 0.5)
        x = np.array(places, dtype=float) + shift
        y, low, high = (np.array([getattr(e, part) for e in estimates]) for part in ("value", "low", "high"))
        known = np.isfinite(y)
        if known.any():
            y, top = y[known], float(np.max(y[known]))
            below = y - np.where(np.isfinite(low), low, np.nan)[known]
            above = np.where(np.isinf(high[known]), 10.0 * (1.0 + top), high[known]) - y  # out of the picture
            axes.errorbar(
                x[known], y, yerr=np.nan_to_num(np.vstack([below, above])).clip(0.0), color=style.colour,
                linestyle=style.line if joined else "none", marker=style.marker or "_", markersize=4.5, linewidth=1.2,
                elinewidth=1.0, capsize=2.0, label=name,
            )  # fmt: skip


def panel_grid(count: int, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure of `ROW` panels a row with a common ordinate, and its `count` panels.

    Args:
        count: how many panels, at least one.
        height: of a row, inches.
    """
    columns = min(ROW, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(1.0 + 3.1 * columns if columns > 1 else 6.0, 1.0 + height * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel().tolist()
    for axes in panels[count:]:
        axes.set_visible(False)
    return figure, panels[:count]


def label_rows(panels: list[Axes], text: str) -> None:
    """Label the ordinate of the first panel of each row."""
    for i, axes in enumerate(panels):
        axes.set_ylabel(text if i % ROW == 0 else "")


def add_legend(figure: Figure, panels: Iterable[Axes], columns: int = 5) -> None:
    """Put one legend for all panels below them; a run that ended early gets a line of its own."""
    entries: dict[str, Artist] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if any(line.get_gid() == ENDED for axes in panels for line in axes.get_lines()):
        entries[ENDED] = mpl.lines.Line2D([], [], color="black", marker=END, markersize=12, linestyle="")
    if entries:
        figure.legend(
            list(entries.values()), list(entries), loc="outside lower center", ncols=min(columns, len(entries)),
            frameon=False, fontsize=8,
        )  # fmt: skip


def scale_by_size(axes: Axes) -> None:
    """Make the value axis logarithmic with plain numbers, if there is anything above zero on it."""
    values = [np.asarray(line.get_ydata(), dtype=np.float64) for line in axes.get_lines()]
    if any((part > 0.0).any() for part in values):
        plain_logarithms(axes)
    else:
        axes.text(0.5, 0.5, "no values", transform=axes.transAxes, ha="center", va="center", color="0.4")


def plain_logarithms(axes: Axes) -> None:
    """Make the value axis logarithmic with plain numbers."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(mpl.ticker.NullFormatter())


def _draw_over_time(axes: Axes, tracks: Tracks, styles: Styles, curve: Callable[[Track], FloatArray]) -> None:
    for name, track in tracks.items():
        values = curve(track)
        if not np.isfinite(values).any():
            continue
        axes.plot(track.time, values, label=name, **styles[name].line_arguments(len(values)))
        if not track.completed:
            last = np.flatnonzero(np.isfinite(values))[-1]
            axes.plot(track.time[last], values[last], color=styles[name].colour, **END_MARK)


def _draw_ends(axes: Axes3D, track: Track, reference: FloatArray) -> None:
    start = _finite_rows(track.vectors("true_feature_")[:, :3])[:1]
    axes.plot(*start.T, color="black", marker="s", markersize=7, markerfacecolor="white", markeredgewidth=1.5,
              linestyle="", label="start", zorder=10)  # fmt: skip
    if track.point_to_point:
        axes.plot(*reference[:1].T, color="black", marker="*", markersize=11, markerfacecolor="white", linestyle="",
                  label="target", zorder=11)  # fmt: skip


def _label_space(axes: Axes3D, features: list[str]) -> None:
    labels = [label_of(name) for name in features[:3]]
    axes.set(xlabel=labels[0], ylabel=labels[1], zlabel=labels[2].replace("z [", "depth z ["))
    lower, upper = axes.get_zlim()
    widest = max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()), 1e-6)
    missing = max(0.0, LEAST_DEPTH * widest - (upper - lower))
    axes.set_zlim(lower - missing / 2, upper + missing / 2)
    axes.set_aspect("equal", adjustable="box")
    axes.view_init(elev=CAMERA_TILT, azim=-90.0, roll=0.0)
    axes.tick_params(axis="y", pad=9.0)
    axes.tick_params(axis="z", pad=5.0)
    axes.yaxis.labelpad, axes.zaxis.labelpad = 18.0, 12.0
    for axis, count in ((axes.xaxis, 5), (axes.yaxis, 4), (axes.zaxis, 3)):
        axis.set_major_locator(mpl.ticker.MaxNLocator(count))


def _finite_rows(points: FloatArray) -> FloatArray:
    return np.asarray(points[np.isfinite(points).all(axis=1)])
