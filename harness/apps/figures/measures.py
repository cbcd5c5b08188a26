"""Figures of metrics: of each run, and of settled runs over a condition that varies."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pandas.api.types import is_numeric_dtype

from servobench.harness.analysis import comparison
from servobench.harness.analysis.comparison import NO_ESTIMATE, Estimate
from servobench.harness.apps.figures.style import (
    BOX,
    LETTER,
    MARKS_OF,
    TEXT,
    WIDE,
    Layout,
    Look,
    MethodStyle,
    Styles,
    add_legend,
    label_rows,
    panel_grid,
    plain_logarithms,
    write_inside,
)
from servobench.harness.run.metrics import METRICS
from servobench.harness.run.result import COMPLETED
from servobench.harness.run.variations import varied_columns
from servobench.plant.contract.checks import FloatArray

SETTLING = "settling_time_s"
NEVER = 1.3  # [1] place of a run that never settled, over the largest settling time
FIGURES = ("settling", "effort", "smoothness", "own")  # each shows the metrics that name it
LINE = 0.165  # [in] a controller
WIDE_RANGE = 30.0  # largest over smallest value from which on an axis is logarithmic
MAX_RANGE = 1e6  # largest over smallest value that an axis shows
NAME_LETTERS = 20  # letters of a controller's name at an axis, for each column of a layout
LETTERS = 16.0  # letters of a label in an inch
NUMBERS = 0.25  # [in] next to the names
MIN_ROWS = 4  # controllers for which a panel has room
UPPER = 0.97  # [1] share of a panel's height at which the mark of an infinite value stands
LINE_LETTERS = 30  # letters of a line of text within a panel
Curves = Mapping[str, Sequence[Estimate]]  # method -> an estimate a place
SIZED_AXIS = re.compile(r"^(?P<axis>[a-z_ ]+)=(?P<magnitude>[0-9.eE+-]+)(?P<unit>[a-zA-Z%°]*)$")


def draw_measures(
    runs: pd.DataFrame, kind: str, styles: Styles, layout: Layout = WIDE
) -> Figure | None:
    """Draw metrics of every run, a column a task, a row a metric, a line a controller; None without values.

    The metrics of a single task stand in one row, on a narrow sheet in one column.

    A bar is the median over runs. Runs that never settled stand at the right edge and are counted there. `kind` is one
    of `FIGURES`; of its metrics those without any value are left out. A narrow layout is for a single task.
    """
    rows = [
        name
        for name, each in METRICS.items()
        if each.figure == kind and name in runs and runs[name].notna().any()
    ]
    if not rows:
        return None
    draw = _draw_one_task if runs["task"].nunique() == 1 else _draw_each_task
    figure = draw(runs, rows, styles, layout)
    notes = []
    if runs.groupby(["task", "controller"]).size().max() > 1:
        notes.append("bar: median")
    if (runs["status"] != COMPLETED).any():
        notes.append("hollow: the run ended early")
    if _never(runs, rows[0]).any():
        notes.append("at the right edge and counted: never settled")
    if notes:
        words = textwrap.fill("; ".join(notes), round(LETTERS * layout.width))
        figure.supxlabel(words, fontsize=TEXT - 0.5)
    return figure


def _draw_each_task(runs: pd.DataFrame, rows: list[str], styles: Styles, layout: Layout) -> Figure:
    """Draw measures of several tasks: a row a measure, a column a task."""
    tasks = runs["task"].unique().tolist()
    names = runs["controller"].unique().tolist()
    height = 0.55 + LINE * max(MIN_ROWS, len(names))
    figure = Figure(figsize=(layout.width, 0.65 + len(rows) * height), layout="constrained")
    parts = figure.subfigures(len(rows), 1, squeeze=False)[:, 0]
    for part, row in zip(parts, rows, strict=True):
        panels = part.subplots(1, len(tasks), sharey=True, squeeze=False)[0]
        for axes, task in zip(panels, tasks, strict=True):
            _draw_dots(axes, runs[runs["task"] == task], names, styles, row)
            axes.set_title(task)
            _name_rows(axes, names, layout)
        part.supxlabel(_label(row, runs), fontsize=TEXT)
    return figure


def _draw_one_task(runs: pd.DataFrame, rows: list[str], styles: Styles, layout: Layout) -> Figure:
    """Draw metrics of one task in rows of as many panels as the layout has columns."""
    names = runs["controller"].unique().tolist()
    rows = [row for row in rows if row != SETTLING or _moves(runs).any()] or rows[:1]
    longest_name = max(len(_short_name(name, layout)) for name in names)
    beside = LETTER * longest_name + NUMBERS
    letters = round((layout.width - beside) / min(layout.columns, len(rows)) / LETTER)
    labels = [textwrap.fill(_label(row, runs), letters) for row in rows]
    label_lines = max(text.count("\n") + 1 for text in labels)
    height = 0.4 + LINE * (label_lines + max(MIN_ROWS, len(names)))
    figure, panels = panel_grid(len(rows), height, layout, head=0.35)
    for axes, row, label in zip(panels, rows, labels, strict=True):
        _draw_dots(axes, runs, names, styles, row)
        _name_rows(axes, names, layout)
        axes.set_xlabel(label)
    return figure


def _name_rows(axes: Axes, names: Sequence[str], layout: Layout) -> None:
    axes.set_yticks(range(len(names)), [_short_name(name, layout) for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)


def _short_name(name: str, layout: Layout) -> str:
    """Return the end of a name, which says more than its beginning, in as many letters as there is room for."""
    letters = NAME_LETTERS * min(2, layout.columns)
    if len(name) <= letters:
        return name
    return f"…{name[1 - letters :]}"


def _label(column: str, runs: pd.DataFrame) -> str:
    """Return the label of an axis, which has a unit in any case."""
    heading = comparison.metric_heading(column, runs)
    if heading.endswith("]"):
        return heading
    return f"{heading} [1]"


def _moves(runs: pd.DataFrame) -> pd.Series[bool]:
    """Return which runs are moves; a curve has no settling time."""
    return comparison.texts_of(runs, "task_kind") != comparison.CURVE


def _never(runs: pd.DataFrame, column: str) -> pd.Series[bool]:
    """Return which runs have no settling time although they are moves; of other measures none."""
    return _moves(runs) & comparison.settling_times(runs).isna() & (column == SETTLING)


def _draw_dots(
    axes: Axes, runs: pd.DataFrame, names: list[str], styles: Styles, column: str
) -> None:
    """Draw a measure of the runs of one task."""
    _, factor = comparison.shown_unit(column, runs)
    values = factor * runs[column].astype(float)
    never = _never(runs, column)
    # A logarithmic axis has no room for tiny values: they stand at its lower end.
    floor = values.max() / MAX_RANGE
    values = values.where(~((values > 0.0) & (values < floor)), floor)
    if column == SETTLING:
        values = values.where(_moves(runs) & ~never)
    if values.isna().all() and not never.any():
        axes.tick_params(axis="x", bottom=False, labelbottom=False)
        write_inside(axes, "does not apply", fontsize=TEXT - 1.0)
    edge = _limit(axes, values, NEVER if never.any() else 1.06)
    places = values.where(~never, edge)
    for i, name in enumerate(names):
        own = runs["controller"] == name
        style = styles[name]
        for completed in (True, False):
            chosen = own & ((runs["status"] == COMPLETED) == completed)
            points = places[chosen].dropna().to_numpy()
            # An empty line that is not clipped would count as a mark at the origin.
            if len(points) == 0:
                continue
            axes.plot(
                points,
                np.full(len(points), i),
                color=style.colour,
                marker=style.marker or "o",
                markerfacecolor=style.colour if completed else "none",
                **MARKS_OF["run"],
            )
        # A move that never settled counts in the median as one that settles after infinite time.
        judged = values[own].fillna(math.inf) if column == SETTLING else values[own]
        middle = judged.median()
        if own.sum() > 1 and math.isfinite(middle):
            axes.plot(middle, i, **MARKS_OF["median"])
        if never[own].any():
            words = f"{never[own].sum()} of {own.sum()}"
            axes.annotate(words, (edge, i), fontsize=TEXT - 2.0, **MARKS_OF["never"])


def _limit(axes: Axes, values: pd.Series[float], room: float) -> float:
    """Show values of at least 0, linear with `room` over the largest one or logarithmic; return the upper end."""
    largest = float(values.max())
    least = float(values.min())
    if least > 0.0 and largest / least > WIDE_RANGE:
        edge = largest * float((largest / least) ** 0.08)
        margin = edge / largest
        plain_logarithms(axes, "x")
        axes.set_xlim(least / margin, edge)
        return edge
    edge = largest * room if largest > 0.0 else 1.0
    axes.set_xlim(0.0, edge)
    axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(4))
    return edge


def draw_curves(
    axes: Axes, places: Sequence[float], values: Curves, styles: Styles, top: float
) -> None:
    """Draw an estimate over a quantity, a line a method with its interval as a band; abscissae are to scale.

    Methods with the same curve share one line, and the panel names them. An infinite estimate is a mark at the upper
    edge `top`.
    """
    x = np.array(places, dtype=float)
    groups = same_curves(values)
    for names in groups:
        first, *others = names
        style = styles[first]
        bounds = [(estimate.value, estimate.low, estimate.high) for estimate in values[first]]
        y, low, high = np.array(bounds).T
        known = ~np.isnan(y)
        if not known.any():
            continue
        interval = np.vstack([np.where(np.isnan(low), y, low), high])[:, known]
        edges = np.nan_to_num(interval, posinf=1.05 * top)
        axes.fill_between(x[known], *edges, color=style.colour, alpha=0.12, linewidth=0.0)
        _draw_line(axes, x[known], y[known], style, first, top)
        for name in others:
            axes.plot([], [], label=name, **styles[name].line_arguments(1))
        if others:
            shared = "all methods" if len(groups) == 1 else ", ".join(names)
            _name_shared_line(axes, shared, y, top)
    axes.set_ylim(-0.02 * top, top)


def _name_shared_line(axes: Axes, methods: str, y: FloatArray, top: float) -> None:
    """Write which methods share a line through `y`, (k,), into that half of the panel that it leaves free."""
    constant = f", {y[0]:g} throughout" if (y == y[0]).all() else ""
    words = textwrap.fill(f"one line{constant}: {methods}", LINE_LETTERS)
    upper_half_free = float(np.nanmean(np.minimum(y, top))) < top / 2.0
    level, side = (0.96, "top") if upper_half_free else (0.04, "bottom")
    look = {"ha": "left", "va": side, "color": "black", "fontsize": TEXT - 2.0}
    write_inside(axes, words, (0.03, level), bbox=BOX, **look)


def same_curves(values: Curves) -> list[list[str]]:
    """Return the methods, those with the same values and intervals everywhere together."""
    groups: dict[str, list[str]] = {}
    for name, estimates in values.items():
        # Texts of numbers, as NaN does not equal itself.
        curve = repr([(e.value, e.low, e.high) for e in estimates])
        groups.setdefault(curve, []).append(name)
    return list(groups.values())


def _draw_line(
    axes: Axes, x: FloatArray, y: FloatArray, style: MethodStyle, name: str, top: float
) -> None:
    look: Look = {
        "color": style.colour,
        "markerfacecolor": style.face,
        "markersize": 4.5,
        "linewidth": 1.2,
    }
    beyond = ~np.isfinite(y)
    shown = np.where(beyond, UPPER * top, y)
    axes.plot(
        x, shown, label=name, linestyle=style.line, marker=style.marker, markevery=~beyond, **look
    )
    if beyond.any():
        level = np.full(np.count_nonzero(beyond), UPPER * top)
        larger = look | {"markersize": 6.5}
        axes.plot(x[beyond], level, linestyle="none", marker=mpl.markers.CARETUP, **larger)


def draw_conditions(runs: pd.DataFrame, styles: Styles, layout: Layout = WIDE) -> Figure | None:
    """Draw the share of settled runs with its 95 % Wilson interval over each condition that varies, if one does."""
    sweeps = _sweeps(runs)
    if not sweeps:
        return None
    figure, panels = panel_grid(len(sweeps), 2.5, layout)
    for axes, (label, part) in zip(panels, sweeps.items(), strict=True):
        shares = {
            key: comparison.settled_share(own) for key, own in part.groupby(["controller", "size"])
        }
        sizes = sorted(part["size"].unique())
        values = {
            name: [shares.get((name, size), NO_ESTIMATE) for size in sizes]
            for name in part["controller"].unique()
        }
        draw_curves(axes, sizes, values, styles, top=104.0)
        axes.set_xlabel(label)
    label_rows(panels, "settled runs [%]")
    add_legend(figure, panels)
    return figure


def _sweeps(runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return for each condition with at least two sizes the runs concerned, with the column `size`.

    Where a sweep says along which axis a run stands, the axes are its own, and the numbers that vary at one place of
    an axis; else the mismatches are read, and runs without mismatch have size 0 on each axis.
    """
    sweeps = _varied_settings(runs)
    at_zero = runs.head(0)
    if "axis" not in runs or (runs["axis"].fillna("") == "").all():
        without_mismatch = runs["mismatch"].isin(["none", comparison.FROM_TWIN])
        at_zero = runs[without_mismatch].assign(size=0.0)
        runs = runs.assign(**runs["mismatch"].str.extract(SIZED_AXIS))
    along = runs[runs["axis"].fillna("") != ""]
    along = along.assign(size=along["magnitude"].astype(float))
    for (axis, unit), group in along.groupby(["axis", "unit"], sort=False):
        label = str(axis).replace("_", " ")
        if unit:
            label += f" [{unit}]"
        sweeps[label] = pd.concat([at_zero, group]) if len(at_zero) else group
    return {
        label: part.dropna(subset=["size"])
        for label, part in sweeps.items()
        if part["size"].nunique() > 1
    }


def _varied_settings(runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return for each number that varies, at one place of an axis if there are axes, the runs with its `size`."""
    places = [runs]
    if "axis" in runs:
        places = [own for _, own in runs.groupby(["axis", "magnitude"], dropna=False)]
    sweeps = {}
    for name, (label, factor) in varied_columns(runs.columns).items():
        if not is_numeric_dtype(runs[name]):
            continue
        if any(own[name].nunique() > 1 for own in places):
            sweeps[label] = runs.assign(size=factor * runs[name].astype(float))
    return sweeps
