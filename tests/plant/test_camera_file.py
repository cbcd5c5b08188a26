"""A user's camera: files of it and their faults, its projection against OpenCV, and its set-ups."""

import casadi
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kit import own
from servobench.plant.cameras.optics import in_image, locate, project, project_rates
from servobench.plant.cameras.registry import Sensing
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.cameras.symbolic import symbolic_feature
from servobench.plant.contract.lanes import stack
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import remark
from servobench.plant.robot.camera_file import read_camera
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch

K = np.array([[615.0, 0.0, 322.5], [0.0, 617.0, 238.0], [0.0, 0.0, 1.0]])
D = (0.12, -0.25, 0.002, -0.001, 0.08)
CAMERA = """
width = 640
height = 480
matrix = [[615.0, 0.0, 322.5], [0.0, 617.0, 238.0], [0.0, 0.0, 1.0]]
distortion = {k1 = 0.12, k2 = -0.25, p1 = 0.002, p2 = -0.001, k3 = 0.08}
"""
QUARTER = "[0.0, 0.0, 0.70710678, 0.70710678]"
ON_FLANGE = f"""
[pose]
frame = "flange"
position = [0.02, -0.07, 0.05]
rotation = {QUARTER}
"""
ABOVE = """
[pose]
frame = "base"
position = [0.9, 0.1, 1.9]
rotation = [[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
"""
MODERATE = Mismatch.parse("moderate")


@pytest.fixture
def write(tmp_path):
    return lambda text, name="mine.toml": own.write(tmp_path, text, name)


def robot_with(path, name="ur10e"):
    return find_robot(f"{name} with {path}")


def true_model(robot, word, seed=0, mismatch=MODERATE) -> SetupModel:
    arm, sample = sample_mismatch(mismatch, robot, seed)
    model, _ = Sensing.parse(word).true(robot, arm, sample, mismatch, seed)
    assert isinstance(model, SetupModel)
    return model


