"""Robots identified from logs of plants whose truth is known, and mistakes of logs that are named."""

import math
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from kit.nightly import some
from kit.own import write
from servobench import run
from servobench.harness.apps.studies.challenge import find_challenge
from servobench.harness.apps.twin import preflight, search
from servobench.harness.apps.twin.drive import (
    Response,
    command_mistake,
    command_response,
    joint_steps,
    untold_response,
)
from servobench.harness.apps.twin.identification import (
    _Problem,
    correlation_time,
    fit_cameras,
    identify,
    robust_covariance,
)
from servobench.harness.apps.twin.log import read_log
from servobench.harness.apps.twin.preflight import mistakes
from servobench.harness.apps.twin.sensor import frame_period, lost_share, sensor
from servobench.harness.apps.twin.summary import estimates, remarks
from servobench.harness.apps.twin.twin_file import twin_text
from servobench.harness.config.sensing import find_sensing
from servobench.harness.run.request import RunRequest
from servobench.harness.run.sampling import draw_robot
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import remark
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.rendered.urdf import arm_tree, text
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.robot.mismatch import Mismatch

pytestmark = pytest.mark.usefixtures("few_fits")
LATENCY, DELAY, LAG = 0.08, 0.03, 0.07
SETTINGS = {
    "kinematic": {"sensing": {"latency": LATENCY}, "command_delay": DELAY, "lag": LAG},
    "random": {"duration": 20.0},
}
ROBOT, MISMATCH, SEED = "ur10e", "severe+gear_ratio=5%", 3
ELBOW = 2


@pytest.fixture
def few_fits(monkeypatch):
    """Let mistakes be found by fewer fits to fewer frames, each of which takes a fifth of a second."""
    monkeypatch.setattr(preflight, "SCREENED", 3)
    monkeypatch.setattr(preflight, "FRAMES", 75)


@pytest.fixture
def few_arms(monkeypatch):
    """Let arms far from the nominal one be searched among fewer and fitted less, for seconds in place of a minute."""
    monkeypatch.setattr(search, "DRAWS", 512)
    monkeypatch.setattr(search, "ITERATIONS", 25)


@cache
def logged(sensing="position", seed=SEED):
    """Return the log of a run with excited joints, its table and the nominal model."""
    made = run("docs/examples/excite.py", task="random", robot=ROBOT, mismatch=MISMATCH, seed=seed, sensing=sensing,
               settings=SETTINGS)  # fmt: skip
    model = find_sensing(sensing).nominal(find_robot(ROBOT))
    return read_log(hand_eye_spec(model, 0.05, 1.0, 2.0 * math.pi), made.steps), made.steps, model


@cache
def identified(sensing="position", seed=SEED):
    log, _, model = logged(sensing, seed)
    return identify(log, model)


def true_robot(seed=SEED):
    return draw_robot(
        RunRequest("kinematic", "constant", "random", Mismatch.parse(MISMATCH), seed, robot=ROBOT)
    )[0]


def truth(seed=SEED):
    """Return the true parameters that a log can tell."""
    true, nominal = true_robot(seed), find_robot(ROBOT).nominal
    names = nominal.arm.joint_names
    values = {f"gear_{name}": true.arm.gear_ratio[i] - 1.0 for i, name in enumerate(names)}
    values |= {
        f"zero_{name}": true.arm.joint_offset[i] - nominal.arm.joint_offset[i]
        for i, name in enumerate(names)
    }
    for row, axis in ((2, 0), (3, 0), (4, 2), (5, 2)):
        share = true.arm.translation[row, axis] / nominal.arm.translation[row, axis] - 1.0
        values[f"link_{row}_{'xyz'[axis]}"] = share
    return values | {"latency": LATENCY}


@pytest.mark.parametrize("sensing", ["position", "pixel"])
def test_parameters_lie_where_the_posterior_says(sensing):
    robot, true = identified(sensing), truth()
    rows = zip(robot.names, robot.values, robot.deviations, robot.told, strict=True)
    told = {
        name: (value, deviation) for name, value, deviation, own in rows if own and name in true
    }
    assert {"latency", "gear_shoulder_pan", "gear_elbow", "zero_elbow", "zero_wrist_1"} <= set(told)
    scores = np.array(
        [(value - true[name]) / deviation for name, (value, deviation) in told.items()]
    )
    assert np.sum(scores**2) < chi2.ppf(0.999, len(scores))
    assert told["latency"][0] == pytest.approx(LATENCY, abs=0.005)
    assert told["gear_elbow"][1] < 0.02


