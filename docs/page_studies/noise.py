"""The study of Leite, Araújo and Martins (Sensors 23 (2023) 8518): Jacobian filters under five families of noise.

Their settings are kept: gain 0.2 per second, 15 s, 20 Hz, 100 episodes a level, a first Jacobian that is right, and
noise that is white, a mixture, bimodal, stable or uniform, of deviation, scale or width 1 px, displaced by 20 px. What
differs: uniform noise is centred; the moves; and in the first set-up of `SETUPS` the arm and the feature, with a size
for 1 px. The second one has their UR10, the camera in its hand and four circles, in pixels. Their measures are of the
error of the features over time; here it is the RMS error over the run, of the true feature, over that of a run with the
same noise and the true Jacobian, so that neither the length of a move nor what the law does with the noise hides the
filters.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from page_studies.study import Study, Words, settings, sweep
from servobench.harness.apps.figures import style
from servobench.harness.apps.figures.style import COLOURS
from servobench.harness.batch.results import load_runs
from servobench.harness.run.result import COMPLETED
from servobench.plant.cameras.registry import Sensing
from servobench.plant.robot.catalogue import find_robot

LAW: Final = "pid"
REFERENCE: Final = "true"
ESTIMATORS: Final = {
    "kalman": COLOURS["blue"], "mckf": COLOURS["orange"], "imcckf": COLOURS["sky"],
    "gmckf": COLOURS["purple"], "rmckf": COLOURS["green"], "robust": COLOURS["vermilion"],
    "constant": COLOURS["grey"], REFERENCE: COLOURS["black"],
}  # fmt: skip
"""Those that are compared, with their colours: the Kalman filter, the correntropy filters, and two bounds."""
GAIN: Final = 0.2  # [1/s]
DURATION: Final = 15.0  # [s]
DISPLACED: Final = 20.0  # [px] by which mixture and bimodal noise is displaced
SEEDS: Final = "60000:60100"
LEVELS: Final = {
    "white": "",
    "mixture": "0:20:5%",
    "bimodal": "0:20:5%",
    "stable": "1:2:0.25",
    "uniform": "",
}
"""What is varied of each family; theirs were twelve levels between the same bounds."""
DEVIATIONS: Final = {"stable": math.sqrt(2.0), "uniform": math.sqrt(1.0 / 12.0)}
"""[px] of the families whose deviation is not 1: of scale 1, and of width 1."""
TITLES: Final = {
    "mixture": "share of the noise that is displaced [%]",
    "bimodal": "share of the noise that is displaced to either side [%]",
    "stable": "exponent α of stable noise",
}
GROUP: Final = 0.84  # width of the boxes of a level


class SetUp(NamedTuple):
    """A sensing set-up in which the study is carried out."""

    study: str  # name of the study, of its first table and of its picture
    errors: str  # name of its table of the Jacobian's errors
    pixel: float  # size of 1 px of the original, in the unit of settings of noise
    options: Words = ()  # of the sweep, which choose it
    where: str = ""  # the set-up in words, after the purpose of the study


POSITION: Final = SetUp("noise", "noise_jacobian", 0.001)
UR10: Final = find_robot("ur10")
FOUR_CIRCLES: Final = Sensing.parse("plate:hand")
PLATE: Final = SetUp(
    "noise_plate",
    "noise_plate_jacobian",
    1.0 / FOUR_CIRCLES.nominal(UR10).noise_unit,
    ("--robot", UR10.name, "--sensing", str(FOUR_CIRCLES)),
    ", on their arm and in pixels",
)
"""As in the original: a UR10, the camera in its hand, four circles, pixels."""
SETUPS: Final = (POSITION, PLATE)


class Measure(NamedTuple):
    """What a column of the figure shows."""

    column: str  # of the runs
    title: str
    ticks: tuple[float, ...]  # of the logarithmic axis, which they span


MEASURES: Final = (
    Measure(
        "ratio", "RMS error of a run over that with the true Jacobian", (0.95, 1.0, 1.1, 1.2, 1.5)
    ),
    Measure(
        "jacobian_error_mean",
        "relative error of the Jacobian",
        (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0),
    ),
)


def family_sweep(setup: SetUp, family: str) -> Words:
    """Return the sweep of one family of noise over its levels."""
    names = [f"{LAW}+{estimator}" for estimator in ESTIMATORS]
    size = DEVIATIONS.get(family, 1.0) * setup.pixel
    changes = [
        f"random.duration={DURATION:g}",
        *(
            [] if LEVELS[family] else [f'kinematic.sensing.noise="{family}"']
        ),  # an axis that is varied sets it
        f"kinematic.sensing.feature_noise={size:.6g}",
        f"kinematic.sensing.noise_offset={DISPLACED * setup.pixel:g}",
        *(f"{name}.law.proportional_gain={GAIN:g}" for name in names),
    ]
    vary = ("--vary", f"{family}={LEVELS[family]}") if LEVELS[family] else ()
    return sweep(
        "kinematic",
        names,
        "random",
        SEEDS,
        "--mismatch",
        "none",
        *vary,
        *settings(changes),
        *setup.options,
    )


def ratios(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the runs of each family with `ratio`, of their RMS error to that with the true Jacobian."""
    found = {}
    for family in LEVELS:
        runs = load_runs(folder / family)
        runs["estimator"] = runs["controller"].str.removeprefix(f"{LAW}+")
        runs["level"] = runs["magnitude"].fillna(0.0)
        best = runs[runs["estimator"] == REFERENCE].set_index(["level", "seed"])["rms_error"]
        ratio = (
            runs["rms_error"]
            / best.loc[list(zip(runs["level"], runs["seed"], strict=True))].to_numpy()
        )
        found[family] = runs.assign(ratio=ratio.where(runs["status"] == COMPLETED, math.inf))
    return found


