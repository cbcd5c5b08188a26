"""Paths of the feature in space, in two views to scale: along the optical axis of the camera, and from the side."""

from __future__ import annotations

import math
import textwrap
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from servobench.harness.apps.figures.style import (
    DESIRED,
    LETTER,
    MARKS_OF,
    WIDE,
    Layout,
    Styles,
    add_legend,
    divisions,
    mark_end,
    way_along,
)
from servobench.harness.apps.figures.tracks import Track, Tracks, TracksByTask, label_of, longest
from servobench.plant.contract.checks import FloatArray

COLUMNS = 2
SINGLE = 3.6  # [in] width of the only view of a wide figure
BESIDE = 0.8  # [in] for the numbers beside a view
LINE = 0.17  # [in] height of a line of the legend
# [1] Least and largest height of a view over its width.
SLIMMEST = 0.3
TALLEST = 1.0
ROOM = 1.16  # [1] size of a view over that of the paths in it
ARROW = 0.06  # [1] share of a curve after which an arrow shows its direction
# Labels of a feature in the frame of the camera.
CAMERA_FRAME = {
    "x_m": "x, to the right [m]",
    "y_m": "y, downwards [m]",
    "z_m": "z, depth downwards [m]",
}
PIXELS = "px"  # unit of a feature in an image, where the second one of a pair points down


class View(NamedTuple):
    """Which features a view shows."""

    title: str
    across: int
    upright: int


def draw_paths(tasks: TracksByTask, styles: Styles, layout: Layout = WIDE) -> Figure | None:
    """Draw the true paths of one run of each controller in two views, to scale; None with fewer than two features.

    Start, target and desired path are in black, an arrow shows in which direction a curve is followed.
    """
    views = _views(next(iter(tasks.values())))
    if not views:
        return None
    blocks = _blocks(tasks, views)
    columns = min(COLUMNS, layout.columns, len(blocks))
    rows = math.ceil(len(blocks) / columns)
    lines = [blocks[first : first + columns] for first in range(0, len(blocks), columns)]
    ratios = [max(extent.ratio(view) for _, _, extent in line) for line in lines for view in views]
    room = layout.width / columns - BESIDE  # [in] width of a view
    width = SINGLE if layout.wide and columns == 1 else room
    methods = sum(len(tracks) for _, tracks, _ in blocks)
    lines_below = LINE * methods * (0.1 if layout.wide else 1.0)
    height = 1.1 + width * sum(ratios) + rows * (0.55 + 0.3 * len(views)) + lines_below
    figure = Figure(figsize=(layout.width, height), layout="compressed")
    grid = figure.subplots(rows * len(views), columns, squeeze=False, height_ratios=ratios)
    for number, (heading, tracks, extent) in enumerate(blocks):
        row, column = divmod(number, columns)
        for i, view in enumerate(views, row * len(views)):
            axes = grid[i, column]
            _draw_view(axes, tracks, styles, view)
            extent.apply(axes, view, ratios[i])
            title = f"{heading}: {view.title}" if len(views) > 1 else heading
            axes.set_title(textwrap.fill(title, round(room / LETTER)))
            below = views[views.index(view) + 1 :]
            if below and below[0].across == view.across:  # one abscissa for both
                axes.set_xlabel("")
                axes.tick_params(labelbottom=False)
    for axes in grid.flat:
        axes.set_visible(axes.has_data())
    add_legend(figure, grid.flat)
    return figure


def _blocks(tasks: TracksByTask, views: list[View]) -> list[tuple[str, Tracks, _Extent]]:
    """Return title, tracks and extent of each task and division of methods; a task has the same extent in all."""
    blocks = []
    for task, whole in tasks.items():
        tracks = {name: track.for_path() for name, track in whole.items()}
        extent = _Extent(tracks, views)
        for head, names in divisions(tracks).items():
            title = ", ".join(filter(None, (task, head)))
            blocks.append((title, {name: tracks[name] for name in names}, extent))
    return blocks


