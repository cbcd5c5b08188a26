"""All figures of a results folder, from its tables alone."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

from servobench.harness.batch import results
from servobench.harness.pictures.batch import draw_effort, draw_joint_speeds, draw_step_times
from servobench.harness.pictures.panels import Styles
from servobench.harness.pictures.paper import (
    draw_jacobians,
    draw_move_paths,
    draw_moves,
    draw_tracking,
    draw_tracking_path,
)
from servobench.harness.pictures.style import figure_style, method_styles
from servobench.harness.pictures.tracks import Group, load_groups

FOLDER = "figures"
FORMATS = ("png", "pdf")
RESOLUTION = 150  # dpi of PNG
SCREEN = 80  # dpi at which a figure is shown in a page
PALETTE = 64  # colours
LETTERS = 12  # of a title in an inch
MOVES_A_FIGURE = 4
HEADINGS = {
    "errors": "Errors and measured features",
    "paths": "True paths as the camera sees them",
    "tracking": "Desired and measured features, and error",
    "tracking_path": "Desired and true path as the camera sees them",
    "jacobian": "Relative error of the estimated Jacobian",
    "effort": "Control effort and saturation of every run",
    "step_times": "Time of a controller's step",
    "joint_speeds": "Commanded joint speeds",
}


class NamedFigure(NamedTuple):
    """A figure and what it is called."""

    kind: str  # what it shows, one of HEADINGS
    stem: str  # name of its file without ending
    title: str  # the heading and what its runs have in common
    figure: Figure


def draw_figures(folder: Path) -> list[Path]:
    """Draw the first seed of each plant and mismatch into the folder's `figures`; return the files, PNG and PDF.

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
        with figure_style():
            metadata = {"CreationDate": None} if ending == "pdf" else {"Software": None}
            figure.savefig(paths[-1], dpi=RESOLUTION, metadata=metadata)
        figure.set_layout_engine("none")  # freeze the layout: computing it dominates the save
    return paths


def picture_of(figure: Figure) -> tuple[bytes, int]:
    """Return a figure as a small PNG of twice the pixels that it is to be shown with, and its width in those, px."""
    large, small = io.BytesIO(), io.BytesIO()
    with figure_style():
        figure.savefig(large, dpi=2 * SCREEN)
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
        yield from _group_figures(group, runs, styles)


def _group_figures(group: Group, runs: pd.DataFrame, styles: Styles) -> Iterator[NamedFigure]:
    chosen = runs[(runs["plant"] == group.plant) & (runs["mismatch"] == group.mismatch)]
    with figure_style():
        figures = list(_drawings(group, chosen, styles))
    for kind, what, figure in figures:
        if figure is None:
            continue
        runs_in_it = f"{group.plant}, mismatch {group.mismatch}" + ("" if kind == "effort" else f", seed {group.seed}")
        title = f"{HEADINGS[kind]}: {', '.join(part for part in (what, runs_in_it) if part)}"
        figure.suptitle(textwrap.fill(title, round(LETTERS * figure.get_figwidth())), fontsize=10)
        words = "_".join(part for part in (kind, what, group.plant, group.mismatch) if part)
        yield NamedFigure(kind, re.sub(r"[^A-Za-z0-9.=+_-]", "_", words), title, figure)


def _drawings(group: Group, runs: pd.DataFrame, styles: Styles) -> Iterator[tuple[str, str, Figure | None]]:
    """Yield kind, what it is of within the group, and the figure."""
    moves = list(group.select(point_to_point=True).items())
    for first in range(0, len(moves), MOVES_A_FIGURE):
        part = dict(moves[first : first + MOVES_A_FIGURE])
        what = "" if len(moves) <= MOVES_A_FIGURE else "-".join(part)
        yield "errors", what, draw_moves(part, styles)
        yield "paths", what, draw_move_paths(part, styles)
    for task, tracks in group.select(point_to_point=False).items():
        yield "tracking", task, draw_tracking(tracks, styles)
        yield "tracking_path", task, draw_tracking_path(tracks, styles)
    yield "jacobian", "", draw_jacobians(group.tasks, styles)
    yield "effort", "", draw_effort(runs, styles)
    yield "step_times", "", draw_step_times(group.tasks, styles)
    for task, tracks in group.tasks.items():
        yield "joint_speeds", task, draw_joint_speeds(tracks, styles)
