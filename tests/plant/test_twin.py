"""Twins: robots that are drawn from the posterior of a file."""

import itertools
import os

import numpy as np
import pytest

from kit.own import assert_remarks, write
from kit.robots import FOUR_JOINTS
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build, build_together
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.harness.run.sampling import draw_robot
from servobench.plant.cameras.registry import Sensing
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.signals import Command
from servobench.plant.robot.catalogue import find_robot, with_files
from servobench.plant.robot.twin import deviated

TWIN = """
robot = "ur10e"
covariance = [[1e-6, 0.0, 1e-6], [0.0, 4e-6, 0.0], [1e-6, 0.0, 9e-6]]
parameters = ["latency", "zero_elbow", "gear_elbow"]
factor = [[0.004, 0.02, 0.0], [0.0, 0.01, -0.01]]
[camera]
latency = 0.083
pose = { frame = "base", position = [0.4, 0.1, 2.2], rotation = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]] }
[mean]
command_delay = 0.02
tool_x = 0.013
zero_elbow = 0.05
link_2_x = -0.04
"""
ELBOW = 2


@pytest.fixture
def twin(tmp_path):
    return written(tmp_path, TWIN)


def written(folder, text):
    return str(write(folder, text, "twin.toml"))


def request(robot, seed=0, mismatch="none", **further):
    return RunRequest("kinematic", "constant", "exp2", mismatch, seed, robot=robot, **further)


def true_robot(robot, seed=0, mismatch="none", **further):
    return draw_robot(request(robot, seed, mismatch, **further))[0]


def test_seed_0_has_the_mean_and_controllers_know_the_named_robot(twin):
    nominal, true = find_robot("ur10e").nominal, true_robot(twin)
    assert true.arm.joint_offset[ELBOW] == pytest.approx(0.05)
    np.testing.assert_allclose(true.arm.tool - nominal.arm.tool, (0.013, 0.0, 0.0))
    np.testing.assert_allclose(true.arm.translation[2, 0] / nominal.arm.translation[2, 0], 0.96)
    np.testing.assert_allclose(true.camera[:3, 3], (0.4, 0.1, 2.2))
    np.testing.assert_array_equal(find_robot(twin).nominal.camera, nominal.camera)


def test_seeds_draw_parameters_with_their_joint_uncertainty(twin):
    own = find_robot(twin).twin
    drawn = np.array(
        [[own.values(seed)[name] for name in own.keys.parameters] for seed in range(1, 4001)]
    )
    factor = np.array(own.keys.factor)
    np.testing.assert_allclose(drawn.mean(axis=0), (0.083, 0.05, 0.0), atol=1e-3)
    np.testing.assert_allclose(np.cov(drawn.T), factor.T @ factor, atol=3e-5)
    assert true_robot(twin, 7).arm.gear_ratio[ELBOW] == 1.0 + own.values(7)["gear_elbow"]


def test_the_plant_has_the_times_and_the_noise_of_the_twin(twin):
    experiment = build(resolve(request(twin), Settings()))
    plant = experiment.plant
    plant.reset(0)
    rest = [plant.step(Command(np.zeros(6))).feature for _ in range(4000)][10:]
    np.testing.assert_allclose(
        np.cov(np.transpose(rest)), find_robot(twin).twin.keys.covariance, atol=4e-7
    )
    assert resolve(request(twin), Settings()).plant.sensing.latency == 0.083
    assert resolve(request(twin), Settings()).plant.command_delay == 0.02


@pytest.mark.parametrize(
    ("rate", "frame_period"), [(20.0, 0.0), (10.0, 0.1), (15.0, 1.0 / 15.0), (40.0, 0.0)]
)
def test_frames_at_the_control_rate_are_as_late_as_the_log_says(tmp_path, rate, frame_period):
    """A grid of frames would round the latency of 83 ms up to the next control instant."""
    robot = written(tmp_path, TWIN.replace("latency = 0.083", f"latency = 0.083\nrate = {rate}"))
    assert resolve(request(robot), Settings()).plant.sensing.frame_period == frame_period


