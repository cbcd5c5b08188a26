"""Control rates, half hours, ends without arrival, and the dynamics of the rendered arm."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from page_studies import cells
from page_studies.study import BOTH, ENGINES, RENDERED, Study, Words, on_engines, settings, sweep
from servobench.harness.analysis.comparison import (
    MISSING,
    column_of,
    is_majority,
    margin,
    median_with_interval,
    settling_times,
)
from servobench.harness.batch.results import load_runs
from servobench.harness.run.result import COMPLETED

RATES: Final = (10, 20, 50, 125, 250)  # [Hz]
NOWHERE: Final = "nowhere"
PERIODS: Final = ",".join(f"{1.0 / rate:g}" for rate in RATES)
# [s]; a bullet run costs seconds, and methods settle within three
SHORT: Final = settings(["random.duration=5"])


def rates_table(folder: Path) -> dict[str, pd.DataFrame]:
    """Return how many robots settle and when at each rate, and where a faster rate is worse than the next one.

    What is worse on one engine only is in bold.
    """
    rows = [
        row for plant in RATES_STUDY.commands for row in rate_rows(load_runs(folder / plant), plant)
    ]
    table = pd.DataFrame(rows)
    for _, own in table[table["plant"].isin(ENGINES)].groupby("method"):
        if len({worse != NOWHERE for worse in own["worse"]}) > 1:
            table.loc[own.index, "worse"] = own["worse"].map(cells.marked)
    return {"rates": table}


def rate_rows(runs: pd.DataFrame, plant: str) -> Iterator[dict[str, str]]:
    """Yield a row for each method on one plant."""
    for name, own in cells.by_method(runs):
        at = {rate: own[np.isclose(own["period_s"], 1.0 / rate)] for rate in RATES}
        worse = [
            f"{fast} Hz: {words}"
            for slow, fast in pairwise(RATES)
            if (words := loss(at[slow], at[fast]))
        ]
        found = {f"{rate} Hz": count_and_median(each) for rate, each in at.items()}
        yield (
            {"method": cells.quoted(name), "plant": plant}
            | found
            | {"worse": "; ".join(worse) or NOWHERE}
        )


def count_and_median(runs: pd.DataFrame) -> str:
    """Return how many runs settled and their median settling time [s], as in `40, 0.83`."""
    count, middle = cells.settled(runs), median_with_interval(settling_times(runs)).value
    return (
        f"{count}, {middle:.2f}"
        if middle < float("inf")
        else "0"
        if count == "0"
        else f"{count}, {MISSING}"
    )


def loss(slow: pd.DataFrame, fast: pd.DataFrame) -> str:
    """Return in which way runs are worse at a faster rate; empty if in none.

    Settled shares differ where a sign test says so of the robots that settle at one rate only; times differ where the
    interval of their mean difference is above the slower period.
    """
    settles = [set(runs.loc[settling_times(runs).notna(), "seed"]) for runs in (slow, fast)]
    lost, won = len(settles[0] - settles[1]), len(settles[1] - settles[0])
    words = []
    if is_majority(lost, won):
        words.append(f"{lost} fewer settle, {won} more")
    named = pd.concat([slow.assign(controller="slow"), fast.assign(controller="fast")])
    later = cells.MOVES.compare(named, [("fast", "slow")])[0]
    if later.mean.low > margin("settling_time_s", named):
        words.append(f"{later.mean:+.2f} s")
    return ", ".join(words)


def last_over_second(runs: pd.DataFrame) -> str:
    """Return the median ratio of the error of the last lap to that of the second one."""
    ratio = column_of(runs, "rms_error_evaluated") / column_of(runs, "rms_error_second_lap")
    return cells.short(median_with_interval(ratio.where(runs["status"] == COMPLETED)), 2)


def long_table(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the errors of the second and the last lap of half an hour, and the outcomes of the runs."""
    shown = {
        "second lap, mm": lambda runs: cells.millimetres(runs, "rms_error_second_lap"),
        "last lap, mm": cells.millimetres,
        "last over second": last_over_second,
        "outcomes": cells.counted,
    }
    rows = [
        {"method": row["method"], "curve": curve} | row
        for curve in LONG.commands
        for row in cells.rows_by_method(load_runs(folder / curve), shown)
    ]
    return {"long": pd.DataFrame(rows)}