def _views(tracks: Tracks) -> list[View]:
    features = longest(tracks).features
    if features[:3] == list(CAMERA_FRAME):
        return [View("camera's view", 0, 1), View("from the side", 0, 2)]
    names = [name.rpartition("_")[0] for name in features]
    image_points = features[0].endswith(f"_{PIXELS}") and len(names) % 2 == 0
    if image_points:
        pairs = [(i, i + 1) for i in range(0, min(4, len(names)), 2)]
    else:
        pairs = [(0, i) for i in range(1, min(3, len(names)))]
    return [
        View(f"{names[upright]} over {names[across]}", across, upright) for across, upright in pairs
    ]


class _Extent:
    """The range of the paths of a block along each of its features."""

    def __init__(self, tracks: Tracks, views: list[View]) -> None:
        whole = longest(tracks)
        paths = [_points(track, "true_feature_") for track in tracks.values()]
        paths.append(_points(whole, "reference_"))
        points = np.concatenate(paths)
        self._units = [name.rpartition("_")[2] for name in whole.features]
        self._middle = (points.max(axis=0) + points.min(axis=0)) / 2
        self._size = np.maximum(ROOM * np.ptp(points, axis=0), 1e-6)
        wide = [float(self._size[view.across]) for view in views]
        tall = [float(self._size[view.upright]) / TALLEST for view in views if self._to_scale(view)]
        self._across = max([*wide, *tall])

    def _to_scale(self, view: View) -> bool:
        return self._units[view.across] == self._units[view.upright]

    def ratio(self, view: View) -> float:
        """Return height over width that a view needs."""
        if not self._to_scale(view):
            return 0.6
        return float(np.clip(self._size[view.upright] / self._across, SLIMMEST, TALLEST))

    def apply(self, axes: Axes, view: View, ratio: float) -> None:
        """Set the limits of a view whose height over width is given; lengths have the same scale both ways."""
        half_width = self._across / 2
        half_height = self._size[view.upright] / 2
        if self._to_scale(view):
            half_height = ratio * half_width
            axes.set_aspect("equal", adjustable="box")
        x = self._middle[view.across]
        y = self._middle[view.upright]
        axes.set(
            xlim=(x - half_width, x + half_width),
            ylim=(y - half_height, y + half_height),
        )
        if axes.get_ylabel() in CAMERA_FRAME.values() or self._units[0] == PIXELS:
            axes.invert_yaxis()
        axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
        axes.yaxis.set_major_locator(mpl.ticker.MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))


def _draw_view(axes: Axes, tracks: Tracks, styles: Styles, view: View) -> None:
    whole = longest(tracks)
    chosen = [view.across, view.upright]
    reference = _points(whole, "reference_")[:, chosen]
    if not whole.point_to_point:
        axes.plot(*reference.T, **DESIRED)
        _draw_direction(axes, reference)
    for name, track in tracks.items():
        points = _points(track, "true_feature_")[:, chosen]
        if len(points):
            axes.plot(*points.T, label=name, **styles[name].path_arguments(points))
            if not track.completed:
                mark_end(axes, points[:, 0], points[:, 1], styles[name])
    start = _points(whole, "true_feature_")[:1, chosen]
    axes.plot(*start.T, **MARKS_OF["start"])
    if whole.point_to_point:
        axes.plot(*reference[:1].T, **MARKS_OF["target"])
    labels = [CAMERA_FRAME.get(whole.features[i], label_of(whole.features[i])) for i in chosen]
    axes.set(xlabel=labels[0], ylabel=labels[1])


def _draw_direction(axes: Axes, reference: FloatArray) -> None:
    """Draw an arrow along a desired curve near its start."""
    way = way_along(reference)
    tail, head = np.searchsorted(way, [ARROW * way[-1], 1.4 * ARROW * way[-1]])
    if tail < head < len(reference):
        look = MARKS_OF["direction"]
        axes.annotate("", reference[head], reference[tail], arrowprops=look, zorder=9)


def _points(track: Track, kind: str) -> FloatArray:
    """Return those rows of the features that are known throughout, (k, m)."""
    points = track.vectors(kind)
    return points[np.isfinite(points).all(axis=1)]
