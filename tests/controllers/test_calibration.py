"""The calibrating stage in closed loop: it learns wrong gears, is right elsewhere, and takes runs side by side."""

from types import MappingProxyType

import numpy as np
import pytest

from kit.lanes import assert_rows_of_single_runs
from kit.toy import plant_spec
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.methods import METHODS
from servobench.controllers.stages import calibration
from servobench.controllers.stages.arm_fit import Fit
from servobench.harness.apps.fmu.products import controller_model
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import carry_out
from servobench.harness.run.experiment import build
from servobench.harness.run.loop import begin, careful, periods
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.robot.mismatch import Mismatch

pytestmark = pytest.mark.slow
METHOD = "calibrating_mfac"
REGRESSING = {METHOD: {"aids": {"model": "regression"}}}
FAR_GEARS = "moderate+gear_ratio=50%"


def run(mismatch=FAR_GEARS, seed=3, *, settings=MappingProxyType({}), task="circle", **further):
    request = RunRequest("kinematic", METHOD, task, Mismatch.parse(mismatch), seed, **further)
    return resolve(request, Settings(settings))


def test_an_arm_with_far_gears_is_followed_more_closely_than_by_the_regression_alone():
    calibrated = carry_out(run())
    regressed = carry_out(run(settings=REGRESSING))
    assert calibrated.row["outcome"] == "followed"
    error = "rms_error_evaluated"
    assert calibrated.row[error] < 0.7 * regressed.row[error]
    assert calibrated.steps["diagnostic_calibrated"].iloc[-1] == 1.0
    assert calibrated.steps["diagnostic_calibrated"].iloc[0] == 0.0


def test_the_latency_of_frames_is_found():
    late = {
        "kinematic": {"sensing": {"latency": 0.1}},
        "random": {"duration": 4.0},
    }
    steps = carry_out(run("moderate", settings=late, task="random")).steps
    assert steps["diagnostic_calibration_latency"].iloc[-1] == pytest.approx(0.1, abs=0.01)


def test_zeros_that_are_all_unknown_are_found_by_new_members_and_never_without(monkeypatch):
    unknown = "moderate+joint_offsets=180deg"
    found = carry_out(run(unknown, 88703, task="tour")).steps
    assert found["jacobian_error"].iloc[-1] < 0.03
    monkeypatch.setattr(calibration, "SEARCH_TIME", 0.0)
    without = carry_out(run(unknown, 88703, task="tour")).steps
    assert without["jacobian_error"].iloc[-1] > 0.1


def test_the_search_explains_the_frames_of_unknown_zeros_much_sooner(monkeypatch):
    brief = {"random": {"duration": 1.2}}
    unknown = "moderate+joint_offsets=180deg"
    runs = [run(unknown, seed, settings=brief, task="random") for seed in range(88700, 88704)]
    found = [carry_out(each).steps["diagnostic_calibration_rms"].iloc[-1] for each in runs]
    monkeypatch.setattr(calibration, "SEARCH_TIME", 0.0)
    without = [carry_out(each).steps["diagnostic_calibration_rms"].iloc[-1] for each in runs]
    assert np.median(found) < 0.5 * np.median(without)


@pytest.mark.parametrize("period", [0.05, 0.008])
def test_runs_side_by_side_have_equal_bits_while_some_of_them_try_new_members(period):
    brief = {"random": {"duration": 1.8}, "run": {"period": period}}
    unknown = "moderate+joint_offsets=180deg"
    runs = [run(unknown, seed, settings=brief, task="random") for seed in (88714, 88701)]
    assert_rows_of_single_runs(runs)


@pytest.mark.parametrize(("period", "most"), [(0.05, 8), (0.008, 1)])
def test_a_frames_iterations_are_spread_over_the_periods_to_the_next(monkeypatch, period, most):
    made = []
    update = calibration.Calibration.update
    iterated = Fit.iterated

    def updated(self, *arguments):
        made.append(0)
        return update(self, *arguments)

    def counted(self, *arguments):
        made[-1] += 1
        return iterated(self, *arguments)

    monkeypatch.setattr(calibration.Calibration, "update", updated)
    monkeypatch.setattr(Fit, "iterated", counted)
    brief = {"random": {"duration": 1.2}, "run": {"period": period}}
    far = run("moderate+joint_offsets=180deg", 88714, settings=brief, task="random")
    steps = carry_out(far).steps
    assert max(made) == most
    # Arms are searched for in most of the periods, and some are fitted.
    assert sum(made) > 0.4 * most * len(made)
    assert steps["diagnostic_calibration_rms"].iloc[-1] > 0.0


