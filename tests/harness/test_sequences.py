"""Tasks of several moves in a row: their places, what a controller sees of them, and their settling times."""

import dataclasses

import numpy as np
import pytest

from kit.lanes import assert_rows_of_single_runs
from servobench.harness.batch.consistency import find_contradiction
from servobench.harness.config.settings import Settings
from servobench.harness.run import feasibility
from servobench.harness.run.episode import carry_out
from servobench.harness.run.experiment import build
from servobench.harness.run.log import Period, StepLog
from servobench.harness.run.loop import LoopSettings, Rollout
from servobench.harness.run.metrics import judge_run, move_times
from servobench.harness.run.outcome import find_outcome
from servobench.harness.run.references import FixedPoint, JointPath, Segment
from servobench.harness.run.rehearsal import build_once
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.harness.run.sampling import draw
from servobench.harness.run.scenario import Scenario, Span
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.signals import Command, Observation, PlantSpec, Truth
from servobench.plant.robot.catalogue import find_robot

SPEC = PlantSpec.of_joints(
    ("a", "b"), ("x",), np.full(2, 2.0), np.full(2, -3.0), np.full(2, 3.0), period=0.1
)
FAR, IN = (
    0.015,
    0.0,
)  # errors outside and inside the band of 5 mm; their chord crosses it after two thirds
SPANS = (Span(0.0, 1.0), Span(1.0, 2.0), Span(2.0, 3.0), Span(4.0, 5.0))


def request(task, seed=0, mismatch="moderate", controller="regression_mfac", **more):
    return RunRequest("kinematic", controller, task, mismatch, seed, **more)


def drawn(task, seed=0, mismatch="moderate", settings=None, **more):
    return draw(resolve(request(task, seed, mismatch, **more), Settings(settings or {})))


def postures(scenario):
    """Return the joint positions at which the targets of a sequence are taught, (s, n) rad."""
    return np.array([each.middle for each in scenario.reference.path.segments])


