"""What a run is judged by, from its logged rows. All errors are those of the true feature.

| metric | meaning |
|---|---|
| settling_time_s | first time after which the error stays within the band (5 mm), for at least 0.5 s; NaN if never |
| settling_time_5pct_s | the same for 5 % of the initial error |
| overshoot | how far the feature passes a fixed target, as a share of the initial error; NaN when tracking |
| steady_state_error | mean error of the last second |
| rms_error, max_error | over the whole run |
| rms_error_evaluated | over the evaluated part: the last lap, the last quarter of a move, the last half of a path |
| path_length_ratio | true path over the straight line (point to point) or over the reference's path (tracking) |
| control_effort_rad | Σ |u| dt over joints and periods |
| saturation_fraction | share of periods in which a joint is commanded at its speed limit |
| feature_invalid_fraction | share of periods without a valid feature |
"""

from __future__ import annotations

import numpy as np

from servobench.harness.run.log import Steps
from servobench.harness.run.references import TaskKind
from servobench.plant.checks import FloatArray

SETTLING_BAND = 0.005  # share of the feature's natural size: 5 mm on the UR5
SETTLING_SHARE = 0.05  # band as a share of the initial error
DWELL = 0.5  # [s] least time within the band at the end of a run
FINAL_SPAN = 1.0  # [s] over which the steady state is averaged


def settling_time(error: FloatArray, band: float, period: float, dwell: float = DWELL) -> float:
    """Return the first time after which `error` stays within `band`.

    Args:
        error: (k,), one value a period [unit of the feature].
        band: [unit of the feature].
        period: [s].
        dwell: least time within the band at the end [s].

    Returns:
        [s]; NaN if the error is outside at the end, or came in less than `dwell` before it.
    """
    outside = np.flatnonzero(~(error <= band))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return first * period if (len(error) - first) * period >= dwell - 1e-9 else np.nan


def overshoot(feature: FloatArray, target: FloatArray) -> float:
    """Return how far the feature passes the target along the initial error, as a share of that.

    Args:
        feature: (k, m) [unit of the feature].
        target: (m,) [unit of the feature].

    Returns:
        At least 0; NaN if the run starts at the target.
    """
    way = target - feature[0]
    length = float(way @ way)
    return max(0.0, float(np.max((feature - feature[0]) @ way)) / length - 1.0) if length > 0.0 else np.nan


def path_length(points: FloatArray) -> float:
    """Return the length of the path through `points`, (k, m) [their unit]."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def judge_run(steps: Steps, kind: TaskKind, evaluate_from: float) -> dict[str, float]:
    """Return the metrics of one run.

    Args:
        steps: its rows, at least one.
        kind: of the task; "point_to_point" has a fixed target.
        evaluate_from: where the evaluated part begins [s].

    Returns:
        Metric name -> value; NaN where a metric does not apply.
    """
    spec, error, fixed = steps.spec, steps.error_norm(), kind == "point_to_point"
    # Column after column: the order of a sum decides its last bits, and stored tables are compared bit for bit.
    feature, reference, command = map(np.asfortranarray, (steps.true_feature, steps.reference, steps.command))
    evaluated = error[steps.time >= evaluate_from - 1e-9]
    final = error[-max(1, round(FINAL_SPAN / spec.period)) :]
    way = float(np.linalg.norm(reference[0] - feature[0])) if fixed else path_length(reference)
    saturated = np.any(np.abs(command) >= spec.joint_velocity_limit * (1 - 1e-9), axis=1)
    jacobian_error, condition = (values[~np.isnan(values)] for values in (
        steps.jacobian_error(), steps.jacobian_condition()))  # fmt: skip
    return {
        "settling_time_s": settling_time(error, SETTLING_BAND * spec.feature.scale, spec.period),
        "settling_time_5pct_s": settling_time(error, SETTLING_SHARE * error[0], spec.period),
        "overshoot": overshoot(feature, reference[0]) if fixed else np.nan,
        "steady_state_error": float(np.mean(final)),
        "rms_error": _rms(error),
        "max_error": float(np.max(error)),
        "rms_error_evaluated": _rms(evaluated) if len(evaluated) else np.nan,
        "path_length_ratio": path_length(feature) / way if way > 0.0 else np.nan,
        "control_effort_rad": float(np.abs(command).sum() * spec.period),
        "saturation_fraction": float(np.mean(saturated)),
        "feature_invalid_fraction": float(np.mean(~steps.feature_valid)),
        "jacobian_error_mean": float(np.mean(jacobian_error)) if len(jacobian_error) else np.nan,
        "jacobian_condition_max": float(np.max(condition)) if len(condition) else np.nan,
        "controller_time_median_us": float(np.median(steps.controller_time)),
        "controller_time_p99_us": float(np.quantile(steps.controller_time, 0.99)),
        "plant_time_median_us": float(np.median(steps.plant_time)),
    }


def _rms(error: FloatArray) -> float:
    return float(np.sqrt(np.mean(error**2)))