def test_gears_and_sensor_of_a_twin_are_settings_of_its_plant(tmp_path):
    robot = written(
        tmp_path, TWIN + "[plant.mechanics]\nbacklash = 0.01\n[plant.sensing]\njitter = 0.1\n"
    )
    plant = resolve(request(robot), Settings()).plant
    assert (plant.mechanics.backlash, plant.sensing.jitter, plant.sensing.latency) == (
        0.01,
        0.1,
        0.083,
    )


def test_latency_is_drawn_to_a_millisecond_unless_a_user_sets_it(twin):
    drawn = {
        seed: resolve(request(twin, seed), Settings()).plant.sensing.latency for seed in range(6)
    }
    assert len(set(drawn.values())) > 3
    assert all(latency == round(latency, 3) for latency in drawn.values())
    given = Settings({"kinematic": {"sensing": {"latency": 0.1}}})
    assert {resolve(request(twin, seed), given).plant.sensing.latency for seed in range(6)} == {0.1}
    mean = Settings({"kinematic": {"sensing": {"latency": 0.083}}})
    kept = {resolve(request(twin, seed), mean).plant.sensing.latency for seed in range(6)}
    assert kept == {0.083}
    varied = request(twin, 3, varied=(("latency", 0.02),))
    assert resolve(varied, Settings()).plant.sensing.latency == 0.02


def test_runs_on_a_twin_have_the_same_noise_side_by_side_and_alone(twin):
    runs = [
        resolve(request(twin, seed, varied=(("latency", 0.05),)), Settings()) for seed in (1, 2)
    ]
    both = build_together(runs).plant
    seen = both.reset([1, 2]).feature
    np.testing.assert_array_equal(seen[1], build(runs[1]).plant.reset(2).feature)


def test_a_deviating_camera_in_pixels_shows_the_marker_elsewhere():
    robot = find_robot("ur5")
    nominal, q = Sensing.parse("pixel").nominal(robot), robot.workspace.home
    moved = deviated(nominal, {"focal": 0.1, "centre_u": 3.0})
    middle = nominal.optics.centre[0]
    np.testing.assert_allclose(
        moved.feature(q), middle + 1.1 * (nominal.feature(q) - middle) + (3.0, 0.0)
    )
    longer = deviated(nominal, {"tool_z": 0.05})
    np.testing.assert_allclose(np.linalg.norm(longer.points(q) - nominal.points(q)), 0.05)


BROKEN = {
    "zero_elbow = 0.05": (
        "zero_elbo = 0.05",
        "has no parameter 'zero_elbo' there; did you mean 'zero_elbow'",
    ),
    "pose = {": ("rate = 20.0 # {", 'camera.pose must have frame = "base"'),
    "command_delay = 0.02": ("lag = -0.02", "mean.lag must be at least 0 s, got -0.02"),
    '"gear_elbow"]': ('"zero_elbow"]', "parameters names 'zero_elbow' twice"),
    ", [0.0, 0.01, -0.01]]": (", [0.0]]", "each row of factor needs 3 numbers"),
    "4e-6": ("-4e-6", "covariance must be a symmetric, positive definite matrix"),
    "[mean]": ("[means]", "has no setting 'means': did you mean 'mean'"),
    'robot = "ur10e"': ('robot = "ur11"', "unknown robot 'ur11'"),
}


@pytest.mark.parametrize("old", BROKEN)
def test_a_wrong_file_is_refused_in_one_line(tmp_path, old):
    new, message = BROKEN[old]
    with pytest.raises(ValueError, match=r"^[^\n]+$") as raised:
        find_robot(written(tmp_path, TWIN.replace(old, new)))
    assert message in str(raised.value)


def test_parameters_in_other_units_are_remarked_on(tmp_path, caplog):
    cases = [
        (
            "zero_elbow = 0.05",
            "zero_elbow = 2.9",
            "zero_elbow deviates by 2.9, and usually by 0.5 at most",
        ),
        ("tool_x = 0.013", "tool_x = 13", "tool_x deviates by 13"),
        ("[0.004,", "[4.0,", "latency deviates by 4"),
    ]
    assert_remarks(caplog, lambda text: find_robot(written(tmp_path, text)), TWIN, cases)


