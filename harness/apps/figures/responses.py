"""Figures over time: errors of moves and curves, estimated Jacobians, measured features and commanded joints.

| figure of the paper | shows | here |
|---|---|---|
| 4 | errors of the point-to-point moves; the measured features | `draw_moves`, `draw_features` |
| 5 | paths of these moves in space | `servobench.harness.apps.figures.paths` |
| 6 | a tracked curve: error, desired and measured features | `draw_tracking` |
| 7 | the tracked curve in space | `servobench.harness.apps.figures.paths` |
| 8 | the arm at eight places on the circle | `servobench.harness.apps.films.film` |
"""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from operator import itemgetter

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import offset_copy

from servobench.harness.analysis.comparison import handy_unit
from servobench.harness.apps.figures.style import (
    BOX,
    CAMERA_MOVES,
    DESIRED,
    JOINTS,
    MARKS_OF,
    SETTLED,
    TEXT,
    WIDE,
    Layout,
    Styles,
    add_legend,
    divisions,
    finish_columns,
    label_rows,
    mark_end,
    panel_grid,
    plain_logarithms,
    write_inside,
)
from servobench.harness.apps.figures.tracks import (
    BAND,
    WINDOW,
    Ensemble,
    Ensembles,
    Shown,
    Tasks,
    Track,
    Tracks,
    TracksByTask,
    label_of,
    longest,
    quantile,
    shown_until,
)
from servobench.plant.contract.checks import FloatArray

COLUMNS = 2
LINE = 0.17  # [in] height of a line of the legend
DrawPanel = Callable[[Axes, Ensembles, Styles], None]
COMMAND = "joint_velocity_command_"
ROW = 0.72  # [in] a controller
# A column of panels each: its title, the metric written into it, and its form
QUANTITIES = (
    ("joint speed [rad/s]", "command_switches", "{:.0f} sign switches"),
    ("acceleration [rad/s²]", "joint_acceleration_rms_rad_s2", "RMS {:.3g}"),
    ("jerk [rad/s³]", "joint_jerk_rms_rad_s3", "RMS {:.3g}"),
)
MARK_SIZE = 6.5  # [points] width of the mark at a settling time
EXACT = 1e-7  # [%] error of an estimate that counts as the truth
AXIS_ROOM = 1.3  # [1] length of an axis over the largest error after the approach
NEAR = 0.02  # [1] share of a time axis within which marks stand side by side
FLOOR = 0.1  # settling bands: the least error that is shown over time
OUTSIDE = 1e12  # a number that is outside of every picture
MAX_ERROR = 1e6  # [error unit] up to which an axis reaches


def draw_moves(tasks: Tasks, styles: Styles, layout: Layout = WIDE) -> Figure:
    """Draw the error of each task over time: median and band over seeds, and where runs settled (figure 4).

    Methods with aids and as published have panels of their own where there are both. The time ends when methods have
    settled.
    """
    figure, panels = _draw_tasks(tasks, styles, draw_error, layout)
    everything = [ensemble for ensembles in tasks.values() for ensemble in ensembles.values()]
    first_panel, _ = panels[0]
    show_errors(first_panel, everything)  # all panels share its ordinate
    for axes, task in panels:
        until = shown_until(tasks[task])
        end = max(float(ensemble.time[-1]) for ensemble in tasks[task].values())
        if until < end:
            axes.set_xlim(-0.02 * until, until)
            axes.set_xlabel(f"time [s]; the move lasts {end:.2g} s")
    return figure


def draw_jacobians(tasks: Tasks, styles: Styles, layout: Layout = WIDE) -> Figure | None:
    """Draw how far the estimated Jacobian is from the true one, over seeds; None if no run knows it."""
    known: dict[str, Ensembles] = {}
    for task, ensembles in tasks.items():
        for name, ensemble in ensembles.items():
            if np.isfinite(ensemble.jacobian_error).any():
                known.setdefault(task, {})[name] = ensemble
    if not known:
        return None
    figure, _ = _draw_tasks(known, styles, draw_jacobian, layout)
    return figure


