"""The appearance of every figure: colour, line and marker of each method, legend, axes and files; readable in grey."""

import base64
import io
import math
import re
import shutil
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from string import ascii_lowercase
from typing import Any, Literal, NamedTuple, Self, TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image

from servobench.controllers.methods import METHODS, PUBLISHED
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.facts import read_beside
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import write_atomically
from servobench.plant.contract.units import split_quantity

_SHEET = read_beside(__file__, "style.toml")
COLOURS: dict[str, str] = _SHEET["colours"]
MARKS = 8  # markers on each line
WIDTH = 7.2  # [in] width of a figure: both columns of a paper
MAX_LINES = 7  # methods in a panel, not counting those that know the true robot
TEXT = 8.0  # [pt] size of text in a figure of that width
FILM_TEXT = 9.0  # [pt]
FORMATS = ("png", "pdf")
ALL_FORMATS = (*FORMATS, "svg", "pgf")
# Unit -> how many of it are an inch
INCHES = {"in": 1.0, "cm": 2.54, "mm": 25.4, "pt": 72.27}
TWO_COLUMNS = 5.0  # [in] from which on panels stand beside each other
PGF_TEXT = re.compile(r"(?<=\\def%\{\\%\}).*(?=\}\}%$)", re.MULTILINE)
UNDERSCORE = re.compile(r"(\$[^$]*\$)|(?<!\\)_")  # a formula, or an underscore outside
TEX = ("pdflatex", "lualatex", "xelatex")  # programs with which pgf measures its text
# Level of PNG; the default takes nearly twice as long for files that are a sixth smaller.
COMPRESSION = 1
UNDATED: dict[str, Any] = {
    "pdf": {"metadata": {"CreationDate": None}},
    "svg": {"metadata": {"Date": None}},
    "png": {"metadata": {"Software": None}, "pil_kwargs": {"compress_level": COMPRESSION}},
}
RESOLUTION = 150  # [dpi] resolution of PNG
PALETTE = 64  # colours of a picture in a page
STRIP = 0.04  # [in] above and below the drawing
ENDED = "run ended early"
END = "|"  # the marker of an early end, which no method has
SETTLED = "settled from here on"
CAMERA_MOVES = "camera moves"
# Entries of a legend that begin so are no methods and stand behind these.
NOT_METHODS = ("desired", "settling band", "start", "target", SETTLED, CAMERA_MOVES, ENDED)
# [1] Upper over lower end of a logarithmic axis below which 2 and 5 have numbers as well.
FEW_DECADES = 50.0
LETTER = 0.066  # [in] width of a letter of the legend
SAMPLE = 0.55  # [in] width of the sample line of a legend
MARGIN = 0.2  # [in] on both sides of the legend
Look: TypeAlias = dict[str, Any]  # arguments of an artist of matplotlib
DESIRED: Look = _SHEET["desired"]
BOX: Look = _SHEET["box"]  # around words in a panel
MARKS_OF: dict[str, Look] = _SHEET["marks"]
DASHED = (0, (3.5, 1.5))  # line of every method as published
UPPER_BOUNDS = ("calibrated", "nmpc_calibrated")  # which know the true robot


def _line(text: str) -> Any:  # noqa: ANN401 - matplotlib's own types
    """Return a line style of matplotlib for its name, or for the lengths of dashes and gaps."""
    if " " in text:
        return 0, tuple(int(length) for length in text.split())
    return text


JOINTS = [
    (COLOURS[colour], _line(line))
    for colour, line in zip(_SHEET["joints"]["colours"], _SHEET["joints"]["lines"], strict=True)
]


@dataclass(frozen=True)
class Layout:
    """The sheet on which a figure is laid out; its type has the same size in points on each."""

    width: float  # [in]
    columns: int  # panels beside each other, at most
    pixels: int  # [px] of a page that the width takes
    density: float  # pixels of a picture for each of the page's

    @classmethod
    def of_width(cls, text: str) -> Self:
        """Return the layout of a width such as `3.5in` or `89mm`; one below 5 in has its panels in one column.

        Raises:
            ConfigurationError: no length from 2 to 20 in.
        """
        number, unit = split_quantity(text) or (math.nan, "")
        width = number / INCHES.get(unit, math.nan)
        if not 2.0 <= width <= 20.0:
            raise ConfigurationError(
                f"--width must be from 2in to 20in, as 3.5in, 89mm or 252pt, got {text}"
            )
        columns = WIDE.columns if width >= TWO_COLUMNS else 1
        return cls(width, columns, WIDE.pixels, WIDE.density)

    @property
    def wide(self) -> bool:
        """Whether panels stand beside each other."""
        return self.columns > 1

    @property
    def scale(self) -> float:
        """Pixels of a page for an inch."""
        return self.pixels / self.width


