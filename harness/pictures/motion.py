"""How joints are driven: commanded speed, acceleration and jerk of every joint, a row a controller."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from servobench.harness.pictures.panels import add_legend
from servobench.harness.pictures.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, TEXT, VERMILION, WIDE, Layout
from servobench.harness.pictures.tracks import Track, Tracks, each, longest
from servobench.plant.contract.checks import FloatArray

COMMAND: Final = "joint_velocity_command_"
JOINTS: Final = (
    (BLUE, "-"),
    (VERMILION, (0, (4, 1))),
    (GREEN, "-."),
    (ORANGE, (0, (6, 1, 1, 1))),
    (PURPLE, (0, (2, 1))),
    (SKY, "-"),
    (BLACK, ":"),
)  # looks of joints in their order
ROW: Final = 0.72  # [in] a controller
QUANTITIES: Final = ("joint speed [rad/s]", "acceleration [rad/s²]", "jerk [rad/s³]")


def draw_joint_motion(tracks: Tracks, until: float, layout: Layout = WIDE) -> Figure | None:
    """Draw what one run of each controller asks of the joints; None without commands.

    Args:
        tracks: controller -> run.
        until: the time at which the figure ends [s]; a long run is shown at its end.
        layout: of the figure; three columns need a wide one.
    """
    shown = each(Track.closing, tracks)
    columns = max(([n for n in track.table.columns if n.startswith(COMMAND)] for track in shown.values()), key=len)
    if not columns:
        return None
    height = 1.2 + max(ROW, 1.6 / len(shown)) * len(shown)
    figure = Figure(figsize=(layout.width, height), layout="constrained")
    panels = figure.subplots(len(shown), 3, sharex=True, sharey="col", squeeze=False)
    for line, (name, track) in zip(panels, shown.items(), strict=True):
        for number, column in enumerate(columns):
            _draw_joint(line, track, column, number)
        for axes, words in zip(line, _words(track), strict=True):
            axes.text(0.985, 0.93, words, transform=axes.transAxes, ha="right", va="top", fontsize=TEXT - 1.5,
                      bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.0})  # fmt: skip
        line[0].set_ylabel(name.replace(":", ":\n"), rotation=0, ha="right", va="center", fontsize=TEXT - 0.5)
    for axes, title in zip(panels[0], QUANTITIES, strict=True):
        axes.set_title(title)
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")
    if not longest(tracks).long:
        panels[0, 0].set_xlim(-0.02 * until, until)
    figure.align_ylabels(panels[:, 0])
    add_legend(figure, panels[0])
    return figure


def _draw_joint(line: np.ndarray, track: Track, column: str, number: int) -> None:
    colour, dashes = JOINTS[number % len(JOINTS)]
    look = {"color": colour, "linestyle": dashes, "linewidth": 0.9}
    values: FloatArray = track.column(column)
    period = float(track.time[1] - track.time[0]) if len(values) > 1 else 1.0
    label = column.removeprefix(COMMAND).rpartition("_rad_s")[0]
    for order, axes in enumerate(line):
        draw: Callable[..., object] = axes.step if order == 0 else axes.plot
        extra = {"where": "post"} if order == 0 else {}
        if len(values) > order:
            draw(track.time[order:], np.diff(values, n=order) / period**order, label=label, **look, **extra)


def _words(track: Track) -> list[str]:
    """Return what stands in each panel of a run."""
    numbers = [
        track.row.get(name) for name in ("command_switches", "joint_acceleration_rms_rad_s2", "joint_jerk_rms_rad_s3")
    ]
    forms = ("{:.0f} sign switches", "RMS {:.3g}", "RMS {:.3g}")
    return ["" if n is None or np.isnan(n) else form.format(n) for n, form in zip(numbers, forms, strict=True)]