def test_first_zero_and_camera_are_not_told_apart():
    robot = identified()
    told = dict(zip(robot.names, robot.told.tolist(), strict=True))
    assert not told["zero_shoulder_pan"]
    assert not told["camera_turn_z"]
    pan = robot.untold[:, robot.names.index("zero_shoulder_pan")]
    assert np.sum(pan**2) > 0.5


def test_features_of_another_motion_are_predicted():
    log, _, model = logged(seed=SEED)
    true = true_robot()
    robot = identified().model(model)
    rng = np.random.default_rng(1)
    q = log.joints[rng.integers(0, len(log.joints), 50)] + rng.uniform(-0.1, 0.1, (50, 6))
    assert np.abs(robot.feature(q) - true.feature(q)).max() < 0.003
    assert np.abs(model.feature(q) - true.feature(q)).max() > 0.05


def test_delay_and_lag_are_those_of_the_drive():
    log, _, _ = logged()
    response = command_response(log)
    assert (response.delay, response.lag) == pytest.approx((DELAY, LAG), abs=1e-5)
    assert response.unexplained < 1e-3
    assert command_mistake(log) == ""


def driven(commands, period=0.05):
    """Return joint positions (k, n) of a drive with these commands."""
    return np.concatenate([np.zeros((1, 6)), joint_steps(commands, period, DELAY, LAG)]).cumsum(
        axis=0
    )


@pytest.mark.parametrize(
    ("gain", "clipped", "level"), [(1.0, 0.1, 0.1), (10.0, 1.5, 1.5), (10.0, np.inf, np.inf)]
)
def test_delay_and_lag_are_found_although_commands_are_clipped_elsewhere(gain, clipped, level):
    """The limit of this log is 1 rad/s."""
    log = logged()[0]
    u = gain * log.commands
    response = command_response(
        log._replace(commands=u, joints=driven(np.clip(u, -clipped, clipped)))
    )
    assert response[:2] == pytest.approx((DELAY, LAG), abs=1e-3)
    assert response.level == pytest.approx(level, rel=1e-3)
    lines = "\n".join(remarks(log, identified(), response))
    assert ("commands act as if clipped at " in lines) is (level < np.inf)


def test_joints_that_do_not_move_and_a_log_of_a_row_tell_nothing_of_a_drive():
    log = logged()[0]
    assert command_response(log._replace(joints=np.zeros_like(log.joints))) is None
    assert (
        command_response(log._replace(joints=log.joints[:10], commands=log.commands[:10])) is None
    )
    assert command_mistake(log._replace(joints=log.joints[:1], commands=log.commands[:1])) == ""