WIDE = Layout(WIDTH, 3, 1000, 1.5)
NARROW = Layout(2.75, 1, 335, 2.0)  # for a phone of 390 px, with a bar to scroll


@dataclass(frozen=True)
class MethodStyle:
    """Colour, line and marker of a method."""

    colour: str  # as matplotlib and browsers take it
    line: Any  # matplotlib's line style
    marker: str  # matplotlib's marker; empty = none
    shift: float = 0.0  # 0 … 1, where between two marks of another method this one's marks lie
    hollow: bool = False  # whether its marks are not filled

    @property
    def face(self) -> str:
        """Colour with which marks are filled."""
        return "white" if self.hollow else self.colour

    def line_arguments(self, points: int) -> Look:
        """Return keyword arguments for a matplotlib line of `points` points, with about eight markers on it."""
        step = max(1, points // MARKS)
        first = int(self.shift * step)
        return {
            "color": self.colour,
            "linestyle": self.line,
            "marker": self.marker,
            "markerfacecolor": self.face,
            "markevery": (first, step),
            **_SHEET["line"],
        }

    def path_arguments(self, points: FloatArray) -> Look:
        """Return keyword arguments for a line through `points`, (k, d), with about eight markers evenly along it."""
        way = way_along(points)
        places = (np.arange(MARKS) + self.shift) / MARKS * way[-1]
        marked = np.unique(np.searchsorted(way, places))
        return self.line_arguments(1) | {"markevery": marked.tolist()}


def way_along(points: FloatArray) -> FloatArray:
    """Return the length of the path through points (k, d) from its start to each of them, (k,)."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(lengths)])


Styles = dict[str, MethodStyle]
_STYLES = {
    name: MethodStyle(COLOURS[colour], line, marker)
    for name, (colour, line, marker) in _SHEET["methods"].items()
}
_STYLES |= {
    name + PUBLISHED: replace(style, line=DASHED, hollow=True) for name, style in _STYLES.items()
}


def method_styles(names: Iterable[str]) -> dict[str, MethodStyle]:
    """Return a style for each name: the known ones always the same, others by their place in the alphabet.

    Call it once for all names of a folder, so that a third party's controller has one style in all its figures.
    """
    wanted = list(dict.fromkeys(names))
    unknown = sorted(name for name in wanted if name not in _STYLES)
    styles = {}
    for i, name in enumerate(wanted):
        style = _STYLES.get(name) or _other(unknown.index(name))
        # Marks of different methods at the same place would hide each other.
        styles[name] = replace(style, shift=i / len(wanted))
    return styles


def divisions(names: Iterable[str]) -> dict[str, list[str]]:
    """Return the names as published and the others, under a heading each; the upper bounds are in all.

    Without a method as published, or with no other, there is one division without a heading. A division of more than
    `MAX_LINES` methods is divided further.
    """
    wanted = list(dict.fromkeys(names))
    published = [name for name in wanted if name.endswith(PUBLISHED)]
    bounds = [name for name in wanted if name in UPPER_BOUNDS]
    others = [name for name in wanted if name not in published]
    if not published or len(others) == len(bounds):
        return _parts("", wanted, bounds)
    aided = all(name in bounds or name + PUBLISHED in METHODS for name in others)
    head = "with aids" if aided else "others"
    return _parts(head, others, bounds) | _parts("as published", published + bounds, bounds)


def fitted(name: str, letters: int) -> str:
    """Return a name in lines of up to `letters` letters, broken after `:` or `/` where that is possible."""
    lines = [""]
    for part in re.split(r"(?<=[:/])", name):
        if len(lines[-1] + part) <= letters:
            lines[-1] += part
        else:
            lines.append(part)
    pieces = []
    for line in lines:  # a part that is too long is broken anywhere
        pieces += [line[first : first + letters] for first in range(0, len(line), letters)]
    return "\n".join(pieces)


@contextmanager
def figure_style(size: float = FILM_TEXT) -> Iterator[None]:
    """Yield in the context in which every figure is drawn, with text of a size [pt]; fonts in PDF are embedded.

    A `matplotlibrc` or a style of the user's does not count: pictures are the same on every machine.
    """
    changed_by_user: dict[Any, Any] = {
        name: value
        for name, value in mpl.rcParamsDefault.items()
        if name != "backend" and mpl.rcParams[name] != value
    }
    own: dict[Any, Any] = {
        **_SHEET["rc"],
        "font.size": size,
        "axes.titlesize": size,
        "pgf.texsystem": next(filter(shutil.which, TEX), TEX[0]),
    }
    with mpl.rc_context({**changed_by_user, **own}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph ")  # the font lacks a letter of a name
        yield


def panel_grid(
    count: int, height: float, layout: Layout = WIDE, head: float = 1.0
) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels with a common ordinate, and its `count` panels.

    A row is `height` high [in], title and legend together `head` [in].
    """
    columns = min(layout.columns, count)
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(layout.width, head + height * rows), layout="constrained")
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    panels = grid.ravel().tolist()
    for axes in panels[count:]:
        axes.set_visible(False)
    return figure, panels[:count]


