"""Every metric of a random log against its definition, written out row by row."""

import math
from itertools import pairwise

import numpy as np
import pytest

from servobench.harness.run.log import Steps
from servobench.harness.run.metrics import judge_run
from servobench.plant.contract.signals import PlantSpec

PERIOD, LIMITS, BAND = 0.1, (1.0, 2.0), 0.005
EVALUATED, LAP = 2.5, 1.1  # [s]; laps end between two rows
SPEC = PlantSpec.of_joints(
    ("a", "b"), ("x", "y", "z"), np.array(LIMITS), np.full(2, -9.0), np.full(2, 9.0), period=PERIOD
)


def random_log(seed, periods=40, calm=False):
    """Return a log; if calm, the feature comes to rest at its target and the controller's times are known."""
    rng = np.random.default_rng(seed)
    reference = np.tile(rng.normal(size=3), (periods, 1)) if calm else rng.normal(size=(periods, 3))
    decay = np.exp(-np.arange(periods) / 2.0)[:, None] if calm else 1.0
    command = rng.normal(size=(periods, 2)) * LIMITS
    command[rng.random((periods, 2)) < 0.3] *= 0.05
    command = np.clip(command, -np.array(LIMITS), LIMITS)
    jacobian = rng.normal(size=(periods, 3, 2))
    estimate = jacobian + 0.1 * rng.normal(size=jacobian.shape)
    estimate[5:8] = np.nan
    return Steps(
        SPEC, np.arange(periods) * PERIOD, reference, rng.normal(size=(periods, 3)),
        reference + decay * rng.normal(size=(periods, 3)), rng.normal(size=(periods, 2)), command,
        rng.random(periods) < 0.8, np.full(periods, np.nan), estimate, jacobian, rng.uniform(0.0, 1.5e5, periods),
        rng.uniform(0.0, 10.0, periods), {},
    )  # fmt: skip


def rms(values):
    return math.sqrt(sum(value**2 for value in values) / len(values)) if values else math.nan


def distance(a, b):
    return math.sqrt(sum((x - y) ** 2 for x, y in zip(a, b, strict=True)))


def settled(error, band):
    """The time from which on all errors are within the band, half a second before the end at the latest."""
    for first in range(len(error)):
        if all(value <= band for value in error[first:]):
            if (len(error) - first) * PERIOD < 0.5 - 1e-9:
                return math.nan
            if first == 0:
                return 0.0
            slope = (error[first] - error[first - 1]) / PERIOD
            return (first - 1) * PERIOD + (band - error[first - 1]) / slope
    return math.nan


def switches(command, limit):
    count = 0
    large = [value if abs(value) >= 0.1 * limit else 0.0 for value in command]
    for k, now in enumerate(large):
        before = [value for value in large[max(0, k - 2) : k] if value != 0.0]
        count += bool(before) and now * before[-1] < 0.0
    return count


def overshoot(feature, target):
    way = [t - f for t, f in zip(target, feature[0], strict=True)]
    length = sum(w * w for w in way)
    passed = max(
        sum(w * (y - y0) for w, y, y0 in zip(way, row, feature[0], strict=True)) for row in feature
    )
    return max(0.0, passed / length - 1.0)


