"""Plant twelve mistakes in logs of hidden plants, one at a time and in pairs, and count which ones are named.

    python benchmarks/planted_mistakes.py --logs 3 --first 81000
    python benchmarks/planted_mistakes.py --clean 200 --first 173385

Of a pair one mistake is to be named, and the other one after its remedy, which is the log with the other one alone.
"""

import re
import tempfile
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from hidden_plants import draw_hidden

import servobench
from measuring import options
from servobench.harness.apps.twin.log import read_log
from servobench.harness.apps.twin.preflight import mistakes
from servobench.harness.batch.logs import logged_in_file
from servobench.harness.config.sensing import find_sensing
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.robot.catalogue import ROBOTS, find_robot
from servobench.plant.robot.hand_eye import hand_eye_spec

TWINS: Final = {"ur5": "ur10e", "ur10e": "ur5e"}  # the arm that is named by mistake


class Logged(NamedTuple):
    """A log, and the robot that is named with it."""

    table: pd.DataFrame
    robot: str
    joint: int  # with which a mistake is made, neither the first nor the last one


Change = Callable[[Logged], Logged]


def columns(log: Logged, kind: str) -> list[str]:
    """Return the columns of joint positions or features."""
    return [name for name in log.table if re.match(rf"{kind}_(?!valid)", name)]


def changed(log: Logged, kind: str, change: Callable[[Any], Any]) -> Logged:
    """Return a log with an array of columns, (k, *), changed."""
    names = columns(log, kind)
    return log._replace(
        table=log.table.assign(
            **dict(zip(names, change(log.table[names].to_numpy()).T, strict=True))
        )
    )


def joints(change: Callable[[Any], Any]) -> Change:
    """Return a change of joint positions."""
    return lambda log: changed(log, "joint_position", change)


def features(change: Callable[[Any], Any]) -> Change:
    """Return a change of features."""
    return lambda log: changed(log, "feature", change)


def of_joint(change: Callable[[Any], Any]) -> Change:
    """Return a change of the positions of one joint, (k,)."""
    return lambda log: changed(
        log, "joint_position", lambda q: np.where(np.arange(q.shape[1]) == log.joint, change(q), q)
    )


def exchanged(log: Logged) -> Logged:
    """Exchange a joint with the next one."""
    order = np.arange(len(columns(log, "joint_position")))
    order[[log.joint, log.joint + 1]] = log.joint + 1, log.joint
    return changed(log, "joint_position", lambda q: q[:, order])


def alphabetical(log: Logged) -> Logged:
    """Write joints in alphabetical order."""
    order = np.argsort(find_robot(log.robot).nominal.arm.joint_names)
    return (
        log
        if (np.diff(order) == 1).all()
        else changed(log, "joint_position", lambda q: q[:, order])
    )


def drifting(log: Logged) -> Logged:
    """Write frames later and later, by 2 ms a second."""
    time = log.table["time_s"].to_numpy()
    return changed(
        log, "feature", lambda y: y - 0.002 * time[:, None] * np.gradient(y, time, axis=0)
    )


def moved(log: Logged) -> Logged:
    """Move the camera by 50 mm after 30 s."""
    return changed(
        log,
        "feature",
        lambda y: y + 0.05 * (log.table["time_s"].to_numpy()[:, None] > 30.0) * (1, 0, 0),
    )


def repeated(log: Logged) -> Logged:
    """Repeat each third frame."""
    return changed(log, "feature", lambda y: y[np.arange(len(y)) - (np.arange(len(y)) % 4 == 3)])


def with_gap(log: Logged) -> Logged:
    """Leave out some rows."""
    return log._replace(table=log.table.drop(index=log.table.index[500:520]).reset_index(drop=True))


MISTAKES: Final[dict[str, tuple[Change, str]]] = {
    "joints exchanged": (exchanged, "are exchanged"),
    "joints alphabetical": (alphabetical, "alphabetical order"),
    "direction reversed": (of_joint(np.negative), "direction of joint"),
    "zero 90° off": (of_joint(lambda q: q + np.pi / 2.0), "the zero of joint"),
    "degrees": (joints(np.degrees), "in degrees"),
    "mm": (features(lambda y: 1e3 * y), "in mm"),
    "axis mirrored": (features(lambda y: y * (1.0, -1.0, 1.0)), "axis of the camera is mirrored"),
    "clocks drift": (drifting, "clocks of camera and joints drift"),
    "frames repeat": (repeated, "frames repeat another one"),
    "rows missing": (with_gap, "rows are lost"),
    "another arm": (
        lambda log: log._replace(robot=TWINS[log.robot]) if log.robot in TWINS else log,
        "the arm is a",
    ),
    "camera moved": (moved, "camera or the ball was moved"),
}


