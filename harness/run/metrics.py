"""What a run is judged by, from its logged rows. All errors are those of the true feature.

| metric | meaning |
|---|---|
| settling_time_s | first time after which the error stays within 5 mm, for at least half a second; NaN if never |
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

from dataclasses import dataclass

import numpy as np
import pandas as pd

from servobench.plant.checks import FloatArray
from servobench.plant.signals import PlantSpec

SETTLING_BAND = 0.005  # m
SETTLING_SHARE = 0.05  # of the initial error
DWELL = 0.5  # s that the error must have stayed in the band by the end
FINAL_SPAN = 1.0  # s over which the steady state is averaged


@dataclass(frozen=True)
class Judgement:
    """What the metrics need to know about a run besides its rows.

    Attributes:
        spec: names, limits and period.
        point_to_point: the reference is a fixed target.
        evaluate_from: s, where the evaluated part begins.
    """

    spec: PlantSpec
    point_to_point: bool
    evaluate_from: float


def settling_time(error: FloatArray, band: float, period: float, dwell: float = DWELL) -> float:
    """Return the first time after which `error` stays within `band`.

    Args:
        error: (k,), m, one value a period.
        band: m.
        period: s.
        dwell: s, least time within the band at the end.

    Returns:
        s; NaN if the error is outside at the end, or came in less than `dwell` before it.
    """
    outside = np.flatnonzero(~(error <= band))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return first * period if (len(error) - first) * period >= dwell - 1e-9 else np.nan


def overshoot(feature: FloatArray, target: FloatArray) -> float:
    """Return how far the feature passes the target along the initial error, as a share of that.

    Args:
        feature: (k, m), m.
        target: (m,), m.

    Returns:
        At least 0; NaN if the run starts at the target.
    """
    way = target - feature[0]
    length = float(way @ way)
    return max(0.0, float(np.max((feature - feature[0]) @ way)) / length - 1.0) if length > 0.0 else np.nan


def path_length(points: FloatArray) -> float:
    """Return the length of the path through `points`, (k, m) m."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def judge_run(steps: pd.DataFrame, judgement: Judgement) -> dict[str, float]:
    """Return the metrics of one run.

    Args:
        steps: its rows, at least one.
        judgement: what to judge them by.

    Returns:
        Metric name -> value; NaN where a metric does not apply.
    """
    spec = judgement.spec
    unit = spec.feature_unit
    error = steps["error_norm"].to_numpy()
    feature = steps[[f"true_feature_{name}_{unit}" for name in spec.feature_names]].to_numpy()
    reference = steps[[f"reference_{name}_{unit}" for name in spec.feature_names]].to_numpy()
    command = steps[[f"joint_velocity_command_{name}_rad_s" for name in spec.joint_names]].to_numpy()
    evaluated = error[steps["time_s"].to_numpy() >= judgement.evaluate_from - 1e-9]
    final = error[-max(1, round(FINAL_SPAN / spec.period)) :]
    way = float(np.linalg.norm(reference[0] - feature[0])) if judgement.point_to_point else path_length(reference)
    saturated = np.any(np.abs(command) >= spec.joint_velocity_limit * (1 - 1e-9), axis=1)
    jacobian_error = steps["jacobian_error"].dropna()
    return {
        "settling_time_s": settling_time(error, SETTLING_BAND, spec.period),
        "settling_time_5pct_s": settling_time(error, SETTLING_SHARE * error[0], spec.period),
        "overshoot": overshoot(feature, reference[0]) if judgement.point_to_point else np.nan,
        "steady_state_error": float(np.mean(final)),
        "rms_error": _rms(error),
        "max_error": float(np.max(error)),
        "rms_error_evaluated": _rms(evaluated) if len(evaluated) else np.nan,
        "path_length_ratio": path_length(feature) / way if way > 0.0 else np.nan,
        "control_effort_rad": float(np.abs(command).sum() * spec.period),
        "saturation_fraction": float(np.mean(saturated)),
        "feature_invalid_fraction": float(np.mean(~steps["feature_valid"].to_numpy())),
        "jacobian_error_mean": float(jacobian_error.mean()) if len(jacobian_error) else np.nan,
        "jacobian_condition_max": float(steps["jacobian_condition"].max()),
        "controller_time_median_us": float(steps["controller_time_us"].median()),
        "controller_time_p99_us": float(steps["controller_time_us"].quantile(0.99)),
        "plant_time_median_us": float(steps["plant_time_us"].median()),
    }


def _rms(error: FloatArray) -> float:
    return float(np.sqrt(np.mean(error**2)))
