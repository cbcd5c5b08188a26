"""Identify twins of hidden plants from 60 s of log, and compare methods on each twin and on its plant.

    python benchmarks/twins.py --robots 20 --first 81000
    python benchmarks/twins.py --challenges all --robots 5 --first 81000 --out twins.csv

A pair is a method on a plant: its median settling time, or error of the path, on the twin counts as right within 10 %,
a period or 1.5 mm of that on the plant. Both have the same tasks and noise; robots of the twin are drawn from its
posterior. With R and S the mean scores on plant and twin, the mean maximum rank violation is

    MMRV = 1/N Σ_i max_j |R_i − R_j| [(S_i < S_j) ≠ (R_i < R_j)]

over the methods i of a plant, where a pair whose medians on the plant are within a period or 1.5 mm is no violation
(Li et al., Evaluating Real-World Robot Manipulation Policies in Simulation, CoRL 2024).
"""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from hidden_plants import draw_hidden, parameters

import servobench
from measuring import options
from servobench.harness.apps.studies.challenge import (
    MEASURES,
    Challenge,
    challenge_names,
    find_challenge,
)
from servobench.harness.apps.studies.suite import judge
from servobench.harness.apps.twin.drive import command_response
from servobench.harness.apps.twin.log import read_log
from servobench.harness.apps.twin.preflight import mistakes
from servobench.harness.apps.twin.twin_file import twin_text
from servobench.harness.config.description import toml
from servobench.harness.config.sensing import find_sensing
from servobench.harness.config.settings import Settings, flatten, nest
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.harness.run.sampling import draw_robot
from servobench.harness.run.variations import SHORT_NAMES
from servobench.plant.contract.sensing import SENSOR_AXES
from servobench.plant.robot.catalogue import ROBOTS, find_robot
from servobench.plant.robot.mechanics import MECHANICS_AXES
from servobench.plant.robot.mismatch import Mismatch

EQUIPPED: Final = ("regression_mfac", "rbfnn_mfac", "ukf_mfac", "ukf_mpc", "rbf_pid")
PUBLISHED: Final = tuple(f"{name}:published" for name in EQUIPPED[1:])
# Which bounds the scores; nmpc_calibrated takes most of the time of a suite
REFERENCES: Final = ("calibrated",)
HIDDEN: Final = (
    Challenge("moves", task="random", measure="settling", reference=REFERENCES),
    Challenge("circle", task="circle", measure="path", reference=REFERENCES),
)
SHARE: Final = 0.1  # [1] of a median, by which that of a twin may be off
USUAL: Final = {"command_delay": 0.05, "lag": 0.05}  # [s] of the plant
PLANT: Final = "kinematic"


class Hidden(NamedTuple):
    """A hidden plant in the world of a challenge."""

    robot: str  # nominal, by name
    mismatch: str
    latency: float  # [s]
    times: dict[str, float]  # of commands and joints [s]
    noise_shape: list[list[float]]
    words: Mismatch  # of sensor, gears and tool
    settings: dict[str, Any]  # by key, with the sections run, plant and task


def hidden_plant(challenge: Challenge, seed: int) -> Hidden:
    """Return a hidden plant of a seed: of a challenge the robot and the world, else those of `hidden_plants`."""
    short = {
        name: getattr(challenge, name)
        for name in SHORT_NAMES
        if getattr(challenge, name) is not None
    }
    settings = {SHORT_NAMES[name].key: value for name, value in short.items()} | flatten(
        challenge.settings
    )
    if challenge in HIDDEN:
        robot, mismatch, own = draw_hidden(seed, PLANT)
        sensing, times = own["sensing"], {name: own[name] for name in USUAL}
        return Hidden(
            robot, mismatch, sensing["latency"], times, sensing["noise_shape"], Mismatch(), settings
        )
    given = Mismatch.parse(challenge.mismatch)
    axes = tuple(each for each in given.axes if each[0] in {**SENSOR_AXES, **MECHANICS_AXES})
    words = Mismatch("", axes) if axes else Mismatch()
    return Hidden(
        "ur5",
        challenge.mismatch,
        challenge.latency or 0.0,
        USUAL,
        np.eye(3).tolist(),
        words,
        settings,
    )


