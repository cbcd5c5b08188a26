"""Identified robots in words: a table of estimates, and remarks on the log that they come from."""

import math
from typing import NamedTuple

import numpy as np
import pandas as pd

from servobench.harness.apps.twin.drive import MIN_MOTION, SUSPECT_SHARE, Response, untold_response
from servobench.harness.apps.twin.held_out import HeldOut
from servobench.harness.apps.twin.identification import EXTRAS, Identified, kind_of, prior, whitened
from servobench.harness.apps.twin.log import Clocks, Log
from servobench.harness.apps.twin.sensor import lost_share, sensor
from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.twin import TIMES

MIN_TIMES = 1e-3  # [s] No drive has a smaller sum of delay and lag.
MIN_DEVIATION = 1e-4  # [s] least deviation of delay and lag that is printed
# A parameter is named in a direction if its entry has this share of the largest one.
MIN_ENTRY = 0.05  # [1]
# Residuals count as white up to this many deviations of a correlation from none.
MAX_CORRELATION = 3.0  # [1]
# Printed unit of each kind of parameter, and how many of these are one of its own unit.
UNITS = {
    "latency": ("ms", 1e3),
    "camera_turn": ("°", 180.0 / math.pi),
    "camera": ("mm", 1e3),
    "tool": ("mm", 1e3),
    "focal": ("%", 1e2),
    "centre": ("px", 1.0),
    "distortion": ("", 1.0),
    "gear": ("%", 1e2),
    "zero": ("°", 180.0 / math.pi),
    "link": ("%", 1e2),
}


class Answer(NamedTuple):
    """What was identified, and from what."""

    title: str  # the robot
    source: str  # name of the log
    log: Log
    nominal: RobotModel
    robot: Identified
    response: Response | None
    held: HeldOut | None


def estimates(robot: Identified, response: Response | None) -> pd.DataFrame:
    """Return a table of the parameters that a log tells, with intervals of 95 %; differences from the nominal robot."""
    rows = []
    if response is not None:
        deviations = np.sqrt(np.diag(response.covariance))
        for name, value, deviation in zip(TIMES[1:], response[:2], deviations, strict=True):
            printed = max(deviation, MIN_DEVIATION)
            rows.append((name, 1e3 * value, 1e3 * printed, "ms"))
    for k, name in enumerate(robot.names):
        if robot.told[k] and name not in EXTRAS:
            unit, per = UNITS.get(kind_of(name), ("", 1.0))
            rows.append((name, per * robot.values[k], per * robot.deviations[k], unit))
    table = pd.DataFrame(rows, columns=["parameter", "estimate", "deviation", "unit"])
    deviation = table.pop("deviation")
    # As many digits as leave two of an interval of two deviations.
    digits = np.maximum(0, 1 - np.floor(np.log10(2.0 * deviation))).astype(int)
    table["± 95 %"] = [f"{1.96 * each:.{n}f}" for each, n in zip(deviation, digits, strict=True)]
    table["estimate"] = [
        f"{each:z.{n}f}" for each, n in zip(table["estimate"], digits, strict=True)
    ]
    return table[["parameter", "estimate", "± 95 %", "unit"]]


def remarks(log: Log, robot: Identified, response: Response | None) -> list[str]:
    """Return lines on a log: its noise, its unexplained residuals, and the parameters that it leaves open."""
    lines = [_noise_line(log, robot), _residuals_line(log, robot)]
    if log.clocks:
        lines.append(_clock_line(log.clocks, robot))
    motions = zip(log.spec.joint_names, np.ptp(log.joints, axis=0), strict=True)
    still = [name for name, motion in motions if motion < MIN_MOTION]
    if still:
        lines.append(f"joints that hardly move: {', '.join(still)}")
    lines += _drive_lines(log, response)
    for section, settings in sensor(log, robot).settings.items():
        words = ", ".join(f"{section}.{name}={value:.3g}" for name, value in settings.items())
        lines.append(f"settings of a plant: {words}")
    far = robot.unlikely()
    if far:
        lines.append(f"far from the nominal robot: {', '.join(far)}; is it this arm?")
    lines += [f"not told: {each}" for each in untold_combinations(robot)]
    lines.append(_longer_line(log, robot))
    return lines


def _noise_line(log: Log, robot: Identified) -> str:
    """Return the residuals of each feature, and the shares of outliers and of lost frames."""
    unit, _ = handy(log)
    noise = _sizes(log, np.sqrt(np.diag(robot.noise)))
    outliers = 1.0 - robot.inliers.mean()
    return (
        f"residuals [{unit}]: {noise}; outliers {outliers:.1%}, lost frames {lost_share(log):.1%}"
    )


