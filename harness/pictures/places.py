"""Estimates with intervals: at named places beside each other, or as curves over a quantity that varies."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes

from servobench.harness.analysis.statistics import Estimate
from servobench.harness.pictures.style import TEXT, MethodStyle
from servobench.plant.contract.checks import FloatArray

SPREAD = 0.5  # share of the distance between two places over which the marks of the methods are spread
UPPER: Final = 0.97  # of a panel's height, where the mark of an infinite value stands
LETTERS: Final = 30  # of a line of text within a panel

Curves = Mapping[str, Sequence[Estimate]]  # method -> an estimate a place


def draw_places(
    axes: Axes,
    places: Sequence[float],
    values: Mapping[str, Sequence[Estimate]],
    styles: Mapping[str, MethodStyle],
) -> None:
    """Draw an estimate with its interval for each method at each place; the methods stand beside each other.

    Args:
        axes: where.
        places: abscissae, ascending; marks are spread over a part of the first distance.
        values: method -> an estimate a place; an infinite one is left out, an infinite end leaves the picture.
        styles: method -> style.
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
                linestyle="none", marker=style.marker or "_", markersize=4.5, linewidth=1.2,
                elinewidth=1.0, capsize=2.0, label=name,
            )  # fmt: skip


def draw_curves(
    axes: Axes, places: Sequence[float], values: Curves, styles: Mapping[str, MethodStyle], top: float
) -> None:
    """Draw an estimate over a quantity, a line a method with its interval as a band; abscissae are to scale.

    Methods with the same curve share one line, and the panel names them.

    Args:
        axes: where.
        places: abscissae, ascending.
        values: method -> an estimate a place; an infinite one is a mark at the upper edge.
        styles: method -> style.
        top: upper edge of the panel.
    """
    x, shared = np.array(places, dtype=float), []
    groups = same_curves(values)
    for names in groups:
        first, style = names[0], styles[names[0]]
        y, low, high = (np.array([getattr(e, part) for e in values[first]]) for part in ("value", "low", "high"))
        known = ~np.isnan(y)
        if not known.any():
            continue
        edges = np.nan_to_num(np.vstack([np.where(np.isnan(low), y, low), high])[:, known], posinf=1.05 * top)
        axes.fill_between(x[known], *edges, color=style.colour, alpha=0.12, linewidth=0.0)
        _draw_line(axes, x[known], y[known], style, first, top)
        for name in names[1:]:
            axes.plot([], [], label=name, **styles[name].line_arguments(1))
        if len(names) > 1:
            shared.append(("all methods" if len(groups) == 1 else ", ".join(names), y))
    for names_text, y in shared:
        constant = f", {y[0]:g} throughout" if (y == y[0]).all() else ""
        words = textwrap.fill(f"one line{constant}: {names_text}", LETTERS)
        upper = float(np.nanmean(np.minimum(y, top))) < top / 2.0
        level, side = (0.96, "top") if upper else (0.04, "bottom")
        axes.text(0.03, level, words, transform=axes.transAxes, va=side, fontsize=TEXT - 2.0,
                  bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.0})  # fmt: skip
    axes.set_ylim(-0.02 * top, top)


def same_curves(values: Curves) -> list[list[str]]:
    """Return the methods, those with the same values and intervals everywhere together."""
    groups: dict[str, list[str]] = {}
    for name, estimates in values.items():
        groups.setdefault(repr([(e.value, e.low, e.high) for e in estimates]), []).append(name)
    return list(groups.values())


def _draw_line(axes: Axes, x: FloatArray, y: FloatArray, style: MethodStyle, name: str, top: float) -> None:
    look: dict[str, Any] = {"color": style.colour, "markerfacecolor": style.face, "markersize": 4.5, "linewidth": 1.2}
    beyond = ~np.isfinite(y)
    shown = np.where(beyond, UPPER * top, y)
    axes.plot(x, shown, label=name, linestyle=style.line, marker=style.marker, markevery=~beyond, **look)
    if beyond.any():
        axes.plot(x[beyond], np.full(np.count_nonzero(beyond), UPPER * top), linestyle="none", marker=6,
                  **(look | {"markersize": 6.5}))  # fmt: skip
