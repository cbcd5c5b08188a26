"""What a run is judged by, from its logged rows. All errors are those of the true feature.

| metric | meaning |
|---|---|
| settling_time_s | first time after which the error stays within the band (5 mm), for at least 0.5 s; NaN if never |
| settling_time_5pct_s | the same for 5 % of the initial error |
| overshoot | how far the feature passes a fixed target, as a share of the initial error; NaN when tracking |
| steady_state_error | mean error of the last second |
| rms_error, max_error | over the whole run |
| rms_error_second_lap | over the second lap; NaN where nothing is repeated |
| rms_error_evaluated | over the evaluated part: the last lap, the last quarter of a move, the last half of a path |
| path_length_ratio | true path over the straight line (point to point) or over the reference's path (tracking) |
| max_joint_position_rad | largest |q| of all joints and periods |
| control_effort_rad | Σ |u| dt over joints and periods |
| saturation_fraction | share of periods in which a joint is commanded at its speed limit |
| joint_acceleration_peak_rad_s2, joint_acceleration_rms_rad_s2 | of the commands, over joints and periods |
| joint_jerk_peak_rad_s3, joint_jerk_rms_rad_s3 | the same of the jerk |
| command_switches | how often a large joint command is followed by a large one of the other sign, see `sign_switches` |
| feature_invalid_fraction | share of periods without a valid feature |
| controller_time_overruns | periods in which the controller's step took longer than the period |
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from servobench.harness.run.log import Steps
from servobench.harness.run.references import TaskKind
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm, transposed

SETTLING_SHARE = 0.05  # band as a share of the initial error
DWELL = 0.5  # [s] least time within the band at the end of a run
FINAL_SPAN = 1.0  # [s] over which the steady state is averaged
LARGE_COMMAND = 0.1  # share of the joint's speed limit from which on a command counts as large
SWITCH_PERIODS = 2  # within which a change of sign counts as a switch


def settling_time(error: FloatArray, band: npt.ArrayLike, period: float, dwell: float = DWELL) -> FloatArray:
    """Return the first time after which `error` stays within `band`.

    Args:
        error: (..., k), one value a period [unit of the feature].
        band: one number or (...) [unit of the feature].
        period: [s].
        dwell: least time within the band at the end [s].

    Returns:
        (...) [s]; NaN if the error is outside at the end, or came in less than `dwell` before it.
    """
    count = error.shape[-1]
    outside = ~(error <= np.asarray(band)[..., None])
    first = np.where(outside.any(axis=-1), count - outside[..., ::-1].argmax(axis=-1), 0)
    return np.where((count - first) * period >= dwell - 1e-9, first * period, np.nan)


def overshoot(feature: FloatArray, target: FloatArray) -> FloatArray:
    """Return how far the feature passes the target along the initial error, as a share of that.

    Args:
        feature: (..., m, k) [unit of the feature].
        target: (..., m) [unit of the feature].

    Returns:
        (...), at least 0; NaN if the run starts at the target.
    """
    start = feature[..., 0]
    way = target - start
    length = np.vecdot(way, way)
    passed = np.vecmat(way, feature - start[..., None]).max(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(length > 0.0, np.maximum(0.0, passed / length - 1.0), np.nan)


def path_length(points: FloatArray) -> FloatArray:
    """Return the length, (...), of the path through `points`, (..., m, k) [their unit]."""
    steps = np.ascontiguousarray(transposed(np.diff(points, axis=-1)))
    return np.asarray(norm(steps).sum(axis=-1))


def sign_switches(command: FloatArray, limit: FloatArray) -> npt.NDArray[np.int_]:
    """Return how often joints are driven to and fro, summed over joints.

    A joint switches in a period whose command is large, that is at least `LARGE_COMMAND` of the limit, if its previous
    large command has the other sign and is at most `SWITCH_PERIODS` periods old. A slow reversal is no switch.

    Args:
        command: (..., n, k) [rad/s].
        limit: (n,) [rad/s].

    Returns:
        (...) switches; 0 for a single period.
    """
    sign = np.where(np.abs(command) >= LARGE_COMMAND * limit[:, None], np.sign(command), 0.0)
    before = np.zeros_like(sign)  # sign of the newest large command of the periods that count
    for back in range(SWITCH_PERIODS, 0, -1):
        earlier = sign[..., :-back]
        before[..., back:] = np.where(earlier == 0.0, before[..., back:], earlier)
    return np.asarray(np.count_nonzero(sign * before < 0.0, axis=(-2, -1)))


def command_derivatives(command: FloatArray, period: float) -> tuple[FloatArray, FloatArray]:
    """Return acceleration, (..., n, k − 1) [rad/s²], and jerk, (..., n, k − 2) [rad/s³], of the commands.

    They are differences of consecutive commands (..., n, k) [rad/s] over the period [s]; the step from rest to the
    first command is none of them.
    """
    acceleration = np.diff(command, axis=-1) / period
    return acceleration, np.diff(acceleration, axis=-1) / period


def judge_run(steps: Steps, kind: TaskKind, evaluate_from: float, lap_time: float = math.nan) -> dict[str, FloatArray]:
    """Return the metrics of a run, or of runs side by side.

    Args:
        steps: the rows, at least one.
        kind: of the task; "point_to_point" has a fixed target.
        evaluate_from: where the evaluated part begins [s].
        lap_time: of a curve that is repeated [s]; NaN of any other.

    Returns:
        Metric name -> (...); NaN where a metric does not apply, as the times of runs side by side.
    """
    spec, fixed = steps.spec, kind == "point_to_point"
    error, jacobian_error, condition = map(
        _columns, (steps.error_norm(), steps.jacobian_error(), steps.jacobian_condition())
    )
    # Column after column: the order of a sum decides its last bits, and stored tables are compared bit for bit.
    feature, reference, command = map(_columns, (steps.true_feature, steps.reference, steps.command))
    judged_from, second_lap, third_lap = np.searchsorted(
        steps.time, [evaluate_from - 1e-9, lap_time - 1e-9, 2.0 * lap_time - 1e-9]
    )
    evaluated, second = error[..., judged_from:], error[..., second_lap:third_lap]
    final = error[..., -max(1, round(FINAL_SPAN / spec.period)) :]
    way = norm(reference[..., 0] - feature[..., 0]) if fixed else path_length(reference)
    effort = np.abs(command)
    acceleration, jerk = command_derivatives(command, spec.period)
    at_limit = effort >= spec.joint_velocity_limit[:, None] * (1 - 1e-9)
    lanes = error.shape[:-1]
    unknown = np.full(lanes, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        path_length_ratio = np.where(way > 0.0, path_length(feature) / way, np.nan)
    return {
        "settling_time_s": settling_time(error, spec.feature.band, spec.period),
        "settling_time_5pct_s": settling_time(error, SETTLING_SHARE * error[..., 0], spec.period),
        "overshoot": overshoot(feature, reference[..., 0]) if fixed else unknown,
        "steady_state_error": final.mean(axis=-1),
        "rms_error": _rms(error),
        "max_error": error.max(axis=-1),
        "rms_error_second_lap": _rms(second) if second.shape[-1] else unknown,
        "rms_error_evaluated": _rms(evaluated) if evaluated.shape[-1] else unknown,
        "path_length_ratio": path_length_ratio,
        "max_joint_position_rad": np.abs(_columns(steps.joint_position)).max(axis=(-2, -1)),
        "control_effort_rad": _flat(effort).sum(axis=-1) * spec.period,
        "saturation_fraction": at_limit.any(axis=-2).mean(axis=-1),
        "joint_acceleration_peak_rad_s2": _peak(acceleration, unknown),
        "joint_acceleration_rms_rad_s2": _rms(_flat(acceleration)) if acceleration.size else unknown,
        "joint_jerk_peak_rad_s3": _peak(jerk, unknown),
        "joint_jerk_rms_rad_s3": _rms(_flat(jerk)) if jerk.size else unknown,
        "command_switches": sign_switches(command, spec.joint_velocity_limit).astype(np.float64),
        "feature_invalid_fraction": np.mean(_columns(~steps.feature_valid), axis=-1),
        "jacobian_error_mean": _of_known(np.mean, jacobian_error),
        "jacobian_condition_max": _of_known(np.max, condition),
        "controller_time_median_us": np.full(lanes, np.median(steps.controller_time)),
        "controller_time_p99_us": np.full(lanes, np.quantile(steps.controller_time, 0.99)),
        "controller_time_overruns": np.full(lanes, _overruns(steps.controller_time, spec.period)),
        "plant_time_median_us": np.full(lanes, np.median(steps.plant_time)),
    }


def _columns(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return values (k, ...) or (k, ..., m) with the period as the last, contiguous axis."""
    return np.ascontiguousarray(np.moveaxis(values, 0, -1))


def _flat(values: FloatArray) -> FloatArray:
    """Return values (..., n, k) as (..., n k)."""
    return values.reshape(*values.shape[:-2], -1)


def _peak(values: FloatArray, unknown: FloatArray) -> FloatArray:
    return np.asarray(np.abs(values).max(axis=(-2, -1))) if values.size else unknown


def _overruns(times: FloatArray, period: float) -> float:
    """Return how many of the times (k,) [µs] are longer than the period [s]; NaN where they are not known."""
    return math.nan if np.isnan(times).any() else float(np.count_nonzero(times > 1e6 * period))


def _of_known(summary: Callable[..., FloatArray], values: FloatArray) -> FloatArray:
    """Return the mean or maximum over periods, (...), of those values (..., k) that are not NaN; NaN without any."""
    if not np.isnan(values).any():
        return np.asarray(summary(values, axis=-1))
    rows = [row[~np.isnan(row)] for row in values.reshape(-1, values.shape[-1])]
    return np.array([summary(row) if len(row) else np.nan for row in rows]).reshape(values.shape[:-1])


def _rms(error: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(error**2, axis=-1)))