def tables(setup: SetUp, folder: Path) -> Mapping[str, pd.DataFrame]:
    """Return median and 95th percentile of the ratio, and the median error of the Jacobian, a row a level."""
    ratio_rows, error_rows = [], []
    for family, runs in ratios(folder).items():
        for level, own in runs.groupby("level"):
            place = {
                "noise": family,
                "level": f"{level:g} {own['unit'].iloc[0]}".strip() if LEVELS[family] else "",
            }
            cells = {
                name: own[own["estimator"] == name] for name in ESTIMATORS if name != REFERENCE
            }
            ratio_rows.append(
                place | {f"`{name}`": spread(each["ratio"]) for name, each in cells.items()}
            )
            errors = {
                f"`{name}`": f"{each['jacobian_error_mean'].median():.2f}"
                for name, each in cells.items()
            }
            error_rows.append(place | errors)
    return {setup.study: pd.DataFrame(ratio_rows), setup.errors: pd.DataFrame(error_rows)}


def spread(values: pd.Series) -> str:
    """Return median and 95th percentile as one text."""
    median, high = values.quantile([0.5, 0.95], interpolation="higher")
    return f"{median:.2f} ({high:.2f})".replace("inf", "∞")


def pictures(setup: SetUp, folder: Path) -> dict[str, bytes]:
    """Return the box plots."""
    stream = io.BytesIO()
    with style.figure_style(style.TEXT):
        boxes(ratios(folder)).savefig(stream, format="png", dpi=140)
    return {f"pictures/{setup.study}.png": stream.getvalue()}


def boxes(runs: Mapping[str, pd.DataFrame]) -> Figure:
    """Draw box plots over the levels of each family, a colour an estimator: the error, and that of the Jacobian."""
    shown = {name: colour for name, colour in ESTIMATORS.items() if name != REFERENCE}
    rows = {
        title: {f"{level:g}": own for level, own in runs[family].groupby("level")}
        for family, title in TITLES.items()
    } | {"white and uniform noise": {family: runs[family] for family in ("white", "uniform")}}
    figure = Figure(figsize=(style.WIDTH, 8.0), layout="constrained")
    grid = figure.subplots(len(rows), len(MEASURES), sharey="col")
    for panels, (title, groups) in zip(grid, rows.items(), strict=True):
        for axes, measure in zip(panels, MEASURES, strict=True):
            draw_groups(axes, groups, shown, measure)
            axes.set_xlabel(title)
    for axes, measure in zip(grid[0], MEASURES, strict=True):
        axes.set_title(measure.title)
    patches = [Patch(color=colour, label=name) for name, colour in shown.items()]
    figure.legend(handles=patches, loc="outside upper center", ncols=len(patches))
    return figure


def draw_groups(
    axes: Axes, groups: Mapping[str, pd.DataFrame], shown: Mapping[str, str], measure: Measure
) -> None:
    """Draw a group of boxes for each level; whiskers reach from the 5th to the 95th percentile."""
    width = GROUP / len(shown)
    for i, (name, colour) in enumerate(shown.items()):
        values = [
            own.loc[own["estimator"] == name, measure.column].clip(upper=1e3)
            for own in groups.values()
        ]
        places = np.arange(len(groups)) + (i - (len(shown) - 1) / 2.0) * width
        axes.boxplot(
            values, positions=places, widths=0.8 * width, whis=(5, 95), sym="", manage_ticks=False, patch_artist=True,
            boxprops={"facecolor": colour, "edgecolor": colour}, whiskerprops={"linewidth": 0.8, "color": colour},
            capprops={"linewidth": 0.8, "color": colour}, medianprops={"color": "black", "linewidth": 1.0},
        )  # fmt: skip
    axes.set_xticks(range(len(groups)), list(groups))
    axes.set(
        yscale="log",
        ylim=measure.ticks[:: len(measure.ticks) - 1],
        xlim=(-0.55, len(groups) - 0.45),
    )
    axes.set_yticks(measure.ticks, [f"{tick:g}" for tick in measure.ticks])
    axes.minorticks_off()


NOISE_STUDIES: Final = tuple(
    Study(
        setup.study,
        "filters of the Jacobian under noise of five families, 100 episodes a level, as Leite and others did it"
        + setup.where,
        1,
        {family: family_sweep(setup, family) for family in LEVELS},
        partial(tables, setup),
        partial(pictures, setup),
    )
    for setup in SETUPS
)