def logged(outside):
    """Return 50 rows; the error of each second is outside the band for so many rows."""
    log = StepLog(SPEC, 50)
    for k in range(50):
        error = FAR if k % 10 < outside[k // 10] else IN
        seen = Observation(0.1 * k, [0.0, 0.0], [0.0])
        truth = Truth(np.zeros(1), None)
        log.add(Period(seen, np.array([[error]]), Command([0.0, 0.0]), truth, (0, 0)), None, {})
    return log.steps()


# --- places


@pytest.mark.parametrize("robot", ["ur5", "panda", "random_arm:3"])
@pytest.mark.parametrize("seed", range(3))
def test_the_targets_of_a_tour_are_in_the_box_and_every_third_one_is_a_corner_of_it(robot, seed):
    scenario = drawn("tour", seed, robot=robot).scenario
    work = find_robot(robot).workspace
    places = postures(scenario)
    assert len(places) == 6
    assert ((work.lower - 1e-12 <= places) & (places <= work.upper + 1e-12)).all()
    at_corner = ((places == work.lower) | (places == work.upper)).all(axis=-1)
    assert at_corner.tolist() == [False, False, True] * 2
    balls = find_robot(robot).arm.ball_position(np.vstack([scenario.start, places]))
    assert (balls[:, 2] >= 0.08 * work.scale).all()
    assert (np.linalg.norm(np.diff(balls, axis=0), axis=-1) >= 0.1 * work.scale).all()
    assert work.clear is None or work.clear(places).all()


@pytest.mark.parametrize("task", ["tour", "again"])
def test_the_first_move_is_that_of_the_task_random(task):
    own, single = drawn(task, 4).scenario, drawn("random", 4).scenario
    assert own.start.tolist() == single.start.tolist()
    np.testing.assert_allclose(own.reference.at(0.0), single.reference.at(0.0), rtol=1e-12)


def test_after_a_move_of_the_camera_targets_are_in_easy_reach():
    work = find_robot("ur5").workspace
    for seed in range(3):
        found = drawn("tour", seed, "moderate+camera_move=45deg")
        points = found.moved.to_base(found.true.feature(postures(found.scenario)))
        distance = np.linalg.norm(points - work.shoulder, axis=-1)
        assert (points[:, 2] >= 0.08).all()
        assert ((work.reach[0] <= distance) & (distance <= work.reach[1])).all()


def test_the_second_time_the_move_of_again_has_the_same_reference_and_start():
    scenario = drawn("again", 2).scenario
    first, back, again = scenario.moves
    assert (first, back, again) == (Span(0.0, 3.0), Span(9.0, 12.0), Span(12.0, 15.0))
    since = 0.05 * np.arange(60)
    found = scenario.reference.at(first.begin + since)
    assert scenario.reference.at(again.begin + since).tolist() == found.tolist()
    path = scenario.reference.path
    assert path.at(back.begin).tolist() == scenario.start.tolist()
    curve = scenario.reference.at(np.linspace(3.0, 8.95, 120))
    assert np.ptp(curve, axis=0).max() > 0.02
    assert np.linalg.norm(np.diff(curve, axis=0), axis=-1).max() < 0.03


def test_cameras_that_see_pixels_see_all_places():
    for word in ("plate", "plate:hand"):
        for task in ("tour", "again"):
            found = drawn(task, 1, sensing=word)
            places = found.scenario.reference.points(np.arange(0.0, found.scenario.duration, 0.5))
            assert found.true.valid_at(places).all()


def test_a_path_is_led_through_one_segment_after_the_other_and_goes_on_with_the_last():
    swings = np.array([[1.0, 0.0], [0.0, 1.0]])
    path = JointPath((Segment(1.0, np.zeros(2)), Segment(4.0, np.ones(2), swings)))
    assert path.ends.tolist() == [1.0, 5.0]
    found = path.at([0.0, 0.9, 1.0, 2.0, 3.0, 6.0])
    wanted = [[0, 0], [0, 0], [2, 1], [1, 2], [0, 1], [1, 2]]
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert path.at(1.0).tolist() == [2.0, 1.0]


def test_a_box_without_another_target_is_refused():
    message = "task tour: no start and target between"
    with pytest.raises(ConfigurationError, match=message):
        drawn("tour", settings={"tour": {"shortest": 1.5}})
    with pytest.raises(ConfigurationError, match="task again: lower must be below upper"):
        drawn("again", settings={"again": {"lower": [1.0] * 6, "upper": [0.0] * 6}})


# --- what a controller sees


def test_a_jump_is_not_seen_before_it_comes():
    desired = np.repeat([1.0, 2.0, 3.0], 5)[:, None]
    rollout = Rollout(None, None, desired, LoopSettings(12, preview=3, jumps=(5, 10)))
    seen = []
    for rollout.k in range(12):
        seen.append(rollout.reference[:, 0].tolist())
    assert seen == [[1.0] * 4] * 5 + [[2.0] * 4] * 5 + [[3.0] * 4] * 2


def test_a_jump_is_no_speed_to_remark_on(monkeypatch):
    said = []
    monkeypatch.setattr(feasibility, "remark", said.append)
    for task in ("tour", "again"):
        build_once(resolve(request(task), Settings({})))
    assert said == []


def test_the_jumps_of_a_run_are_the_periods_in_which_its_reference_jumps():
    for period in (0.05, 1.0 / 30.0):
        settings = Settings({"run": {"period": period}})
        experiment = build(resolve(request("again"), settings))
        moved = np.linalg.norm(np.diff(experiment.desired(), axis=0), axis=-1)
        assert [k for k in experiment.loop.jumps if moved[k - 1] < 0.03] == []
        assert len(experiment.loop.jumps) == 3


# --- settling times


@pytest.mark.parametrize(
    ("outside", "times", "outcome"),
    [
        ((1, 2, 3, 10, 4), [0.0, 0.1, 0.2, 0.3], "settled"),
        ((0, 5, 5, 0, 0), [-1 / 15, 0.4, 0.4, -1 / 15], "settled"),
        ((6, 2, 3, 0, 4), [np.nan, 0.1, 0.2, 0.3], "not_settled"),
        ((1, 2, 3, 0, 10), [0.0, 0.1, 0.2, np.nan], "not_settled"),
    ],
)
def test_each_move_has_its_settling_time_from_its_own_jump_on(outside, times, outcome):
    steps = logged(outside)
    wanted = np.array(times) + 2 / 3 * 0.1
    found = move_times(steps, SPANS)
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    metrics = judge_run(steps, "sequence", 2.0, moves=SPANS)
    assert metrics["settling_time_first_s"] == pytest.approx(wanted[0], nan_ok=True)
    assert metrics["settling_time_second_s"] == pytest.approx(wanted[1])
    assert metrics["settling_time_later_s"] == pytest.approx(wanted[2:].mean(), nan_ok=True)
    scenario = Scenario(None, FixedPoint(np.zeros(1)), 5.0, 2.0, "sequence", moves=SPANS)
    assert find_outcome(steps, scenario, np.nan, 1.0, None) == outcome


def test_a_run_that_ends_early_has_no_times_of_moves_to_which_it_did_not_come():
    steps = logged((1, 2, 3, 10, 4)).first(20)
    found = judge_run(steps, "sequence", 2.0, moves=SPANS)
    assert np.isfinite([found["settling_time_first_s"], found["settling_time_second_s"]]).all()
    assert np.isnan(found["settling_time_later_s"])


def test_runs_of_other_kinds_have_no_columns_of_moves():
    for kind in ("point_to_point", "curve"):
        assert not any("later" in name for name in judge_run(logged((0,) * 5), kind, 0.0))


@pytest.mark.parametrize("wrong", [{"moves": ()}, {"kind": "curve"}, {"kind": "point_to_point"}])
def test_a_sequence_and_no_other_kind_has_moves(wrong):
    right = Scenario(None, FixedPoint(np.zeros(1)), 5.0, 2.0, "sequence", moves=SPANS)
    with pytest.raises(ValueError, match="moves"):
        dataclasses.replace(right, **wrong)


@pytest.mark.parametrize("task", ["tour", "again"])
def test_a_controller_that_knows_the_robot_settles_every_move(task):
    run = carry_out(resolve(request(task, 1, "moderate", "calibrated"), Settings({})))
    assert (run.row["outcome"], run.row["task_kind"]) == ("settled", "sequence")
    assert 0.3 < run.row["settling_time_later_s"] < 2.0
    assert find_contradiction(run.row, run.steps, 0.05) == ""
    wrong = run.row | {"settling_time_first_s": np.nan}
    assert "contradicts" in find_contradiction(wrong, run.steps, 0.05)
    jumps = run.steps.filter(like="reference_").diff().abs().max(axis=1).to_numpy() > 0.03
    assert jumps.sum() == {"tour": 5, "again": 3}[task]


def test_sequences_side_by_side_have_the_rows_of_single_runs():
    settings = Settings({"tour": {"targets": 3, "hold": 1.5}})
    assert_rows_of_single_runs([resolve(request("tour", seed), settings) for seed in (1, 2)])
