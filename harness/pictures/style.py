"""One colour, line and marker a method, the same in every picture, and readable without colour."""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any

import matplotlib as mpl
import numpy as np

from servobench.controllers.methods import METHODS, PUBLISHED
from servobench.plant.contract.checks import FloatArray

# Okabe and Ito's palette, distinguishable with every kind of colour vision.
BLUE, ORANGE, GREEN, VERMILION, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
SKY, YELLOW, GREY, BLACK = "#56B4E9", "#B8A900", "#7F7F7F", "#000000"
WINE, INDIGO = "#882255", "#332288"  # of Tol's palette, which goes with it
MARKS = 8  # on each line
WIDTH = 7.2  # [in] of a figure: both columns of a paper
MOST_LINES = 7  # of methods in a panel, besides those that know the true robot
TEXT = 8.0  # [pt] of a figure of that width
FILM_TEXT = 9.0  # [pt]


@dataclass(frozen=True)
class Layout:
    """The sheet on which a figure is laid out; its type has the same size in points on each.

    Attributes:
        width: [in].
        columns: panels beside each other, at most.
        pixels: [px] of a page that the width takes.
        density: pixels of a picture for each of the page's.
    """

    width: float
    columns: int
    pixels: int
    density: float

    @property
    def scale(self) -> float:
        """Pixels of a page for an inch."""
        return self.pixels / self.width


WIDE = Layout(WIDTH, 3, 1000, 1.5)
NARROW = Layout(2.75, 1, 335, 2.0)  # of a phone of 390 px, with a bar to scroll


@dataclass(frozen=True)
class MethodStyle:
    """How a method's line looks.

    Attributes:
        colour: as matplotlib and browsers take it.
        line: matplotlib's line style.
        marker: matplotlib's marker; empty = none.
        shift: 0 … 1, where between two marks of another method this one's marks lie.
        hollow: whether its marks are not filled.
    """

    colour: str
    line: Any
    marker: str
    shift: float = 0.0
    hollow: bool = False

    @property
    def face(self) -> str:
        """Colour with which marks are filled."""
        return "white" if self.hollow else self.colour

    def line_arguments(self, points: int) -> dict[str, Any]:
        """Return keyword arguments for a matplotlib line of `points` points, with about eight markers on it."""
        step = max(1, points // MARKS)
        return self._arguments() | {"markevery": (int(self.shift * step), step)}

    def path_arguments(self, points: FloatArray) -> dict[str, Any]:
        """Return keyword arguments for a line through `points`, (k, d), with about eight markers evenly along it."""
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        places = (np.arange(MARKS) + self.shift) / MARKS * way[-1]
        return self._arguments() | {"markevery": np.unique(np.searchsorted(way, places)).tolist()}

    def _arguments(self) -> dict[str, Any]:
        look = {"color": self.colour, "linestyle": self.line, "marker": self.marker}
        return look | {"markersize": 4.0, "linewidth": 1.2, "markerfacecolor": self.face}


DASHED = (0, (3.5, 1.5))  # of every method as published
_STYLES = {
    "rbfnn_mfac": MethodStyle(VERMILION, "-", "o"),
    "map_mfac": MethodStyle(WINE, "-", "*"),
    "arm_mfac": MethodStyle(INDIGO, "-", "H"),
    "ukf_mfac": MethodStyle(BLUE, "-", "s"),
    "ukf_mpc": MethodStyle(GREEN, "-", "^"),
    "rbf_pid": MethodStyle(ORANGE, "-", "D"),
    "calibrated": MethodStyle(BLACK, "-.", ""),
    "nmpc_calibrated": MethodStyle(BLACK, ":", "x"),
    "constant": MethodStyle(GREY, ":", "v"),
    "broyden": MethodStyle(PURPLE, "-", "P"),
    "rls": MethodStyle(SKY, "-", "X"),
    "cfdl_mfac": MethodStyle(YELLOW, "-", "p"),
}
_STYLES |= {
    name + PUBLISHED: replace(_STYLES[name], line=DASHED, hollow=True)
    for name in _STYLES
    if name + PUBLISHED in METHODS
}
UPPER_BOUNDS = ("calibrated", "nmpc_calibrated")  # which know the true robot
_OTHER_COLOURS = (PURPLE, SKY, YELLOW, VERMILION, BLUE, GREEN)
_OTHER_LINES = ((0, (6, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)), (0, (5, 1, 1, 1, 1, 1)), "-.")
_OTHER_MARKERS = ("<", ">", "h", "d", "8", *(f"${letter}$" for letter in "abcdefghijklmnopqrstuvwxyz"))


def method_styles(names: Iterable[str]) -> dict[str, MethodStyle]:
    """Return a style for each name: the known ones always the same, others by their place in the alphabet.

    Ask once for all names of a folder, so that a third party's controller looks the same in all its figures.
    """
    wanted = list(dict.fromkeys(names))
    unknown = sorted(name for name in wanted if name not in _STYLES)
    styles = {name: _STYLES.get(name) or _other(unknown.index(name)) for name in wanted}
    return {name: replace(style, shift=i / len(styles)) for i, (name, style) in enumerate(styles.items())}


def divisions(names: Iterable[str]) -> dict[str, list[str]]:
    """Return the names with aids and those as published, under a heading each; the upper bounds are in all.

    Without a method as published, or with no other, there is one division without a heading. A division of more than
    `MOST_LINES` methods is divided further.
    """
    wanted = list(dict.fromkeys(names))
    published = [name for name in wanted if name.endswith(PUBLISHED)]
    bounds = [name for name in wanted if name in UPPER_BOUNDS]
    others = [name for name in wanted if name not in published]
    if not published or len(others) == len(bounds):
        return _parts("", wanted, bounds)
    return _parts("with aids", others, bounds) | _parts("as published", published + bounds, bounds)


def fitted(name: str, letters: int) -> str:
    """Return a name in lines of at most so many letters, broken after `:` or `/` where that is possible."""
    lines = [""]
    for part in re.split(r"(?<=[:/])", name):
        lines[-1:] = [lines[-1] + part] if len(lines[-1] + part) <= letters else [lines[-1], part]
    return "\n".join(line[i : i + letters] for line in lines for i in range(0, len(line), letters))


def figure_style(size: float = FILM_TEXT) -> AbstractContextManager[None]:
    """Return the context in which every figure is drawn; text in SVG stays text, fonts in PDF are embedded.

    Args:
        size: of the text [pt].
    """
    return mpl.rc_context(
        {
            "font.size": size,
            "axes.titlesize": size,
            "axes.grid": True,
            "grid.alpha": 0.3,
            "axes.axisbelow": True,
            "svg.fonttype": "none",
            "pdf.fonttype": 42,
        }
    )


def _parts(heading: str, names: list[str], bounds: list[str]) -> dict[str, list[str]]:
    """Return the names of a division in as few parts of about the same size as are needed, each with the bounds."""
    own = [name for name in names if name not in bounds]
    count = -(-len(own) // MOST_LINES)
    if count <= 1:
        return {heading: names}
    size = -(-len(own) // count)
    return {f"{heading} {i + 1} of {count}".lstrip(): own[i * size : (i + 1) * size] + bounds for i in range(count)}


def _other(index: int) -> MethodStyle:
    """Return the style of an unknown method; the first 32 differ in their markers."""
    return MethodStyle(
        _OTHER_COLOURS[index % len(_OTHER_COLOURS)],
        _OTHER_LINES[index % len(_OTHER_LINES)],
        _OTHER_MARKERS[index % len(_OTHER_MARKERS)],
    )
