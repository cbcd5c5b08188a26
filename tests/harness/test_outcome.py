import numpy as np
import pytest

from kit.plants import nominal_ur5
from servobench.harness.config.settings import Settings
from servobench.harness.run import episode
from servobench.harness.run.episode import carry_out, carry_out_together
from servobench.harness.run.log import Period, StepLog, Steps
from servobench.harness.run.outcome import find_outcome, joint_rests_at_limit
from servobench.harness.run.references import FixedPoint
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import ResolvedRun, resolve
from servobench.harness.run.scenario import Scenario
from servobench.harness.run.tasks import TASKS
from servobench.plant.contract.signals import Command, Observation, PlantSpec, Truth
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.robot.ur5 import HOME

SPEC = PlantSpec.of_joints(
    ("a", "b"), ("x",), np.full(2, 2.0), np.full(2, -3.0), np.full(2, 3.0), period=0.1
)
STOP, FREE, FAR, NEAR = 3.0, 2.9, 1.0, 0.001
REACHED, FAR_AWAY = nominal_ur5().feature(HOME), np.array([0.0, -1.5, 1.25])


def logged(joints: list[tuple[float, float]], errors: list[float]) -> Steps:
    log = StepLog(SPEC, len(joints))
    for k, (q, error) in enumerate(zip(joints, errors, strict=True)):
        seen, truth = Observation(0.1 * k, list(q), [0.0]), Truth(np.zeros(1), None)
        log.add(Period(seen, np.array([[error]]), Command([0.0, 0.0]), truth, (0, 0)), None, {})
    return log.steps()


@pytest.mark.parametrize(
    ("joints", "errors", "rests"),
    [
        ([(FREE, 0.0)] * 5 + [(STOP, 0.0)] * 10, [FAR] * 15, True),
        ([(0.0, -STOP)] * 10 + [(0.0, 0.0)] * 5, [FAR] * 15, True),
        ([(STOP - 9e-7, 0.0)] * 10, [FAR] * 10, True),
        ([(STOP - 2e-6, 0.0)] * 10, [FAR] * 10, False),
        ([(FREE, 0.0)] * 6 + [(STOP, 0.0)] * 9, [FAR] * 15, False),
        ([(STOP, 0.0), (0.0, STOP)] * 10, [FAR] * 20, False),
        ([(STOP, 0.0)] * 20, [FAR] * 9 + [NEAR] + [FAR] * 9 + [NEAR], False),
        ([(STOP, 0.0)] * 5, [FAR] * 5, False),
    ],
)
def test_a_joint_rests_at_its_limit_after_a_second_outside_the_band(joints, errors, rests):
    assert joint_rests_at_limit(logged(joints, errors), 0.005) is rests


def run(
    controller: str, task: str, settings: dict[str, object], seed: int = 3, mismatch: str = "none"
) -> ResolvedRun:
    return resolve(RunRequest("kinematic", controller, task, mismatch, seed), Settings(settings))


@pytest.mark.parametrize(
    ("task", "settings", "outcome"),
    [
        ("exp2", {}, "settled"),
        ("exp2", {"exp2": {"duration": 0.6}}, "not_settled"),
        ("circle", {}, "followed"),
        ("circle", {"circle": {"laps": 1}}, "not_followed"),
        ("circle", {"circle": {"radius": 0.9}}, "target_unreachable"),
        ("unreachable", {}, "target_unreachable"),
        ("singular_start", {}, "settled"),
        ("exp2", {"kinematic": {"sensing": {"drop_probability": 0.99}}}, "feature_lost"),
    ],
)  # fmt: skip
def test_each_end_has_its_name(task, settings, outcome):
    row = carry_out(run("calibrated", task, settings), steps=False).row
    assert row["outcome"] == outcome
    assert row["status"] == ("feature_lost" if outcome == "feature_lost" else "completed")


@pytest.mark.parametrize(
    ("target", "at_stop", "robot", "outcome"),
    [
        (REACHED, True, nominal_ur5(), "joint_at_limit"),
        (REACHED, False, nominal_ur5(), "not_settled"),
        (FAR_AWAY, True, nominal_ur5(), "target_unreachable"),
        (FAR_AWAY, True, None, "joint_at_limit"),
        (FAR_AWAY, False, None, "not_settled"),
    ],
)
def test_a_target_out_of_reach_counts_before_a_joint_at_its_stop(target, at_stop, robot, outcome):
    log = StepLog(hand_eye_spec(nominal_ur5(), 0.05, 1.0, 2.35), 40)
    q = np.array(HOME)
    q[2] = -2.35 if at_stop else -2.3
    for k in range(40):
        truth = Truth(target + 0.1, None)
        seen = Observation(0.05 * k, q, truth.feature)
        log.add(Period(seen, target[None], Command(np.zeros(6)), truth, (0, 0)), None, {})
    scenario = Scenario(q, FixedPoint(target), 2.0, 1.5, "point_to_point")
    assert find_outcome(log.steps(), scenario, np.nan, 0.17, robot) == outcome


def test_runs_side_by_side_have_the_outcomes_of_each_alone_however_few_fit_in_memory(monkeypatch):
    settings = {"random": {"duration": 1.0}}
    runs = [run("ukf_mfac", "random", settings, seed, "severe") for seed in range(40001, 40008)]
    alone = [carry_out(each, steps=False).row["outcome"] for each in runs]
    assert len(set(alone)) > 1
    together = carry_out_together(runs)
    assert [each.row["outcome"] for each in together] == alone
    monkeypatch.setattr(episode, "ROWS_AT_ONCE", 3 * 20)
    for few, many in zip(carry_out_together(runs), together, strict=True):
        np.testing.assert_equal(few.row, many.row)


def test_endurance_is_more_laps_of_the_same_curve():
    settings = {"endurance": {"laps": 3, "lap_time": 4.0, "curve": "lemniscate"}}
    row, two = (
        carry_out(run("calibrated", task, chosen), steps=False).row
        for task, chosen in (
            ("endurance", settings),
            ("lemniscate", {"lemniscate": {"laps": 2, "lap_time": 4.0}}),
        )
    )
    assert row["periods"] == 240
    assert row["rms_error_second_lap"] == two["rms_error_evaluated"] == two["rms_error_second_lap"]
    assert row["rms_error_second_lap"] != row["rms_error_evaluated"]
    assert row["max_joint_position_rad"] >= two["max_joint_position_rad"] > 2.0


def test_the_stretched_arm_has_lost_a_direction_to_move_in():
    singular = np.linalg.svd(
        nominal_ur5().arm.ball_and_jacobian(TASKS["singular_start"].default.start)[1],
        compute_uv=False,
    )
    assert singular[-1] < 1e-6 * singular[0]