def true_text(plant: Hidden, seed: int) -> str:
    """Return a file of a twin that is the plant itself."""
    request = RunRequest(
        PLANT, "constant", "random", Mismatch.parse(plant.mismatch), seed, robot=plant.robot
    )
    true, nominal = (
        draw_robot(request)[0],
        find_sensing("position").nominal(find_robot(plant.robot)),
    )
    shape = 1e-3 * np.array(plant.noise_shape)
    pose = f"{{ frame = 'base', position = {toml(true.camera[:3, 3])}, rotation = {toml(true.camera[:3, :3])} }}"
    lines = [f"robot = {toml(plant.robot)}", f"covariance = {toml(shape @ shape.T)}"]
    lines += ["[camera]", f"latency = {plant.latency}", f"pose = {pose}", "[mean]"]
    mean = parameters(true, nominal) | plant.times
    return (
        "\n".join([*lines, *(f"{key} = {toml(float(value))}" for key, value in mean.items())])
        + "\n"
    )


def sections(settings: dict[str, Any], task: str) -> dict[str, Any]:
    """Return settings by section, given those by key with roles for the sections."""
    roles = {"run": "run", "plant": PLANT, "task": task}
    named = {
        f"{roles[key.partition('.')[0]]}.{key.partition('.')[2]}": value
        for key, value in settings.items()
    }
    return nest(named)


def identified(plant: Hidden, truth: str, seed: int) -> tuple[str, str]:
    """Return the line on a log of a plant, and the file of its twin, empty for a log that is refused."""
    settings = {key: value for key, value in plant.settings.items() if not key.startswith("task.")}
    given = {
        "random": {"duration": 60.0},
        "Excite": {"swing": 0.25, "fastest": 0.5},
        **sections(settings, "random"),
    }
    given["run"] = given.get("run", {}) | {"lost_after": 20.0}
    made = servobench.run(
        "docs/examples/excite.py", PLANT, task="random", mismatch=str(plant.words), robot=truth, seed=seed,
        settings=given,
    )  # fmt: skip
    if made.row["status"] != "completed":
        return f"the run ended: {made.row['reason']}", ""
    request = RunRequest(PLANT, "constant", "random", plant.words, seed, robot=truth)
    experiment = build(
        resolve(request, Settings({key: given[key] for key in given if key != "Excite"}))
    )
    experiment.plant.close()
    log, own = read_log(experiment.plant.spec, made.steps), find_robot(plant.robot)
    others = {
        name: find_robot(name).nominal
        for name in ROBOTS
        if name != plant.robot and find_robot(name).n == own.n
    }
    said, found = mistakes(log, find_sensing("position").nominal(own), lambda: others)
    if found is None:
        return said, ""
    return said, twin_text(found, log, command_response(log), (plant.robot, "position"))


def compared(
    challenge: Challenge, seed: int, methods: Sequence[str], runs: int, told: bool
) -> pd.DataFrame:
    """Return a row a method: median and score on a hidden plant and on its twin."""
    plant = hidden_plant(challenge, seed)
    about = {
        "challenge": challenge.name,
        "seed": seed,
        "robot": plant.robot,
        "mismatch": plant.mismatch,
    }
    with tempfile.TemporaryDirectory() as folder:
        truth, twin = (
            Path(folder) / f"{name}_{challenge.name}_{seed}.toml" for name in ("truth", "twin")
        )
        truth.write_text(true_text(plant, seed), encoding="utf-8")
        said, text = identified(plant, str(truth), seed)
        about["said"] = said
        if not text:
            return pd.DataFrame([about])
        twin.write_text(text, encoding="utf-8")
        known = {
            key: value
            for key, value in plant.settings.items()
            if told or not key.startswith("plant.sensing")
        }
        worlds = (
            (truth, plant.words, plant.settings),
            (twin, plant.words if told else Mismatch(), known),
        )
        tables = [
            servobench.compare(
                [*methods, *challenge.reference], (PLANT,), (challenge.task,), mismatches=(str(words),),
                seeds=range(1, runs + 1), robot=str(path), settings=sections(settings, challenge.task),
            )
            for path, words, settings in worlds
        ]  # fmt: skip
    measure = MEASURES[challenge.measure]
    floor = (
        plant.settings.get("run.period", 0.05)
        if challenge.measure == "settling"
        else measure.factor * measure.floor
    )
    real, predicted = (
        judge(challenge, table).groupby("controller", sort=False) for table in tables
    )
    rows = [
        about | {"controller": name, "tie": floor}
        | {f"{what}_{kind}": value for what, group in (("real", real), ("twin", predicted))
           for kind, value in _summary(group.get_group(name)).items()}
        for name in methods
    ]  # fmt: skip
    return pd.DataFrame(rows)