def ends_table(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the outcomes for targets out of reach and for starts with the arm stretched."""
    unreachable = {
        "target out of reach": cells.counted,
        "error at the end, mm": lambda runs: cells.millimetres(runs, "steady_state_error", 0),
        "sign switches": lambda runs: cells.short(
            median_with_interval(column_of(runs, "command_switches")), 0
        ),
    }
    singular_start = {
        "arm stretched at the start": cells.counted,
        "settling time, s": cells.settling,
    }
    shown = {"unreachable": unreachable, "singular_start": singular_start}
    parts = [cells.rows_by_method(load_runs(folder / part), each) for part, each in shown.items()]
    return {"ends": pd.DataFrame(one | other for one, other in zip(*parts, strict=True))}


def dynamics_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the paired difference that each switch makes to each method on both engines, moves and circle."""
    usual = {engine: load_runs(folder / engine) for engine in ENGINES}
    changes = {"`kinematic` instead": dict.fromkeys(ENGINES, "kinematic")}
    changes |= {words: {engine: part_of(words, engine) for engine in ENGINES} for words in SWITCHES}
    pairs = {cells.quoted(name): (name + cells.CHANGED, name) for name in RENDERED}
    made: dict[str, list[dict[str, str]]] = {"dynamics": [], "dynamics_circle": []}
    for words, parts in changes.items():
        both = {
            engine: cells.changed_and_usual(load_runs(folder / parts[engine]), usual[engine])
            for engine in ENGINES
        }
        for table, measure in zip(made.values(), (cells.MOVES, cells.CIRCLES), strict=True):
            found = dict(zip(pairs, measure.on_engines(both, list(pairs.values())), strict=True))
            for engine in ENGINES:
                row = {name: by_engine[engine] for name, by_engine in found.items()}
                table.append({"changed": words, "plant": engine} | row)
    return {name: pd.DataFrame(rows) for name, rows in made.items()}


def part_of(words: str, engine: str) -> str:
    """Return the part with one switch changed on one engine."""
    return f"{engine}_{words.replace(' ', '_')}"


def rendered(plant: str, switched: Words = ()) -> Words:
    """Return the sweep of moves and circles on a rendered plant with some of its settings switched."""
    changes = settings(f"{plant}.{each}" for each in switched)
    return sweep(plant, RENDERED, "random,circle", DYNAMICS_SEEDS, *SHORT, *changes)


DYNAMICS_SEEDS: Final = "47000:47008"
SWITCHES: Final[Mapping[str, tuple[str, ...]]] = {
    "without dynamics": ("drives.dynamics=false",),
    "torque limits halved": ("drives.torque_limit=[75.0, 75.0, 75.0, 14.0, 14.0, 14.0]",),
    "payload doubled": ("drives.payload=5.0",),
    "without friction": (
        "drives.coulomb_friction=[0.0]", "drives.viscous_friction=[0.0]", "drives.friction_compensation=0.0",
    ),
    "friction not compensated": ("drives.friction_compensation=0.0",),
    "bandwidth halved": ("drives.velocity_bandwidth=[7.5, 7.5, 7.5, 10.0, 10.0, 10.0]",),
    "contact with itself": ("self_contact=true",),
    "without depth noise": ('depth_noise="none"',),
}  # fmt: skip

RATES_STUDY = Study(
    "rates",
    "control rates from 10 to 250 Hz in the same physical worlds, 100 robots on `kinematic`, 10 on each physics engine",
    35,
    {"kinematic": sweep("kinematic", BOTH, "random", "52000:52100", "--period", PERIODS)}
    | on_engines(
        lambda plant: sweep(plant, RENDERED, "random", "52100:52110", "--period", PERIODS, *SHORT)
    ),
    rates_table,
)
LONG = Study(
    "long",
    "half an hour on the circle and the lemniscate",
    30,
    {
        curve: sweep(
            "kinematic", BOTH, "endurance", "45000:45010", *settings([f'endurance.curve="{curve}"'])
        )
        for curve in ("circle", "lemniscate")
    },
    long_table,
)
ENDS = Study(
    "ends",
    "targets out of reach and starts with the arm stretched",
    2,
    {
        task: sweep("kinematic", BOTH, task, "46000:46020")
        for task in ("unreachable", "singular_start")
    },
    ends_table,
)
DYNAMICS = Study(
    "dynamics",
    "what each switch of `bullet` and `mujoco` does to each method, and both against `kinematic`",
    30,
    {"kinematic": sweep("kinematic", RENDERED, "random,circle", DYNAMICS_SEEDS, *SHORT)}
    | on_engines(rendered)
    | {
        part_of(words, engine): command
        for words, switched in SWITCHES.items()
        for engine, command in on_engines(partial(rendered, switched=switched)).items()
    },
    dynamics_tables,
)
