"""Identified robots in words: tables of estimates, remarks on a log, and the file of a twin."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from servobench.harness.config.description import toml
from servobench.harness.run.drive import MIN_MOTION, SUSPECT, Response, untold_response
from servobench.harness.run.identification import EXTRAS, OUTLIER, Identified, Log, kind_of, prior
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import BoolArray
from servobench.plant.robot.twin import TIMES

MIN_TIMES: Final = 1e-3  # [s] of delay and lag, below which no drive is
MIN_DEVIATION: Final = 1e-4  # [s] of delay and lag, as they are printed
SHOWN: Final = 0.05  # [1] of the largest entry of a direction, from which a parameter is named
WHITE: Final = (
    3.0  # [1] deviations of a correlation from none, up to which residuals count as white
)
CERTAIN: Final = 5.0  # [1] deviations from none of backlash, ripple, a soft tool and the like
MIN_LATE: Final = 0.02  # [s] by which frames must be late by changing times
MAX_SPREAD: Final = 0.05  # [s] of these times that is no outlier
SLOW_SHARE: Final = 0.3  # [1] of the frames, in which their lateness hardly shows
LATE_RATIO: Final = (
    0.2  # [1] median over mean of squared errors, above which fast frames are late and not false
)
BURST_RATIO: Final = 2.0  # [1] lost frames in a row over those of independent losses
MIN_ODD: Final = (
    0.05  # [1] of the usual gaps between frames, from which others belong to the camera's period
)
ODD_GAPS: Final = (
    12.0  # of a steady camera, within which the lateness of its frames changes by less than UNEVEN
)
MIN_PART: Final = 1e-3  # [rows] from which the distance of frames is no whole number of rows
UNEVEN: Final = 2.0  # [rows]
JITTERS: Final = np.arange(0.01, 0.5, 0.01).tolist()  # [s]
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
    for name, value, deviation, told in zip(
        robot.names, robot.values, robot.deviations, robot.told, strict=True
    ):
        unit, per = UNITS.get(kind_of(name), ("", 1.0))
        rows += [(name, per * value, per * deviation, unit)] if told and name not in EXTRAS else []
    table = pd.DataFrame(rows, columns=["parameter", "estimate", "deviation", "unit"])
    digits = np.maximum(0, 1 - np.floor(np.log10(2.0 * table["deviation"]))).astype(int)
    table["± 95 %"] = [
        f"{1.96 * each:.{n}f}" for each, n in zip(table.pop("deviation"), digits, strict=True)
    ]
    table["estimate"] = [
        f"{each:z.{n}f}" for each, n in zip(table["estimate"], digits, strict=True)
    ]
    return table[["parameter", "estimate", "± 95 %", "unit"]]


def remarks(log: Log, robot: Identified, response: Response | None) -> list[str]:
    """Return lines on a log: its noise, its unexplained residuals, and the parameters that it leaves open."""
    scale, unit = (1e3, "mm") if log.spec.feature.unit == "m" else (1.0, log.spec.feature.unit)
    noise = ", ".join(f"{name} {scale * each:.2g}" for name, each in
                      zip(log.spec.feature_names, np.sqrt(np.diag(robot.noise)), strict=True))  # fmt: skip
    over_time, over_posture = unexplained(log, robot)
    lines = [
        f"residuals [{unit}]: {noise}; outliers {1.0 - robot.inliers.mean():.1%}, lost frames {lost_share(log):.1%}",
        f"residuals over time are {'white' if over_time < WHITE else 'not white'}, correlated over "
        f"{robot.correlation:.2g} frames; posture explains {max(0.0, over_posture):.1%} of their variance",
    ]
    motions = zip(log.spec.joint_names, np.ptp(log.joints, axis=0), strict=True)
    if still := [name for name, motion in motions if motion < MIN_MOTION]:
        lines.append(f"joints that hardly move: {', '.join(still)}")
    if response is None:
        lines.append(f"not told: delay and lag, as {untold_response(log)}")
    elif response.delay + response.lag < MIN_TIMES:
        lines.append(
            "joints follow commands at once: these are likely their measured speeds; log what was sent"
        )
    elif response.unexplained > SUSPECT:
        lines.append(
            f"delay and lag leave {response.unexplained:.0%} of joint motion: the drive is no first-order lag"
        )
    if response is not None and response.level < math.inf:
        lines.append(
            f"commands act as if clipped at {response.level:.3g} rad/s: log them as they are sent"
        )
    for section, settings in sensor(log, robot).settings.items():
        words = ", ".join(f"{section}.{name}={value:.3g}" for name, value in settings.items())
        lines.append(f"settings of a plant: {words}")
    if far := robot.unlikely():
        lines.append(f"far from the nominal robot: {', '.join(far)}; is it this arm?")
    lines += [f"not told: {each}" for each in untold_combinations(robot)]
    told = [
        name
        for name, told in zip(robot.names, robot.told, strict=True)
        if told and name not in EXTRAS
    ]
    share, widest = max((robot.estimate(name)[1] / prior(name), name) for name in told)
    # As the prior is no part of a log's information
    longer = 3.0 * float(np.ptp(log.time)) / (1.0 - share**2)
    lines.append(
        f"at most {longer:.0f} s more of such motion would halve the widest interval, that of {widest}"
    )
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
    """Return the distance of frames of which some may be missing [s]: usual gaps, and those a row longer or shorter."""
    rows = np.flatnonzero(log.valid)
    gaps = np.diff(rows)
    counts = np.bincount(gaps, minlength=gaps.max() + 2)
    usual = int(counts.argmax())
    other = max(usual - 1, usual + 1, key=lambda gap: int(counts[gap]))
    length = float(np.average([usual, other], weights=counts[[usual, other]]))
    if usual == 1 < length:  # a gap of two rows is a lost frame, or one of a steady camera
        frames = np.cumsum(np.where(gaps <= other, 1.0, np.rint(gaps / length)))
        window = min(len(gaps), int(ODD_GAPS / (length - 1.0)))
        late = sliding_window_view(rows[1:] - length * frames, window)[::window]
        length = length if np.median(np.ptp(late, axis=1)) < UNEVEN else 1.0
    return log.spec.period * (usual if counts[other] < MIN_ODD * counts[usual] else length)


def missing_frames(log: Log) -> FloatArray:
    """Return how many frames are missing in each gap between two."""
    gaps, length = np.diff(np.flatnonzero(log.valid)), frame_period(log) / log.spec.period
    return np.asarray(np.where(gaps > math.ceil(length - 1e-9), np.rint(gaps / length) - 1.0, 0.0))


def lost_share(log: Log) -> float:
    """Return the share of the frames that did not arrive."""
    missing = missing_frames(log)
    return float(missing.sum() / (missing.sum() + len(missing)))


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


class Sensor(NamedTuple):
    """How camera, gears and tool deviate from steady and rigid ones, as a log tells."""

    latency: float  # [s]
    noise: FloatArray  # Σ, (m, m)
    outliers: BoolArray  # which of the frames, (k,)
    lost: float  # [1] share of the frames
    settings: dict[str, dict[str, float]]  # of a plant, by section


def sensor(log: Log, robot: Identified) -> Sensor:
    """Return the sensor and the mechanics behind a log.

    Frames late by times of deviation σ leave residuals with E‖e‖² = tr Σ + σ² ‖ẏ‖² of a feature that moves at ẏ.
    """
    found = {name: value for name, (value, deviation) in ((name, robot.estimate(name)) for name in EXTRAS)
             if abs(value) > CERTAIN * deviation}  # fmt: skip
    mechanics: dict[str, float] = {
        name: abs(found[name]) for name in ("backlash", "ripple") if name in found
    }
    mechanics |= (
        {"tool_frequency": found["compliance"] ** -0.5}
        if found.get("compliance", 0.0) > 1e-12
        else {}
    )
    sensing = {"camera_turn": found["turning"]} if found.get("turning", 0.0) > 0.0 else {}
    swing = math.hypot(found.get("swing_sin", 0.0), found.get("swing_cos", 0.0))
    spread, steady, kept = _lateness(log, robot)
    noise, outliers, waiting = robot.noise, ~robot.inliers, Waiting(0.0, 0.0, 0.0)
    lost, missing = lost_share(log), missing_frames(log)
    gap = float(np.median(missing[missing > 0.0])) if missing.any() else 0.0  # of frames in a row
    if swing > MIN_LATE:
        sensing |= {"latency_swing": swing, "swing_period": robot.swing_period}
        waiting = arrivals(log.spec.period, 0.0, swing, robot.swing_period)
        if waiting.swing > MIN_LATE:
            sensing["latency_swing"] *= swing / waiting.swing
    elif spread > MIN_LATE:
        tried = [(arrivals(log.spec.period, jitter), jitter) for jitter in JITTERS]
        waiting, sensing["jitter"] = min(tried, key=lambda each: abs(each[0].deviation - spread))
    elif gap * (1.0 - lost) > BURST_RATIO:
        sensing |= {"occlusions": lost, "occlusion_duration": gap * frame_period(log)}
        lost = 0.0
    rows = frame_period(log) / log.spec.period
    # Until the next control instant
    wait = 0.5 * log.spec.period if abs(rows - round(rows)) > MIN_PART else 0.0
    if waiting.mean:
        wait = waiting.mean
        noise, outliers, lost = steady, ~kept, max(0.0, lost - waiting.missing)
    latency = max(0.0, robot.estimate("latency")[0] - wait)  # an estimate of 0 may fall below it
    sections: dict[str, dict[str, float]] = {"sensing": sensing, "mechanics": mechanics}
    return Sensor(
        latency, noise, outliers, lost, {name: own for name, own in sections.items() if own}
    )


def _lateness(log: Log, robot: Identified) -> tuple[float, FloatArray, BoolArray]:
    """Return the certain part of σ [s], Σ by the slow frames, and which frames are no outliers."""
    speed, square = np.sum(robot.rates(log) ** 2, axis=1), np.sum(robot.residuals**2, axis=1)
    slow = robot.inliers & (speed <= np.quantile(speed, SLOW_SHARE))
    usual = float(np.mean(square[slow])) + 1e-18
    kept = square < OUTLIER * (usual / log.spec.m + MAX_SPREAD**2 * speed)
    weight = kept / (usual + MAX_SPREAD**2 * speed)
    apart = weight * (speed - np.average(speed, weights=weight))
    size = float(apart @ speed) + 1e-12
    slope = float(apart @ square) / size
    left = square - slope * speed
    deviation = float(np.linalg.norm(apart * (left - np.average(left, weights=weight)))) / size
    share = max(float(np.mean(left[slow])) / usual, 0.1)
    fast = kept & (speed > np.median(speed))  # outliers enlarge few of them, lateness most
    late = (
        slope > CERTAIN * deviation
        and float(np.median(square[fast] / (slope * speed[fast]))) > LATE_RATIO
    )
    return (slope**0.5 if late else 0.0), share * np.cov(robot.residuals[slow].T), kept


class Waiting(NamedTuple):
    """The time from exposure to the control instant that follows the delivery, in frames of a latency that changes."""

    mean: float  # [s]
    deviation: float  # [s]
    missing: float  # [1] share of the periods without a new frame
    swing: float = 0.0  # [s] of a fit to the frames that are seen


def arrivals(
    period: float, jitter: float, swing: float = 0.0, swing_period: float = 1.0
) -> Waiting:
    """Return the times of frames that are late by A (1 + sin(2π t/P)) + U(0, jitter), as the bench delivers them."""
    instants = np.arange(4000.0)
    late = swing * (1.0 + np.sin(2.0 * np.pi * period * instants / swing_period))
    late += jitter * np.random.default_rng(0).random(len(instants))
    newest = (
        np.searchsorted(np.maximum.accumulate(instants + late / period), instants, side="right") - 1
    )
    new = np.diff(newest, prepend=-1) > 0
    age = period * (instants - newest)[new]
    wave = np.sin(2.0 * np.pi * period * newest[new] / swing_period)
    size = float(np.cov(wave, age)[0, 1] / max(wave.var(), 1e-9))
    return Waiting(float(age.mean()), float(age.std()), 1.0 - len(age) / len(instants), size)


def twin_text(
    robot: Identified, log: Log, response: Response | None, named: tuple[str, str]
) -> str:
    """Return the file of a twin.

    Args:
        robot: as identified.
        log: of it.
        response: to commands, if the log tells it.
        named: robot and sensing.
    """
    own = [k for k, name in enumerate(robot.names) if name not in EXTRAS]
    names, factor, told = [robot.names[k] for k in own], robot.factor[:, own], sensor(log, robot)
    mean = {name: float(robot.values[k]) for name, k in zip(names, own, strict=True)
            if name != "latency" and not name.startswith("camera")}  # fmt: skip
    if response is not None:
        mean |= {"command_delay": response.delay, "lag": response.lag}
        values, vectors = np.linalg.eigh(response.covariance)
        times = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
        factor = np.block(
            [[factor, np.zeros((len(factor), 2))], [np.zeros((2, len(names))), times]]
        )
        names += TIMES[1:]
    top: dict[str, Any] = {
        "robot": named[0],
        "sensing": named[1],
        "covariance": told.noise,
        "lost_frames": told.lost,
    }
    if told.outliers.any():
        size = float(np.sqrt(np.mean(robot.residuals[told.outliers] ** 2)))
        top |= {"outliers": float(told.outliers.mean()), "outlier_size": size}
    top |= {"parameters": names, "factor": factor}
    pose = f'{{ frame = "base", position = {toml(robot.pose[:3, 3])}, rotation = {toml(robot.pose[:3, :3])} }}'
    sections = {"camera": {"latency": told.latency, "rate": 1.0 / frame_period(log)}, "mean": mean}
    sections |= {f"plant.{name}": settings for name, settings in told.settings.items()}
    lines = [f"{key} = {toml(value)}" for key, value in top.items()]
    for name, section in sections.items():
        lines += [f"[{name}]", *(f"{key} = {toml(value)}" for key, value in section.items())]
        lines += [f"pose = {pose}"] if name == "camera" else []
    return "\n".join(lines) + "\n"
