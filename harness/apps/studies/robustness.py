"""The robustness map: success and settling time along axes, each varied by itself from a `moderate` mismatch.

Every method gets the same robots, starts and targets at every place of the map. Runs whose camera is moved half-way
take longer, so that there is time to recover. The usual map has the axes `LINES`; a user names others.
"""

import csv
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from servobench.harness.analysis import comparison
from servobench.harness.apps.figures import style
from servobench.harness.apps.figures.measures import Curves, draw_curves, same_curves
from servobench.harness.apps.loops.loop_analysis import latency_border
from servobench.harness.batch.campaign import Campaign, Execution, carry_out
from servobench.harness.batch.plan import Batch, Cell, Grid, Place
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.registry import RENDERED, find_controller, find_plant
from servobench.harness.config.settings import Settings, default_config
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.variations import Varied
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import write_atomically
from servobench.plant.contract.settings import remark, suggest
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.catalogue import DEFAULT_ROBOT, find_robot
from servobench.plant.robot.mismatch import Magnitude, parse_magnitudes

BASE = "moderate"
TASK = "random"
DURATION = "task.duration"
LONGER: Varied = ((DURATION, 20.0),)  # [s], settings of a run whose camera is moved half-way
FIGURES = "figures"
LIMITS = "predicted_limits.csv"
NOTE = 115  # letters on a line of the notes below the title
MOVE = "camera_move"
LATENCY = "latency"
NOISE = "noise"
Measure: TypeAlias = Callable[
    [pd.DataFrame], comparison.Estimate
]  # a number from the runs at a place


@dataclass(frozen=True)
class Line:
    """An axis of the map."""

    axis: str  # an axis of the mismatch, the sensor's among them, or "latency" or "noise"
    title: str  # label of the axis
    places: tuple[Magnitude, ...]  # its magnitudes
    usual: bool = False  # whether it belongs to the usual map


def _read_lines() -> dict[str, Line]:
    """Return the axes of `lines.csv` by name."""
    table = (files("servobench.harness.apps.studies") / "lines.csv").read_text(encoding="utf-8")
    lines = {}
    for row in csv.DictReader(table.splitlines()):
        axis = row["axis"]
        if axis in (LATENCY, NOISE):
            numbers = map(float, row["places"].split("/"))
            places = tuple(Magnitude(number, row["unit"]) for number in numbers)
        else:
            places = parse_magnitudes(axis, row["places"])
        lines[axis] = Line(axis, row["title"], places, row["usual"] == "yes")
    return lines


KNOWN_LINES = _read_lines()
LINES = tuple(line for line in KNOWN_LINES.values() if line.usual)


def find_lines(axes: Sequence[str]) -> tuple[Line, ...]:
    """Return the axes of those names, in the order of the map; all of the usual map for none.

    Raises:
        ConfigurationError: an unknown name.
    """
    for axis in axes:
        if axis not in KNOWN_LINES:
            raise ConfigurationError(f"the map has no axis {axis!r}: {suggest(axis, KNOWN_LINES)}")
    return tuple(line for line in KNOWN_LINES.values() if line.axis in axes) or LINES


def map_cells(batch: Batch, lines: Sequence[Line] = LINES, moving: Varied = LONGER) -> Grid[Cell]:
    """Return the runs of the map; those whose camera is moved have the settings `moving`."""

    def cell(place: Place, request: RunRequest) -> Cell:
        """Return the run of a request at a place: latency and noise are settings, all else is mismatch."""
        number = 0.0 if place.magnitude is None else place.magnitude.number
        varied: Varied = ()
        mismatch = request.mismatch
        if place.axis == LATENCY:
            varied = ((LATENCY, number / 1000.0),)
        elif place.axis == NOISE:
            varied = ((NOISE, number),)
        else:
            mismatch = place.vary(mismatch)
        if place.axis == MOVE:
            varied = moving
        return Cell(replace(request, mismatch=mismatch, varied=varied), place.columns)

    places = [Place(line.axis, magnitude) for line in lines for magnitude in line.places]
    return Grid(cell, places, batch.requests())