def test_a_twin_of_a_twin_is_refused(twin, tmp_path):
    other = write(tmp_path, TWIN.replace("ur10e", twin), "other.toml")
    with pytest.raises(ValueError, match="its robot must be the one that controllers know"):
        find_robot(str(other))


def test_twins_of_each_other_are_refused(tmp_path):
    first, second = (write(tmp_path, TWIN.replace("ur10e", f"{name}.toml"), f"{other}.toml")
                     for name, other in (("a", "b"), ("b", "a")))  # fmt: skip
    for path in (first, second):
        with pytest.raises(ValueError, match="its robot must be the one that controllers know"):
            find_robot(str(path))


@pytest.mark.parametrize("name", ["arm.toml", "arm with gripper#2.toml"])
def test_a_twin_finds_its_robot_beside_itself(tmp_path, monkeypatch, name):
    write(tmp_path, FOUR_JOINTS, name)
    own = TWIN.replace("ur10e", name).replace("elbow", "joint_3")
    path = written(tmp_path, own)
    monkeypatch.chdir(tmp_path.parent)
    assert find_robot(path).n == 4
    assert (
        with_files("my arm.urdf#tool0 with camera.toml", str.upper)
        == "MY ARM.URDF#tool0 with CAMERA.TOML"
    )


def test_a_robot_is_read_again_once_a_file_that_it_names_has_changed(tmp_path):
    """A camera names its intrinsics and a twin its robot; an unchanged robot is the same object."""
    times = itertools.count(1)

    def change(text, name):
        path = write(tmp_path, text, name)
        os.utime(path, ns=(0, next(times)))
        return path

    change(FOUR_JOINTS, "arm.toml")
    twin = change(TWIN.replace("ur10e", "arm.toml").replace("elbow", "joint_3"), "twin.toml")
    intrinsics = "width: 640\nheight: 480\nk: [615, 0, 320, 0, 615, 240, 0, 0, 1]\n"
    change(intrinsics, "intrinsics.yaml")
    camera = change('intrinsics = "intrinsics.yaml"\n', "camera.toml")
    word = f"{twin} with {camera}"
    robot = find_robot(word)
    assert find_robot(word) is robot
    change(intrinsics.replace("615", "600"), "intrinsics.yaml")
    seen = find_robot(word)
    assert (robot.camera.matrix[0, 0], seen.camera.matrix[0, 0]) == (615.0, 600.0)
    change(FOUR_JOINTS.replace("joint_speed = [2.0", "joint_speed = [0.5"), "arm.toml")
    slower = find_robot(word)
    assert slower.limits.speed[0] == 0.5 < seen.limits.speed[0]
    assert find_robot(word) is slower


@pytest.mark.parametrize("mismatch", ["moderate", "tool=20mm"])
def test_a_twin_has_no_mismatch_of_its_robot(twin, mismatch):
    with pytest.raises(
        ConfigurationError, match="draws its robot from a posterior: leave the mismatch out"
    ):
        true_robot(twin, mismatch=mismatch)
    np.testing.assert_array_equal(
        true_robot(twin, mismatch="outliers=5%").camera, true_robot(twin).camera
    )


def test_another_sensing_than_that_of_the_log_is_refused(twin):
    with pytest.raises(ConfigurationError, match="was logged with the sensing position, got pixel"):
        true_robot(twin, sensing="pixel")


def test_noise_with_a_shape_of_another_size_is_refused():
    given = Settings({"kinematic": {"sensing": {"noise_shape": [[1.0, 0.0], [0.0, 1.0]]}}})
    run = resolve(request("ur5"), given)
    with pytest.raises(ValueError, match="sensing.noise_shape needs 3 rows of 3 numbers"):
        build(run).plant.reset(0)