COMMANDS = {  # of a log -> mistaken ones, and the line on them
    "missing": (lambda log: None, "the log has no command of each joint"),
    "constant": (
        lambda log: np.ones_like(log.joints),
        "none up to 0.5 s explain the joint motion by the commands",
    ),
    "positions": (lambda log: log.joints, "commands of the log are its joint positions"),
    "degrees": (
        lambda log: np.degrees(log.commands),
        r"commands are 5\d times the joint speeds; if they are in deg/s",
    ),
    "exchanged": (
        lambda log: log.commands[:, [0, 2, 1, 3, 4, 5]],
        "shoulder_lift follows the command of elbow, elbow",
    ),
    "negated": (
        lambda log: -log.commands,
        "every joint moves against its command; give each joint its own",
    ),
    "reversed": (
        lambda log: log.commands * (1, 1, -1, 1, 1, 1),
        "^elbow moves against its command; give",
    ),
    "late": (
        lambda log: np.roll(log.commands, -20, axis=0),
        "none up to 0.5 s explain the joint motion",
    ),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_no_delay_and_lag_are_told_by_mistaken_commands(name):
    change, line = COMMANDS[name]
    log = logged()[0]
    log = log._replace(commands=change(log))
    assert command_response(log) is None
    assert re.search(line, untold_response(log))


@pytest.mark.parametrize("name", ["joint_velocity_elbow_rad_s", "elbow"])
def test_commands_that_are_missing_or_misnamed_are_named(name, caplog):
    log, table, _ = logged()
    own = "joint_velocity_command_elbow_rad_s"
    remark.cache_clear()
    assert read_log(log.spec, table.rename(columns={own: name})).commands is None
    assert (
        f"the log has columns joint_velocity_… but no {own}: commands are left out" in caplog.text
    )


def test_a_drive_that_is_no_first_order_lag_widens_the_interval_of_the_delay():
    """Joints that stick at slow speed move in steps, which no lag has."""
    log = logged()[0]
    stuck = log._replace(joints=0.01 * np.round(log.joints / 0.01))
    exact, response = command_response(log), command_response(stuck)
    deviation = float(np.sqrt(response.covariance[0, 0]))
    assert np.sqrt(exact.covariance[0, 0]) < 1e-6 < 0.002 < deviation
    assert abs(response.delay - DELAY) < 1.96 * deviation
    assert response.covariance[0, 0] + response.covariance[0, 1] < 0.1 * response.covariance[0, 0]


def test_joint_steps_are_the_integral_of_the_lag():
    period, delay, lag, fine = 0.05, 0.07, 0.11, 1000
    u = np.array([[1.0], [0.0], [-2.0], [0.5], [0.0], [0.0]])
    h = period / fine
    held = np.concatenate([np.zeros(round(delay / h)), np.repeat(u[:, 0], fine)])[: fine * len(u)]
    q, v, at = 0.0, 0.0, [0.0]
    for k, each in enumerate(held, 1):
        gone = -math.expm1(-h / lag)
        q, v = q + h * each + lag * gone * (v - each), v + gone * (each - v)
        if k % fine == 0:
            at.append(q)
    np.testing.assert_allclose(
        joint_steps(u, period, delay, lag)[:, 0], np.diff(at)[:-1], atol=1e-9
    )


def test_poses_of_cameras_are_found_among_outliers():
    rng = np.random.default_rng(0)
    for sensing in ("position", "pixel"):
        log, _, model = logged(sensing)
        q = log.joints[::4]
        wanted = model.turned(np.array([0.1, -0.2, 0.7]), (0.4, 0.1, 0.4))
        y = np.array(wanted.feature(q))
        y[rng.random(len(y)) < 0.2] += 50.0 if sensing == "pixel" else 0.3
        poses, errors = fit_cameras(model, np.stack([q, q[:, ::-1]]), y)
        np.testing.assert_allclose(poses[0], wanted.camera, atol=2e-3)
        assert errors[0] < 2e-3 * log.spec.feature.scale < 0.1 * errors[1]


@pytest.mark.parametrize("sensing", ["position", "pixel"])
def test_derivatives_of_residuals_are_their_differences(sensing):
    log, _, model = logged(sensing)
    problem = _Problem(log, model, 50, {})
    problem.motion = problem.smooth  # Derivatives are those for joints without noise.
    z = problem.recentred(problem.z) + np.random.default_rng(0).normal(0.0, 0.2, len(problem.z))
    root, weights = (
        np.eye(log.spec.m) / log.spec.feature.scale,
        np.linspace(0.5, 1.0, len(problem.rows)),
    )
    columns = [
        (problem.weighted(z + step, root, weights) - problem.weighted(z - step, root, weights))
        / 2e-5
        for step in 1e-5 * np.eye(len(z))
    ]
    own = problem.weighted_jacobian(z, root, weights)
    np.testing.assert_allclose(own, np.transpose(columns), atol=2e-5)


def test_covariance_and_outliers_are_told_apart():
    rng = np.random.default_rng(4)
    true = np.array([[4.0, 1.0], [1.0, 2.0]])
    errors = rng.multivariate_normal((0.0, 0.0), true, 5000)
    errors[:1000] += 40.0
    covariance, inliers = robust_covariance(errors)
    np.testing.assert_allclose(covariance, true, rtol=0.1)
    assert inliers[:1000].sum() == 0
    assert inliers[1000:].mean() > 0.99


def test_correlation_time_is_that_of_the_process():
    rng, share = np.random.default_rng(5), 0.8
    white = rng.standard_normal((20000, 1))
    x = np.zeros_like(white)
    for k in range(1, len(x)):
        x[k] = share * x[k - 1] + white[k]
    assert correlation_time(x) == pytest.approx((1 + share) / (1 - share), rel=0.15)
    assert correlation_time(white) == 1.0


def exchanged(log):
    return log._replace(joints=log.joints[:, [0, 2, 1, 3, 4, 5]])


def wrapped(log):
    q = log.joints + (0.0, 0.0, 0.0, 0.0, np.pi - log.joints[60, 4], 0.0)
    return log._replace(joints=(q + np.pi) % (2.0 * np.pi) - np.pi)


def drifting(log):
    late = 0.002 * log.time[:, None]
    return log._replace(features=log.features - late * np.gradient(log.features, log.time, axis=0))


def early(log):
    return log._replace(
        features=np.roll(log.features, -3, axis=0), valid=log.valid & (log.time < 19.8)
    )


def moved(log):
    later = (log.time > 12.0)[:, None]
    return log._replace(features=log.features + later * (0.05, 0.0, 0.0))


def repeated(log):
    y = log.features.copy()
    y[3::4] = y[2::4][: len(y[3::4])]
    return log._replace(features=y)


def zeros(log):
    return log._replace(
        features=np.where((np.arange(len(log.time)) % 20 == 0)[:, None], 0.0, log.features)
    )


def lost(log):
    return log._replace(joints=log.joints * (np.arange(len(log.time)) != 90)[:, None])


MISTAKES = {
    "exchanged": (exchanged, "joints shoulder_lift and elbow are exchanged"),
    "drifting": (
        drifting,
        r"frames come (39|40|41) ± \d ms later at the end than at the beginning",
    ),
    "early": (
        early,
        r"frames come (69|70) ms before the joints are where they show them, as clocks of camera and joints",
    ),
    "moved": (moved, r"features jump by 0\.05 m about 1[1-3] s after the beginning"),
    "repeated": (
        repeated,
        r"25% of the frames repeat another one although the arm moves, first in row \d+",
    ),
    "zeros": (
        zeros,
        r"5% of the frames repeat another one .* first in row 20: give rows without .* feature_valid = 0",
    ),
    "lost": (lost, r"joint \w+ jumps by .* rad in row 90, above [\d.]+ rad/s: interpolate"),
    "negated": (
        lambda log: log._replace(joints=-log.joints),
        "the directions of all joints are reversed",
    ),
    "wrapped": (
        wrapped,
        r"joint wrist_2 jumps by 6\.\d+ rad in row \d+, as it is wrapped at ±π: unwrap it",
    ),
    "degrees": (
        lambda log: log._replace(joints=np.degrees(log.joints)),
        "; if the log is in degrees, write it in rad",
    ),
    "centimetres": (
        lambda log: log._replace(features=1e2 * log.features),
        "likely in cm; write them in m",
    ),
    "inches": (
        lambda log: log._replace(features=log.features / 0.0254),
        "likely in inches; write them in m",
    ),
    "millimetres": (
        lambda log: log._replace(features=1e3 * log.features),
        "likely in mm; write them in m",
    ),
}


BY_DAY = [name for name in MISTAKES if name != "negated"]  # a remedy, as that of exchanged joints


@pytest.mark.usefixtures("few_arms")
@pytest.mark.parametrize("mistake", some(MISTAKES, *BY_DAY))
def test_a_mistake_is_named_with_its_remedy(mistake):
    change, wanted = MISTAKES[mistake]
    log, _, model = logged()
    text, robot = mistakes(change(log), model)
    assert re.search(wanted, text)
    assert robot is None


def test_another_arm_is_named(output_of, tmp_path):
    logged()[1].to_csv(tmp_path / "robot.csv", index=False)
    assert ": the arm is a ur10e" in output_of(
        "identify", tmp_path / "robot.csv", "--robot", "ur5e", code=1
    )


def test_outliers_and_a_joint_at_rest_are_no_mistakes():
    log, _, model = logged()
    rng, y = np.random.default_rng(2), log.features.copy()
    bad = rng.random(len(y)) < 0.3
    y[bad] += rng.normal(0.0, 0.3, (int(bad.sum()), 3))
    text, robot = mistakes(log._replace(features=y), model)
    assert text == ""
    assert 1.0 - robot.inliers.mean() == pytest.approx(0.3, abs=0.05)
    assert np.sqrt(np.diag(robot.noise)).max() < 0.0015


@pytest.mark.parametrize("controller", ["nmpc_calibrated", "rbfnn_mfac"])
def test_a_short_move_and_a_long_rest_are_no_mistake_and_tell_no_parameter(controller):
    made = run(controller, task="exp2", settings={"exp2": {"duration": 6.0}})
    model = find_sensing("position").nominal(find_robot("ur5"))
    log = read_log(hand_eye_spec(model, 0.05, 1.0, 2.0 * math.pi), made.steps)
    text, robot = mistakes(log, model)
    assert text == ""
    assert estimates(robot, None).empty
    assert remarks(log, robot, None)[-1].startswith("no parameter of arm or camera is told by")
    # The arm itself moves by a fifth of a metre
    for unit, size in (("mm", 1e3), ("cm", 1e2), ("inches", 1.0 / 0.0254)):
        moved = log._replace(features=size * log.features)
        assert f"likely in {unit}; write them in m" in mistakes(moved, model)[0]


@pytest.mark.parametrize(("drift", "motion"), [(0.0, "0 rad"), (0.004, "0.0039 rad")])
def test_no_robot_is_fitted_to_the_noise_of_an_arm_at_rest(drift, motion):
    log, _, model = logged()
    rng = np.random.default_rng(5)
    features = log.features[:1] + rng.normal(0.0, 1e-3, log.features.shape)
    creep = np.linspace(0.0, drift, len(log.joints))[:, None]
    still = log._replace(joints=log.joints[:1] + creep, features=features)
    text, robot = mistakes(still, model)
    assert robot is None
    assert text.startswith(f"no joint moves by more than {motion}")


@pytest.mark.parametrize("pixel", [0.01, 0.02])
def test_equal_frames_of_a_detector_of_whole_pixels_are_no_mistake(pixel):
    log = logged()[0]
    coarse = log._replace(features=np.round(log.features / pixel) * pixel)
    assert (np.diff(coarse.features, axis=0) == 0.0).all(axis=1).mean() > 0.02
    assert coarse.frame_mistake() == ""
    assert "frames repeat another one" in zeros(coarse).frame_mistake()
    coarse.features[100:140] = coarse.features[100]
    assert "frames repeat another one" in coarse.frame_mistake()


def test_frames_of_a_short_log_and_of_the_same_laps_again_and_again_are_no_mistake():
    log = logged()[0]
    short = log._replace(
        **{
            name: getattr(log, name)[:80]
            for name in ("time", "joints", "features", "valid", "captured")
        }
    )
    assert short.frame_mistake() == ""
    lap = 10 + np.arange(len(log.time)) % 60
    laps = log._replace(
        joints=np.sin(np.pi * lap / 30.0)[:, None] * np.ones(6), features=log.features[lap]
    )
    assert laps.frame_mistake() == ""
    assert "frames repeat another one" in zeros(laps).frame_mistake()


def test_what_is_printed_names_units_and_what_the_log_does_not_tell():
    log, _, _ = logged()
    still = log._replace(joints=log.joints * (1, 1, 1, 1, 1, 0.0))
    table = estimates(identified(), command_response(log)).set_index("parameter")
    assert table.loc["latency", "unit"] == "ms"
    assert float(table.loc["latency", "estimate"]) == pytest.approx(80.0, abs=2.0)
    lines = "\n".join(remarks(log._replace(commands=-log.commands), identified(), None))
    assert "residuals over time are white" in lines
    assert "not told: zero_shoulder_pan with camera_turn_" in lines
    assert "not told: delay and lag, as every joint moves against its command" in lines
    at_once = Response(0.0, 2e-4, np.eye(2), 0.0, np.inf)
    assert "joints follow commands at once: these are likely their" in "\n".join(
        remarks(log, identified(), at_once)
    )
    assert "joints that hardly move: wrist_3" in "\n".join(remarks(still, identified(), None))
    values = np.where(np.array(identified().names) == "zero_elbow", 1.0, identified().values)
    assert "far from the nominal robot: zero_elbow" in "\n".join(
        remarks(log, replace(identified(), values=values), None)
    )


def test_a_twin_has_the_features_and_the_uncertainty_of_the_log(tmp_path):
    log, _, model = logged()
    path = write(
        tmp_path,
        twin_text(identified(), log, command_response(log), (ROBOT, "position")),
        "twin.toml",
    )
    request = RunRequest(
        "kinematic", "constant", "random", Mismatch.parse("none"), 0, robot=str(path)
    )
    mean = draw_robot(request)[0]
    q = log.joints[::20]
    np.testing.assert_allclose(mean.feature(q), identified().model(model).feature(q), atol=1e-9)
    twin = find_robot(str(path)).twin
    assert twin.times(0) == pytest.approx(
        {"sensing.latency": LATENCY, "command_delay": DELAY, "lag": LAG}, abs=1.1e-3
    )
    drawn = [draw_robot(replace(request, seed=seed))[0].feature(q) for seed in range(1, 20)]
    assert 1e-5 < np.std(drawn, axis=0).mean() < 1e-3


def test_a_swing_of_the_latency_that_the_bench_would_not_show_stays_as_it_is():
    log = logged()[0]
    swing = np.array(identified().names) == "swing_sin"
    found = replace(
        identified(), values=np.where(swing, 3.0, identified().values), swing_period=log.spec.period
    )
    assert sensor(log, found).settings["sensing"]["latency_swing"] == pytest.approx(3.0, abs=0.01)


def test_a_latency_that_is_estimated_below_0_is_0_in_a_twin(tmp_path):
    found, path = identified(), tmp_path / "twin.toml"
    values = found.values.copy()
    values[found.names.index("latency")] = -2e-4
    log = logged()[0]
    path.write_text(
        twin_text(replace(found, values=values), log, command_response(log), (ROBOT, "position")),
        "utf-8",
    )
    assert find_robot(str(path)).twin.times(0)["sensing.latency"] == 0.0


WORLDS = {  # mismatch -> section, and settings with the share by which they may be off
    "backlash=1deg": ("mechanics", {"backlash": (math.radians(1.0), 0.1)}),
    "ripple=0.03rad": ("mechanics", {"ripple": (0.03, 0.1)}),
    "flexible_tool=12": ("mechanics", {"tool_frequency": (12.0, 0.1)}),
    "camera_turn=10deg": ("sensing", {"camera_turn": (math.radians(10.0), 0.01)}),
    "latency_swing=100ms": ("sensing", {"latency_swing": (0.1, 0.15), "swing_period": (4.0, 0.05)}),
    "jitter=200ms": ("sensing", {"jitter": (0.2, 0.25)}),
    "occlusions=50%": ("sensing", {"occlusions": (0.5, 0.4), "occlusion_duration": (0.5, 0.2)}),
    "outliers=20%": ("", {}),
    "none": ("", {}),
}


def excited(world, *, stamps=False):
    """Return the steps of a run with excited joints in a world."""
    settings = {
        "random": {"duration": 40.0},
        "run": {"lost_after": 20.0},
        "Excite": {"swing": 0.25},
        "kinematic": {"sensing": {"stamps": stamps}},
    }
    made = run(
        "docs/examples/excite.py", task="random", mismatch=world, seed=SEED, settings=settings
    )
    return made.steps


@pytest.mark.parametrize("world", ["jitter=200ms", "latency_swing=100ms"])
def test_stamps_tell_when_frames_were_exposed_that_are_late_by_changing_times(world, tmp_path):
    steps = excited(world, stamps=True)
    spec, nominal = logged()[0].spec, find_robot("ur5").nominal
    log, unstamped = read_log(spec, steps), read_log(spec, steps.drop(columns="capture_time_s"))
    robot = identify(log, nominal)
    sizes = [
        np.linalg.norm(list(each.sizes().values()))  # The true robot is the nominal one
        for each in (robot, identify(unstamped, nominal))
    ]
    assert sizes[0] < 0.6 * sizes[1]
    told = sensor(log, robot)
    _, wanted = WORLDS[world]
    assert told.settings == {
        "sensing": {"stamps": True, **{n: pytest.approx(v, rel=s) for n, (v, s) in wanted.items()}}
    }
    assert np.sqrt(np.diag(told.noise)) == pytest.approx(0.001, rel=0.1)
    twin = twin_text(robot, log, command_response(log), ("ur5", "position"))
    path = write(tmp_path, twin, "twin.toml")
    brief = {"exp1": {"duration": 1.0}}
    seen = run("constant", robot=str(path), mismatch="none", settings=brief).steps
    assert "capture_time_s" in seen


def test_stamps_in_another_unit_are_refused():
    steps = logged()[1]
    milliseconds = steps.assign(capture_time_s=1e3 * (steps["time_s"] - 0.08))
    with pytest.raises(
        ConfigurationError,
        match="capture_time_s of the log runs 1.995e.04 s while its rows run 19.95 s",
    ):
        read_log(logged()[0].spec, milliseconds)


@pytest.mark.parametrize("world", WORLDS)
def test_a_twin_has_the_gears_the_tool_and_the_lateness_that_a_log_tells(world, tmp_path):
    log = read_log(logged()[0].spec, excited(world))
    robot = identify(log, find_robot("ur5").nominal)
    told, (section, wanted) = sensor(log, robot), WORLDS[world]
    assert told.settings.keys() == ({section} if section else set())
    assert told.settings.get(section, {}).keys() == wanted.keys()
    for name, (value, share) in wanted.items():
        assert told.settings[section][name] == pytest.approx(value, rel=share)
    assert told.latency < 0.02
    assert 0.0008 < np.sqrt(np.diag(told.noise)).max() < 0.0025
    assert told.lost < 0.05
    path = write(
        tmp_path, twin_text(robot, log, command_response(log), ("ur5", "position")), "twin.toml"
    )
    row = run(
        "constant", robot=str(path), mismatch="none", settings={"exp1": {"duration": 1.0}}
    ).row
    assert row["status"] == "completed"


@pytest.mark.parametrize(
    ("frame", "period", "lost"),
    [
        (0.1, 0.05, 0.0),
        (0.066, 0.02, 0.0),
        (0.066, 0.02, 0.2),
        (0.067, 0.05, 0.0),
        (0.05, 0.05, 0.05),
    ],
)
def test_the_period_of_a_camera_and_lost_frames_are_told_apart(frame, period, lost):
    rows = np.ceil(np.arange(0.0, 60.0, frame) / period - 1e-9).astype(int)
    rows = rows[np.random.default_rng(0).random(len(rows)) >= lost]
    valid = np.isin(np.arange(round(60.0 / period)), rows)
    valid[301] |= frame == 0.1  # an odd frame
    log = logged()[0]._replace(spec=replace(logged()[0].spec, period=period), valid=valid)
    assert frame_period(log) == pytest.approx(frame, rel=0.01)
    assert lost_share(log) == pytest.approx(lost, abs=0.03)


def test_a_twin_has_the_rate_and_latency_of_a_camera_at_no_multiple_of_the_period(tmp_path):
    settings = {
        "kinematic": {"sensing": {"latency": 0.08, "frame_period": 0.066}},
        "run": {"period": 0.02},
    }
    made = run("docs/examples/excite.py", task="random", robot="ur5e", seed=SEED,
               settings=settings | {"random": {"duration": 20.0}})  # fmt: skip
    log = read_log(replace(logged()[0].spec, period=0.02), made.steps)
    robot = identify(log, find_robot("ur5e").nominal)
    twin = find_robot(
        str(write(tmp_path, twin_text(robot, log, None, ("ur5e", "position")), "twin.toml"))
    ).twin
    given = twin.plant_settings(KinematicConfig(), 0.02)["sensing"]
    assert given["frame_period"] == pytest.approx(0.066, rel=1e-3)
    assert given["latency"] == pytest.approx(0.08, abs=0.003)
    assert given["drop_probability"] == 0.0


@pytest.mark.slow
@pytest.mark.usefixtures("few_arms")
def test_two_mistakes_are_named_together_and_a_log_they_do_not_explain_is_refused(monkeypatch):
    log, _, model = logged()
    order = np.argsort(np.argsort(log.spec.joint_names))
    both = log._replace(joints=log.joints[:, order], features=log.features * (1, 1, -1))
    text, robot = mistakes(both, model)
    assert text.startswith(
        "joints are in alphabetical order, as in ROS, and an axis of the camera is mirrored"
    )
    assert robot is None
    monkeypatch.setattr(preflight, "SCREENED", 1)
    foreign = 0.2 * np.sin(log.time[:, None] * (9.0, 7.0, 5.0))
    # Has no halves of 50 frames
    text, robot = mistakes(log._replace(features=foreign, valid=log.time < 5.2), model)
    assert "of the motion, and neither one mistake nor two explain them" in text
    assert robot is None


@pytest.mark.slow
@pytest.mark.usefixtures("few_arms")
def test_a_mistake_is_named_although_the_camera_was_moved_too():
    log, _, model = logged()
    moved = log.features + 0.05 * (log.time[:, None] > 0.5 * log.time[-1]) * (1, 0, 0)
    text, robot = mistakes(
        log._replace(joints=log.joints * (1, 1, -1, 1, 1, 1), features=moved), model
    )
    assert text.startswith(
        f"the direction of joint {log.spec.joint_names[2]} is reversed (undone, "
    )
    assert robot is None


@pytest.mark.slow
def test_frames_late_by_changing_times_are_no_clocks_that_drift():
    settings = {
        "random": {"duration": 60.0},
        "run": {"lost_after": 20.0},
        "Excite": {"swing": 0.25, "fastest": 0.5},
    }
    made = run(
        "docs/examples/excite.py",
        task="random",
        mismatch="jitter=200ms",
        seed=173401,
        settings=settings,
    )
    log = read_log(logged()[0].spec, made.steps)
    # A drift of 6.5 deviations of a steady latency
    assert mistakes(log, find_robot("ur5").nominal)[0] == ""


def test_zeros_at_any_angle_are_parameters_and_no_mistakes():
    settings = {"random": {"duration": 30.0}, "Excite": {"swing": 0.25}}
    words = "moderate+joint_offsets=180deg"
    made = run(
        "docs/examples/excite.py", task="random", mismatch=words, seed=81000, settings=settings
    )
    request = RunRequest("kinematic", "constant", "random", Mismatch.parse(words), 81000)
    model = find_robot("ur5").nominal
    text, robot = mistakes(read_log(logged()[0].spec, made.steps), model)
    wanted = draw_robot(request)[0].arm.joint_offset - model.arm.joint_offset
    assert text == ""
    assert robot.estimate("zero_elbow")[0] == pytest.approx(wanted[ELBOW], abs=0.05)
    assert abs(wanted[ELBOW]) > 1.0


@pytest.mark.slow
@pytest.mark.usefixtures("few_arms")
@pytest.mark.parametrize(
    ("sensing", "seed", "duration"), [("position", 88702, 60.0), ("pixel", 88710, 40.0)]
)
def test_an_arm_far_from_the_nominal_one_is_found_by_the_search(sensing, seed, duration):
    settings = {"random": {"duration": duration}, "Excite": {"swing": 0.25}}
    words = find_challenge("unknown_arm").mismatch
    made = run(
        "docs/examples/excite.py",
        task="random",
        mismatch=words,
        seed=seed,
        sensing=sensing,
        settings=settings,
    )
    request = RunRequest(
        "kinematic", "constant", "random", Mismatch.parse(words), seed, sensing=sensing
    )
    model = find_sensing(sensing).nominal(find_robot("ur5"))
    log = read_log(hand_eye_spec(model, 0.05, 1.0, 2.0 * math.pi), made.steps)

    def error(robot):
        true = draw_robot(request)[0]
        q = log.joints[::100]
        wanted = true.jacobian(q)
        return np.linalg.norm(robot.model(model).jacobian(q) - wanted) / np.linalg.norm(wanted)

    assert error(identify(log, model)) > 0.1
    text, robot = mistakes(log, model)
    assert text == ""
    assert error(robot) < 0.01


def test_the_command_writes_a_twin_that_other_commands_take(output_of, tmp_path, monkeypatch):
    _, table, _ = logged()
    log, out = tmp_path / "robot.csv", tmp_path / "my twins/twin.toml"
    out.parent.mkdir()
    write(tmp_path, text(arm_tree(find_robot(ROBOT).arm, find_robot(ROBOT))), "arm.urdf")
    monkeypatch.chdir(tmp_path)
    table = table.assign(time_s=table["time_s"] / 1.5)
    table[::2].drop(columns=[name for name in table if name.startswith("true_")]).to_csv(
        log, index=False
    )
    told = output_of("identify", log, "--robot", "arm.urdf", "--out", out)
    assert "gear_elbow" in told
    assert f"servobench compare --robot '{out}' --plants kinematic --set run.period=15Hz\n" in told
    assert out.read_text(encoding="utf-8").startswith('robot = "../arm.urdf"')
    monkeypatch.chdir(out.parent)
    row = run(
        "regression_mfac",
        task="exp2",
        robot=str(out),
        mismatch="none",
        settings={"exp2": {"duration": 3.0}},
    ).row
    assert row["outcome"] == "settled"


def test_commands_of_a_table_are_clipped_where_its_robot_is(output_of, tmp_path):
    fast = SETTINGS | {"Excite": {"fastest": 0.7, "swing": 0.4}}
    fast["kinematic"] = SETTINGS["kinematic"] | {"max_joint_speed": 2.0}
    made = run(
        "docs/examples/excite.py",
        task="random",
        robot=ROBOT,
        mismatch=MISMATCH,
        seed=SEED,
        settings=fast,
    ).steps
    assert 1.5 < made.filter(like="_velocity_command_").abs().max(axis=None) < 2.0
    made.to_csv(tmp_path / "fast.csv", index=False)
    assert "clipped" not in output_of("identify", tmp_path / "fast.csv", "--robot", ROBOT)


def test_a_twin_of_a_twin_is_refused_before_the_work(refusal_of, tmp_path):
    logged()[1].to_csv(tmp_path / "robot.csv", index=False)
    pose = "pose = {frame = 'base', position = [0.4, 0.1, 2.2], rotation = [0, 0, 0, 1]}"
    twin = write(tmp_path, f"robot = '{ROBOT}'\n[camera]\n{pose}\n", "twin.toml")
    line = refusal_of("identify", tmp_path / "robot.csv", "--robot", twin)
    assert "is itself a twin, which no twin can deviate from: identify a table" in line
    assert f"with --robot {ROBOT}" in line


def test_the_command_names_a_mistake_with_exit_code_1_and_writes_nothing(output_of, tmp_path):
    _, table, _ = logged()
    log, out = tmp_path / "robot.csv", tmp_path / "twin.toml"
    features = [name for name in table if name.startswith("feature_") and name.endswith("_m")]
    table.assign(**{name: 1e3 * table[name] for name in features}).to_csv(log, index=False)
    printed = output_of("identify", log, "--robot", ROBOT, "--out", out, code=1)
    assert "they are likely in mm; write them in m" in printed
    assert not out.exists()


def test_missing_rows_are_a_mistake_with_exit_code_1(output_of, tmp_path):
    logged()[1].drop(index=range(50, 60)).to_csv(tmp_path / "robot.csv", index=False)
    printed = output_of("identify", tmp_path / "robot.csv", "--robot", ROBOT, code=1).replace(
        "\n", " "
    )
    assert "row 50 is 0.55 s after the row before" in printed


def test_logs_that_are_too_short_or_of_other_cameras_are_refused():
    log, table, _ = logged()
    with pytest.raises(
        ConfigurationError, match=r"has 5 valid frames after the first 0\.25 s; wanted 50 or more"
    ):
        read_log(log.spec, table.iloc[:10])
    with pytest.raises(
        ConfigurationError, match="with --sensing position or pixel, of a fixed camera; got stereo"
    ):
        identify(log, find_sensing("stereo").nominal(find_robot(ROBOT)))
    with pytest.raises(ConfigurationError, match="feature_x_m"):
        read_log(log.spec, table.drop(columns="feature_x_m"))