def _summary(own: pd.DataFrame) -> dict[str, float]:
    """Return the median with lost runs as infinite, the mean score, and the share of good runs."""
    return {
        "median": float(own["measured"].where(own["value"].notna(), np.inf).median()),
        "measured": float(own["measured"].median()),
        "score": float(own["score"].mean()),
        "good": float(own["value"].notna().mean()),
    }


def is_within(table: pd.DataFrame) -> "pd.Series[bool]":
    """Return which medians are predicted."""
    real, twin = table["real_median"], table["twin_median"]
    off = (twin - real).abs() <= np.maximum(SHARE * real, table["tie"])
    return off.where(np.isfinite(real) & np.isfinite(twin), np.isinf(real) & np.isinf(twin))


def rank_violation(place: pd.DataFrame) -> float:
    """Return the mean maximum rank violation over the methods of a plant."""
    real, twin, median = (
        place[name].to_numpy() for name in ("real_score", "twin_score", "real_median")
    )
    with np.errstate(invalid="ignore"):
        tie = np.abs(median[:, None] - median) <= place["tie"].iloc[0]
    wrong = ((twin[:, None] < twin) != (real[:, None] < real)) & ~tie
    return float(np.mean(np.max(np.abs(real[:, None] - real) * wrong, axis=1)))


def report(table: pd.DataFrame) -> str:
    """Return a table of pairs within, rank violation and correlation by challenge."""
    rows = []
    known = table[table["controller"].notna()] if "controller" in table else table.iloc[:0]
    for name, all_of in table.groupby("challenge", sort=False):
        own = known[known["challenge"] == name]
        plants = own.groupby("seed")
        row = {
            "challenge": name,
            "plants": all_of["seed"].nunique(),
            "refused": int(all_of["real_score"].isna().sum()),
        }
        if len(own):
            means = own.groupby("controller")[["real_score", "twin_score"]].mean()
            row |= {
                "within": is_within(own).mean(),
                "MMRV": plants.apply(rank_violation).mean(),
                "r": np.corrcoef(own["real_score"], own["twin_score"])[0, 1],
                "r of means": np.corrcoef(means.T)[0, 1],
                "median ratio": (own["twin_measured"] / own["real_measured"]).median(),
                "real score": own["real_score"].mean(),
                "twin score": own["twin_score"].mean(),
            }
        rows.append(row)
    texts = [pd.DataFrame(rows).round(3).to_string(index=False)]
    if len(known):
        r = np.corrcoef(known["real_score"], known["twin_score"])[0, 1]
        mmrv = known.groupby(["challenge", "seed"]).apply(rank_violation).mean()
        texts.append(
            f"all: {is_within(known).mean():.1%} of {len(known)} pairs within, MMRV {mmrv:.3f}, r {r:.3f}"
        )
    return "\n".join(texts)


def main() -> None:
    """Print the tables."""
    given = options(
        __doc__,
        challenges=("", "names, or all of grades II and III; default: hidden plants"),
        robots=3,
        first=81000,
        runs=(20, "on each plant and each twin"),
        methods=",".join(EQUIPPED),
        told={"action": "store_true", "help": "give the twin the words of the world, too"},
        out={"type": Path, "help": "CSV file for a row a method and plant"},
    )
    chosen = [
        find_challenge(name) for name in given.challenges.split(",") if name not in ("", "all")
    ]
    if given.challenges == "all":
        chosen = [
            each
            for each in map(find_challenge, challenge_names())
            if each.grade.name in ("II", "III")
        ]
    chosen = [replace(each, reference=REFERENCES) for each in chosen] or HIDDEN
    methods = [*EQUIPPED, *PUBLISHED] if given.methods == "all" else given.methods.split(",")
    tables = []
    for challenge in chosen:
        for seed in range(given.first, given.first + given.robots):
            tables.append(compared(challenge, seed, methods, given.runs, given.told))
            if given.out is not None:
                pd.concat(tables).to_csv(given.out, index=False)
        print(report(pd.concat(tables)), flush=True)


if __name__ == "__main__":
    main()
