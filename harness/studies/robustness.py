"""The robustness map: one axis of the world made worse at a time, everything else `moderate`, and who still arrives.

Every method meets the same robots, starts and targets at every place of the map. The camera that is moved in the middle
of a run has a longer run, so that there is time to recover.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from servobench.harness.analysis.comparison import settled_share, settling_times
from servobench.harness.analysis.statistics import Estimate, median_with_interval
from servobench.harness.batch import results
from servobench.harness.batch.compare import Batch
from servobench.harness.batch.sweep import Cell, vary
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.harness.pictures.places import draw_places
from servobench.harness.pictures.style import method_styles
from servobench.harness.run.request import RunRequest
from servobench.plant.robot.mismatch import parse_magnitudes

BASE: Final = "moderate"
TASK: Final = "random"
MOVE: Final = "camera_move"
MOVE_DURATION: Final = 20.0  # s, of a run whose camera is moved in its middle


USUAL, MOVED = "usual", "moved"  # folders of a map: runs of usual length, and those whose camera moves


@dataclass(frozen=True)
class Line:
    """An axis of the map.

    Attributes:
        axis: of the mismatch, or "latency" or "noise".
        title: what the reader sees.
        places: magnitudes as written.
    """

    axis: str
    title: str
    places: tuple[str, ...]

    def request(self, request: RunRequest, place: str) -> RunRequest:
        """Return `request` at one place of this axis."""
        if self.axis == "latency":
            return replace(request, latency_periods=int(place))
        if self.axis == "noise":
            return replace(request, noise_factor=float(place))
        return replace(request, mismatch=vary(request.mismatch, self.axis, place))


def _texts(axis: str, text: str) -> tuple[str, ...]:
    return tuple(str(magnitude) for magnitude in parse_magnitudes(axis, text))


LINES: Final = (
    Line("camera_rotation", "camera turned, °", _texts("camera_rotation", "0:180:30deg")),
    Line("links", "link lengths wrong by up to, %", _texts("links", "0:30:10%")),
    Line("joint_offsets", "joint zeros wrong by up to, °", _texts("joint_offsets", "0:20:5deg")),
    Line("tool", "tool wrong by up to, mm", _texts("tool", "0:100:25mm")),
    Line("latency", "camera latency, periods of 50 ms", tuple("012345")),
    Line("noise", "sensor noise, times the usual", ("0", "1", "2", "4", "8")),
    Line(MOVE, "camera moved in mid-run, °", _texts(MOVE, "0:180:45deg")),
)


def map_cells(plant: str, controllers: Sequence[str], seeds: Sequence[int]) -> tuple[list[Cell], list[Cell]]:
    """Return the runs of the map: those of usual length, and those whose camera moves."""
    requests = Batch((plant,), tuple(controllers), (TASK,), (BASE,), tuple(seeds)).requests()
    usual: list[Cell] = []
    moved: list[Cell] = []
    for line in LINES:
        cells = [Cell(line.request(request, place), line.axis, place) for place in line.places for request in requests]
        (moved if line.axis == MOVE else usual).extend(cells)
    return usual, moved


def moved_settings(settings: Settings) -> Settings:
    """Return the settings of the runs whose camera moves; a duration that the user gives stays."""
    task = {"duration": MOVE_DURATION, **settings.sections.get(TASK, {})}
    return Settings({**settings.sections, TASK: task})


def map_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the runs of a map by part; `moved_at_s` says when the camera was moved, NaN where it was not.

    Raises:
        ConfigurationError: not the folder of a map.
    """
    usual, moved = (results.load_runs(folder / part) for part in (USUAL, MOVED))
    configuration = results.read_manifest(folder / MOVED)["configuration"]
    moment = configuration["run"]["camera_moves_at"] * configuration[TASK]["duration"]
    at_rest = moved["magnitude"].map(number_of).astype(float) == 0.0
    return {USUAL: usual, MOVED: moved.assign(moved_at_s=np.where(at_rest, np.nan, moment))}


def draw_map(runs: pd.DataFrame, folder: Path) -> list[Path]:
    """Draw success rates and settling times along all axes, as PNG and PDF.

    Args:
        runs: the table of the map's runs.
        folder: where; made if needed.

    Returns:
        The files.

    Raises:
        ConfigurationError: the table is not that of a map.
    """
    if "axis" not in runs or not set(runs["axis"]) & {line.axis for line in LINES}:
        raise ConfigurationError("the table holds no axis of the robustness map; make one with `servobench robustness`")
    folder.mkdir(parents=True, exist_ok=True)
    return [
        *_draw(runs, folder / "robustness", "Runs that arrived within 5 mm and stayed, %", settled_share, 104.0),
        *_draw(
            runs,
            folder / "robustness_settling",
            "Median settling time (after the move, where the camera moves), s",
            settling_median,
            10.0,
        ),
    ]


def settling_median(runs: pd.DataFrame) -> Estimate:
    """Return the median settling time of `runs`, s, with its bootstrap interval; infinite if half never settle.

    Where the table says when the camera was moved, `moved_at_s`, the time counts from there.
    """
    begin = runs["moved_at_s"].fillna(0.0) if "moved_at_s" in runs else 0.0
    return median_with_interval((settling_times(runs) - begin).clip(lower=0.0))


def _draw(
    runs: pd.DataFrame, stem: Path, title: str, measure: Callable[[pd.DataFrame], Estimate], top: float
) -> list[Path]:
    lines = [line for line in LINES if line.axis in set(runs["axis"])]
    controllers = list(dict.fromkeys(runs["controller"]))
    styles = method_styles(controllers)
    columns = min(4, len(lines))
    rows = -(-len(lines) // columns)
    figure = Figure(figsize=(3.1 * columns, 2.5 * rows + 0.5), layout="constrained")
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes, line in zip(grid.flat, lines, strict=False):
        cells = dict(iter(runs[runs["axis"] == line.axis].groupby(["controller", "magnitude"])))
        values = {name: [measure(cells[name, place]) for place in line.places] for name in controllers}
        draw_places(axes, range(len(line.places)), values, styles, joined=True)
        axes.set_xticks(range(len(line.places)), [number_of(place) for place in line.places])
        axes.set_xlabel(line.title)
        axes.set_ylim(0.0, top)
        axes.grid(visible=True, alpha=0.3)
    for axes in grid.flat[len(lines) :]:
        axes.set_axis_off()
    handles, labels = grid.flat[0].get_legend_handles_labels()
    if len(lines) < grid.size:
        grid.flat[-1].legend(handles, labels, loc="center", frameon=False, fontsize=11)
    else:
        figure.legend(handles, labels, loc="outside lower center", ncols=len(controllers), frameon=False)
    robots, plant = runs["seed"].nunique(), runs["plant"].iloc[0]
    figure.suptitle(f"{title}: {robots} robots a point on {plant}, bars are 95 % intervals")
    files = [stem.with_suffix(suffix) for suffix in (".png", ".pdf")]
    for file in files:
        figure.savefig(file, dpi=150)
    return files


def number_of(place: str) -> str:
    """Return a magnitude without its unit."""
    return re.sub(r"[a-z%]+$", "", place)