def make_map(
    out: Path, batch: Batch, settings: Settings, how: Execution, lines: Sequence[Line] = LINES
) -> list[Path]:
    """Carry out the runs of a map, put its tables together and draw it.

    Args:
        out: folder of the map.
        batch: its runs at one place, of the task `TASK` with the mismatch `BASE`, none on a twin.
        settings: overrides of the defaults.
        how: how the runs are carried out.
        lines: its axes.

    Returns:
        The files of the pictures.

    Raises:
        ConfigurationError: a plant with a robot of its own, or runs that `carry_out` refuses.
    """
    (plant,) = batch.plants
    if find_plant(plant).own_robot:
        raise ConfigurationError(
            f"the map varies the true robot, and plant {plant} brings one of its own"
        )
    # A duration that a user gives is kept
    moving = () if "duration" in settings.sections.get(TASK, {}) else LONGER
    carry_out(Campaign(map_cells(batch, lines, moving), settings), out, how)
    has_model = plant not in RENDERED and find_robot(batch.robot).twin is None
    has_usual_camera = batch.sensings == (DEFAULT_SENSING,)
    varies_latency = any(line.axis == LATENCY for line in lines)
    limits = {}
    if has_model and has_usual_camera and varies_latency:
        limits = predicted_limits(batch.controllers, settings, batch.robot, plant)
    column = pd.Series(limits, name="predicted_latency_limit_s")
    write_atomically(out / LIMITS, partial(column.to_csv, index_label="controller"))
    return draw_map(map_runs(ResultsFolder(out)), out / FIGURES, limits)


def predicted_limits(
    controllers: Sequence[str],
    settings: Settings,
    robot: str = DEFAULT_ROBOT,
    plant: str = "kinematic",
) -> dict[str, float]:
    """Return from which latency on the loop of each composed controller is predicted to be unstable, in s.

    The prediction is that of small motions of the nominal robot without mismatch, of the plant `kinematic` with those
    settings of `plant` that it has, too. A remark names the methods that cannot be predicted.
    """
    known = {field.name for field in fields(KinematicConfig)}
    own = {key: value for key, value in settings.sections.get(plant, {}).items() if key in known}
    latencies = [place.number / 1000.0 for place in KNOWN_LINES[LATENCY].places]
    run = settings.resolve("run", RunSettings())
    config = Settings({plant: own}).resolve(plant, KinematicConfig())
    model_known = find_robot(robot).known
    limits = {}
    for name in controllers:
        entry = find_controller(name)
        if entry.side_by_side:
            method = settings.resolve(name, default_config(entry, model_known=model_known))
            try:
                limits[name] = latency_border(method, name, latencies, run, config, robot)
            except ConfigurationError as error:
                remark(f"no latency limit is predicted for {name}: {error}")
    return limits


def map_runs(folder: ResultsFolder) -> pd.DataFrame:
    """Return the runs of a map; `moved_at_s` says when the camera was moved, NaN where it was not.

    Raises:
        ConfigurationError: not the folder of a map.
    """
    runs = folder.runs()
    configuration = folder.configuration
    durations = comparison.column_of(runs, DURATION).fillna(configuration[TASK]["duration"])
    share = configuration["run"]["camera_moves_at"]  # [1] of a run's duration
    is_moved = (runs["axis"] == MOVE) & (runs["magnitude"] > 0.0)
    return runs.assign(moved_at_s=(share * durations).where(is_moved))


def draw_map(runs: pd.DataFrame, folder: Path, limits: Mapping[str, float]) -> list[Path]:
    """Draw success rates and settling times along all axes, as PNG and PDF.

    Args:
        runs: the table of the map's runs.
        folder: folder of the files; made if needed.
        limits: predicted limits of the latency by method, see `predicted_limits`.

    Returns:
        The files.
    """
    arrived = f"Runs that came within {comparison.settling_band(runs)} and stayed"
    took = "Median settling time, from the move where the camera moves"
    share = _draw(runs, limits, comparison.settled_share, arrived, "settled runs [%]", 104.0)
    time = _draw(runs, limits, settling_median, took, "settling time [s]", 10.0)
    files = style.save_figure(share, folder / "robustness")
    return files + style.save_figure(time, folder / "robustness_settling")


def settling_median(runs: pd.DataFrame) -> comparison.Estimate:
    """Return the median settling time of `runs`, s, with its bootstrap interval; infinite if half never settle.

    Where the camera was moved, `moved_at_s`, the time counts from there.
    """
    times = comparison.settling_times(runs) - runs["moved_at_s"].fillna(0.0)
    return comparison.median_with_interval(times.clip(lower=0.0))


