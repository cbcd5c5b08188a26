"""One self-contained page about a twin: intervals, what its log leaves open, residuals, and where it is sure.

It has the style and the tables of the report on a results folder, and loads nothing.
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from servobench.controllers.methods import PUBLISHED
from servobench.harness.apps.figures.style import (
    COLOURS,
    JOINTS,
    NARROW,
    TEXT,
    WIDE,
    Layout,
    Look,
    add_legend,
    drawing_of,
    figure_style,
    label_rows,
    panel_grid,
)
from servobench.harness.apps.report.page import Picture, page_asset, page_policy, page_template
from servobench.harness.apps.twin.identification import whitened
from servobench.harness.apps.twin.log import Log
from servobench.harness.apps.twin.summary import Answer, estimates, handy, held_out_line, remarks
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.files import write_text
from servobench.plant.contract.signals import BoolArray
from servobench.plant.robot.twin import deviated

TEMPLATE = "twin.html.j2"
OWN = Path(__file__).parent
LONG_TABLE = 100  # rows; of a table that has more, the page shows a line that opens it
BINS = 20  # parts of time and of each joint's range
POSTURES = 1500  # for which the page says how sure the twin is
REGION = 2.0  # [1] range of their joints over that of the log
STEP = 1e-4  # [1] part of a deviation, with which derivatives are taken
PANEL = 2.1  # [in] height of a panel
MIN_IN_BIN = 5  # frames
AXIS_ROOM = 4.5  # [1] half of the height of a panel over the deviation of residuals
PLANES = (("x", "y"), ("x", "z"))  # in the base frame
DRAWN: Look = {"linestyle": "", "marker": ".", "markersize": 2.0}


class Region(NamedTuple):
    """How sure a twin is of the features of some postures."""

    ball: FloatArray  # places of the ball in the base frame, (k, 3) m
    deviation: FloatArray  # how far features may be off, (k,) [unit of the feature]


def write_page(answer: Answer, path: Path) -> None:
    """Write the page of a twin."""
    style = page_asset("report.css")
    template = page_template(TEMPLATE, OWN)
    template.globals.update(long_table=LONG_TABLE, published=PUBLISHED, tuned={}, region=REGION)
    unit, scale = handy(answer.log)
    logged = region_of(answer, answer.log.joints[answer.robot.rows])
    wide = region_of(answer, postures_about(answer.log))
    usual_there = scale * np.median(logged.deviation)
    usual = scale * np.median(wide.deviation)
    largest = scale * np.quantile(wide.deviation, 0.95)
    held = held_out_line(answer.log, answer.held)
    lines = remarks(answer.log, answer.robot, answer.response)
    table = estimates(answer.robot, answer.response)
    pictures = _pictures(answer, wide)
    policy = page_policy(style, [])
    text = template.render(
        title=answer.title,
        source=Path(answer.source).name,
        policy=policy,
        style=Markup(style),
        table=table,
        held=held,
        remarks=lines,
        pictures=pictures,
        unit=unit,
        sure=f"{usual_there:.2g}",
        wide=f"{usual:.2g}",
        worst=f"{largest:.2g}",
    )
    write_text(path, text)


def postures_about(log: Log) -> FloatArray:
    """Return postures in a region `REGION` times as wide as that of a log, within the limits, (k, n) rad."""
    lowest = log.joints.min(axis=0)
    highest = log.joints.max(axis=0)
    half = 0.5 * REGION * (highest - lowest)
    shares = np.random.default_rng(0).uniform(-1.0, 1.0, (POSTURES, log.joints.shape[1]))
    drawn = 0.5 * (lowest + highest) + half * shares
    return np.clip(drawn, log.spec.joint_lower, log.spec.joint_upper)


def region_of(answer: Answer, joints: FloatArray) -> Region:
    """Return the deviation of the feature at postures (k, n) rad that the uncertainty of θ leaves.

    It is √tr(H C Hᵀ), with C the covariance of the posterior and H = ∂h/∂θ by differences along its principal axes.
    """
    robot = answer.robot
    model = answer.nominal.with_camera(robot.pose)
    static = {n: v for n, v in robot.values_by_name().items() if not n.startswith("camera")}
    feature = deviated(model, static).feature(joints)
    sizes, axes = np.linalg.eigh(robot.covariance)
    variance = np.zeros(len(joints))
    for size, axis in zip(sizes, axes.T, strict=True):
        step = STEP * np.sqrt(max(float(size), 0.0)) * axis
        changed = dict(static)
        for name, own in zip(robot.names, step.tolist(), strict=True):
            changed[name] = static.get(name, 0.0) + own
        moved = deviated(model, changed).feature(joints) - feature
        variance += np.sum((moved / STEP) ** 2, axis=-1)
    ball = deviated(model, static).arm.ball_position(joints)
    return Region(ball, np.sqrt(variance))


def _pictures(answer: Answer, region: Region) -> list[Picture]:
    """Return the figures of the page, each for a wide and for a narrow one."""
    drawings = {
        "time": ("Residuals over time", partial(_over_time, answer)),
        "posture": ("Residuals over each joint", partial(_over_posture, answer)),
        "region": ("Where the twin is sure", partial(_over_region, answer, region)),
    }
    pictures = []
    with figure_style(TEXT):
        for kind, (title, draw) in drawings.items():
            wide = drawing_of(draw(WIDE), WIDE)
            narrow = drawing_of(draw(NARROW), NARROW)
            pictures.append(Picture(kind, title, (), wide, narrow))
    return pictures


def _over_time(answer: Answer, layout: Layout) -> Figure:
    """Draw the residuals of each feature over time, with the window that was held out."""
    log = answer.log
    robot = answer.robot
    unit, scale = handy(log)
    figure, panels = panel_grid(log.spec.m, PANEL, layout)
    time = log.time[robot.rows]
    for axes, name, own in zip(panels, log.spec.feature_names, robot.residuals.T, strict=True):
        axes.set_title(name)
        axes.set_xlabel("time [s]")
        _draw_binned(axes, time, scale * own[:, None], robot.inliers)
        if answer.held is not None:
            axes.axvspan(
                answer.held.begin,
                answer.held.end,
                color=COLOURS["orange"],
                alpha=0.15,
                label="held out",
            )
    label_rows(panels, f"residual [{unit}]")
    add_legend(figure, panels)
    return figure


def _over_posture(answer: Answer, layout: Layout) -> Figure:
    """Draw the whitened residuals over the position of each joint."""
    log = answer.log
    robot = answer.robot
    white = whitened(robot.residuals, robot.noise)
    figure, panels = panel_grid(log.spec.n, PANEL, layout)
    joints = np.degrees(log.joints[robot.rows])
    for axes, name, own in zip(panels, log.spec.joint_names, joints.T, strict=True):
        axes.set_title(name)
        axes.set_xlabel("position [°]")
        _draw_binned(axes, own, white, robot.inliers)
        axes.locator_params(axis="x", nbins=4)
    label_rows(panels, "residual [deviations]")
    add_legend(figure, panels)
    return figure


def _draw_binned(axes: Axes, x: FloatArray, residuals: FloatArray, inliers: BoolArray) -> None:
    """Draw residuals (k, c) over x (k,), and the mean of each component in parts of x with its interval of 95 %."""
    axes.plot(x[inliers], residuals[inliers], color="0.75", **DRAWN)
    (mark, *_) = axes.plot(x[~inliers], residuals[~inliers], color=COLOURS["vermilion"], **DRAWN)
    mark.set_label("outlier")
    height = AXIS_ROOM * float(np.std(residuals[inliers]))
    axes.set_ylim(-height, height)
    edges = np.linspace(x.min(), x.max(), BINS + 1)
    places = np.clip(np.digitize(x, edges) - 1, 0, BINS - 1)
    parts = [residuals[(places == part) & inliers] for part in range(BINS)]
    kept = [part for part in range(BINS) if len(parts[part]) >= MIN_IN_BIN]
    middles = 0.5 * (edges[:-1] + edges[1:])[kept]
    means = np.array([parts[part].mean(axis=0) for part in kept])
    halves = np.array([1.96 * parts[part].std(axis=0) / len(parts[part]) ** 0.5 for part in kept])
    components = zip(means.T, halves.T, JOINTS, strict=False)
    for number, (mean, half, (colour, _)) in enumerate(components, start=1):
        label = "mean of a part, ± 95 %"
        if len(means.T) > 1:
            label = f"mean of component {number}, ± 95 %"
        axes.errorbar(middles, mean, half, color=colour, linewidth=1.0, label=label)


def _over_region(answer: Answer, region: Region, layout: Layout) -> Figure:
    """Draw the deviation of the feature over the place of the ball, in two planes of the base frame."""
    unit, scale = handy(answer.log)
    rows = answer.robot.rows
    path = answer.nominal.arm.ball_position(answer.log.joints[rows])
    order = np.argsort(region.deviation)
    height = 2.0 * PANEL
    columns = min(layout.columns, len(PLANES))
    figure = Figure(
        figsize=(layout.width, 0.3 + height * (len(PLANES) // columns)), layout="constrained"
    )
    panels = figure.subplots(len(PLANES) // columns, columns, squeeze=False).ravel()
    drawn: Any = None
    for axes, plane in zip(panels, PLANES, strict=True):
        i, j = ("xyz".index(letter) for letter in plane)
        drawn = axes.scatter(
            *region.ball[order][:, [i, j]].T,
            c=scale * region.deviation[order],
            s=7.0,
            norm=LogNorm(),
            cmap="viridis",
        )
        axes.plot(path[:, i], path[:, j], color="black", linewidth=0.4, label="the log")
        axes.set_xlabel(f"{plane[0]} of the base [m]")
        axes.set_ylabel(f"{plane[1]} of the base [m]")
        axes.set_aspect("equal", adjustable="datalim")
    side = "right" if layout.wide else "bottom"
    bar = figure.colorbar(
        drawn,
        ax=list(panels),
        location=side,
        label=f"deviation of the predicted feature [{unit}]",
        ticks=LogLocator(subs=(1.0, 2.0, 5.0)),
        format="%g",
    )
    bar.ax.minorticks_off()
    add_legend(figure, panels)
    return figure
