"""Paths in space to be turned and zoomed in a browser: a plotly figure that works without a network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from servobench.harness.batch import results
from servobench.harness.pictures.style import MethodStyle, method_styles
from servobench.harness.pictures.tracks import Group, Track, Tracks, each, label_of, load_groups

MOST_POINTS = 250  # of a path; more cannot be told apart
MOST_VIEWS = 24  # plant, mismatch and task
HEIGHT = 620  # px
CONFIG = {"displaylogo": False, "responsive": True, "showSendToCloud": False}  # nothing leaves the page
DASHES = {"-": "solid", "--": "dash", "-.": "dashdot", ":": "dot"}
SYMBOLS = {"o": "circle", "s": "square", "D": "diamond", "^": "diamond-open", "x": "x", "P": "cross", "+": "cross",
           "X": "x", "v": "square-open", "*": "circle-open"}  # fmt: skip


def plotly_script() -> str:
    """Return plotly's own code as a script element, to be put into a page once."""
    return f'<script type="text/javascript">{get_plotlyjs()}</script>'


def interactive_paths(folder: Path) -> str:
    """Return the paths of a results folder as HTML that needs `plotly_script`; empty where no run has a path.

    A menu chooses plant, mismatch and task; the legend switches controllers on and off.

    Raises:
        ConfigurationError: not a results folder.
    """
    styles = method_styles(results.load_runs(folder)["controller"].tolist())
    views = [
        (group, task, tracks)
        for group in load_groups(folder)
        for task, tracks in group.tasks.items()
        if all(len(track.features) >= 3 for track in tracks.values())
    ][:MOST_VIEWS]
    if not views:
        return ""
    figure, owners = go.Figure(), []
    for number, (_, _, tracks) in enumerate(views):
        traces = _traces(each(Track.for_path, tracks), styles)
        for trace in traces:
            trace.visible = number == 0
        figure.add_traces(traces)
        owners += [number] * len(traces)
    figure.update_layout(
        height=HEIGHT,
        margin={"l": 0, "r": 0, "t": 50, "b": 0},
        updatemenus=[{"buttons": _buttons(views, owners), "x": 0.0, "y": 1.02, "xanchor": "left", "yanchor": "bottom"}],
        scene=_scene(views[0][2]),
        legend={"itemsizing": "constant", "y": 0.9},
    )
    html: str = figure.to_html(full_html=False, include_plotlyjs=False, div_id="paths", config=CONFIG)
    return html


def _traces(tracks: Tracks, styles: dict[str, MethodStyle]) -> list[go.Scatter3d]:
    longest = max(tracks.values(), key=lambda track: len(track.table))
    reference = longest.vectors("reference_")[:, :3]
    if longest.point_to_point:
        desired = _points(reference[:1], "target", "black", "diamond")
    else:
        desired = _line(reference, "desired", {"color": "rgba(0,0,0,0.35)", "width": 9})
    traces = [desired, _points(longest.vectors("true_feature_")[:1, :3], "start", "black", "square-open")]
    for name, track in tracks.items():
        style = styles[name]
        dash = DASHES.get(style.line, "longdash") if isinstance(style.line, str) else "longdash"
        path = _line(track.vectors("true_feature_")[:, :3], name, {"color": style.colour, "width": 4, "dash": dash})
        if style.marker:
            # Marks that are apart from each other, as many as in the printed figures.
            chosen = np.isin(np.arange(len(path.x)), style.path_arguments(_stack(path))["markevery"])
            path.mode = "lines+markers"
            path.marker = {
                "size": np.where(chosen, 8, 0),
                "symbol": SYMBOLS.get(style.marker, "diamond"),
                "color": style.colour,
                "line": {"width": 0},
            }
        traces.append(path)
    return traces


def _stack(path: go.Scatter3d) -> np.ndarray:
    points = np.stack([path.x, path.y, path.z], axis=-1).astype(np.float64)
    return np.nan_to_num(points)


def _line(points: np.ndarray, name: str, line: dict[str, object]) -> go.Scatter3d:
    step = -(-len(points) // MOST_POINTS)
    x, y, z = points[::step].astype(np.float32).T
    return go.Scatter3d(x=x, y=y, z=z, mode="lines", name=name, line=line)


def _points(points: np.ndarray, name: str, colour: str, symbol: str) -> go.Scatter3d:
    x, y, z = points.astype(np.float32).T
    marker = {"size": 6, "color": colour, "symbol": symbol}
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", name=name, marker=marker)


def _buttons(views: list[tuple[Group, str, Tracks]], owners: list[int]) -> list[dict[str, object]]:
    return [
        {
            "label": f"{task} on {group.plant}, mismatch {group.mismatch}, seed {group.seed}",
            "method": "update",
            "args": [{"visible": [owner == number for owner in owners]}, {"scene": _scene(tracks)}],
        }
        for number, (group, task, tracks) in enumerate(views)
    ]


def _scene(tracks: Tracks) -> dict[str, object]:
    """Return axes with units, seen from where the camera is: x right, y down, depth away."""
    labels = [label_of(name) for name in next(iter(tracks.values())).features]
    return {
        "xaxis": {"title": {"text": labels[0]}},
        "yaxis": {"title": {"text": labels[1]}},
        "zaxis": {"title": {"text": f"depth {labels[2]}"}},
        "aspectmode": "data",
        "camera": {"eye": {"x": 0.0, "y": 0.9, "z": -2.1}, "up": {"x": 0.0, "y": -1.0, "z": 0.0}},
    }