def held_out_line(log: Log, held: HeldOut | None) -> str:
    """Return the errors in the window that was held out; empty without one."""
    if held is None:
        return ""
    unit, _ = handy(log)
    return (
        f"held out, {held.begin:.1f} to {held.end:.1f} s, for a fit to the frames before: errors [{unit}]: "
        f"{_sizes(log, held.deviations)}, {held.ratio:.2f} times its residuals"
    )


def handy(log: Log) -> tuple[str, float]:
    """Return the unit in which errors of features are printed, and how many of these are one of the feature's."""
    unit = log.spec.feature.unit
    if unit == "m":
        return "mm", 1e3
    return unit, 1.0


def _sizes(log: Log, deviations: FloatArray) -> str:
    """Return deviations of the features by name."""
    _, scale = handy(log)
    each = zip(log.spec.feature_names, deviations, strict=True)
    return ", ".join(f"{name} {scale * deviation:.2g}" for name, deviation in each)


def _clock_line(clocks: Clocks, robot: Identified) -> str:
    """Return what the latency of a log with stamps of its own holds, and the offset of its clocks if it is told."""
    if clocks.delivery is None:
        return "latency holds the offset of the clocks, which one bag with times of recording tells"
    latency, deviation = robot.estimate("latency")
    return (
        "camera's clock ahead of that of the joints, if frames are stamped when exposed: "
        f"{1e3 * (latency - clocks.delivery):+.1f} ± {1960.0 * deviation:.1g} ms"
    )


def _residuals_line(log: Log, robot: Identified) -> str:
    """Return how far residuals depend on time and on posture."""
    over_time, over_posture = unexplained(log, robot)
    colour = "white" if over_time < MAX_CORRELATION else "not white"
    share = max(0.0, over_posture)
    return (
        f"residuals over time are {colour}, correlated over {robot.correlation:.2g} frames; posture explains "
        f"{share:.1%} of their variance"
    )


def _drive_lines(log: Log, response: Response | None) -> list[str]:
    """Return lines on the commands: why no drive is told, how well it explains the motion, and their clipping."""
    if response is None:
        return [f"not told: delay and lag, as {untold_response(log)}"]
    lines = []
    if response.delay + response.lag < MIN_TIMES:
        lines.append(
            "joints follow commands at once: these are likely their measured speeds; log what was sent"
        )
    elif response.unexplained > SUSPECT_SHARE:
        lines.append(
            f"delay and lag leave {response.unexplained:.0%} of joint motion: the drive is no first-order lag"
        )
    if response.level < math.inf:
        lines.append(
            f"commands act as if clipped at {response.level:.3g} rad/s: log them as they are sent"
        )
    return lines


def _longer_line(log: Log, robot: Identified) -> str:
    """Return how much longer a log would halve the widest interval of a parameter, in deviations of its prior."""
    identified = [name for name, is_told in zip(robot.names, robot.told, strict=True) if is_told]
    wanted = [name for name in identified if name not in EXTRAS]
    shares = [(robot.estimate(name)[1] / prior(name), name) for name in wanted]
    if not shares:
        return "no parameter of arm or camera is told by itself: lead the arm through more postures"
    share, widest = max(shares)
    # Half the interval needs four times the information, of which the prior is no part.
    longer = 3.0 * float(np.ptp(log.time)) / (1.0 - share**2)
    return f"at most {longer:.0f} s more of such motion would halve the widest interval, that of {widest}"


def unexplained(log: Log, robot: Identified) -> tuple[float, float]:
    """Return how white residuals are.

    Returns:
        Their correlation from frame to frame in deviations of that of white noise, and the share of their variance
        that a quadratic function of the joint positions explains beyond chance.
    """
    white = whitened(robot.residuals, robot.noise)[robot.inliers]
    square = float(np.sum(white**2))
    along = float(np.sum(white[1:] * white[:-1])) / square * white.size**0.5
    q = log.joints[robot.rows][robot.inliers]
    q = (q - q.mean(axis=0)) / np.maximum(q.std(axis=0), 1e-9)
    i, j = np.triu_indices(q.shape[1])
    columns = np.concatenate([np.ones((len(q), 1)), q, q[:, i] * q[:, j]], axis=1)
    left = white - columns @ np.linalg.lstsq(columns, white, rcond=None)[0]
    left_share = float(np.sum(left**2)) / square
    chance = columns.shape[1] / len(white)
    return abs(along), 1.0 - left_share / (1.0 - chance)


def untold_combinations(robot: Identified) -> list[str]:
    """Return the directions that a log does not tell, by their parameters, each as sparse as pivoting makes it."""
    rows = robot.untold.copy()
    for i in range(len(rows)):
        column = int(np.abs(rows[i]).argmax())
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= rows[others, column : column + 1] * rows[i]
    texts = []
    for row in rows:
        order = np.argsort(-np.abs(row))
        texts.append(" with ".join(robot.names[k] for k in order if abs(row[k]) > MIN_ENTRY))
    return texts
