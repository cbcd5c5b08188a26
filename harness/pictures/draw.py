"""All figures of a results folder, from its tables alone."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, TypeVar

import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

from servobench.harness.batch import results
from servobench.harness.pictures.batch import ACCURACY, EFFORT, SMOOTHNESS, draw_measures, draw_step_times
from servobench.harness.pictures.ensembles import Ensembles, load_ensembles, shown_until
from servobench.harness.pictures.motion import draw_joint_motion
from servobench.harness.pictures.panels import Styles
from servobench.harness.pictures.paper import draw_features, draw_jacobians, draw_moves, draw_tracking
from servobench.harness.pictures.paths import draw_paths
from servobench.harness.pictures.style import TEXT, WIDTH, divisions, figure_style, method_styles
from servobench.harness.pictures.tracks import Group, load_groups

FOLDER = "figures"
FORMATS = ("png", "pdf")
RESOLUTION = 150  # dpi of PNG
SCREEN = 1000.0 / WIDTH  # dpi at which a figure is shown in a page
DENSITY = 1.5  # pixels of a picture in a page for each that it is shown with
PALETTE = 64  # colours
LETTERS = 15.0  # of a title in an inch
MOVES_A_FIGURE = 4
TASKS_A_FIGURE = 4
BLOCKS_A_FIGURE = 4
HEADINGS = {
    "errors": "Error of moves over time",
    "features": "Measured features of moves",
    "paths": "True paths of moves, to scale",
    "tracking": "Error along the curve, and measured features",
    "tracking_path": "Desired and true path, to scale",
    "jacobian": "Error of the estimated Jacobian",
    "settling": "When each run settled, and with what error it ended",
    "effort": "Control effort and saturation of each run",
    "smoothness": "How smoothly each run drives the joints",
    "step_times": "Time of a controller's step",
    "joint_speeds": "What is commanded of the joints",
}
OVER_SEEDS = ("errors", "jacobian", "tracking")  # kinds that show a median and a band
OF_FIRST_SEED = ("features", "paths", "tracking_path", "joint_speeds")

T = TypeVar("T")


class NamedFigure(NamedTuple):
    """A figure and what it is called."""

    kind: str  # what it shows, one of HEADINGS
    stem: str  # name of its file without ending
    title: str  # the heading and what its runs have in common
    figure: Figure


def draw_figures(folder: Path) -> list[Path]:
    """Draw the runs of each plant and mismatch into the folder's `figures`; return the files, PNG and PDF.

    Raises:
        ConfigurationError: not a results folder.
    """
    return [
        path for named in folder_figures(folder) for path in save_figure(named.figure, folder / FOLDER / named.stem)
    ]


def save_figure(figure: Figure, stem: Path) -> list[Path]:
    """Write a figure as PNG and as PDF beside each other; the same figure gives the same bytes."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    paths = []
    for ending in FORMATS:
        paths.append(stem.with_name(f"{stem.name}.{ending}"))
        with figure_style(TEXT):
            metadata = {"CreationDate": None} if ending == "pdf" else {"Software": None}
            figure.savefig(paths[-1], dpi=RESOLUTION, metadata=metadata)
        figure.set_layout_engine("none")  # freeze the layout: computing it dominates the save
    return paths


def picture_of(figure: Figure) -> tuple[bytes, int]:
    """Return a figure as a small, sharp PNG and the width at which it is to be shown, px."""
    large, small = io.BytesIO(), io.BytesIO()
    with figure_style(TEXT):
        figure.savefig(large, dpi=DENSITY * SCREEN)
    # A line drawing has few colours; a palette makes half the size of it.
    with Image.open(large) as picture:
        picture.convert("RGB").quantize(PALETTE, dither=Image.Dither.NONE).save(small, "PNG", optimize=True)
    return small.getvalue(), round(SCREEN * figure.get_figwidth())


