"""The tables of the audit of version 0.1.0, line by line: what was measured then, and the nearest configuration now."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from page_studies.audit_lines import ABLATION, ENDS, HARD, LONG, OLD_HARD, RATES, SUCCESSOR, THEN, TUNING, WORLDS, Line
from page_studies.held_out import LOST
from page_studies.methods import (
    MOVE,
    count_and_median,
    difference,
    millimetres,
    paired,
    quoted,
    settled,
)
from page_studies.study import Study, Words, sweep
from servobench.harness.analysis.comparison import column_of, outcomes, settling_times
from servobench.harness.batch.results import load_runs, load_steps
from servobench.harness.run.result import COMPLETED

CIRCLE_UNIT: Final = 0.05  # [m] RMS on a circle that costs 1 in the score of 0.1.0
FIFTHS: Final = 5


def layers(lines: Sequence[Line]) -> Iterator[list[Line]]:
    """Yield the lines in groups in which each controller has one set of settings."""
    found: list[dict[str, Line]] = []
    for line in dict.fromkeys(line._replace(was="", old=()) for line in lines):
        place = next((each for each in found if line.controller not in each), None)
        if place is None:
            found.append(place := {})
        place[line.controller] = line
    yield from (list(each.values()) for each in found)


def layered(name: str, lines: Sequence[Line], plant: str, *rest: str) -> dict[str, Words]:
    """Return the sweeps of some lines, by part `name` and number of the layer; `rest` are task, seeds and options."""
    commands = {}
    for k, layer in enumerate(layers(lines)):
        options = [word for line in layer for each in line.settings for word in ("--set", f"{line.controller}.{each}")]
        commands[f"{name}_{k}"] = sweep(plant, [line.controller for line in layer], *rest, *options)
    return commands


def runs_of(line: Line, folder: Path, name: str, lines: Sequence[Line]) -> pd.DataFrame:
    """Return the runs of a line out of the parts that `layered` made."""
    bare = line._replace(was="", old=())
    k = next(k for k, layer in enumerate(layers(lines)) if bare in layer)
    runs = load_runs(folder / f"{name}_{k}")
    return runs[runs["controller"] == line.controller]


def now(line: Line) -> str:
    """Return a line's configuration now."""
    return ", ".join([quoted(line.controller), *map(quoted, line.settings)])


def tuning_table(folder: Path) -> pd.DataFrame:
    """Return score, circle and settling time of each line; the score has the formula of 0.1.0 on other robots."""
    rows = []
    for line in TUNING:
        runs = runs_of(line, folder, "tuning", TUNING)
        usual = runs[runs["latency_s"] == 0.0]
        move, circle = (usual[usual["task"] == task] for task in ("random", "circle"))
        rows.append({
            "in 0.1.0": line.was, "score": line.old[0], "circle, mm": line.old[1], "settling, s": line.old[2],
            "now": now(line), "score now": f"{score(runs):.3f}", "circle now, mm": millimetres(circle),
            "settled and settling now, s": count_and_median(move),
        })  # fmt: skip
    return pd.DataFrame(rows)


def score(runs: pd.DataFrame) -> float:
    """Return the score of 0.1.0: mean settling time over duration, plus the mean RMS on circles over 50 mm."""
    done = runs["status"] == COMPLETED
    move = (settling_times(runs) / MOVE).fillna(1.0).where(done, 2.0)
    circle = (column_of(runs, "rms_error_evaluated") / CIRCLE_UNIT).clip(upper=1.0).where(done, 2.0)
    return float(move[runs["task"] == "random"].mean() + circle[runs["task"] == "circle"].mean())


def ablation_table(folder: Path) -> pd.DataFrame:
    """Return settled runs and settling times in each world, and the error on the circle, then and now."""
    rows = []
    for line in ABLATION:
        row = {"in 0.1.0": line.was, "now": now(line)}
        for k, (world, old) in enumerate(zip(WORLDS, line.old, strict=True)):
            runs = runs_of(line, folder, f"ablation{k}", ABLATION)
            new = millimetres(runs) if world == "circle, mm" else f"{count_and_median(runs)} of {len(runs)}"
            row[f"{world}: then"], row[f"{world}: now"] = old, new
        rows.append(row)
    return pd.DataFrame(rows)


def rates_table(folder: Path) -> pd.DataFrame:
    """Return settled runs and settling times at fast rates."""
    rows = []
    for line in RATES:
        runs = load_runs(folder / "rates")
        own = runs[runs["controller"] == line.controller]
        fast, faster = (own[np.isclose(own["period_s"], period)] for period in (0.008, 0.004))
        rows.append({
            "in 0.1.0": line.was, "125 Hz": line.old[0], "240 Hz": line.old[1], "now": now(line),
            "125 Hz now": count_and_median(fast), "250 Hz now": count_and_median(faster),
        })  # fmt: skip
    return pd.DataFrame(rows)


def long_table(folder: Path) -> pd.DataFrame:
    """Return the RMS error of each fifth of half an hour on the circle."""
    runs = load_runs(folder / "long")
    rows = []
    for line in LONG:
        run = runs[runs["controller"] == line.controller].iloc[0]
        errors = load_steps(folder / "long", [run["run_id"]])["error_norm"].to_numpy()
        parts = ", ".join(f"{1e3 * math.sqrt(np.mean(part**2)):.1f}" for part in np.array_split(errors, FIFTHS))
        rows.append({
            "in 0.1.0": line.was, "RMS of each fifth, mm": line.old[0], "now": now(line),
            "RMS of each fifth now, mm": parts, "outcome": run["outcome"],
        })  # fmt: skip
    return pd.DataFrame(rows)