def draw_features(
    tasks: TracksByTask, until: Mapping[str, float], styles: Styles, layout: Layout = WIDE
) -> Figure:
    """Draw a column for each task with each feature as it was measured in one run of each controller (figure 4).

    The column of a task ends at `until[task]` [s]. A narrow layout is for a single task.
    """
    features = _features(tasks)
    figure = Figure(figsize=(layout.width, 1.1 + 1.3 * len(features)), layout="constrained")
    panels = figure.subplots(len(features), len(tasks), sharex="col", sharey="row", squeeze=False)
    for column, (task, whole) in zip(panels.T, tasks.items(), strict=True):
        tracks = {name: track.overview() for name, track in whole.items()}
        for axes, feature in zip(column, features, strict=True):
            desired = longest(tracks)
            axes.plot(desired.time, desired.column(f"reference_{feature}"), **DESIRED)
            for name, track in tracks.items():
                _draw_values(axes, track, track.column(f"feature_{feature}"), name, styles)
            axes.set_ylabel(f"measured\n{label_of(feature)}")
        column[0].set_title(task)
        column[-1].set_xlabel("time [s]")
        if until[task] < longest(tracks).time[-1]:
            column[-1].set_xlim(-0.02 * until[task], until[task])
    finish_columns(figure, panels)
    return figure


def draw_tracking(
    ensembles: Ensembles, tracks: Tracks, styles: Styles, layout: Layout = WIDE
) -> Figure:
    """Draw the error along a curve over seeds, and below it the error in each feature of one run (figure 6).

    Of a long run, the latter is drawn at its end only, on a narrow sheet not at all.
    """
    if layout.columns < COLUMNS:
        figure, _ = _draw_tasks({"": ensembles}, styles, draw_error, layout)
        return figure
    features = _features({"": tracks})
    long = any(track.long for track in tracks.values())
    heads = divisions(ensembles)
    closing = {name: track.closing() for name, track in tracks.items()}
    figure = Figure(figsize=(layout.width, 3.1 + 1.15 * len(features)), layout="constrained")
    panels = figure.subplots(
        1 + len(features),
        len(heads),
        sharex=False if long else "col",
        sharey="row",
        squeeze=False,
        height_ratios=[2.2, *[1.0] * len(features)],
    )
    for column, (head, names) in zip(panels.T, heads.items(), strict=True):
        draw_error(column[0], {name: ensembles[name] for name in names}, styles)
        column[0].set_title(head)
        shown = {name: closing[name] for name in names if name in closing}
        if shown:
            for axes, feature in zip(column[1:], features, strict=True):
                _draw_feature_error(axes, shown, styles, feature)
        column[-1].set_xlabel("time [s], the end of the run" if long else "time [s]")
        if long:
            column[0].set_xlabel("time [s]")
    finish_columns(figure, panels)
    return figure


def _draw_tasks(
    tasks: Tasks, styles: Styles, draw: DrawPanel, layout: Layout
) -> tuple[Figure, list[tuple[Axes, str]]]:
    """Draw a panel for each task and division of methods; return the figure, and the panels with their tasks."""
    cells = []
    for task, ensembles in tasks.items():
        for heading, names in divisions(ensembles).items():
            cells.append((task, heading, {name: ensembles[name] for name in names}))
    methods = {name for ensembles in tasks.values() for name in ensembles}
    row = 2.8 if layout.wide and len(cells) == 1 else 2.0
    head = 0.6 + LINE * (2 + len(methods) * (0.25 if layout.wide else 1.0))
    sheet = replace(layout, columns=min(COLUMNS, layout.columns))
    figure, panels = panel_grid(len(cells), row, sheet, head)
    drawn = []
    for axes, (task, heading, ensembles) in zip(panels, cells, strict=True):
        draw(axes, ensembles, styles)
        axes.set(title=", ".join(filter(None, (task, heading))), xlabel="time [s]")
        drawn.append((axes, task))
    label_rows(panels)
    add_legend(figure, panels)
    return figure, drawn


def _features(tasks: TracksByTask) -> list[str]:
    """Return the names of the features in the order of the plant; those of the richest track count."""
    return max((track.features for tracks in tasks.values() for track in tracks.values()), key=len)


