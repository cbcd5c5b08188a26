"""Identify hidden plants from 60 s of log each: coverage of intervals by parameter, latency, false alarms.

python benchmarks/hidden_plants.py --plant kinematic --robots 200 --first 81000
python benchmarks/hidden_plants.py --mismatch moderate+joint_offsets=180deg --robots 40
"""

import time
from typing import Any

import numpy as np
import pandas as pd

import servobench
from measuring import options
from servobench.harness.apps.twin.drive import command_response
from servobench.harness.apps.twin.log import Log, read_log
from servobench.harness.apps.twin.preflight import mistakes
from servobench.harness.config.sensing import find_sensing
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.harness.run.sampling import draw_robot
from servobench.plant.robot.catalogue import ROBOTS, find_robot
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.mismatch import Mismatch
from servobench.plant.robot.twin import TOOL, parameter_names

ARMS = ("ur5", "ur10e", "panda")
MISMATCHES = ("moderate", "moderate+gear_ratio=3%", "severe", "severe+gear_ratio=5%")


def parameters(true: RobotModel, nominal: RobotModel) -> dict[str, float]:
    """Return the deviations of gears, zeros, lengths and tool by their names."""
    names, values = (
        nominal.arm.joint_names,
        dict(zip(TOOL, (true.arm.tool - nominal.arm.tool).tolist(), strict=True)),
    )
    gears = true.arm.gear_ratio / nominal.arm.gear_ratio - 1.0
    zeros = true.arm.joint_offset - nominal.arm.joint_offset
    for kind, each in (("gear", gears), ("zero", zeros)):
        values |= {
            f"{kind}_{name}": value for name, value in zip(names, each.tolist(), strict=True)
        }
    for name in parameter_names(nominal.arm):
        if name.startswith("link"):
            row, axis = int(name.split("_")[1]), "xyz".index(name[-1])
            values[name] = (
                true.arm.translation[row, axis] / nominal.arm.translation[row, axis] - 1.0
            )
    return values


def draw_hidden(seed: int, plant: str) -> tuple[str, str, dict[str, Any]]:
    """Return robot, mismatch and settings of a hidden plant: latency, delay, lag, noise; friction and load of half."""
    draws = np.random.default_rng(seed)
    robot, mismatch = str(draws.choice(ARMS)), str(draws.choice(MISMATCHES))
    latency, delay, lag = (round(float(draws.uniform(0.0, most)), 3) for most in (0.13, 0.06, 0.1))
    shape = np.diag(draws.uniform(0.5, 2.0, 3))
    sections: dict[str, Any] = {
        "sensing": {"latency": latency, "noise_shape": shape.tolist()},
        "command_delay": delay,
    }
    if plant == "kinematic":
        return robot, mismatch, sections | {"lag": max(lag, 0.01)}
    free = {
        "coulomb_friction": [0.0],
        "viscous_friction": [0.0],
        "payload": 0.0,
        "assumed_payload": 0.0,
    }
    return (
        robot,
        mismatch,
        sections | {"scenery": False, "drives": free if draws.random() < 0.5 else {}},
    )


def jacobian_error(log: Log, twin: RobotModel, true: RobotModel) -> float:
    """Return how wrong the Jacobian of a twin is along a log, as a share of the true one."""
    q = log.joints[::50]
    wanted = np.asarray(true.jacobian(q))
    missed = np.asarray(twin.jacobian(q)) - wanted
    return float(np.linalg.norm(missed) / np.linalg.norm(wanted))


