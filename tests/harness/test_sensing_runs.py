"""Runs under sensing set-ups: units, tasks, views, pose errors, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kit.lanes import assert_rows_of_single_runs
from kit.own import write
from kit.robots import FOUR_JOINTS
from servobench.controllers.methods import METHODS
from servobench.harness.batch.manifest import describe_sensing
from servobench.harness.config.registry import find_plant
from servobench.harness.config.sensing import find_sensing
from servobench.harness.config.settings import Settings
from servobench.harness.run import experiment
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.experiment import build
from servobench.harness.run.lanes import side_by_side_key
from servobench.harness.run.outcome import pose_error
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.harness.run.starts import PoseTask, displaced, pose_start
from servobench.harness.run.training import train_networks
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.signals import Command
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.inverse import reach_pose

PIXEL_WORDS = ["pixel", "pixel:hand", "stereo", "stereo:hand", "plate", "plate:hand"]


def request(
    sensing: str, task: str = "random", controller: str = "ukf_mfac", seed: int = 0, **more: object
) -> RunRequest:
    return RunRequest("kinematic", controller, task, "moderate", seed, sensing=sensing, **more)


def drawn(sensing: str, task: str, seed: int = 0, **more: object):
    return build(resolve(request(sensing, task, seed=seed, **more), Settings({}))).drawn


# --- units


def test_laws_and_estimators_see_a_metre_whatever_the_unit():
    """A plant in millimetres is controlled, joint for joint, as the same plant in metres."""
    experiment = build(resolve(request("position"), Settings({})))
    knowledge = experiment.controller.servo.knowledge
    spec = replace(knowledge.spec, feature=replace(knowledge.spec.feature, unit="mm", scale=1000.0))
    in_mm = replace(
        knowledge, spec=spec, nominal_jacobian=lambda q: 1000.0 * knowledge.nominal_jacobian(q)
    )
    entry, plant = METHODS["ukf_mfac"], experiment.plant
    pair = [entry.build(entry.config(), each) for each in (knowledge, in_mm)]
    seen = plant.reset(3)
    desired = experiment.scenario.reference.sampled(0.05, 100)
    for controller, unit in zip(pair, (1.0, 1000.0), strict=True):
        controller.reset(seen.with_values(seen.joint_position, unit * seen.feature), 0)
    for k in range(40):
        commands = [
            controller.step(
                seen.with_values(seen.joint_position, unit * seen.feature),
                unit * desired[k : k + 11],
            )
            for controller, unit in zip(pair, (1.0, 1000.0), strict=True)
        ]
        np.testing.assert_allclose(
            commands[1].joint_velocity, commands[0].joint_velocity, rtol=1e-6, atol=1e-9
        )
        jacobians = [controller.estimated_jacobian() for controller in pair]
        np.testing.assert_allclose(jacobians[1], 1000.0 * jacobians[0], rtol=1e-6, atol=1e-6)
        seen = plant.step(commands[0])


def test_noise_of_pixels_is_everywhere_that_of_the_ball_in_the_planned_image():
    robot, entry = find_robot("ur5"), find_plant("kinematic")
    for word in ("pixel", "pixel:hand", "plate"):
        model = find_sensing(word).nominal(robot)
        plant = entry.build(entry.config(), PlantSetup(model, robot.workspace.home, 0.05, robot))
        still, seen = Command(np.zeros(6)), []
        plant.reset(0)
        for _ in range(1000):
            seen.append(plant.step(still).feature)
        np.testing.assert_allclose(np.std(seen, axis=0), 0.001 * 207.85 / 1.3, rtol=0.1)


# --- tasks


@pytest.mark.parametrize("word", PIXEL_WORDS)
@pytest.mark.parametrize("seed", range(3))
def test_starts_and_targets_are_in_view_and_taught_on_the_true_robot(word, seed):
    run = drawn(word, "random", seed)
    model, reference = run.true, run.scenario.reference
    assert model.valid(run.scenario.start).all()
    assert model.valid_at(reference.points(0.0)).all()
    np.testing.assert_array_equal(reference.at(3.0), model.feature(reference.path.at(0.0)))
    if ":hand" in word and "plate" not in word:  # where a fixed circle might leave the view
        curve = drawn(word, "circle", seed)
        assert curve.true.valid_at(
            curve.scenario.reference.points(np.linspace(0.0, 10.0, 16))
        ).all()


@pytest.mark.parametrize("word", ["pixel", "stereo"])
@pytest.mark.parametrize("task", ["circle", "line", "lemniscate", "target"])
def test_curves_are_the_image_of_the_ball_on_the_curve_of_position(word, task):
    here, there = drawn(word, task, 2), drawn("position", task, 2)
    times = np.linspace(0.0, 9.0, 7)
    place = there.scenario.reference.at(times)
    at = there.true.to_base(place)
    np.testing.assert_allclose(here.scenario.reference.points(times)[:, 0], at, atol=1e-12)
    camera, f = here.true.optics, here.true.optics.focal[0]
    a = place[:, :2] / place[:, 2:]
    bent = a * (1.0 + camera.distortion[0] * (a**2).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(
        here.scenario.reference.at(times)[:, :2], camera.centre[0] + f * bent, rtol=1e-10
    )


def test_a_circle_of_a_plate_keeps_its_orientation_and_is_in_reach_of_the_arm():
    run, q = drawn("plate", "circle"), find_robot("ur5").workspace.home
    model, limit = run.true, np.full(6, 2 * np.pi)
    home, start = model.points(q), model.arm.frames(q)[-1]
    for time in np.linspace(0.0, 10.0, 21):
        points, pose = run.scenario.reference.points(time), start.copy()
        assert pose_error(home, points)[1] == pytest.approx(0.0, abs=1e-6)
        pose[:3, 3] += points.mean(axis=0) - home.mean(axis=0)
        q, left = reach_pose(model.arm, pose, q, -limit, limit)
        assert left < 1e-6
        np.testing.assert_allclose(model.points(q), points, atol=1e-5)


@pytest.mark.parametrize("word", ["plate", "plate:hand"])
@pytest.mark.parametrize("task", ["axis_turn", "retreat", "camera_turn", "plane_turn"])
def test_the_canonical_tasks_displace_the_target_before_the_camera_as_they_say(word, task):
    robot = find_robot("ur5")
    model = find_sensing(word).nominal(robot)
    config = resolve(request(word, task), Settings({})).task
    assert isinstance(config, PoseTask)
    start = pose_start(config, robot, model)
    assert model.valid(start).all()
    pose = np.linalg.inv(model.camera)
    home, away = (
        model.points(q) @ pose[:3, :3].T + pose[:3, 3] for q in (robot.workspace.home, start)
    )
    D = displaced(config, home.mean(axis=0))
    np.testing.assert_allclose(away, home @ D[:3, :3].T + D[:3, 3], atol=1e-5)
    distance, angle = pose_error(away, home)
    turned = {"axis_turn": 45.0, "retreat": 0.0, "camera_turn": 15.0, "plane_turn": 30.0}[task]
    assert np.degrees(angle) == pytest.approx(turned, abs=1e-3)
    if task == "plane_turn":
        assert distance == pytest.approx(0.0, abs=1e-5)
    if task == "retreat":
        np.testing.assert_allclose(away.mean(axis=0)[2], 0.75 * home.mean(axis=0)[2], rtol=1e-5)


def test_a_pose_beyond_the_length_of_the_arm_is_not_reached():
    robot, limit = find_robot("ur5"), np.full(6, 2 * np.pi)
    far = robot.arm.frames(robot.workspace.home)[-1].copy()
    far[:3, 3] = 3.0
    assert reach_pose(robot.arm, far, robot.workspace.home, -limit, limit)[1] > 0.1


def test_the_pose_error_is_the_motion_between_two_places():
    rng = np.random.default_rng(2)
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    for angle in (0.0, 0.3, 2.0, 3.1):
        axis = rng.standard_normal(3)
        R = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
        distance, found = pose_error(square @ R.T + [0.0, 0.0, 0.4], square)
        assert distance == pytest.approx(0.4)
        assert found == pytest.approx(angle, abs=1e-7)


# --- runs


def test_a_run_of_a_plate_has_its_true_pose_error_in_both_tables():
    result = run_experiment(request("plate", "plane_turn"), Settings({}))
    assert {"pose_error_mm", "pose_error_deg", "true_feature_u3_px"} <= set(result.steps)
    # The true arm is another one
    assert result.steps["pose_error_deg"].iloc[0] == pytest.approx(30.0, abs=12.0)
    assert result.row["pose_error_deg"] == pytest.approx(
        result.steps["pose_error_deg"].iloc[-20:].mean()
    )
    assert result.row["pose_error_deg"] < 6.0
    assert result.row["feature_unit"] == "px"
    assert result.row["sensing"] == "plate"
    assert "camera_focal" in result.row["mismatch_values"]
    assert "pose_error_mm" not in run_experiment(request("position"), Settings({})).row


def test_runs_side_by_side_are_those_of_single_runs():
    settings = Settings({"random": {"duration": 4.0}})
    assert_rows_of_single_runs(
        [resolve(request("stereo:hand", seed=seed), settings) for seed in (0, 1)]
    )


@pytest.mark.parametrize("version", [2, 3])
def test_of_two_cameras_the_first_one_moves_on_the_exported_arm_as_on_that_of_numpy(version):
    """Within the run it is displaced, and in every period it turns on; runs are side by side."""
    turning = {"sensing": {"camera_turn": 0.05}}
    settings = Settings({"kinematic": turning, "fmu": {**turning, "fmi_version": version}})
    moved = replace(request("stereo"), mismatch="moderate+camera_move=20deg")
    tables = []
    for plant in ("kinematic", "fmu"):
        runs = [replace(moved, plant=plant, seed=seed) for seed in (0, 1)]
        tables.append(assert_rows_of_single_runs([resolve(run, settings) for run in runs]))
    for wanted, came in zip(*tables, strict=True):
        assert came["steady_state_error"] == pytest.approx(wanted["steady_state_error"], rel=1e-6)


@pytest.mark.parametrize("word", PIXEL_WORDS)
@pytest.mark.parametrize("task", ["exp1", "exp4", "singular_start"])
def test_moves_are_drawn_together_until_both_ends_are_in_view(word, task):
    run, robot = drawn(word, task), find_robot("ur5")
    assert run.true.valid(run.scenario.start).all()
    assert run.true.valid_at(run.scenario.reference.points(0.0)).all()
    config, home = resolve(request(word, task), Settings({})).task, robot.workspace.home
    pairs = (
        (run.scenario.start, config.start),
        (run.scenario.reference.path.at(0.0), config.target),
    )
    ways = [(q - home, given - home) for q, given in pairs if np.any(np.asarray(given) != home)]
    share = [way @ whole / (whole @ whole) for way, whole in ways]
    np.testing.assert_allclose(share, share[0])
    assert round(10 * share[0]) in range(1, 11)


def test_a_start_out_of_view_is_a_run_without_a_feature():
    settings = Settings(
        {"exp1": {"start": [2.0, -1.69, -2.34, 0.89, 1.22, 0.0], "into_view": False}}
    )
    row = run_experiment(request("pixel:hand", "exp1"), settings).row
    assert row["status"] == "feature_lost"
    assert "not visible at the start" in row["reason"]


def test_a_plant_may_have_the_position_only(monkeypatch):
    entry = replace(find_plant("kinematic"), any_sensing=False)
    monkeypatch.setattr(experiment, "find_plant", lambda _: entry)
    with pytest.raises(
        ConfigurationError, match="plant kinematic has the sensing position only, got pixel"
    ):
        build(resolve(request("pixel"), Settings({})))


@pytest.mark.slow
def test_an_arm_of_four_joints_sees_with_the_others(tmp_path):
    file = write(tmp_path, FOUR_JOINTS, "four.toml")
    for word in ("pixel", "stereo"):
        assert (
            run_experiment(request(word, robot=str(file)), Settings({})).row["outcome"] == "settled"
        )


OWN = """
import numpy as np
from servobench.plant.cameras.setups import SensingSetup


