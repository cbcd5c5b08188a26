"""Identified robots in words: tables of estimates, remarks on a log, and the file of a twin."""

import math
from typing import Any, Final

import numpy as np
import pandas as pd

from servobench.harness.config.description import toml
from servobench.harness.run.identification import Identified, Log, Response, kind_of, prior
from servobench.plant.robot.twin import TIMES

MIN_DEVIATION: Final = 1e-4  # [s] of delay and lag, as they are printed
STILL: Final = 0.05  # [rad] of motion, below which a joint hardly moves
MAX_UNEXPLAINED: Final = 0.1  # [1] share of the joint motion that a lag of first order may leave
SHOWN: Final = 0.05  # [1] of the largest entry of a direction, from which a parameter is named
WHITE: Final = 3.0  # [1] deviations of a correlation from none, up to which residuals count as white
UNITS: Final = {  # of parameters as they are printed, by the begin of their names, and how many are one of their own
    "latency": ("ms", 1e3), "camera_turn": ("°", 180.0 / math.pi), "camera": ("mm", 1e3), "tool": ("mm", 1e3),
    "focal": ("%", 1e2), "centre": ("px", 1.0), "distortion": ("", 1.0), "gear": ("%", 1e2),
    "zero": ("°", 180.0 / math.pi), "link": ("%", 1e2),
}  # fmt: skip


def estimates(robot: Identified, response: Response | None) -> pd.DataFrame:
    """Return a table of the parameters that a log tells, with intervals of 95 %; differences from the nominal robot."""
    rows = [] if response is None else [
        (name, 1e3 * value, 1e3 * max(deviation, MIN_DEVIATION), "ms")
        for name, value, deviation in zip(TIMES[1:], response[:2], np.sqrt(np.diag(response.covariance)), strict=True)
    ]  # fmt: skip
    for name, value, deviation, told in zip(robot.names, robot.values, robot.deviations, robot.told, strict=True):
        unit, per = UNITS[kind_of(name)]
        rows += [(name, per * value, per * deviation, unit)] if told else []
    table = pd.DataFrame(rows, columns=["parameter", "estimate", "deviation", "unit"])
    digits = np.maximum(0, 1 - np.floor(np.log10(2.0 * table["deviation"]))).astype(int)
    table["± 95 %"] = [f"{1.96 * each:.{n}f}" for each, n in zip(table.pop("deviation"), digits, strict=True)]
    table["estimate"] = [f"{each:z.{n}f}" for each, n in zip(table["estimate"], digits, strict=True)]
    return table[["parameter", "estimate", "± 95 %", "unit"]]


def remarks(log: Log, robot: Identified, response: Response | None) -> list[str]:
    """Return lines on a log: its noise, what remains unexplained, and what it does not tell."""
    scale, unit = (1e3, "mm") if log.spec.feature.unit == "m" else (1.0, log.spec.feature.unit)
    noise = ", ".join(f"{name} {scale * each:.2g}" for name, each in
                      zip(log.spec.feature_names, np.sqrt(np.diag(robot.noise)), strict=True))  # fmt: skip
    over_time, over_posture = unexplained(log, robot)
    lines = [
        f"residuals [{unit}]: {noise}; outliers {1.0 - robot.inliers.mean():.1%}, lost frames {lost_share(log):.1%}",
        f"residuals over time are {'white' if over_time < WHITE else 'not white'}, correlated over "
        f"{robot.correlation:.2g} frames; posture explains {max(0.0, over_posture):.1%} of their variance",
    ]
    still = [name for name, each in zip(log.spec.joint_names, np.ptp(log.joints, axis=0), strict=True) if each < STILL]
    if still:
        lines.append(f"joints that hardly move: {', '.join(still)}")
    if response is None:
        lines.append("not told: delay and lag of commands, as the log has none")
    elif response.unexplained > MAX_UNEXPLAINED:
        lines.append(
            f"delay and lag leave {response.unexplained:.0%} of the joint motion: the drive is no first-order lag"
        )
    lines += [f"not told: {each}" for each in untold_combinations(robot)]
    widest = max(
        (name for name, told in zip(robot.names, robot.told, strict=True) if told),
        key=lambda name: robot.deviations[robot.names.index(name)] / prior(name),
    )
    duration = float(np.ptp(log.time))
    lines.append(f"{3.0 * duration:.0f} s more of such motion would halve the intervals; the widest is {widest}")
    return lines


