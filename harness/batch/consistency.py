"""Whether the row of a run fits itself and its steps, as one does that the harness has made.

Code of users shares the process of its run and can write any row. Metrics of the steps are computed again here, with
the functions that made the row; the rest is compared within the row. A log that was falsified while it was written
has a row that fits it, and is not noticed.
"""

import math
from dataclasses import replace

import numpy as np
import pandas as pd

from servobench.harness.run.log import Steps
from servobench.harness.run.metrics import FINAL_SPAN, judge_run
from servobench.harness.run.outcome import (
    FOLLOWED,
    FOLLOWING_BANDS,
    NOT_FOLLOWED,
    NOT_SETTLED,
    OUTCOMES,
    SETTLED,
)
from servobench.harness.run.result import COMPLETED
from servobench.harness.run.variations import Row
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import COMMAND, PlantSpec

FROM_STEPS = (  # metrics that need neither limits of the plant nor times of the task
    "settling_time_s", "settling_time_5pct_s", "overshoot", "steady_state_error", "rms_error", "max_error", "log_error",
    "path_length_ratio", "max_joint_position_rad", "control_effort_rad", "joint_acceleration_peak_rad_s2",
    "joint_acceleration_rms_rad_s2", "joint_jerk_peak_rad_s3", "joint_jerk_rms_rad_s3", "feature_invalid_fraction",
    "controller_time_median_us", "controller_time_p99_us", "plant_time_median_us",
)  # fmt: skip
MOVE = "point_to_point"
SEQUENCE = "sequence"
MOVE_OUTCOMES = frozenset(OUTCOMES) - {FOLLOWED, NOT_FOLLOWED}
CURVE_OUTCOMES = frozenset(OUTCOMES) - {SETTLED, NOT_SETTLED}
ERRORS = ("rms_error", "rms_error_evaluated", "rms_error_second_lap", "steady_state_error")
TOLERANCE = 1e-9  # [1] by which two sums of the same terms may differ
ANY = 1e9  # [rad, rad/s] a limit that no metric above reads


def find_contradiction(row: Row, steps: pd.DataFrame | None, period: float) -> str:
    """Return how the row of a run contradicts itself or its steps, as a clause; empty if it does not.

    Args:
        row: with values of the right types.
        steps: its table of steps; None where none is kept.
        period: of control [s].

    Raises:
        ValueError: the steps lack columns, or have some that no run has.
    """
    wrong = _find_within(row, period)
    if wrong or steps is None:
        return wrong
    return _find_beside(row, steps, period)


def _find_within(row: Row, period: float) -> str:
    status = row["status"]
    outcome = row["outcome"]
    settling = _number(row, "settling_time_s")
    band = _number(row, "settling_band")
    if status != COMPLETED:
        fits = outcome == status
    elif row["task_kind"] == MOVE:
        fits = outcome in MOVE_OUTCOMES and math.isnan(settling) == (outcome != SETTLED)
    elif row["task_kind"] == SEQUENCE:
        first = not math.isnan(_number(row, "settling_time_first_s"))
        fits = outcome in MOVE_OUTCOMES and (first or outcome != SETTLED)
    else:
        followed = _number(row, "rms_error_evaluated") <= FOLLOWING_BANDS * band
        fits = outcome in CURVE_OUTCOMES and followed == (outcome == FOLLOWED)
    if not fits:
        return f"its outcome {outcome!r} contradicts its status, settling time or error"
    length = row["periods"] * period
    if settling > length:
        return f"its settling time {settling:g} s is beyond its {length:g} s"
    largest = _number(row, "max_error")
    for name in ERRORS:
        if _number(row, name) > largest * (1.0 + TOLERANCE):
            return f"its {name} is larger than its largest error"
    if length - settling - period >= FINAL_SPAN and _number(row, "steady_state_error") > band * (
        1.0 + TOLERANCE
    ):
        return "its steady_state_error is outside the band in which it settled"
    return ""


def _number(row: Row, name: str) -> float:
    value = row.get(name)
    if value is None:
        return math.nan
    return float(value)


def _find_beside(row: Row, steps: pd.DataFrame, period: float) -> str:
    if len(steps) != row["periods"]:
        return f"it has {row['periods']} periods and {len(steps)} steps"
    if steps.empty:
        return ""
    logged = _as_logged(steps, _number(row, "settling_band"), period)
    if not np.allclose(logged.time, period * np.arange(len(steps)), rtol=TOLERANCE):
        return "its steps are not a period apart"
    with np.errstate(all="ignore"):
        computed = judge_run(logged, row["task_kind"], 0.0)
        if not np.allclose(
            logged.error_norm(), steps["error_norm"], rtol=TOLERANCE, equal_nan=True
        ):
            return "its error_norm is not that of its steps"
        for name in FROM_STEPS:
            found = float(computed[name])
            told = _number(row, name)
            if not np.isclose(told, found, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True):
                return f"its {name} is {told:g}, and by its steps {found:g}"
    return ""


def _as_logged(steps: pd.DataFrame, band: float, period: float) -> Steps:
    """Return a table of steps as the log that it was made of, without Jacobians and stamps of frames."""

    def numbers(kind: str) -> FloatArray:
        return steps[[name for name in steps.columns if name.startswith(f"{kind}_")]].to_numpy(
            np.float64
        )

    true_feature = numbers("true_feature")
    command = numbers(COMMAND)
    joints = tuple(map(str, range(command.shape[1])))
    places = tuple(map(str, range(true_feature.shape[1])))
    limit = np.full(len(joints), ANY)
    spec = PlantSpec.of_joints(joints, places, limit, -limit, limit, period)
    spec = replace(spec, feature=replace(spec.feature, tolerance=band))
    return replace(
        Steps.unknown(spec, len(steps)),
        time=steps["time_s"].to_numpy(np.float64),
        reference=numbers("reference"),
        true_feature=true_feature,
        joint_position=numbers("joint_position"),
        command=command,
        feature_valid=steps["feature_valid"].to_numpy(np.bool_),
        controller_time=steps["controller_time_us"].to_numpy(np.float64),
        plant_time=steps["plant_time_us"].to_numpy(np.float64),
    )