def label_rows(panels: Iterable[Axes], text: str | None = None) -> None:
    """Label the ordinate of the first panel of each row only, with `text` or as it is labelled."""
    for axes in panels:
        place = axes.get_subplotspec()
        first = place is None or place.is_first_col()
        if not first:
            axes.set_ylabel("")
        elif text is not None:
            axes.set_ylabel(text)


def finish_columns(figure: Figure, panels: np.ndarray) -> None:
    """Label the ordinates of a grid of panels at its left edge, and add the legend."""
    label_rows(panels.flat)
    figure.align_ylabels(panels[:, 0])
    add_legend(figure, panels.flat)


def write_inside(
    axes: Axes,
    words: str,
    place: tuple[float, float] = (0.5, 0.5),
    **look: Any,  # noqa: ANN401 - as matplotlib's
) -> None:
    """Write words at a place of a panel, [1] of its width and height; in grey at its centre without another look."""
    axes.text(*place, words, transform=axes.transAxes, **{**_SHEET["remark"], **look})


def mark_end(axes: Axes, x: FloatArray, y: FloatArray, style: MethodStyle) -> None:
    """Mark the last known point (x, y) of a run that ended early."""
    last = np.flatnonzero(np.isfinite(y))[-1]
    axes.plot(x[last], y[last], color=style.colour, marker=END, gid=ENDED, **MARKS_OF["end"])


def add_legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """Put one legend for all panels below them, methods first; marks of settling and of an early end get a line."""
    panels = list(panels)
    entries: dict[str, Artist] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    groups = {line.get_gid() for axes in panels for line in axes.get_lines()}
    for gid, marker in ((SETTLED, "^"), (ENDED, END)):
        if gid in groups:
            entries[gid] = mpl.lines.Line2D([], [], marker=marker, **MARKS_OF["legend"])
    entries = dict(sorted(entries.items(), key=lambda entry: entry[0].startswith(NOT_METHODS)))
    if not entries:
        return
    width = figure.get_figwidth()
    letters = math.floor((width - SAMPLE - MARGIN) / LETTER)
    labels = [fitted(label, letters) for label in entries]
    longest_line = max(len(line) for label in labels for line in label.splitlines())
    fitting = math.floor(width / (SAMPLE + LETTER * longest_line))
    figure.legend(
        list(entries.values()),
        labels,
        fontsize=TEXT - 0.5,
        ncols=max(1, min(fitting, len(entries))),
        **_SHEET["legend"],
    )


def plain_logarithms(axes: Axes, which: Literal["x", "y"] = "y") -> None:
    """Make an axis logarithmic with plain numbers; where it spans few decades, 2 and 5 have numbers as well."""
    axis = axes.yaxis if which == "y" else axes.xaxis

    def between(value: float, _position: int | None) -> str:
        low, high = sorted(axis.get_view_interval())
        first_digit = f"{value:e}"[0]
        numbered = high < FEW_DECADES * low and first_digit in "25"
        return f"{value:g}" if numbered else ""

    axes.set(**{f"{which}scale": "log"})
    axis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(mpl.ticker.FuncFormatter(between))


def check_tex() -> None:
    """Refuse the format pgf where there is no TeX to measure its text.

    Raises:
        ConfigurationError: there is none.
    """
    if not any(map(shutil.which, TEX)):
        raise ConfigurationError(
            f"--format pgf needs a TeX while it is drawn, {', '.join(TEX[:-1])} or {TEX[-1]}, and there is none; "
            "on Debian: apt install texlive-latex-recommended texlive-pictures; pdf, svg and png need none"
        )


