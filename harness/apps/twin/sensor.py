"""The camera behind a log: period, lateness and losses of its frames, and how far gears and tool are not rigid."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from servobench.harness.apps.twin.identification import EXTRAS, OUTLIER, Identified, fitted_wave
from servobench.harness.apps.twin.log import Log
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import BoolArray

CERTAIN = (
    5.0  # [1] deviations from none that make backlash, ripple, a soft tool and the like certain
)
MIN_JITTER = 0.02  # [s] by which frames must be late by changing times
WAVE_RESIDUAL_SHARE = (
    0.3  # [1] share of the squares of stamped latenesses that a wave leaves where they swing
)
MAX_JITTER = 0.05  # [s] deviation of these times that makes no outliers
SLOW_SHARE = 0.3  # [1] share of the frames, the slowest ones, in which their lateness hardly shows
# Fast frames are late, and not false, if the median of their squared errors over the mean is above this.
LATE_RATIO = 0.2  # [1]
BURST_RATIO = 2.0  # [1] lost frames in a row over those of independent losses
# Gaps of another length belong to the camera's period if they have this share of the usual ones.
MIN_ODD_SHARE = 0.05  # [1]
# Between this many odd gaps of a steady camera the lateness of frames changes by less than MAX_UNEVENNESS.
ODD_GAPS = 12.0
MAX_UNEVENNESS = 2.0  # [rows]
MIN_ROW_PART = 1e-3  # [rows] from which the distance of frames is no whole number of rows
JITTERS = np.arange(0.01, 0.5, 0.01).tolist()  # [s] that are tried


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
    return np.where(gaps > longest, np.rint(gaps / length) - 1.0, 0.0)


def lost_share(log: Log) -> float:
    """Return the share of the frames that did not arrive."""
    missing = missing_frames(log)
    return float(missing.sum() / (missing.sum() + len(missing)))


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
    sensing = {}
    if certain.get("turning", 0.0) > 0.0:
        sensing["camera_turn"] = certain["turning"]
    swing = math.hypot(certain.get("swing_sin", 0.0), certain.get("swing_cos", 0.0))
    lateness = _lateness(log, robot)
    swing_period = robot.swing_period
    if log.stamped.any():
        sensing["stamps"] = True
        late = log.lateness[log.stamped]
        late = late - late.mean()
        wave = fitted_wave(log.frame_time[log.stamped], late, np.ones_like(late))
        if wave is not None and wave[-1] < WAVE_RESIDUAL_SHARE:
            pace, sizes, _ = wave
            swing = float(np.linalg.norm(sizes))
            swing_period = 2.0 * math.pi / pace
    waiting = Waiting(0.0, 0.0, 0.0)
    lost = lost_share(log)
    missing = missing_frames(log)
    in_a_row = float(np.median(missing[missing > 0.0])) if missing.any() else 0.0
    if swing > MIN_JITTER:
        waiting = arrivals(period, 0.0, swing, swing_period)
        # The fit sees the newest frames only, and so a smaller swing.
        ratio = swing / waiting.swing if waiting.swing > MIN_JITTER else 1.0
        sensing["latency_swing"] = swing * ratio
        sensing["swing_period"] = swing_period
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
    elif log.clocks is None:
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
    """Return the lateness of frames: by their stamps, or σ² as the slope of ‖e‖² over ‖ẏ‖²."""
    if log.stamped.any():
        deviation = float(log.lateness[log.stamped].std())
        return _Lateness(deviation, robot.noise, robot.inliers)
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