def measure(points, optics):
    x, y, z = np.moveaxis(points[..., 0, 0, :], -1, 0)
    return np.stack([np.sqrt((x + 1.0) ** 2 + y**2), y, z], axis=-1)


FROM_THE_SIDE = SensingSetup("side", "distance from a pole", ("r", "y", "z"), "m", measure)
"""


def test_a_file_can_bring_a_set_up(tmp_path):
    file = write(tmp_path, OWN, "side.py")
    word = f"{file}:hand"
    row = run_experiment(request(word), Settings({})).row
    assert (row["outcome"], row["sensing"]) == ("settled", word)
    own, usual = (resolve(request(each), Settings({})) for each in (word, "position"))
    assert side_by_side_key(own) is None is not side_by_side_key(usual)
    assert describe_sensing(word) == {
        "name": word,
        "features": ["r", "y", "z"],
        "unit": "m",
        "cameras": 1,
    }
    with pytest.raises(
        ConfigurationError, match="has no sensing set-up 'OTHER': it defines FROM_THE_SIDE"
    ):
        find_sensing(f"{file}:OTHER")
    file.write_text(OWN.replace("axis=-1", "axis=0"))
    wanted = r"sensing side: measure must return .* \(5, 3\) for points .*, got float64 of shape \(3, 5\)"
    with pytest.raises(ConfigurationError, match=wanted):
        run_experiment(request(str(file)), Settings({}))
    file.write_text(OWN.replace("np.sqrt", "np.square_root"))
    with pytest.raises(ConfigurationError, match=r"side.py:8: AttributeError: .* 'square_root'"):
        find_sensing(str(file))
    with pytest.raises(ConfigurationError, match="defines no sensing set-up"):
        find_sensing(str(write(tmp_path, "x = 1\n", "none.py")))


def test_networks_are_trained_on_the_features_of_a_set_up():
    few = {"samples": 100, "width_scales": [1.0], "regularisations": [1e-6]}
    training = {"jacobian": {**few, "centres": 5}, "controller": {**few, "hidden": 5}}
    settings = Settings({"rbfnn_mfac": {"training": training}})
    by_metres, by_pixels = (
        train_networks("rbfnn_mfac", settings, lambda *_: None, "ur5", word)
        for word in ("position", "pixel")
    )
    assert (by_metres.jacobian.m, by_pixels.jacobian.m) == (3, 2)


@pytest.mark.parametrize(("robot", "sensing"), [("ur10e", "pixel"), ("panda", "pixel:hand")])
def test_noise_in_pixels_is_logged_in_pixels(robot, sensing):
    noise = Settings({"kinematic": {"sensing": {"feature_noise": "2px"}}, "circle": {"laps": 4}})
    steps = run_experiment(request(sensing, "circle", "constant", robot=robot), noise).steps
    apart = np.concatenate(
        [steps[f"feature_{each}_px"] - steps[f"true_feature_{each}_px"] for each in "uv"]
    )
    assert apart.std() == pytest.approx(2.0, abs=0.15)
