"""Figures of moves and of tracked curves, among them those of the paper drawn anew from logged steps.

| figure | shows | here |
|---|---|---|
| 4 | errors of the point-to-point moves; the measured features | `draw_moves`, `draw_features` |
| 5 | paths of these moves in space | `servobench.harness.pictures.paths` |
| 6 | a tracked curve: error, desired and measured features | `draw_tracking` |
| 7 | the tracked curve in space | `servobench.harness.pictures.paths` |

Figure 8, the arm at eight places on the circle, is rendered by `servobench.harness.pictures.film`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from servobench.harness.pictures.ensembles import WINDOW, Ensembles, shown_until
from servobench.harness.pictures.panels import Styles, add_legend, draw_error, draw_feature, draw_jacobian, error_limits
from servobench.harness.pictures.style import WIDE, Layout, divisions
from servobench.harness.pictures.tracks import Track, Tracks, each, longest

COLUMNS: Final = 2
LINE: Final = 0.17  # [in] of the legend

DrawPanel = Callable[[Axes, Ensembles, Styles], None]


def draw_moves(tasks: Mapping[str, Ensembles], styles: Styles, layout: Layout = WIDE) -> Figure:
    """Draw the error of each task over time: median and band over seeds, and where runs settled (figure 4).

    With aids and as published are beside each other where there are both. The time ends when methods have settled.
    """
    figure, panels = _draw_tasks(tasks, styles, draw_error, layout)
    low, high = error_limits([ensemble for ensembles in tasks.values() for ensemble in ensembles.values()])
    if high > 0.0:
        panels[0][0].set_ylim(low if low > 0.0 else None, high)
    for axes, task in panels:
        until, end = shown_until(tasks[task]), max(float(own.time[-1]) for own in tasks[task].values())
        if until < end:
            axes.set_xlim(-0.02 * until, until)
            axes.set_xlabel(f"time [s]; the move lasts {end:.2g} s")
    return figure


def draw_jacobians(tasks: Mapping[str, Ensembles], styles: Styles, layout: Layout = WIDE) -> Figure | None:
    """Draw how far the estimated Jacobian is from the true one, over seeds; None if no run knows it."""
    known = {
        task: {name: own for name, own in ensembles.items() if np.isfinite(own.jacobian_error).any()}
        for task, ensembles in tasks.items()
    }
    known = {task: ensembles for task, ensembles in known.items() if ensembles}
    return _draw_tasks(known, styles, draw_jacobian, layout)[0] if known else None


def draw_features(
    tasks: Mapping[str, Tracks], until: Mapping[str, float], styles: Styles, layout: Layout = WIDE
) -> Figure:
    """Draw a column for each task with each feature as it was measured in one run of each controller (figure 4).

    Args:
        tasks: task -> controller -> run.
        until: task -> the time at which its column ends [s].
        styles: controller -> style.
        layout: of the figure; a narrow one is for a single task.
    """
    features = _features(tasks)
    figure = Figure(figsize=(layout.width, 1.1 + 1.3 * len(features)), layout="constrained")
    panels = figure.subplots(len(features), len(tasks), sharex="col", sharey="row", squeeze=False)
    for column, (task, whole) in zip(panels.T, tasks.items(), strict=True):
        tracks = each(Track.overview, whole)
        for axes, feature in zip(column, features, strict=True):
            draw_feature(axes, tracks, styles, feature)
        column[0].set_title(task)
        column[-1].set_xlabel("time [s]")
        if until[task] < longest(tracks).time[-1]:
            column[-1].set_xlim(-0.02 * until[task], until[task])
    for axes in panels[:, 1:].ravel():
        axes.set_ylabel("")
    figure.align_ylabels(panels[:, 0])
    add_legend(figure, panels.ravel())
    return figure


def draw_tracking(ensembles: Ensembles, tracks: Tracks, styles: Styles, layout: Layout = WIDE) -> Figure:
    """Draw the error along a curve over seeds, and below it the measured features of one run (figure 6).

    Of a long run, features are drawn at its end only. On a narrow sheet there are errors only.
    """
    if layout.columns < COLUMNS:
        figure, drawn = _draw_tasks({"": ensembles}, styles, draw_error, layout)
        for axes, _ in drawn:
            axes.set_ylabel(f"{axes.get_ylabel()},\nRMS over {WINDOW:g} s")
        return figure
    features, long = _features({"": tracks}), any(track.long for track in tracks.values())
    heads = divisions(ensembles)
    figure = Figure(figsize=(layout.width, 3.1 + 1.15 * len(features)), layout="constrained")
    panels = figure.subplots(
        1 + len(features), len(heads), sharex=False if long else "col", sharey="row", squeeze=False,
        height_ratios=[2.2, *[1.0] * len(features)],
    )  # fmt: skip
    closing = each(Track.closing, tracks)
    for column, (head, names) in zip(panels.T, heads.items(), strict=True):
        draw_error(column[0], {name: ensembles[name] for name in names}, styles)
        column[0].set_title(head)
        column[0].set_ylabel(f"{column[0].get_ylabel()},\nRMS over {WINDOW:g} s")
        shown = {name: closing[name] for name in names if name in closing}
        for axes, feature in zip(column[1:], features, strict=True):
            if shown:
                draw_feature(axes, shown, styles, feature)
        column[-1].set_xlabel("time [s], the end of the run" if long else "time [s]")
        if long:
            column[0].set_xlabel("time [s]")
    for axes in panels[:, 1:].ravel():
        axes.set_ylabel("")
    figure.align_ylabels(panels[:, 0])
    add_legend(figure, panels.ravel())
    return figure


def _draw_tasks(
    tasks: Mapping[str, Ensembles], styles: Styles, draw: DrawPanel, layout: Layout
) -> tuple[Figure, list[tuple[Axes, str]]]:
    """Draw a panel for each task and division of methods; return the figure, and the panels with their tasks."""
    cells = [
        (task, head, {name: ensembles[name] for name in names})
        for task, ensembles in tasks.items()
        for head, names in divisions(ensembles).items()
    ]
    columns = min(COLUMNS, layout.columns, len(cells))
    rows = -(-len(cells) // columns)
    names = {name for ensembles in tasks.values() for name in ensembles}
    panel = 2.8 if columns == 1 and layout is WIDE else 2.0
    height = 0.6 + panel * rows + LINE * (2 + len(names) * (0.25 if layout is WIDE else 1.0))
    figure = Figure(figsize=(layout.width, height), layout="constrained")
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    panels = []
    for axes, (task, head, ensembles) in zip(grid.flat, cells, strict=False):
        draw(axes, ensembles, styles)
        axes.set(title=", ".join(filter(None, (task, head))), xlabel="time [s]")
        panels.append((axes, task))
    for axes in grid[:, 1:].flat:
        axes.set_ylabel("")
    for axes in grid.flat[len(cells) :]:
        axes.set_visible(False)
    add_legend(figure, [axes for axes, _ in panels])
    return figure, panels


def _features(tasks: Mapping[str, Tracks]) -> list[str]:
    """Return the names of the features in the order of the plant; those of the richest track count."""
    return max((track.features for tracks in tasks.values() for track in tracks.values()), key=len)