@pytest.mark.parametrize("stamps", [{}, {"stamps": True, "jitter": 0.1}])
def test_runs_side_by_side_have_the_bits_of_each_run_alone(stamps):
    rough = {
        "kinematic": {"sensing": {"drop_probability": 0.1, "latency": 0.05, **stamps}},
        "random": {"duration": 1.5},
    }
    runs = [run("severe", seed, settings=rough, task="random") for seed in (40001, 40002, 40003)]
    assert_rows_of_single_runs(runs)


def test_runs_of_which_some_keep_more_frames_have_the_bits_of_each_run_alone():
    late = {"kinematic": {"sensing": {"jitter": 0.08}}, "circle": {"laps": 1}}
    # The frames of the first one seem to come late, those of the other one do not.
    runs = [run("moderate", seed, settings=late) for seed in (88700, 88701)]
    assert_rows_of_single_runs(runs)


def test_with_stamps_the_latency_of_frames_is_found_though_it_swings():
    swing = {"latency": 0.05, "latency_swing": 0.1, "swing_period": 1.0}
    found = []
    for stamps in (False, True):
        settings = {
            "kinematic": {"sensing": {**swing, "stamps": stamps, "clock_offset": 40.0}},
            "random": {"duration": 4.0},
        }
        found.append(carry_out(run("moderate", 4, settings=settings, task="random")).steps.iloc[-1])
    bare, stamped = found
    assert bare["diagnostic_lateness"] > 0.02
    assert stamped["diagnostic_lateness"] == 0.0
    # That of the first frame, which does not swing yet.
    assert stamped["diagnostic_calibration_latency"] == pytest.approx(0.05, abs=0.01)
    assert stamped["diagnostic_calibration_rms"] < bare["diagnostic_calibration_rms"]


@pytest.mark.parametrize("sensing", ["pixel", "stereo", "plate", "pixel:hand"])
def test_it_servoes_under_every_sensing(sensing):
    brief = {"exp2": {"duration": 3.0}}
    done = carry_out(run("moderate", settings=brief, task="exp2", sensing=sensing))
    assert done.row["status"] == "completed"
    assert np.isfinite(done.steps["diagnostic_calibration_rms"]).all()


def test_a_law_with_a_preview_of_its_own_knows_how_the_camera_turns():
    turning = RunRequest(
        "kinematic", "ukf_mpc", "circle", Mismatch.parse("moderate+camera_turn=10deg"), 88700
    )
    calibrating = Settings({"ukf_mpc": {"aids": {"model": "arm"}}})
    row = carry_out(resolve(turning, calibrating)).row
    # Without the camera's turn among the moves that it plans against it lags by 3.6 mm.
    assert row["rms_error_evaluated"] < 1e-3


@pytest.mark.parametrize("order", [5.0, 8.0])
def test_play_and_ripple_of_gears_are_found_and_reckoned_with(order):
    geared = "moderate+backlash=1deg+ripple=0.03rad"
    gears = {"kinematic": {"mechanics": {"ripple_order": order}}}
    calibrated = carry_out(run(geared, settings=gears))
    regressed = carry_out(run(geared, settings=gears | REGRESSING))
    error = "rms_error_evaluated"
    assert calibrated.row[error] < 0.5 * regressed.row[error]
    last = calibrated.steps.iloc[-1]
    assert last["diagnostic_calibration_play"] == pytest.approx(np.radians(1.0), rel=0.2)
    assert last["diagnostic_calibration_ripple"] == pytest.approx(0.03, rel=0.1)