def ends_table(folder: Path) -> pd.DataFrame:
    """Return what came of targets out of reach, stretched arms and extreme worlds."""
    reach, stretched = (load_runs(folder / task) for task in ("unreachable", "singular_start"))
    rows = []
    for name in THEN:
        far, start = (runs[runs["controller"] == name] for runs in (reach, stretched))
        row = {
            "method": quoted(name), "1.5 m away: then": ENDS[name][0],
            "1.5 m away: now": f"{millimetres(far, 'steady_state_error', 0)} mm, {worded(far)}",
            "arm stretched: then": ENDS[name][1], "arm stretched: now": worded(start),
        }  # fmt: skip
        for world in HARD:
            runs = load_runs(folder / part_of(world))
            own = runs[runs["controller"] == name]
            error = f", {millimetres(own, 'steady_state_error', 0)} mm"
            row[f"{world}: then"] = OLD_HARD[world][name]
            row[f"{world}: now"] = f"{settled(own)} of {len(own)} settle{error}"
        rows.append(row)
    return pd.DataFrame(rows)


def worded(runs: pd.DataFrame) -> str:
    """Return the outcomes of runs with their numbers."""
    return ", ".join(f"{count} {word}" for word, count in outcomes(runs).value_counts().items())


def part_of(world: str) -> str:
    """Return the part of a world."""
    return "".join(letter if letter.isalnum() else "_" for letter in world)


def other_table(folder: Path) -> pd.DataFrame:
    """Return the paired differences of the audit: on the circle, in the moves of claim 3, and with weaker motors."""
    tuning = pd.concat([load_runs(folder / part) for part in AUDIT.commands if part.startswith("tuning_")])
    circles = tuning[(tuning["task"] == "circle") & (tuning["latency_s"] == 0.0)]
    printed = load_runs(folder / "printed")
    weak, usual = (load_runs(folder / part).assign(label=part) for part in ("weak_motors", "bullet"))
    motors = pd.concat([weak, usual]).assign(controller=lambda runs: runs["controller"] + " " + runs["label"])
    plain = circles.drop_duplicates(["controller", "seed"])
    cases: tuple[tuple[str, str, pd.DataFrame, tuple[str, str], str, float, float], ...] = (
        ("circle, `rbfnn_mfac` − `rbf_pid`, mm", "−19.2; with `feedforward` +3.9 [3.2, 4.5]", plain,
         ("rbfnn_mfac", "rbf_pid"), "rms_error_evaluated", LOST, 1e3),
        *((f"{task}, `ukf_mpc` − `ukf_mfac` as printed, s", old, printed[printed["task"] == task],
           ("ukf_mpc:published", "ukf_mfac:published"), "settling_time_s", MOVE, 1.0)
          for task, old in (("exp2", "−0.00 [−0.03, 0.05]"), ("exp3", "−0.28 [−0.40, −0.20]"))),
        *((f"torque limits halved on `bullet`, `{name}`, s", "0", motors, (f"{name} weak_motors", f"{name} bullet"),
           "settling_time_s", MOVE, 1.0) for name in (SUCCESSOR, "rbf_pid:published")),
    )  # fmt: skip
    rows = []
    for words, old, runs, pair, metric, never, factor in cases:
        compared = paired(runs, [pair], metric=metric, never=never)[0]
        rows.append({"difference": words, "in 0.1.0": old, "now": difference(compared, 2, factor)})
    return pd.DataFrame(rows)


TABLES: Final[Mapping[str, Callable[[Path], pd.DataFrame]]] = {
    "audit_tuning": tuning_table,
    "audit_rates": rates_table,
    "audit_long": long_table,
    "audit_ablation": ablation_table,
    "audit_ends": ends_table,
    "audit_differences": other_table,
}
ENDLESS: Final = (
    "compare", "--plants", "kinematic", "--controllers", ",".join(dict.fromkeys(line.controller for line in LONG)),
    "--tasks", "endurance", "--seeds", "9300:9301", "--no-report",
)  # fmt: skip
WEAK: Final = ("--set", "bullet.drives.torque_limit=[75.0, 75.0, 75.0, 14.0, 14.0, 14.0]")
RENDERED: Final = ("bullet", (SUCCESSOR, "rbf_pid:published"), "random", "9100:9112", "--set", "bullet.scenery=false")
AUDIT: Final = Study(
    "audit",
    "the tables of the audit of 0.1.0, then and now",
    30,
    {
        **layered("tuning", TUNING, "fmu", "random,circle", "9200:9224", "--latency", "0,0.05"),
        **{
            part: command
            for k, rest in enumerate(WORLDS.values())
            for part, command in layered(f"ablation{k}", ABLATION, "fmu", *rest).items()
        },
        "rates": sweep("kinematic", THEN, "random", "9100:9106", "--period", "0.008,0.004"),
        "long": ENDLESS,
        **{task: sweep("kinematic", THEN, task, "9100:9104") for task in ("unreachable", "singular_start")},
        **{part_of(world): sweep("kinematic", THEN, "random", "9100:9106", *rest) for world, rest in HARD.items()},
        "printed": sweep("fmu", ("ukf_mpc:published", "ukf_mfac:published"), "exp2,exp3", "9100:9112"),
        "bullet": sweep(*RENDERED),
        "weak_motors": sweep(*RENDERED, *WEAK),
    },
    lambda folder: {name: make(folder) for name, make in TABLES.items()},
)
