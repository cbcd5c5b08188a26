"""Identified robots in words: tables of estimates, remarks on a log, and the file of a twin."""

import math
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from servobench.harness.apps.twin.drive import MIN_MOTION, SUSPECT_SHARE, Response, untold_response
from servobench.harness.apps.twin.identification import (
    EXTRAS,
    OUTLIER,
    Identified,
    Log,
    kind_of,
    prior,
)
from servobench.harness.config.description import toml
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import BoolArray
from servobench.plant.robot.twin import TIMES

MIN_TIMES: Final = 1e-3  # [s] No drive has a smaller sum of delay and lag.
MIN_DEVIATION: Final = 1e-4  # [s] least deviation of delay and lag that is printed
# A parameter is named in a direction if its entry has this share of the largest one.
MIN_ENTRY: Final = 0.05  # [1]
# Residuals count as white up to this many deviations of a correlation from none.
MAX_CORRELATION: Final = 3.0  # [1]
CERTAIN: Final = (
    5.0  # [1] deviations from none that make backlash, ripple, a soft tool and the like certain
)
MIN_JITTER: Final = 0.02  # [s] by which frames must be late by changing times
MAX_JITTER: Final = 0.05  # [s] deviation of these times that makes no outliers
SLOW_SHARE: Final = (
    0.3  # [1] share of the frames, the slowest ones, in which their lateness hardly shows
)
# Fast frames are late, and not false, if the median of their squared errors over the mean is above this.
LATE_RATIO: Final = 0.2  # [1]
BURST_RATIO: Final = 2.0  # [1] lost frames in a row over those of independent losses
# Gaps of another length belong to the camera's period if they have this share of the usual ones.
MIN_ODD_SHARE: Final = 0.05  # [1]
# Between this many odd gaps of a steady camera the lateness of frames changes by less than MAX_UNEVENNESS.
ODD_GAPS: Final = 12.0
MAX_UNEVENNESS: Final = 2.0  # [rows]
MIN_ROW_PART: Final = 1e-3  # [rows] from which the distance of frames is no whole number of rows
JITTERS: Final = np.arange(0.01, 0.5, 0.01).tolist()  # [s] that are tried
# Printed unit of each kind of parameter, and how many of these are one of its own unit.
UNITS: Final = {
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
    unit = log.spec.feature.unit
    scale = 1.0
    if unit == "m":
        unit = "mm"
        scale = 1e3
    deviations = np.sqrt(np.diag(robot.noise))
    each = zip(log.spec.feature_names, deviations, strict=True)
    noise = ", ".join(f"{name} {scale * deviation:.2g}" for name, deviation in each)
    outliers = 1.0 - robot.inliers.mean()
    return (
        f"residuals [{unit}]: {noise}; outliers {outliers:.1%}, lost frames {lost_share(log):.1%}"
    )


def _residuals_line(log: Log, robot: Identified) -> str:
    """Return how far residuals depend on time and on posture."""
    over_time, over_posture = unexplained(log, robot)
    colour = "white" if over_time < MAX_CORRELATION else "not white"
    share = max(0.0, over_posture)
    correlation = (
        f"residuals over time are {colour}, correlated over {robot.correlation:.2g} frames"
    )
    return f"{correlation}; posture explains {share:.1%} of their variance"


def _drive_lines(log: Log, response: Response | None) -> list[str]:
    """Return lines on the commands: why no drive is told, how well it explains the motion, and their clipping."""
    if response is None:
        return [f"not told: delay and lag, as {untold_response(log)}"]
    lines = []
    if response.delay + response.lag < MIN_TIMES:
        likely = "these are likely their measured speeds; log what was sent"
        lines.append(f"joints follow commands at once: {likely}")
    elif response.unexplained > SUSPECT_SHARE:
        left = f"delay and lag leave {response.unexplained:.0%} of joint motion"
        lines.append(f"{left}: the drive is no first-order lag")
    if response.level < math.inf:
        clipped = f"commands act as if clipped at {response.level:.3g} rad/s"
        lines.append(f"{clipped}: log them as they are sent")
    return lines


def _longer_line(log: Log, robot: Identified) -> str:
    """Return how much longer a log would halve the widest interval of a parameter, in deviations of its prior."""
    told = [name for name, own in zip(robot.names, robot.told, strict=True) if own]
    shares = [(robot.estimate(n)[1] / prior(n), n) for n in told if n not in EXTRAS]
    share, widest = max(shares)
    # Half the interval needs four times the information, of which the prior is no part.
    longer = 3.0 * float(np.ptp(log.time)) / (1.0 - share**2)
    motion = f"at most {longer:.0f} s more of such motion"
    return f"{motion} would halve the widest interval, that of {widest}"


def unexplained(log: Log, robot: Identified) -> tuple[float, float]:
    """Return how white residuals are.

    Returns:
        Their correlation from frame to frame in deviations of that of white noise, and the share of their variance
        that a quadratic function of the joint positions explains beyond chance.
    """
    whitening = np.linalg.inv(np.linalg.cholesky(robot.noise)).T
    white = (robot.residuals @ whitening)[robot.inliers]
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


def frame_period(log: Log) -> float:
    """Return the distance of frames of which some may be missing [s]: usual gaps, and those a row longer or shorter."""
    rows = np.flatnonzero(log.valid)
    gaps = np.diff(rows)
    counts = np.bincount(gaps, minlength=gaps.max() + 2)
    usual = int(counts.argmax())
    odd = max(usual - 1, usual + 1, key=lambda gap: int(counts[gap]))
    if counts[odd] < MIN_ODD_SHARE * counts[usual]:
        return log.spec.period * usual
    length = float(np.average([usual, odd], weights=counts[[usual, odd]]))
    if usual == 1 < length and not _is_steady(rows, length, odd):
        length = 1.0
    return log.spec.period * length


def _is_steady(rows: npt.NDArray[np.intp], length: float, odd: int) -> bool:
    """Return whether the rows of frames are those of a steady camera with frames `length` rows apart.

    A gap of two rows is a lost frame, or one of a camera that is a little slower than the log.
    """
    gaps = np.diff(rows)
    frames = np.cumsum(np.where(gaps <= odd, 1.0, np.rint(gaps / length)))
    window = min(len(gaps), int(ODD_GAPS / (length - 1.0)))
    late = sliding_window_view(rows[1:] - length * frames, window)[::window]
    return bool(np.median(np.ptp(late, axis=1)) < MAX_UNEVENNESS)


def missing_frames(log: Log) -> FloatArray:
    """Return how many frames are missing in each gap between two."""
    gaps = np.diff(np.flatnonzero(log.valid))
    length = frame_period(log) / log.spec.period  # [rows]
    longest = math.ceil(length - 1e-9)
    return np.asarray(np.where(gaps > longest, np.rint(gaps / length) - 1.0, 0.0))


def lost_share(log: Log) -> float:
    """Return the share of the frames that did not arrive."""
    missing = missing_frames(log)
    return float(missing.sum() / (missing.sum() + len(missing)))


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


class Sensor(NamedTuple):
    """How camera, gears and tool deviate from steady and rigid ones, as a log tells."""

    latency: float  # [s]
    noise: FloatArray  # Σ, (m, m)
    outliers: BoolArray  # which frames are outliers, (k,)
    lost: float  # [1] share of the frames
    settings: dict[str, dict[str, float]]  # settings of a plant, by section


def sensor(log: Log, robot: Identified) -> Sensor:
    """Return the sensor and the mechanics behind a log.

    Frames late by times of deviation σ leave residuals with E‖e‖² = tr Σ + σ² ‖ẏ‖² of a feature that moves at ẏ.
    """
    period = log.spec.period
    certain = _certain_extras(robot)
    sensing: dict[str, float] = {}
    if certain.get("turning", 0.0) > 0.0:
        sensing["camera_turn"] = certain["turning"]
    swing = math.hypot(certain.get("swing_sin", 0.0), certain.get("swing_cos", 0.0))
    lateness = _lateness(log, robot)
    waiting = Waiting(0.0, 0.0, 0.0)
    lost = lost_share(log)
    missing = missing_frames(log)
    in_a_row = float(np.median(missing[missing > 0.0])) if missing.any() else 0.0
    if swing > MIN_JITTER:
        waiting = arrivals(period, 0.0, swing, robot.swing_period)
        # The fit sees the newest frames only, and so a smaller swing.
        ratio = swing / waiting.swing if waiting.swing > MIN_JITTER else 1.0
        sensing["latency_swing"] = swing * ratio
        sensing["swing_period"] = robot.swing_period
    elif lateness.deviation > MIN_JITTER:
        tried = [(arrivals(period, jitter), jitter) for jitter in JITTERS]
        waiting, jitter = min(tried, key=lambda each: abs(each[0].deviation - lateness.deviation))
        sensing["jitter"] = jitter
    elif in_a_row * (1.0 - lost) > BURST_RATIO:
        sensing["occlusions"] = lost
        sensing["occlusion_duration"] = in_a_row * frame_period(log)
        lost = 0.0
    noise = robot.noise
    outliers = ~robot.inliers
    wait = waiting.mean
    if wait:
        noise = lateness.noise
        outliers = ~lateness.kept
        lost = max(0.0, lost - waiting.missing)
    else:
        rows = frame_period(log) / period
        if abs(rows - round(rows)) > MIN_ROW_PART:
            wait = 0.5 * period  # until the next control instant
    # An estimate of 0 may fall below the wait.
    latency = max(0.0, robot.estimate("latency")[0] - wait)
    sections = {"sensing": sensing, "mechanics": _mechanics(certain)}
    settings = {name: own for name, own in sections.items() if own}
    return Sensor(latency, noise, outliers, lost, settings)


def _certain_extras(robot: Identified) -> dict[str, float]:
    """Return those parameters of gears, clocks, tool and mounting that are certainly not 0."""
    found = {}
    for name in EXTRAS:
        value, deviation = robot.estimate(name)
        if abs(value) > CERTAIN * deviation:
            found[name] = value
    return found


def _mechanics(certain: Mapping[str, float]) -> dict[str, float]:
    """Return the settings of a plant's gears and tool."""
    found = {name: abs(certain[name]) for name in ("backlash", "ripple") if name in certain}
    if certain.get("compliance", 0.0) > 1e-12:
        found["tool_frequency"] = certain["compliance"] ** -0.5
    return found


class _Lateness(NamedTuple):
    """How far frames are late by changing times."""

    deviation: float  # the certain part of σ [s]
    noise: FloatArray  # Σ by the slow frames, (m, m)
    kept: BoolArray  # which frames are no outliers, (k,)


def _lateness(log: Log, robot: Identified) -> _Lateness:
    """Return the lateness of frames, σ² as the slope of ‖e‖² over ‖ẏ‖²."""
    speed = np.sum(robot.rates(log) ** 2, axis=1)  # ‖ẏ‖²
    square = np.sum(robot.residuals**2, axis=1)  # ‖e‖²
    slow = robot.inliers & (speed <= np.quantile(speed, SLOW_SHARE))
    usual = float(np.mean(square[slow])) + 1e-18
    kept = square < OUTLIER * (usual / log.spec.m + MAX_JITTER**2 * speed)
    weight = kept / (usual + MAX_JITTER**2 * speed)
    lever = weight * (speed - np.average(speed, weights=weight))
    size = float(lever @ speed) + 1e-12
    slope = float(lever @ square) / size
    left = square - slope * speed
    scatter = lever * (left - np.average(left, weights=weight))
    deviation = float(np.linalg.norm(scatter)) / size
    share = max(float(np.mean(left[slow])) / usual, 0.1)
    late = 0.0
    if slope > CERTAIN * deviation:
        # Outliers enlarge few of the fast frames' errors, and lateness most.
        fast = kept & (speed > np.median(speed))
        if float(np.median(square[fast] / (slope * speed[fast]))) > LATE_RATIO:
            late = slope**0.5
    return _Lateness(late, share * np.cov(robot.residuals[slow].T), kept)


class Waiting(NamedTuple):
    """The time from exposure to the control instant that follows the delivery, in frames of a latency that changes."""

    mean: float  # [s]
    deviation: float  # [s]
    missing: float  # [1] share of the periods without a new frame
    swing: float = 0.0  # [s] amplitude fitted to the frames that are seen


def arrivals(
    period: float, jitter: float, swing: float = 0.0, swing_period: float = 1.0
) -> Waiting:
    """Return the times of frames that are late by A (1 + sin(2π t/P)) + U(0, jitter), as the bench delivers them."""
    instants = np.arange(4000.0)  # [periods]
    late = swing * (1.0 + np.sin(2.0 * np.pi * period * instants / swing_period))
    late += jitter * np.random.default_rng(0).random(len(instants))
    # No frame is delivered before an earlier one.
    delivered = np.maximum.accumulate(instants + late / period)
    newest = np.searchsorted(delivered, instants, side="right") - 1
    new = np.diff(newest, prepend=-1) > 0
    age = period * (instants - newest)[new]
    wave = np.sin(2.0 * np.pi * period * newest[new] / swing_period)
    size = float(np.cov(wave, age)[0, 1] / max(wave.var(), 1e-9))
    missing = 1.0 - len(age) / len(instants)
    return Waiting(float(age.mean()), float(age.std()), missing, size)


def twin_text(
    robot: Identified, log: Log, response: Response | None, named: tuple[str, str]
) -> str:
    """Return the file of a twin.

    Args:
        robot: as identified.
        log: the log that it was identified from.
        response: to commands, if the log tells it.
        named: robot and sensing.
    """
    own = [k for k, name in enumerate(robot.names) if name not in EXTRAS]
    names = [robot.names[k] for k in own]
    factor = robot.factor[:, own]
    mean: dict[str, float] = {}
    for k, name in zip(own, names, strict=True):
        if name != "latency" and not name.startswith("camera"):
            mean[name] = float(robot.values[k])
    if response is not None:
        mean["command_delay"] = response.delay
        mean["lag"] = response.lag
        factor = _with_times(factor, response.covariance)
        names += TIMES[1:]
    measured = sensor(log, robot)
    top: dict[str, Any] = {
        "robot": named[0],
        "sensing": named[1],
        "covariance": measured.noise,
        "lost_frames": measured.lost,
    }
    if measured.outliers.any():
        false = robot.residuals[measured.outliers]
        top["outliers"] = float(measured.outliers.mean())
        top["outlier_size"] = float(np.sqrt(np.mean(false**2)))
    top["parameters"] = names
    top["factor"] = factor
    camera = {"latency": measured.latency, "rate": 1.0 / frame_period(log)}
    place = toml(robot.pose[:3, 3])
    rotation = toml(robot.pose[:3, :3])
    lines = [
        *_assignments(top),
        "[camera]",
        *_assignments(camera),
        f'pose = {{ frame = "base", position = {place}, rotation = {rotation} }}',
        "[mean]",
        *_assignments(mean),
    ]
    for name, settings in measured.settings.items():
        lines += [f"[plant.{name}]", *_assignments(settings)]
    return "\n".join(lines) + "\n"


def _assignments(values: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {toml(value)}" for key, value in values.items()]


def _with_times(factor: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return a factor (d, p) with rows and columns for delay and lag, of covariance (2, 2): (d + 2, p + 2)."""
    values, vectors = np.linalg.eigh(covariance)
    times = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    directions, parameters = factor.shape
    return np.block([[factor, np.zeros((directions, 2))], [np.zeros((2, parameters)), times]])