def unexplained(log: Log, robot: Identified) -> tuple[float, float]:
    """Return how white residuals are.

    Returns:
        Their correlation from frame to frame in deviations of that of white noise, and the share of their variance
        that a quadratic function of the joint positions explains beyond chance.
    """
    white = (robot.residuals @ np.linalg.inv(np.linalg.cholesky(robot.noise)).T)[robot.inliers]
    q = log.joints[robot.rows][robot.inliers]
    q = (q - q.mean(axis=0)) / np.maximum(q.std(axis=0), 1e-9)
    upper = np.triu_indices(q.shape[1])
    columns = np.concatenate([np.ones((len(q), 1)), q, q[:, upper[0]] * q[:, upper[1]]], axis=1)
    left = white - columns @ np.linalg.lstsq(columns, white, rcond=None)[0]
    square, chance = float(np.sum(white**2)), columns.shape[1] / len(white)
    along = float(np.sum(white[1:] * white[:-1])) / square * white.size**0.5
    return abs(along), 1.0 - float(np.sum(left**2)) / square / (1.0 - chance)


def frame_period(log: Log) -> float:
    """Return the usual distance of valid frames [s]."""
    return log.spec.period * float(np.median(np.diff(np.flatnonzero(log.valid))))


def lost_share(log: Log) -> float:
    """Return the share of the frames that did not arrive."""
    rows = np.flatnonzero(log.valid)
    return max(0.0, 1.0 - (len(rows) - 1) * frame_period(log) / float(log.time[rows[-1]] - log.time[rows[0]]))


def untold_combinations(robot: Identified) -> list[str]:
    """Return the directions that a log does not tell, by their parameters, each as sparse as pivoting makes it."""
    rows, texts = robot.untold.copy(), []
    for i in range(len(rows)):
        column = int(np.abs(rows[i]).argmax())
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= rows[others, column : column + 1] * rows[i]
    for row in rows:
        order = np.argsort(-np.abs(row))
        texts.append(" with ".join(robot.names[k] for k in order if abs(row[k]) > SHOWN))
    return texts


def twin_text(robot: Identified, log: Log, response: Response | None, named: tuple[str, str]) -> str:
    """Return the file of a twin.

    Args:
        robot: as identified.
        log: of it.
        response: to commands, if the log tells it.
        named: robot and sensing.
    """
    mean = {name: value for name, value in zip(robot.names, robot.values.tolist(), strict=True)
            if name != "latency" and not name.startswith("camera")}  # fmt: skip
    names, factor = list(robot.names), robot.factor
    if response is not None:
        mean |= {"command_delay": response.delay, "lag": response.lag}
        values, vectors = np.linalg.eigh(response.covariance)
        own = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
        factor = np.block([[factor, np.zeros((len(factor), 2))], [np.zeros((2, len(names))), own]])
        names += TIMES[1:]
    errors = robot.residuals[~robot.inliers]
    top: dict[str, Any] = {
        "robot": named[0],
        "sensing": named[1],
        "covariance": robot.noise,
        "lost_frames": lost_share(log),
    }
    if len(errors):
        size = float(np.sqrt(np.mean(errors**2)))
        top |= {"outliers": 1.0 - float(robot.inliers.mean()), "outlier_size": size}
    top |= {"parameters": names, "factor": factor}
    pose = f'{{ frame = "base", position = {toml(robot.pose[:3, 3])}, rotation = {toml(robot.pose[:3, :3])} }}'
    latency = max(0.0, float(robot.values[robot.names.index("latency")]))  # an estimate of 0 may fall below it
    camera = {"latency": latency, "rate": 1.0 / frame_period(log)}
    lines = [f"{key} = {toml(value)}" for key, value in top.items()]
    lines += ["[camera]", *(f"{key} = {toml(value)}" for key, value in camera.items()), f"pose = {pose}"]
    return "\n".join([*lines, "[mean]", *(f"{key} = {toml(value)}" for key, value in mean.items())]) + "\n"