def by_definition(steps, kind):
    """Return what `judge_run` is to return."""
    y, r, u = steps.true_feature.tolist(), steps.reference.tolist(), steps.command.tolist()
    error = [distance(a, b) for a, b in zip(r, y, strict=True)]
    times = [k * PERIOD for k in range(len(error))]
    acceleration = [[(b - a) / PERIOD for a, b in zip(*pair, strict=True)] for pair in pairwise(u)]
    jerk = [
        [(b - a) / PERIOD for a, b in zip(*pair, strict=True)] for pair in pairwise(acceleration)
    ]
    way = distance(r[0], y[0]) if kind == "point_to_point" else sum(map(distance, r, r[1:]))
    deviations = [
        np.linalg.norm(a - b) / np.linalg.norm(b)
        for a, b in zip(steps.estimated_jacobian, steps.true_jacobian, strict=True)
        if np.isfinite(a).all()
    ]
    flat = [[abs(value) for row in rows for value in row] for rows in (u, acceleration, jerk)]
    return {
        "settling_time_s": settled(error, BAND * SPEC.feature.scale),
        "settling_time_5pct_s": settled(error, 0.05 * error[0]),
        "overshoot": overshoot(y, r[0]) if kind == "point_to_point" else math.nan,
        "steady_state_error": sum(error[-10:]) / 10,
        "rms_error": rms(error),
        "max_error": max(error),
        "rms_error_second_lap": rms([e for e, t in zip(error, times, strict=True) if LAP <= t < 2 * LAP]),
        "rms_error_evaluated": rms([e for e, t in zip(error, times, strict=True) if t >= EVALUATED - 1e-9]),
        "log_error": sum(max(0.0, math.log10(e / (0.3 * BAND * SPEC.feature.scale))) for e in error) / len(error),
        "path_length_ratio": sum(map(distance, y, y[1:])) / way if way else math.nan,
        "max_joint_position_rad": max(abs(q) for row in steps.joint_position.tolist() for q in row),
        "control_effort_rad": sum(flat[0]) * PERIOD,
        "saturation_fraction": sum(
            any(abs(v) >= limit * (1 - 1e-9) for v, limit in zip(row, LIMITS, strict=True)) for row in u
        ) / len(u),
        "joint_acceleration_peak_rad_s2": max(flat[1]),
        "joint_acceleration_rms_rad_s2": rms(flat[1]),
        "joint_jerk_peak_rad_s3": max(flat[2]),
        "joint_jerk_rms_rad_s3": rms(flat[2]),
        "command_switches": sum(switches([row[j] for row in u], LIMITS[j]) for j in range(2)),
        "feature_invalid_fraction": sum(not valid for valid in steps.feature_valid) / len(u),
        "jacobian_error_mean": sum(deviations) / len(deviations),
        "jacobian_condition_max": max(np.linalg.cond(J) for J in steps.true_jacobian),
        "controller_time_median_us": np.median(steps.controller_time),
        "controller_time_p99_us": np.quantile(steps.controller_time, 0.99),
        "controller_time_overruns": sum(time > 1e6 * PERIOD for time in steps.controller_time),
        "plant_time_median_us": np.median(steps.plant_time),
    }  # fmt: skip


@pytest.mark.parametrize("calm", [False, True])
@pytest.mark.parametrize("kind", ["point_to_point", "curve"])
@pytest.mark.parametrize("seed", range(5))
def test_every_metric_is_its_definition(seed, kind, calm):
    steps = random_log(seed, calm=calm)
    assert judge_run(steps, kind, EVALUATED, LAP) == pytest.approx(
        by_definition(steps, kind), rel=1e-12, nan_ok=True
    )


def test_the_logs_above_reach_every_branch():
    calm, rough = (
        by_definition(random_log(0, calm=calm), "point_to_point") for calm in (True, False)
    )
    assert math.isfinite(calm["settling_time_5pct_s"])
    assert math.isnan(rough["settling_time_s"])
    for name in (
        "saturation_fraction",
        "command_switches",
        "controller_time_overruns",
        "overshoot",
    ):
        assert rough[name] > 0.0


def test_runs_side_by_side_are_judged_as_single_ones():
    logs = [random_log(seed) for seed in range(3)]
    names = ("reference", "feature", "true_feature", "joint_position", "command", "feature_valid",
             "capture_time", "estimated_jacobian", "true_jacobian")  # fmt: skip
    unknown = np.full(40, np.nan)
    lanes = {name: np.stack([getattr(log, name) for log in logs], axis=1) for name in names}
    steps = Steps(
        SPEC, logs[0].time, **lanes, controller_time=unknown, plant_time=unknown, diagnostics={}
    )
    found = judge_run(steps, "curve", EVALUATED, LAP)
    for lane, log in enumerate(logs):
        alone = judge_run(log, "curve", EVALUATED, LAP)
        for name, values in found.items():
            if "_time_" in name and "settling" not in name:
                assert np.isnan(values[lane])
            else:
                assert values[lane] == pytest.approx(alone[name], rel=1e-12, nan_ok=True), name