def draw_error(axes: Axes, ensembles: Ensembles, styles: Styles) -> None:
    """Draw the true error over time: its median and band over seeds, logarithmic, and where runs settled."""
    first = next(iter(ensembles.values()))
    draw_over_seeds(axes, ensembles, styles, lambda ensemble: ensemble.shown_error)
    show_errors(axes, ensembles.values())
    mark_settling_band(axes, first)
    if first.point_to_point:
        _mark_settling_times(axes, ensembles, styles)
    if math.isfinite(first.camera_moved_at):
        axes.axvline(
            first.camera_moved_at, color="0.4", linewidth=0.9, linestyle="-.", label=CAMERA_MOVES
        )
    unit, _ = first.error_unit
    label = f"true error [{unit}]"
    if not first.point_to_point:
        label += f",\nRMS over {WINDOW:g} s"
    axes.set_ylabel(label)


def show_errors(axes: Axes, ensembles: Collection[Ensemble]) -> None:
    """Set a logarithmic axis and its range to show these errors, if one is above zero.

    Errors of a small part of the settling band are left out: they are noise, which a median describes better.
    """
    largest = 0.0
    for ensemble in ensembles:
        known = ensemble.error[np.isfinite(ensemble.error)]
        largest = max(largest, float(known.max(initial=0.0)))
    if largest > 0.0:
        low = FLOOR * next(iter(ensembles)).settling_band
        plain_logarithms(axes)
        axes.set_ylim(low if low > 0.0 else None, min(1.6 * largest, MAX_ERROR))


def draw_jacobian(axes: Axes, ensembles: Ensembles, styles: Styles) -> None:
    """Draw the relative error of the estimated Jacobian over time, its median and band over seeds, logarithmic."""
    exact = [
        name
        for name, ensemble in ensembles.items()
        if np.nanmax(ensemble.jacobian_error, initial=0.0) < EXACT
    ]
    others = {name: ensemble for name, ensemble in ensembles.items() if name not in exact}
    draw_over_seeds(axes, others, styles, lambda ensemble: ensemble.jacobian_error)
    for name in exact:
        axes.plot([], [], label=f"{name} (exact)", **styles[name].line_arguments(1))
    axes.set_ylabel("Jacobian error [%]")
    if math.isfinite(axes.dataLim.minposy):  # infinite where no value is above zero
        plain_logarithms(axes)
    else:
        write_inside(axes, "no values")


def draw_over_seeds(
    axes: Axes,
    ensembles: Ensembles,
    styles: Styles,
    curve: Callable[[Ensemble], FloatArray],
) -> None:
    """Draw the median over seeds of a curve of each ensemble, (r, k), and between which values most seeds are."""
    for name, ensemble in ensembles.items():
        values = curve(ensemble)
        style = styles[name]
        low, middle, high = (quantile(values, share) for share in BAND)
        known = np.isfinite(middle)
        if not known.any():
            continue
        if len(values) > 1:
            axes.fill_between(
                ensemble.time,
                np.minimum(low, OUTSIDE),
                np.minimum(high, OUTSIDE),
                color=style.colour,
                alpha=min(0.18, 0.5 / len(ensembles)),
                linewidth=0.0,
            )
        shown = np.where(known, middle, np.nan)
        axes.plot(ensemble.time, shown, label=name, **style.line_arguments(len(shown)))
        if ensemble.mostly_ended:
            mark_end(axes, ensemble.time, shown, style)