def test_another_arm_is_calibrated_as_well():
    brief = {"exp2": {"duration": 3.0}}
    done = carry_out(run("moderate", settings=brief, task="exp2", robot="panda"))
    assert done.row["outcome"] == "settled"


def test_after_a_move_of_the_camera_frames_of_before_count_no_more():
    mismatch = "moderate+camera_move=90deg"
    settled = []
    for settings in ({}, REGRESSING):
        row = carry_out(run(mismatch, 88733, settings=settings, task="random")).row
        settled.append(row["settling_time_s"])
    calibrated, regressed = settled
    # With the frames of before it settled 1.3 s behind the regression, which forgets as well.
    assert calibrated < regressed + 0.1


def test_an_arm_of_unknown_geometry_is_refused_with_the_reason():
    method = METHODS[METHOD]
    config = method.config()
    knowledge = RobotKnowledge(plant_spec(6, 3), 4, lambda q: np.zeros((*q.shape[:-1], 3, 6)))
    with pytest.raises(ValueError, match="'arm' needs the geometry of the robot"):
        method.build(config, knowledge)


def test_an_export_is_refused_by_name():
    request = RunRequest("kinematic", METHOD, "target", Mismatch.parse("none"), 0)
    with pytest.raises(ConfigurationError, match=r"fits the arm \(aids.model=arm\)"):
        controller_model(request, Settings())


def test_the_jacobian_is_that_of_the_true_arm_after_a_lap():
    short = {"circle": {"lap_time": 8.0, "laps": 1}}
    steps = carry_out(run(settings=short)).steps
    assert steps["diagnostic_calibrated"].iloc[-1] == 1.0
    # The regression alone is wrong by a quarter here.
    assert steps["jacobian_error"].iloc[-1] < 0.02


@pytest.mark.parametrize(("mismatch", "seed"), [("moderate", 46000), ("gear_ratio=50%", 46001)])
def test_a_target_out_of_reach_is_approached_as_near_as_by_the_regression(mismatch, seed):
    """The Jacobian half-way to it led 0.25 to 0.4 m away."""
    errors = []
    for method in (METHOD, "regression_mfac"):
        request = RunRequest("kinematic", method, "unreachable", Mismatch.parse(mismatch), seed)
        row = carry_out(resolve(request, Settings())).row
        assert row["outcome"] == "target_unreachable"
        errors.append(row["steady_state_error"])
    assert errors[0] == pytest.approx(errors[1], rel=0.02)


def test_an_arm_that_is_believed_steps_by_its_jacobian_half_way_to_the_target():
    """A step errs by the cube of its length, by the Jacobian of where it begins by its square."""
    experiment = build(run(task="random"))
    controller = experiment.controller
    rollout = begin(experiment.plant, controller, experiment.desired(), experiment.loop, (1, 2))
    with careful():
        for period in periods(rollout, controller):
            if period.observation.time > 3.0:
                break
    servo = controller.servo
    calibration = controller.state.calibration
    assert calibration.used
    commanded = []
    command = servo.law.command

    def noted(state, estimate, observation, reference):
        commanded.append((estimate.jacobian, observation.joint_position, reference[0]))
        return command(state, estimate, observation, reference)

    servo.law.command = noted
    errors = []
    for size in (0.08, 0.04):
        target = period.observation.feature + size * np.array([0.6, -0.64, 0.48])
        reference = np.tile(target, (1 + servo.knowledge.preview, 1))
        stepped = servo.step(controller.state, period.observation, reference)
        J, q, wanted = commanded[-1]

        def after(jacobian, q=q, wanted=wanted, calibration=stepped.state.calibration):
            here = servo.calibration.ahead(calibration, q, np.zeros(()))
            step = np.linalg.pinv(here.jacobian if jacobian is None else jacobian) @ (
                wanted - here.feature
            )
            there = servo.calibration.ahead(calibration, q + step, np.zeros(()))
            return np.linalg.norm(there.feature - wanted)

        errors.append((after(J), after(None)))
    (far, wide), (near, narrow) = errors
    assert wide / narrow == pytest.approx(4.0, rel=0.2)
    assert far / near == pytest.approx(8.0, rel=0.2)
    assert far < 0.1 * wide
