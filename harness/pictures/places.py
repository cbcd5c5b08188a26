"""A panel of methods side by side: a mark with its interval for each of them at each place, readable without colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from servobench.harness.analysis.statistics import Estimate
from servobench.harness.pictures.style import MethodStyle

SPREAD = 0.5  # of the distance between two places, over which the methods' marks are spread


def draw_places(
    axes: Any,  # noqa: ANN401 - matplotlib's
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
                x[known],
                y,
                yerr=np.nan_to_num(np.vstack([below, above])).clip(0.0),
                color=style.colour,
                linestyle=style.line if joined else "none",
                marker=style.marker or "_",
                markersize=4.5,
                linewidth=1.2,
                elinewidth=1.0,
                capsize=2.0,
                label=name,
            )