def hidden(seed: int, plant: str, words: str) -> list[dict[str, Any]]:
    """Identify one hidden plant, of a mismatch if one is given, and return a row a parameter."""
    robot, mismatch, sections = draw_hidden(seed, plant)
    mismatch = words or mismatch
    latency, delay = sections["sensing"]["latency"], sections["command_delay"]
    # Engines have a table
    task, reach = ("random", np.inf) if plant == "kinematic" else ("target", 0.15)
    settings = {
        plant: sections,
        task: {"duration": 60.0},
        "Excite": {"swing": 0.25, "reach": reach},
    }
    chosen: dict[str, Any] = {"robot": robot, "mismatch": mismatch, "seed": seed}
    made = servobench.run("docs/examples/excite.py", plant, task=task, settings=settings, **chosen)
    about: dict[str, Any] = {
        "seed": seed,
        "robot": robot,
        "mismatch": mismatch,
        "rows": len(made.steps),
    }
    if made.row["status"] != "completed":
        return [about | {"parameter": "", "said": f"the run ended: {made.row['reason']}"}]
    request = RunRequest(plant, "constant", task, Mismatch.parse(mismatch), seed, robot=robot)
    experiment = build(resolve(request, Settings(settings | {})))
    log, nominal = (
        read_log(experiment.plant.spec, made.steps),
        find_sensing("position").nominal(find_robot(robot)),
    )
    experiment.plant.close()
    times = {"latency": latency, "command_delay": delay, "lag": sections.get("lag", np.nan)}
    return judged(log, nominal, draw_robot(request)[0], times, about)


def judged(
    log: Log,
    nominal: RobotModel,
    robot_drawn: RobotModel,
    times: dict[str, float],
    about: dict[str, Any],
) -> list[dict[str, Any]]:
    """Identify a log and return a row a parameter, given the true robot and the true times [s]."""
    others = {
        name: find_robot(name).nominal
        for name in ROBOTS
        if name != about["robot"] and find_robot(name).n == log.spec.n
    }
    began = time.perf_counter()
    said, found = mistakes(log, nominal, lambda: others)
    response = command_response(log)
    about |= {"seconds": time.perf_counter() - began, "said": said}
    rows: list[tuple[Any, ...]] = []
    true = parameters(robot_drawn, nominal) | {"latency": times["latency"]}
    if found is not None:
        about["jacobian"] = jacobian_error(log, found.model(nominal), robot_drawn)
    if response is not None:
        errors = response.delay - times["command_delay"], response.lag - times["lag"]
        sizes = np.maximum(np.sqrt(np.diag(response.covariance)), 1e-4)
        told = np.isfinite(errors)  # the drive of an engine has no lag of first order
        rows += zip(("command_delay", "lag"), errors, sizes, told, strict=True)
    if found is not None:
        estimates = zip(found.names, found.values, found.deviations, found.told, strict=True)
        rows += [
            (name, value - true[name], *other) for name, value, *other in estimates if name in true
        ]
    return [
        about | dict(zip(("parameter", "error", "deviation", "told"), row, strict=False))
        for row in rows or [("",)]
    ]


def main() -> None:
    """Print the tables."""
    given = options(__doc__, plant="kinematic", robots=200, first=81000, mismatch="")
    seeds = range(given.first, given.first + given.robots)
    rows = [row for seed in seeds for row in hidden(seed, given.plant, given.mismatch)]
    print_summary(pd.DataFrame(rows))


def print_summary(table: pd.DataFrame) -> None:
    """Print coverage and errors of a table with a row a parameter."""
    runs = table.drop_duplicates("seed")
    print(
        f"{len(runs)} logs, {(runs['said'] != '').sum()} with a line, median {runs['seconds'].median():.1f} s a log"
    )
    print(runs.loc[runs["said"] != "", ["seed", "robot", "mismatch", "said"]].to_string())
    if "jacobian" in runs:
        print(f"Jacobian of the twin within 1 %: {(runs['jacobian'] < 0.01).sum()} of {len(runs)}")
    late = table[table["parameter"] == "latency"]
    error = late["error"].abs()
    print(f"latency within 5 ms: {(error < 0.005).mean():.1%}, largest error {error.max():.4f} s")
    told = table[table["told"].fillna(False).astype(bool)]
    told = told.assign(covered=told["error"].abs() <= 1.96 * told["deviation"])
    own = told[~told["parameter"].isin(["command_delay", "lag"])]
    print(f"pooled coverage of 95 %: {own['covered'].mean():.1%} of {len(own)}")
    by = told.groupby("parameter")
    columns = {
        "logs": by.size(),
        "covered": by["covered"].mean(),
        "median deviation": by["deviation"].median(),
        "RMS error": by["error"].apply(lambda error: np.sqrt(np.mean(error**2))),
    }
    print(pd.DataFrame(columns).to_string())


if __name__ == "__main__":
    main()