def save_figure(
    figure: Figure, stem: Path, formats: Iterable[str] = FORMATS, *, exact_width: bool = False
) -> list[Path]:
    """Write a figure in each format, by default PNG and PDF, under one name; the same figure gives the same bytes.

    Its width is that of the figure; with `exact_width` its height is that of the drawing, without empty strips.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    paths = []
    box = None
    with figure_style(TEXT):
        if exact_width:
            drawn = box_of(figure)
            box = Bbox.from_extents(0.0, drawn.y0, figure.get_figwidth(), drawn.y1)
        for ending in formats:
            path = stem.with_name(f"{stem.name}.{ending}")
            paths.append(path)
            content = _encode(figure, ending, box)
            write_atomically(path, partial(Path.write_bytes, data=content))
            figure.set_layout_engine(None)  # freeze the layout: computing it dominates the save
    return paths


def _encode(figure: Figure, ending: str, box: Bbox | None) -> bytes:
    """Return the content of a file: a writer of PDF that finds no room on the disk ends in an error of its own."""
    content = io.StringIO() if ending == "pgf" else io.BytesIO()
    if ending == "png" and box is None:  # drawn once; `savefig` would draw it twice
        figure.set_dpi(RESOLUTION)
        FigureCanvasAgg(figure).print_png(content, **UNDATED[ending])  # type: ignore[no-untyped-call]
    else:
        figure.savefig(
            content, format=ending, dpi=RESOLUTION, bbox_inches=box, **UNDATED.get(ending, {})
        )
    made = content.getvalue()
    if isinstance(made, bytes):
        return made
    return PGF_TEXT.sub(_escape_underscores, made).encode()


def _escape_underscores(text: re.Match[str]) -> str:
    """Return matched text for TeX with its underscores escaped; formulas stay."""
    return UNDERSCORE.sub(lambda found: found[1] or r"\_", text[0])


def box_of(figure: Figure) -> Bbox:
    """Lay a figure out for good; return the box [in] as high as the drawing and as wide as the figure."""
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)  # once, also for the edges of the drawing
        # "none" leaves a placeholder, for which a figure is drawn once more
        figure.set_layout_engine(None)
    drawn = figure.get_tightbbox()
    left = min(0.0, drawn.x0)
    right = max(figure.get_figwidth(), drawn.x1)
    return Bbox.from_extents(left, drawn.y0 - STRIP, right, drawn.y1 + STRIP)


class Drawing(NamedTuple):
    """A figure in a page, with the size [px] at which its type is as large as that of the page."""

    data: str  # the PNG file, base64
    width: int
    height: int


def drawing_of(figure: Figure, layout: Layout = WIDE) -> Drawing:
    """Return a figure as a small, sharp PNG for a page.

    The picture is as high as the drawing: nothing is cut, and there is no empty strip.
    """
    large = io.BytesIO()
    small = io.BytesIO()
    with figure_style(TEXT):
        box = box_of(figure)
        dpi = layout.density * layout.scale
        unpacked = {"compress_level": 0}  # it is read again at once
        figure.savefig(large, dpi=dpi, bbox_inches=box, pil_kwargs=unpacked)
    # A line drawing has few colours; a palette makes half the size of it, and an octree keeps those of a few pixels.
    with Image.open(large) as picture:
        indexed = picture.convert("RGB").quantize(
            PALETTE, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE
        )
        indexed.save(small, "PNG", optimize=True)
    content = base64.b64encode(small.getvalue()).decode("ascii")
    return Drawing(content, round(layout.scale * box.width), round(layout.scale * box.height))


def _parts(heading: str, names: list[str], bounds: list[str]) -> dict[str, list[str]]:
    """Return the names of a division in as few parts of about the same size as are needed, each with the bounds."""
    own = [name for name in names if name not in bounds]
    count = math.ceil(len(own) / MAX_LINES)
    if count <= 1:
        return {heading: names}
    size = math.ceil(len(own) / count)
    parts = {}
    for i in range(count):
        title = f"{heading} {i + 1} of {count}".lstrip()
        parts[title] = own[i * size : (i + 1) * size] + bounds
    return parts


def _other(index: int) -> MethodStyle:
    """Return the style of an unknown method; the first 32 differ in their markers."""
    known = _SHEET["unknown_methods"]
    markers = [*known["markers"], *(f"${letter}$" for letter in ascii_lowercase)]
    colour, line, marker = (
        values[index % len(values)] for values in (known["colours"], known["lines"], markers)
    )
    return MethodStyle(COLOURS[colour], _line(line), marker)