@pytest.mark.parametrize(("word", "pose"), [("pixel", ""), ("pixel", ABOVE), ("pixel:hand", ON_FLANGE), ("plate", "")])
def test_its_pixels_are_those_of_opencv(write, word, pose):
    robot = robot_with(write(CAMERA + pose))
    model = Sensing.parse(word).nominal(robot)
    assert model.valid(robot.workspace.home).all()
    X = model.camera
    postures = np.random.default_rng(1).uniform(robot.workspace.lower, robot.workspace.upper, (40, 6))
    seen = [posture for posture in postures if model.valid(posture).all()]
    assert len(seen) >= 5
    for posture in seen:
        points, R = model.points(posture), X[:3, :3].T
        wanted, _ = cv2.projectPoints(points, cv2.Rodrigues(R)[0], -R @ X[:3, 3], K, np.array(D))
        np.testing.assert_allclose(model.feature(posture), wanted.reshape(-1), rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("word", ["pixel:hand", "plate:hand"])
def test_its_jacobian_is_that_of_casadi_and_its_lanes_have_the_bits_of_single_runs(write, word):
    robot = robot_with(write(CAMERA + ON_FLANGE))
    models, q = [true_model(robot, word, seed) for seed in range(3)], robot.workspace.home + 0.05
    together = stack(models).observe(np.stack([q] * 3))
    for lane, model in enumerate(models):
        function, x = symbolic_feature(model), casadi.SX.sym("q", 6)
        y, J, _ = model.observe(q)
        np.testing.assert_allclose(np.asarray(function(q))[:, 0], y, rtol=1e-12)
        np.testing.assert_allclose(casadi.Function("J", [x], [casadi.jacobian(function(x), x)])(q), J, rtol=1e-9)
        for one, many in zip(model.observe(q), together, strict=True):
            np.testing.assert_array_equal(one, many[lane])


def test_a_pixel_is_found_again_and_beyond_the_fold_nothing_is_in_the_image(write):
    robot = robot_with(write(CAMERA.replace("k1 = 0.12, k2 = -0.25", "k1 = -0.34, k2 = 0.0").replace("0.08", "0.0")))
    optics = Sensing.parse("pixel").nominal(robot).optics
    pixels = np.stack(np.meshgrid(np.linspace(0, 640, 9), np.linspace(0, 480, 7)), axis=-1).reshape(1, -1, 2)
    points = locate(pixels, np.ones((1, 63)), optics)
    np.testing.assert_allclose(project(points, optics), pixels, atol=1e-8)
    step = 1e-6 * np.random.default_rng(2).standard_normal((1, 63, 3, 1))
    rates = (project(points + step[..., 0], optics) - project(points - step[..., 0], optics)) / 2.0
    np.testing.assert_allclose(project_rates(points, step, optics)[..., 0], rates, atol=1e-9)
    folded = np.array([[[x, 0.0, 1.0] for x in np.linspace(1.2, 3.0, 50)]])
    assert (np.abs(project(folded, optics)[..., 0] - 320.0) < 320.0).any()
    assert not in_image(folded, optics).any()


def test_mismatch_is_drawn_on_top_of_the_file(write):
    robot = robot_with(write(CAMERA + ABOVE))
    model = true_model(robot, "pixel", mismatch=Mismatch.parse("camera_rotation=20deg+focal=10%+centre=8px"))
    nominal = Sensing.parse("pixel").nominal(robot)
    turn = Rotation.from_matrix(nominal.camera[:3, :3].T @ model.camera[:3, :3]).magnitude()
    assert np.degrees(turn) == pytest.approx(20.0)
    assert 0.0 < abs(model.optics.focal[0] / 615.0 - 1.0) <= 0.1
    assert 0.0 < np.abs(model.optics.centre[0] - K[:2, 2]).max() <= 8.0
    np.testing.assert_allclose(nominal.camera[:3, 3], [0.9, 0.1, 1.9])
    np.testing.assert_allclose(nominal.optics.focal_lengths, [[615.0, 617.0]])


ROS = """
image_width: 640
image_height: 480
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [615.0, 0.0, 322.5, 0.0, 617.0, 238.0, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.12, -0.25, 0.002, -0.001, 0.08]}
"""


def test_files_of_ros_and_opencv_give_the_same_camera(write, tmp_path):
    storage = cv2.FileStorage(str(tmp_path / "opencv.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array([D]))
    storage.release()
    topic = "height: 480\nwidth: 640\ndistortion_model: plumb_bob\nd: [12e-2, -0.25, 0.002, -0.001, 0.08]\n"
    topic += "k: [6.15e2, 0.0, 322.5, 0.0, 617.0, 238.0, 0.0, 0.0, 1.0]\n---\n"
    named = write(f'intrinsics = "ros.yaml"\nrate = 30\n{ON_FLANGE}', "named.toml")
    flat = write(CAMERA.replace("[[", "[").replace("]]", "]").replace("], [", ", "), "flat.toml")
    for path in (
        write(CAMERA),
        flat,
        write(ROS, "ros.yaml"),
        tmp_path / "opencv.yml",
        write(topic, "topic.yaml"),
        named,
    ):
        text = path.read_text()
        camera = read_camera(named if text == ROS else path)
        np.testing.assert_array_equal(camera.matrix, K)
        assert camera.distortion == D, text
    assert read_camera(named).files == (named, tmp_path / "ros.yaml")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("width = 640", "width = 12", "width must be given in px, from 16"),
        ("width = 640", "", "width must be given in px, from 16 to 20000, got 0"),
        ("615.0", "0.0036", "a focal length of 0.0036 px does not fit a width of 640 px; in px it is the focal length"),
        ("615.0", "3.6", "a focal length of 3.6 px does not fit"),
        ("322.5", "1200.0", r"the principal point \[1200.0, 238.0\] px must be in the image"),
        ("matrix = ", "matrices = ", "has no setting 'matrices': did you mean 'matrix'"),
        (
            "0.12",
            "-3.0",
            "folds an image of 640 × 480 px before its corners, with this matrix; take them from one calibration",
        ),
        ("k3", "k4", "distortion has no coefficient 'k4'; wanted plumb_bob with k1, k2, p1, p2, k3"),
        ("height", 'distortion_model = "fisheye"\nheight', "distortion_model 'fisheye' is not known; wanted plumb_bob"),
        ("[pose]", "vertical_fov = 60.0\n[pose]", "either matrix .px. or vertical_fov .deg. must be given, got both"),
        ("[pose]", "rate = 0.05\n[pose]", "rate must be given in Hz, from 0.5 to 1000, got 0.05"),
        ("[pose]", "latency = 80\n[pose]", "latency must be given in s, from 0 to 5, got 80"),
        ('frame = "flange"', "", 'a place needs frame, "base" or "flange", and position'),
        ("-0.07", "-70.0", "position must be in m, at most 1 m on the flange"),
        (QUARTER, "[[1, 0, 0], [0, 2, 0], [0, 0, 1]]", "pose.rotation must be a rotation"),
        (QUARTER, "[[1, 0, 0], [0, -1, 0], [0, 0, 1]]", "pose.rotation must be a rotation"),
        (QUARTER, "[0.0, 0.0, 1.57]", "pose.rotation must be a rotation matrix or a quat"),
        ("[pose]", "noise = 0.5\n[pose]", 'noise needs its unit, such as "0.5px"'),
        ("[pose]", 'second = "none.toml"\n[pose]', "none.toml cannot be read: No such file"),
    ],
)
def test_a_bad_file_is_one_line(write, old, new, said):
    text = CAMERA + ON_FLANGE
    assert old in text
    path = write(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=said) as caught:
        robot_with(path)
    assert str(caught.value).startswith(f"camera file {path}")
    assert "\n" not in str(caught.value)


def test_an_unlikely_file_is_remarked_on(write, caplog):
    cases = [
        (
            "322.5], [0.0, 617.0, 238.0]",
            "240.0], [0.0, 617.0, 320.0]",
            "are cx and cy, or width and height, exchanged?",
        ),
        ("k1 = 0.12, k2 = -0.25", "k1 = 12.0, k2 = -25.0", "moves points by 144% of their distance from the middle"),
        (
            "p1 = 0.002",
            "p1 = 0.9",
            "of their distance from the middle; coefficients of OpenCV are no percent, and k1, k2, p1",
        ),
        (QUARTER, "[1.0, 0.0, 0.0, 0.0]", "by more than 60° from the flange's z axis: z is"),
        (QUARTER, "[0.5, -0.5, 0.5, -0.5]", "a quaternion is x, y, z, w"),
        (
            "[pose]",
            "target.radius = 40\n[pose]",
            "target.radius is 40, and usually at most 0.5 m; if 40cm or 40mm is meant",
        ),
        (ON_FLANGE, ABOVE.replace("1.9]", "15.5]"), "pose.position is 15.5, and usually at most 5 m"),
    ]
    own.assert_remarks(caplog, lambda text: read_camera(write(text)), CAMERA + ON_FLANGE, cases)


def test_a_ball_that_hardly_fits_into_the_image_is_remarked_on(write, caplog):
    for radius in ("", "[target]\nradius = 0.08\n", "[target]\nradius = 0.4\n"):
        remark.cache_clear()
        Sensing.parse("pixel:hand").nominal(robot_with(write(CAMERA + ON_FLANGE + radius)))
        assert ("px of an image 480 px high; is it its radius?" in caplog.text) == ("0.4" in radius)


def test_a_camera_that_does_not_fit_the_set_up_is_refused_with_the_remedy(write):
    away = robot_with(write(CAMERA + ABOVE.replace("1.9]", "-1.9]"), "away.toml"))
    with pytest.raises(ValueError, match="camera away.toml does not see the target with the arm at home"):
        Sensing.parse("pixel").nominal(away)
    target = robot_with(write(CAMERA + ON_FLANGE + '[target]\nframe = "flange"\nposition = [0.0, 0.0, 0.1]', "t.toml"))
    with pytest.raises(ValueError, match="the target must be on the base where the camera is on the flange"):
        Sensing.parse("pixel:hand").nominal(target)


def test_two_files_are_a_stereo_pair(write):
    write(CAMERA + ABOVE.replace("0.1, 1.9", "-0.3, 1.9").replace("615.0", "620.0"), "right.toml")
    robot = robot_with(write('second = "right.toml"' + CAMERA + ABOVE))
    model = Sensing.parse("stereo").nominal(robot)
    np.testing.assert_array_equal(model.optics.focal, [615.0, 615.0])
    np.testing.assert_array_equal(model.cameras[:, 1, 3], [0.1, -0.3])


def test_the_target_is_where_and_as_large_as_the_file_says(write):
    target = '[target]\nframe = "base"\nposition = {}\nside = 0.1\nradius = 0.02\n'
    home = find_robot("ur10e").arm.frames(find_robot("ur10e").workspace.home)[-1]
    wanted = home[:3, :3] @ [0.02, -0.07, 0.75] + home[:3, 3]
    robot = robot_with(write(CAMERA + ON_FLANGE + target.format(wanted.tolist())))
    model = Sensing.parse("plate:hand").nominal(robot)
    np.testing.assert_allclose(model.target.mean(axis=0), wanted)
    np.testing.assert_allclose(np.linalg.norm(model.target[1] - model.target[0]), 0.1)
    assert model.distance == pytest.approx(0.7)
    assert robot.workspace.ball_radius == 0.02


def test_a_frame_takes_a_multiple_of_the_period_or_its_own_time(write):
    camera = read_camera(write(f'rate = 15\nlatency = 0.08\nnoise = "2mm"{CAMERA}'))
    sensing = camera.sensing(SensingConfig(), 0.05)
    assert (sensing.frame_period, sensing.latency, sensing.feature_noise) == (1.0 / 15.0, 0.08, 0.002)
    assert camera.sensing(SensingConfig(), 1.0 / 30.0).frame_period == pytest.approx(1.0 / 15.0, abs=1e-12)


@pytest.mark.parametrize(
    ("rate", "period", "frame"),
    [(20, 0.05, 0.05), (60, 0.05, 0.0), (15, 0.067, 0.067), (5, 0.05, 0.2), (30, 0.03333, 0.03333)],
)
def test_the_camera_and_the_controller_keep_time(write, caplog, rate, period, frame):
    remark.cache_clear()
    camera = read_camera(write(f"rate = {rate}\n{CAMERA}"))
    assert camera.sensing(SensingConfig(), period).frame_period == pytest.approx(frame, abs=1e-12)
    assert not caplog.text
    camera.sensing(SensingConfig(), 0.047)
    assert f"so delays change; run.period={rate}Hz helps" in caplog.text