def _draw(
    runs: pd.DataFrame,
    limits: Mapping[str, float],
    measure: Measure,
    title: str,
    label: str,
    top: float,
) -> Figure:
    """Draw a measure of the runs at each place of the map, with a title, its label and the upper edge of the panels."""
    styles = style.method_styles(list(dict.fromkeys(runs["controller"])))
    curves = _curves(runs, measure)
    # An axis along which all methods have one value at all places says nothing; it is named, not drawn.
    flat = [
        axis
        for axis, each in curves.items()
        if len(same_curves(each)) == 1 and len(_values(each)) == 1
    ]
    some_flat = 0 < len(flat) < len(curves)
    lines = [KNOWN_LINES[axis] for axis in curves if not (some_flat and axis in flat)]
    with style.figure_style(style.TEXT):
        figure, panels = style.panel_grid(len(lines), 1.9, head=1.5)
        for axes, line in zip(panels, lines, strict=True):
            numbers = [place.number for place in line.places]
            draw_curves(axes, numbers, curves[line.axis], styles, top)
            axes.set_xticks(numbers)
            axes.set_xlabel(line.title)
            if line.axis == LATENCY and limits:
                _mark_limits(axes, line, limits, styles)
        style.label_rows(panels, label)
        notes = [f"{_robots_in_words(runs)}, bands are 95 % intervals"]
        if some_flat:
            notes.append(_name_flat(flat, curves))
        if any(np.isinf(value) for each in curves.values() for value in _values(each)):
            notes.append("carets at the upper edge: half of the runs or more never settle")
        words = "\n".join(textwrap.fill(note, NOTE) for note in notes)
        figure.suptitle(f"{title}\n{words}", fontsize=style.TEXT + 0.5)
        style.add_legend(figure, panels)
    return figure


def _curves(runs: pd.DataFrame, measure: Measure) -> dict[str, Curves]:
    """Return a measure of the runs at each place of each axis, by axis and method."""
    controllers = list(dict.fromkeys(runs["controller"]))
    known = set(runs["axis"])
    curves: dict[str, Curves] = {}
    for axis, line in KNOWN_LINES.items():
        if axis in known:
            cells = dict(iter(runs[runs["axis"] == axis].groupby(["controller", "magnitude"])))
            numbers = [place.number for place in line.places]
            curves[axis] = {
                name: [measure(cells[name, number]) for number in numbers] for name in controllers
            }
    return curves


def _values(curves: Curves) -> set[float]:
    """Return the different values of all methods along an axis."""
    return {estimate.value for estimates in curves.values() for estimate in estimates}


def _robots_in_words(runs: pd.DataFrame) -> str:
    """Return how many robots of which kind each point of the map has."""
    arm = runs["robot"].iloc[0]
    kind = "robots" if arm == DEFAULT_ROBOT else Path(arm).stem
    return f"{runs['seed'].nunique()} {kind} a point on {runs['plant'].iloc[0]}"


def _name_flat(flat: Sequence[str], curves: Mapping[str, Curves]) -> str:
    """Return a sentence on the axes along which nothing differs."""
    found = next(iter(curves[flat[0]].values()))[0]
    ends = []
    for axis in flat:
        line = KNOWN_LINES[axis]
        # The unit in the title, " [mm]", becomes the last magnitude with it, " 100 mm".
        ends.append(re.sub(r" \[(.*)\]", rf" {line.places[-1].number:g} \1", line.title))
    return (
        f"not drawn, as every method has {found.value:g} (interval from {found.low:.0f}) throughout: "
        f"{'; '.join(ends)}"
    )


def _mark_limits(axes: Axes, line: Line, limits: Mapping[str, float], styles: style.Styles) -> None:
    """Draw a vertical line where each method is predicted to become unstable, if that is on the axis."""
    last = line.places[-1].number
    drawn = []
    for name, limit in limits.items():
        at = 1000.0 * limit  # [ms]
        if name in styles and at <= last:
            look = styles[name]
            axes.axvline(at, color=look.colour, linestyle=look.line, linewidth=1.6, alpha=0.6)
            drawn.append(name)
    if not drawn:
        return
    words = f"upright: predicted limit of stability of {', '.join(drawn)}"
    if len(drawn) < len(limits):
        words += ", others beyond"
    axes.set_xlabel(f"{line.title}\n{textwrap.fill(words, NOTE // 3)}")
