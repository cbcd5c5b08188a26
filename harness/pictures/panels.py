"""What a single pair of axes shows over time, of one run or of all seeds; and the legend below all axes."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from servobench.harness.pictures.ensembles import BAND, Ensemble, quantile
from servobench.harness.pictures.style import TEXT, WIDE, Layout, MethodStyle, fitted
from servobench.harness.pictures.tracks import Track, Tracks, label_of, longest
from servobench.plant.contract.checks import FloatArray

ENDED, END = "run ended early", "|"  # and its marker, which no method has
SETTLED, CAMERA_MOVES = "settled from here on", "camera moves"
NOT_METHODS: Final = ("desired", "settling band", "start", "target", SETTLED, CAMERA_MOVES, ENDED)  # in a legend
EXACT: Final = 1e-7  # [%] of an estimate that counts as the truth
FLOOR: Final = 0.1  # settling bands: the least error that is told apart over time
FEW_DECADES: Final = 50.0  # upper over lower end of a logarithmic axis
OUTSIDE: Final = 1e12  # of every picture
MAX_ERROR: Final = 1e6  # [error unit] up to which an axis reaches
LETTER, SAMPLE = 0.066, 0.55  # [in] width of a letter of the legend and of the line beside it
MARGIN: Final = 0.2  # [in] beside the legend
DESIRED: dict[str, Any] = {"color": "black", "linewidth": 3.0, "alpha": 0.3, "label": "desired"}
END_MARK: dict[str, Any] = {"marker": END, "markersize": 12, "markeredgewidth": 2.0, "linestyle": "", "zorder": 12,
                            "gid": ENDED}  # fmt: skip

Styles = dict[str, MethodStyle]


def draw_error(axes: Axes, ensembles: Mapping[str, Ensemble], styles: Styles) -> None:
    """Draw the true error over time: its median and band over seeds, logarithmic, and where runs settled."""
    first = next(iter(ensembles.values()))
    draw_over_seeds(axes, ensembles, styles, lambda ensemble: ensemble.shown_error)
    low, high = error_limits(ensembles.values())
    if high > 0.0:
        plain_logarithms(axes)
        axes.set_ylim(low if low > 0.0 else None, high)
    mark_settling_band(axes, first)
    if first.point_to_point:
        _mark_settling_times(axes, ensembles, styles)
    if math.isfinite(first.camera_moved_at):
        axes.axvline(first.camera_moved_at, color="0.4", linewidth=0.9, linestyle="-.", label=CAMERA_MOVES)
    axes.set_ylabel(f"true error [{first.error_unit[0]}]")


def error_limits(ensembles: Collection[Ensemble]) -> tuple[float, float]:
    """Return between which errors these runs are shown [error unit]; 0 where that is not known.

    Errors of a small part of the settling band are left out: there is noise, and a median tells it better.
    """
    largest = [float(ensemble.error[np.isfinite(ensemble.error)].max(initial=0.0)) for ensemble in ensembles]
    band = next(iter(ensembles)).settling_band
    return FLOOR * band if math.isfinite(band) else 0.0, min(1.6 * max(largest), MAX_ERROR)


def draw_jacobian(axes: Axes, ensembles: Mapping[str, Ensemble], styles: Styles) -> None:
    """Draw the relative error of the estimated Jacobian over time, its median and band over seeds, logarithmic."""
    exact = [name for name, ensemble in ensembles.items() if np.nanmax(ensemble.jacobian_error, initial=0.0) < EXACT]
    others = {name: ensemble for name, ensemble in ensembles.items() if name not in exact}
    draw_over_seeds(axes, others, styles, lambda ensemble: ensemble.jacobian_error)
    for name in exact:
        axes.plot([], [], label=f"{name} (exact)", **styles[name].line_arguments(1))
    axes.set_ylabel("Jacobian error [%]")
    if any((np.asarray(line.get_ydata(), dtype=np.float64) > 0.0).any() for line in axes.get_lines()):
        plain_logarithms(axes)
    else:
        axes.text(0.5, 0.5, "no values", transform=axes.transAxes, ha="center", va="center", color="0.4")


def draw_over_seeds(
    axes: Axes, ensembles: Mapping[str, Ensemble], styles: Styles, curve: Callable[[Ensemble], FloatArray]
) -> None:
    """Draw the median of a curve over seeds, and between which values most seeds are.

    Args:
        axes: where.
        ensembles: controller -> its runs.
        styles: controller -> style.
        curve: of an ensemble, (r, k).
    """
    for name, ensemble in ensembles.items():
        values, style = curve(ensemble), styles[name]
        low, middle, high = (quantile(values, share) for share in BAND)
        known = np.isfinite(middle)
        if not known.any():
            continue
        if len(values) > 1:
            axes.fill_between(ensemble.time, np.minimum(low, OUTSIDE), np.minimum(high, OUTSIDE), color=style.colour,
                              alpha=min(0.18, 0.5 / len(ensembles)), linewidth=0.0)  # fmt: skip
        shown = np.where(known, middle, np.nan)
        axes.plot(ensemble.time, shown, label=name, **style.line_arguments(len(shown)))
        if ensemble.mostly_ended:
            last = np.flatnonzero(known)[-1]
            axes.plot(ensemble.time[last], middle[last], color=style.colour, **END_MARK)


def draw_feature(axes: Axes, tracks: Tracks, styles: Styles, feature: str) -> None:
    """Draw a feature of one run of each controller as it was measured, and the desired one."""
    whole = longest(tracks)
    axes.plot(whole.time, whole.column(f"reference_{feature}"), **DESIRED)
    for name, track in tracks.items():
        values = track.column(f"feature_{feature}")
        if not np.isfinite(values).any():
            continue
        axes.plot(track.time, values, label=name, **styles[name].line_arguments(len(values)))
        if not track.completed:
            last = np.flatnonzero(np.isfinite(values))[-1]
            axes.plot(track.time[last], values[last], color=styles[name].colour, **END_MARK)
    axes.set_ylabel(f"measured\n{label_of(feature)}")


def panel_grid(count: int, height: float, layout: Layout = WIDE) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels with a common ordinate, and its `count` panels.

    Args:
        count: how many panels, at least one.
        height: of a row, inches.
        layout: of the figure.
    """
    columns = min(layout.columns, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(layout.width, 1.0 + height * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel().tolist()
    for axes in panels[count:]:
        axes.set_visible(False)
    return figure, panels[:count]


def label_rows(panels: list[Axes], text: str) -> None:
    """Label the ordinate of the first panel of each row."""
    for axes in panels:
        place = axes.get_subplotspec()
        axes.set_ylabel(text if place is None or place.is_first_col() else "")


def add_legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """Put one legend for all panels below them, methods first; marks of settling and of an early end get a line."""
    panels = list(panels)
    entries: dict[str, Artist] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    for gid, marker in ((SETTLED, "v"), (ENDED, END)):
        if any(line.get_gid() == gid for axes in panels for line in axes.get_lines()):
            entries[gid] = mpl.lines.Line2D([], [], color="0.3", marker=marker, markersize=7, linestyle="")
    entries = dict(sorted(entries.items(), key=lambda entry: entry[0].startswith(NOT_METHODS)))
    if entries:
        letters = math.floor((figure.get_figwidth() - SAMPLE - MARGIN) / LETTER)
        labels = [fitted(label, letters) for label in entries]
        longest_line = max(len(line) for label in labels for line in label.splitlines())
        fitting = math.floor(figure.get_figwidth() / (SAMPLE + LETTER * longest_line))
        figure.legend(
            list(entries.values()), labels, loc="outside lower center", frameon=False, fontsize=TEXT - 0.5,
            ncols=max(1, min(fitting, len(entries))), handlelength=2.6, columnspacing=1.2,
        )  # fmt: skip


def plain_logarithms(axes: Axes) -> None:
    """Make the value axis logarithmic with plain numbers; where it spans few decades, 2 and 5 have numbers as well."""

    def between(value: float, _position: int | None) -> str:
        low, high = axes.get_ylim()
        return f"{value:g}" if high < FEW_DECADES * low and f"{value:e}"[0] in "25" else ""

    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(mpl.ticker.FuncFormatter(between))


def mark_settling_band(axes: Axes, runs: Track | Ensemble) -> None:
    """Draw the error within which a run counts as settled, where the table of runs tells it."""
    if math.isfinite(runs.settling_band):
        label = f"settling band, {runs.settling_band:g} {runs.error_unit[0]}"
        axes.axhline(runs.settling_band, color="0.4", linewidth=0.9, linestyle=(0, (2, 2)), label=label)


def _mark_settling_times(axes: Axes, ensembles: Mapping[str, Ensemble], styles: Styles) -> None:
    """Mark on the settling band the median settling time of each controller."""
    for name, ensemble in ensembles.items():
        if math.isfinite(ensemble.settling_time) and math.isfinite(ensemble.settling_band):
            style = styles[name]
            edge = style.colour if style.hollow else "black"
            axes.plot(ensemble.settling_time, ensemble.settling_band, marker="v", markersize=6.5, linestyle="",
                      color=style.colour, markeredgecolor=edge, markeredgewidth=1.4 if style.hollow else 0.6,
                      markerfacecolor=style.face, zorder=11, gid=SETTLED)  # fmt: skip