def folder_figures(folder: Path) -> Iterator[NamedFigure]:
    """Yield every figure of a results folder, one in memory at a time.

    Raises:
        ConfigurationError: not a results folder.
    """
    runs = results.load_runs(folder)
    styles = method_styles(runs["controller"].tolist())
    for group in load_groups(folder):
        chosen = runs[(runs["plant"] == group.plant) & (runs["mismatch"] == group.mismatch)]
        yield from _group_figures(group, chosen, load_ensembles(folder, chosen), styles)


def _group_figures(
    group: Group, runs: pd.DataFrame, ensembles: Mapping[str, Ensembles], styles: Styles
) -> Iterator[NamedFigure]:
    with figure_style(TEXT):
        figures = list(_drawings(group, runs, ensembles, styles))
    for kind, what, figure in figures:
        if figure is None:
            continue
        place = f"{group.plant}, mismatch {group.mismatch}"
        details = ", ".join(filter(None, (what, place, _sample(kind, group, runs))))
        title = f"{HEADINGS[kind]}: {details}"
        wrapped = textwrap.fill(details, round(LETTERS * figure.get_figwidth()))
        figure.suptitle(f"{HEADINGS[kind]}\n{wrapped}", fontsize=TEXT + 1.0)
        words = "_".join(part for part in (kind, what, group.plant, group.mismatch) if part)
        yield NamedFigure(kind, re.sub(r"[^A-Za-z0-9.=+_-]", "_", words), title, figure)


def _sample(kind: str, group: Group, runs: pd.DataFrame) -> str:
    """Return words for the seeds that a figure shows, and how."""
    seeds = runs["seed"].nunique()
    if kind in OF_FIRST_SEED or seeds == 1:
        return f"seed {group.seed}"
    if kind not in OVER_SEEDS:
        return f"{seeds} seeds"
    words = f"median of {seeds} seeds, band: the middle 80 %"
    return f"{words}; features of seed {group.seed}" if kind == "tracking" else words


def _drawings(
    group: Group, runs: pd.DataFrame, ensembles: Mapping[str, Ensembles], styles: Styles
) -> Iterator[tuple[str, str, Figure | None]]:
    """Yield kind, what it is of within the group, and the figure."""
    moves, curves = (group.select(point_to_point=fixed) for fixed in (True, False))
    for what, part in _parts(moves, MOVES_A_FIGURE):
        yield "errors", what, draw_moves({task: ensembles[task] for task in part}, styles)
        yield "features", what, draw_features(part, {task: shown_until(ensembles[task]) for task in part}, styles)
    for what, part in _parts(
        moves, BLOCKS_A_FIGURE // len(divisions(name for tracks in moves.values() for name in tracks))
    ):
        yield "paths", what, draw_paths(part, styles)
    for task, tracks in curves.items():
        yield "tracking", task, draw_tracking(ensembles[task], tracks, styles)
        yield "tracking_path", task, draw_paths({task: tracks}, styles)
    yield "jacobian", "", draw_jacobians(ensembles, styles)
    several = len(runs) > 1  # of a single run, its row in the table of runs says it all
    for what, measured in _parts(dict.fromkeys(runs["task"] if several else ()), TASKS_A_FIGURE):
        chosen = runs[runs["task"].isin(list(measured))]
        for kind, columns in (("settling", ACCURACY), ("effort", EFFORT), ("smoothness", SMOOTHNESS)):
            yield kind, what, draw_measures(chosen, columns, styles)
    yield "step_times", "", draw_step_times(ensembles, styles)
    for task, tracks in group.tasks.items():
        yield "joint_speeds", task, draw_joint_motion(tracks, shown_until(ensembles[task]))


def _parts(tasks: Mapping[str, T], size: int) -> Iterator[tuple[str, dict[str, T]]]:
    """Yield tasks in parts for a figure each, and words for the part where there are several."""
    names = list(tasks)
    for first in range(0, len(names), size):
        part = names[first : first + size]
        yield "" if len(names) <= size else "-".join(part), {name: tasks[name] for name in part}