def _draw_feature_error(axes: Axes, tracks: Tracks, styles: Styles, feature: str) -> None:
    """Draw the true error in a feature of one run of each controller; its range is that after the approach."""
    name, _, own = feature.rpartition("_")
    unit, factor = handy_unit(own)
    axes.axhline(0.0, color="0.4", linewidth=0.9)
    reach = 0.0
    for label, track in tracks.items():
        true = track.column(f"true_feature_{feature}")
        desired = track.column(f"reference_{feature}")
        error = factor * (true - desired)
        _draw_values(axes, track, error, label, styles)
        late = np.abs(error[len(error) // 2 :])
        reach = max(reach, float(np.max(late[np.isfinite(late)], initial=0.0)))
    if reach > 0.0:
        reach *= AXIS_ROOM
        if not axes.get_autoscaley_on():  # another panel of the row has set the common range
            low, high = axes.get_ylim()
            reach = max(reach, -low, high)
        axes.set_ylim(-reach, reach)
    axes.set_ylabel(f"error in\n{name} [{unit}]")


def _draw_values(axes: Axes, track: Track, values: FloatArray, name: str, styles: Styles) -> None:
    """Draw values of a run over time, if it has some, and its early end."""
    if np.isfinite(values).any():
        axes.plot(track.time, values, label=name, **styles[name].line_arguments(len(values)))
        if not track.completed:
            mark_end(axes, track.time, values, styles[name])


def mark_settling_band(axes: Axes, runs: Shown) -> None:
    """Draw the error within which a run counts as settled, where the table of runs has it."""
    if math.isfinite(runs.settling_band):
        label = f"settling band, {runs.settling_band:g} {runs.error_unit[0]}"
        axes.axhline(
            runs.settling_band, color="0.4", linewidth=0.9, linestyle=(0, (2, 2)), label=label
        )


def _mark_settling_times(axes: Axes, ensembles: Ensembles, styles: Styles) -> None:
    """Mark below the settling band the median settling time of each controller; equal ones stand side by side."""
    near = NEAR * shown_until(ensembles)
    anchor = -math.inf
    beside = 0  # marks that stand from the anchor on
    settled = [
        (ensemble.settling_time, name)
        for name, ensemble in ensembles.items()
        if math.isfinite(ensemble.settling_time + ensemble.settling_band)
    ]
    for settling_time, name in sorted(settled, key=itemgetter(0)):
        if settling_time >= anchor + beside * near:
            anchor = settling_time
            beside = 0
        style = styles[name]
        place = offset_copy(
            axes.transData,
            axes.get_figure(root=True),
            MARK_SIZE * beside,
            -0.6 * MARK_SIZE,
            units="points",
        )
        axes.plot(
            anchor,
            ensembles[name].settling_band,
            markersize=MARK_SIZE,
            transform=place,
            color=style.colour,
            markeredgecolor=style.colour if style.hollow else "black",
            markeredgewidth=1.4 if style.hollow else 0.6,
            markerfacecolor=style.face,
            gid=SETTLED,
            **MARKS_OF["settled"],
        )
        beside += 1


def draw_joint_motion(tracks: Tracks, until: float, layout: Layout = WIDE) -> Figure | None:
    """Draw the commanded joint motion of one run of each controller until a time [s]; None without commands.

    A long run is shown at its end. A wide layout has room for a metric in each panel.
    """
    shown = {name: track.closing() for name, track in tracks.items()}
    commands = [
        [name for name in track.table.columns if name.startswith(COMMAND)]
        for track in shown.values()
    ]
    columns = max(commands, key=len)
    if not columns:
        return None
    figure = Figure(figsize=(layout.width, 1.2 + max(ROW * len(shown), 1.6)), layout="constrained")
    panels = figure.subplots(len(shown), 3, sharex=True, sharey="col", squeeze=False)
    for line, (name, track) in zip(panels, shown.items(), strict=True):
        for number, column in enumerate(columns):
            _draw_joint(line, track, column, number)
        for axes, (_, metric, form) in zip(line, QUANTITIES, strict=True):
            value = track.row.get(metric)
            if layout.wide and pd.notna(value):
                place = (0.985, 0.93)
                look = {"ha": "right", "va": "top", "color": "black", "fontsize": TEXT - 1.5}
                write_inside(axes, form.format(value), place, bbox=BOX, **look)
        line[0].set_ylabel(
            name.replace(":", ":\n"), rotation=0, ha="right", va="center", fontsize=TEXT - 0.5
        )
    for axes, (title, _, _) in zip(panels[0], QUANTITIES, strict=True):
        axes.set_title(title if layout.wide else title.replace(" [", "\n["))
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")
    if until > 0.0 and not longest(tracks).long:  # a run may end in its first period
        panels[0, 0].set_xlim(-0.02 * until, until)
    figure.align_ylabels(panels[:, 0])
    add_legend(figure, panels[0])
    return figure


def _draw_joint(line: np.ndarray, track: Track, column: str, number: int) -> None:
    """Draw a command and its first and second derivative into the panels of a line."""
    colour, dashes = JOINTS[number % len(JOINTS)]
    values: FloatArray = track.column(column)
    period = float(track.time[1] - track.time[0]) if len(values) > 1 else 1.0
    joint = column.removeprefix(COMMAND).rpartition("_rad_s")[0]
    for order, axes in enumerate(line):
        if len(values) > order:
            derivative = np.diff(values, n=order) / period**order
            axes.plot(
                track.time[order:],
                derivative,
                color=colour,
                linestyle=dashes,
                linewidth=0.9,
                label=joint,
                # A command is held over its period.
                drawstyle="steps-post" if order == 0 else "default",
            )