def logged(seed: int) -> Logged:
    """Return 60 s of log of a hidden plant; a panda's arm and joints in alphabetical order are no others."""
    robot, mismatch, sections = draw_hidden(seed, "kinematic")
    made = servobench.run(
        "docs/examples/excite.py", task="random", robot=robot, mismatch=mismatch, seed=seed,
        settings={"kinematic": sections, "random": {"duration": 60.0}, "Excite": {"swing": 0.25}},
    )  # fmt: skip
    kept = [
        name
        for name in made.steps
        if re.match("time_s|joint_position|joint_velocity|feature", name)
    ]
    return Logged(made.steps[kept], robot, 1 + seed % 4)


def said(log: Logged, folder: Path) -> str:
    """Return the line on a log, as `servobench identify` prints it; empty for none."""
    path = folder / "log.parquet"
    log.table.to_parquet(path)
    try:
        logged_in_file(path, "constant", log.robot, "position")
    except ConfigurationError as error:
        return str(error)
    own, model = find_robot(log.robot), find_sensing("position").nominal(find_robot(log.robot))
    others = {
        name: find_robot(name).nominal
        for name in ROBOTS
        if name != log.robot and find_robot(name).n == own.n
    }
    return mistakes(
        read_log(hand_eye_spec(model, 0.05, 1.0, 2.0 * np.pi), log.table), model, lambda: others
    )[0]


def planted(seed: int, folder: Path, pairs: int) -> list[dict[str, Any]]:
    """Return a row for each mistake in a log, and for so many pairs, drawn by the seed."""
    clean, rows = logged(seed), []
    names = [name for name, (change, _) in MISTAKES.items() if change(clean) is not clean]
    alone = {}
    for name in names:
        line = said(MISTAKES[name][0](clean), folder)
        alone[name] = MISTAKES[name][1] in line
        rows.append({"seed": seed, "first": name, "second": "", "named": alone[name], "line": line})
    drawn = np.random.default_rng(seed).permutation(list(combinations(names, 2)))[:pairs]
    for first, second in drawn.tolist():
        line = said(MISTAKES[second][0](MISTAKES[first][0](clean)), folder)
        one, other = (MISTAKES[name][1] in line for name in (first, second))
        named = (one and (other or alone[second])) or (other and alone[first])
        rows.append(
            {
                "seed": seed,
                "first": first,
                "second": second,
                "named": named,
                "one": one or other,
                "line": line,
            }
        )
    return rows


def main() -> None:
    """Print the tables."""
    given = options(
        __doc__,
        logs=(0, "in which mistakes are planted"),
        pairs=(66, "of mistakes, in each of these logs"),
        clean=(0, "logs without a mistake"),
        first=81000,
        out={"type": Path, "help": "CSV file for a row a log"},
    )
    with tempfile.TemporaryDirectory() as folder:
        lines = [
            said(logged(seed), Path(folder))
            for seed in range(given.first, given.first + given.clean)
        ]
        rows = []
        for seed in range(given.first, given.first + given.logs):
            rows += planted(seed, Path(folder), given.pairs)
            if given.out is not None:
                pd.DataFrame(rows).to_csv(given.out, index=False)
    if lines:
        print(
            f"{len(lines)} clean logs, {sum(map(bool, lines))} with a line: {[line for line in lines if line]}"
        )
    if rows:
        table = pd.DataFrame(rows)
        single = table[table["second"] == ""]
        print(single.groupby("first", sort=False)["named"].agg(["sum", "count"]).to_string())
        pairs = table[table["second"] != ""]
        if len(pairs):
            one, both = pairs["one"].mean(), pairs["named"].mean()
            print(
                f"{len(pairs)} pairs: one named in {one:.1%}, and the other one after its remedy in {both:.1%}"
            )
        missed = table[~table["named"].astype(bool)]
        print(missed[["seed", "first", "second", "line"]].to_string(max_colwidth=140))


if __name__ == "__main__":
    main()
