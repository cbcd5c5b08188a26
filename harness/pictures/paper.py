"""The figures of the paper, drawn anew from logged steps.

| figure | shows | here |
|---|---|---|
| 4 | errors of the point-to-point moves, the measured features below | `draw_moves` |
| 5 | paths of these moves in space, seen from the camera | `draw_move_paths` |
| 6 | a tracked curve: desired and measured features, and the error | `draw_tracking` |
| 7 | the tracked curve in space | `draw_tracking_path` |

Figure 8, the arm at eight places on the circle, is rendered by `servobench.harness.pictures.film`.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from servobench.harness.pictures.panels import (
    Styles,
    add_legend,
    draw_error,
    draw_feature,
    draw_jacobian,
    draw_path,
    label_rows,
    panel_grid,
)
from servobench.harness.pictures.tracks import Track, Tracks, each

ROOM_IN_SPACE = (0.0, 0.0, 0.95, 0.95)  # constrained layout ignores 3-D axis labels


def draw_moves(tasks: dict[str, Tracks], styles: Styles) -> Figure:
    """Draw a column for each task: the error on top, below it each feature as it was measured (figure 4)."""
    features = _features(tasks)
    rows, columns = 1 + len(features), len(tasks)
    figure = Figure(figsize=(1.2 + 2.7 * columns if columns > 1 else 6.0, 2.3 + 1.35 * len(features)),
                    layout="constrained")  # fmt: skip
    panels = figure.subplots(
        rows, columns, sharex="col", sharey="row", squeeze=False, height_ratios=[1.8, *[1.0] * len(features)]
    )
    for column, (task, whole) in zip(panels.T, tasks.items(), strict=True):
        tracks = each(Track.overview, whole)
        draw_error(column[0], tracks, styles)
        for axes, feature in zip(column[1:], features, strict=True):
            draw_feature(axes, tracks, styles, feature)
        column[0].set_title(task)
        column[-1].set_xlabel("time [s]")
    for axes in panels[:, 1:].ravel():
        axes.set_ylabel("")
    figure.align_ylabels(panels[:, 0])
    add_legend(figure, panels.ravel(), 8 if columns > 2 else 4)
    return figure


def draw_move_paths(tasks: dict[str, Tracks], styles: Styles) -> Figure:
    """Draw the path of each task in space as the camera sees it, with start and target (figure 5)."""
    columns = min(2, len(tasks))
    rows = -(-len(tasks) // columns)
    figure = Figure(figsize=(4.6 * columns if columns > 1 else 6.0, 0.6 + 4.0 * rows),
                    layout=ConstrainedLayoutEngine(rect=ROOM_IN_SPACE))  # fmt: skip
    panels = []
    for i, (task, tracks) in enumerate(tasks.items()):
        axes = figure.add_subplot(rows, columns, i + 1, projection="3d")
        draw_path(axes, each(Track.for_path, tracks), styles)
        axes.text2D(0.02, 1.0, task, transform=axes.transAxes, fontweight="bold")
        panels.append(axes)
    add_legend(figure, panels)
    return figure


def draw_tracking(tracks: Tracks, styles: Styles) -> Figure:
    """Draw desired and measured features over time and the error below (figure 6).

    Of a long run, features are drawn at its end only.
    """
    features, long = _features({"": tracks}), any(track.long for track in tracks.values())
    figure = Figure(figsize=(7.5, 2.6 + 1.4 * len(features)), layout="constrained")
    panels = np.atleast_1d(
        figure.subplots(len(features) + 1, 1, sharex=not long, height_ratios=[*[1.0] * len(features), 1.5])
    )
    for axes, feature in zip(panels, features, strict=False):
        draw_feature(axes, each(Track.closing, tracks), styles, feature)
    draw_error(panels[-1], each(Track.overview, tracks), styles)
    if long:
        panels[-2].set_xlabel("time [s], the end of the run")
    panels[-1].set_xlabel("time [s], each point the root mean square of those around it" if long else "time [s]")
    figure.align_ylabels(panels)
    add_legend(figure, panels)
    return figure


def draw_tracking_path(tracks: Tracks, styles: Styles) -> Figure:
    """Draw desired and true path in space (figure 7)."""
    figure = Figure(figsize=(7.0, 5.8), layout=ConstrainedLayoutEngine(rect=ROOM_IN_SPACE))
    axes = figure.add_subplot(projection="3d")
    draw_path(axes, each(Track.for_path, tracks), styles)
    add_legend(figure, [axes])
    return figure


def draw_jacobians(tasks: dict[str, Tracks], styles: Styles) -> Figure | None:
    """Draw how far the estimated Jacobian is from the true one, a panel a task; None if no run knows it."""
    known = {
        task: {name: track for name, track in tracks.items() if np.isfinite(track.column("jacobian_error")).any()}
        for task, tracks in tasks.items()
    }
    known = {task: tracks for task, tracks in known.items() if tracks}
    if not known:
        return None
    figure, panels = panel_grid(len(known), 2.3)
    for axes, (task, tracks) in zip(panels, known.items(), strict=True):
        draw_jacobian(axes, each(Track.overview, tracks), styles)
        axes.set(title=task, xlabel="time [s]")
    label_rows(panels, panels[0].get_ylabel())
    add_legend(figure, panels)
    return figure


def _features(tasks: dict[str, Tracks]) -> list[str]:
    """Return the names of the features in the order of the plant; those of the richest track count."""
    return max((track.features for tracks in tasks.values() for track in tracks.values()), key=len)
