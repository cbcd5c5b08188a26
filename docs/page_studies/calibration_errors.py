"""What errors of a calibration cost: a robot that looks and then moves, and servoing with that calibration or none."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import matplotlib as mpl
import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

from page_studies import cells
from page_studies.pictures import small
from page_studies.study import CALIBRATES, Study, Words, settings, sweep
from servobench.harness.analysis.comparison import (
    column_of,
    median_with_interval,
    settled_share,
)
from servobench.harness.batch.results import load_runs
from servobench.harness.run.result import COMPLETED

LOOKS: Final = "./docs/examples/look_then_move.py:LookThenMove"
SERVOES: Final = "regression_mfac"
# From the hash of the last commit that changed code before they were drawn: e3486
SEEDS: Final = "930950:930990"
# Axis of the mismatch -> its title, unit and magnitudes
AXES: Final[Mapping[str, tuple[str, str, tuple[float, ...]]]] = {
    "camera_rotation": ("camera turned by", "deg", (0.5, 1.0, 2.0, 3.0, 10.0, 30.0, 60.0, 90.0)),
    "joint_offsets": ("joint zeros within ±", "deg", (0.1, 0.5, 1.0, 3.0, 10.0, 30.0)),
    "links": ("links within ±", "%", (0.5, 1.0, 2.0, 5.0, 10.0, 30.0)),
    "tool": ("tool within ±", "mm", (5.0, 10.0, 30.0, 100.0)),
}
# Errors as people report them, all axes together, and multiples of them
USUAL: Final = {"camera_rotation": 1.0, "joint_offsets": 0.3, "links": 0.5, "tool": 5.0}
FACTORS: Final = (1.0, 3.0, 10.0, 30.0)
METHODS: Final = {  # part of the study and name there -> title
    ("learning", "LookThenMove"): "look, then move",
    ("kept", SERVOES): "servo with the calibration",
    ("learning", SERVOES): f"`{SERVOES}`",
    ("learning", CALIBRATES): f"`{CALIBRATES}`",
}
ON_CURVES: Final = {
    ("curves_kept", SERVOES): "servo with the calibration",
    ("curves", SERVOES): f"`{SERVOES}`",
    ("curves", CALIBRATES): f"`{CALIBRATES}`",
}
KEPT: Final = settings((f"{SERVOES}.aids.model=nominal",))  # the calibration is not learned from
COLOURS: Final = ("0.2", "tab:orange", "tab:blue", "tab:green")
BAND: Final = 5.0  # [mm] settling band


def words(axis: str, magnitude: float) -> str:
    """Return a mismatch of one axis, as an option takes it."""
    return f"{axis}={magnitude:g}{AXES[axis][1]}"


def together(factor: float) -> str:
    """Return all axes with a multiple of the usual errors."""
    return "+".join(words(axis, factor * size) for axis, size in USUAL.items())


def mismatches() -> dict[str, str]:
    """Return the mismatches with their titles."""
    found = {}
    for axis, (title, unit, magnitudes) in AXES.items():
        for magnitude in magnitudes:
            found[words(axis, magnitude)] = f"{title} {magnitude:g} {unit}"
    for factor in FACTORS:
        sizes = [f"{factor * size:g} {AXES[axis][1]}" for axis, size in USUAL.items()]
        found[together(factor)] = f"all: {', '.join(sizes)}"
    return found


def moves(controllers: tuple[str, ...], *options: str) -> Words:
    """Return the arguments of the sweep of methods over all errors, on moves."""
    every = ",".join(mismatches())
    return sweep("kinematic", controllers, "random", SEEDS, "--mismatch", every, *options)


def curves(controllers: tuple[str, ...], *options: str) -> Words:
    """Return the arguments of the sweep of methods over errors of all axes together, on the circle."""
    every = ",".join(("none", *map(together, FACTORS)))
    return sweep("kinematic", controllers, "circle", SEEDS, "--mismatch", every, *options)


def reached(runs: pd.DataFrame) -> str:
    """Return the median error of the last second [mm] with its interval, and the share of runs that settle."""
    error = cells.millimetres(runs, "steady_state_error")
    return f"{error}, {settled_share(runs).value:.0f} %"


def _runs(folder: Path, methods: Mapping[tuple[str, str], str]) -> dict[str, pd.DataFrame]:
    """Return the runs of each method by its title."""
    parts = {part: load_runs(folder / part) for part, _ in methods}
    found = {}
    for (part, name), title in methods.items():
        runs = parts[part]
        found[title] = runs[runs["controller"] == name]
    return found


def _rows(
    runs: Mapping[str, pd.DataFrame], titles: Mapping[str, str], cell: cells.Cell
) -> pd.DataFrame:
    """Return what each method reaches with each error, a row an error."""
    rows = []
    for mismatch, title in titles.items():
        row = {"error of the calibration": title}
        for method, own in runs.items():
            row[method] = cell(own[own["mismatch"] == mismatch])
        rows.append(row)
    return pd.DataFrame(rows)


def errors_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return what each method reaches with each error on moves, and with those of all axes on the circle."""
    titles = mismatches()
    circle = {"none": "none"} | {each: titles[each] for each in map(together, FACTORS)}
    return {
        "calibration_errors": _rows(_runs(folder, METHODS), titles, reached),
        "calibration_errors_circle": _rows(_runs(folder, ON_CURVES), circle, cells.millimetres),
    }


def errors_picture(folder: Path) -> dict[str, bytes]:
    """Return a picture of the error in the last second over the error of the calibration, a panel an axis."""
    runs = _runs(folder, METHODS)
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    panels = figure.subplots(1, len(AXES), sharey=True)
    for axes, (axis, (title, unit, magnitudes)) in zip(panels, AXES.items(), strict=True):
        for colour, (method, own) in zip(COLOURS, runs.items(), strict=True):
            middle = [
                median_with_interval(
                    1000.0
                    * column_of(part, "steady_state_error").where(part["status"] == COMPLETED)
                )
                for part in (
                    own[own["mismatch"] == words(axis, magnitude)] for magnitude in magnitudes
                )
            ]
            axes.fill_between(
                magnitudes,
                [each.low for each in middle],
                [each.high for each in middle],
                color=colour,
                alpha=0.2,
                linewidth=0.0,
            )
            label = method.replace("`", "")
            values = [each.value for each in middle]
            axes.plot(magnitudes, values, color=colour, marker=".", label=label)
        axes.axhline(BAND, color="0.4", linewidth=0.9, linestyle=(0, (2, 2)))
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.xaxis.set_major_formatter(mpl.ticker.StrMethodFormatter("{x:g}"))
        axes.set_xlabel(f"{title} [{unit}]")
    panels[0].set_ylabel("error of the last second [mm]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=130)
    return {"pictures/calibration_errors.png": small(Image.open(stream))}


CALIBRATION_ERRORS = Study(
    "calibration_errors",
    "what errors of a calibration cost one who looks and then moves, and one who servoes: 40 robots",
    10,
    {
        "learning": moves((LOOKS, SERVOES, CALIBRATES)),
        "kept": moves((SERVOES,), *KEPT),
        "curves": curves((SERVOES, CALIBRATES)),
        "curves_kept": curves((SERVOES,), *KEPT),
    },
    errors_tables,
    errors_picture,
)
