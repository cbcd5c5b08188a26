"""A user's camera: files of it and their faults, its projection against OpenCV, and its set-ups."""

import casadi
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kit import own
from servobench.harness.apps.twin.identification import fit_cameras
from servobench.plant.cameras.optics import Optics, in_image, locate, project, project_rates
from servobench.plant.cameras.registry import Sensing
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.cameras.symbolic import symbolic_feature
from servobench.plant.contract.lanes import stack
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import remark
from servobench.plant.robot.camera_file import read_camera, turning_point
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


@pytest.mark.parametrize(
    ("word", "pose"), [("pixel", ""), ("pixel", ABOVE), ("pixel:hand", ON_FLANGE), ("plate", "")]
)
def test_its_pixels_are_those_of_opencv(write, word, pose):
    robot = robot_with(write(CAMERA + pose))
    model = Sensing.parse(word).nominal(robot)
    assert model.valid(robot.workspace.home).all()
    X = model.camera
    postures = np.random.default_rng(1).uniform(
        robot.workspace.lower, robot.workspace.upper, (40, 6)
    )
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
        np.testing.assert_allclose(
            casadi.Function("J", [x], [casadi.jacobian(function(x), x)])(q), J, rtol=1e-9
        )
        for one, many in zip(model.observe(q), together, strict=True):
            np.testing.assert_array_equal(one, many[lane])


def test_a_pixel_is_found_again_and_beyond_the_fold_nothing_is_in_the_image(write):
    robot = robot_with(
        write(
            CAMERA.replace("k1 = 0.12, k2 = -0.25", "k1 = -0.34, k2 = 0.0").replace("0.08", "0.0")
        )
    )
    optics = Sensing.parse("pixel").nominal(robot).optics
    pixels = np.stack(np.meshgrid(np.linspace(0, 640, 9), np.linspace(0, 480, 7)), axis=-1).reshape(
        1, -1, 2
    )
    points = locate(pixels, np.ones((1, 63)), optics)
    np.testing.assert_allclose(project(points, optics), pixels, atol=1e-8)
    step = 1e-6 * np.random.default_rng(2).standard_normal((1, 63, 3, 1))
    rates = (project(points + step[..., 0], optics) - project(points - step[..., 0], optics)) / 2.0
    np.testing.assert_allclose(project_rates(points, step, optics)[..., 0], rates, atol=1e-9)
    folded = np.array([[[x, 0.0, 1.0] for x in np.linspace(1.2, 3.0, 50)]])
    assert (np.abs(project(folded, optics)[..., 0] - 320.0) < 320.0).any()
    assert not in_image(folded, optics).any()


WIDE = [[330.0, 0.0, 322.5], [0.0, 331.0, 238.0], [0.0, 0.0, 1.0]]
LENSES = [
    ("rational_polynomial", [1.2, 0.3, 0.0008, -0.0005, 0.01, 1.55, 0.65, 0.06]),
    (
        "Rational Polynomial",
        [0.5378, -2.6486, 0.000537, -0.000307, 1.5349, 0.4155, -2.4699, 1.4627],
    ),
    ("equidistant", [0.0034, 0.0007, -0.002, 0.0002]),
    ("Kannala_Brandt4", [-0.008, 0.045, -0.041, 0.008]),
    ("fisheye", [0.0, 0.0, 0.0, 0.0]),
]


def wide_camera(lens, coefficients) -> str:
    return f'width=640\nheight=480\nmatrix={WIDE}\ndistortion={coefficients}\ndistortion_model="{lens}"\n'


@pytest.mark.parametrize(("lens", "coefficients"), LENSES)
def test_wide_lenses_are_those_of_opencv_both_ways_over_the_whole_image(write, lens, coefficients):
    model = Sensing.parse("pixel").nominal(robot_with(write(wide_camera(lens, coefficients))))
    optics, q = model.optics, find_robot("ur10e").workspace.home
    pixels = np.stack(
        np.meshgrid(np.linspace(0, 640, 33), np.linspace(0, 480, 25)), axis=-1
    ).reshape(1, -1, 2)
    points = locate(pixels, np.full(pixels.shape[:2], 1.3), optics)
    of_opencv = cv2.projectPoints if len(coefficients) == 8 else cv2.fisheye.projectPoints
    wanted, _ = of_opencv(
        points[0][:, None], np.zeros(3), np.zeros(3), np.array(WIDE), np.array(coefficients)
    )
    np.testing.assert_allclose(project(points, optics)[0], wanted[:, 0], atol=1e-9)
    np.testing.assert_allclose(project(points, optics), pixels, atol=1e-9)
    points = np.append(points, [[[0.0, 0.0, 1.0], [1e-13, 0.0, 2.0]]], axis=1)
    step = 1e-6 * np.random.default_rng(2).standard_normal((*points.shape, 1))
    rates = (project(points + step[..., 0], optics) - project(points - step[..., 0], optics)) / 2.0
    np.testing.assert_allclose(project_rates(points, step, optics)[..., 0], rates, atol=1e-9)
    function, x = symbolic_feature(model), casadi.SX.sym("q", 6)
    y, J, _ = model.observe(q)
    np.testing.assert_allclose(np.asarray(function(q))[:, 0], y, rtol=1e-12)
    np.testing.assert_allclose(
        casadi.Function("J", [x], [casadi.jacobian(function(x), x)])(q), J, rtol=1e-9, atol=1e-9
    )


def test_the_place_of_a_fisheye_is_found_from_its_pixels(write):
    lens, coefficients = LENSES[2]
    model = Sensing.parse("pixel").nominal(
        robot_with(write(wide_camera(lens, coefficients) + ABOVE))
    )
    work = find_robot("ur10e").workspace
    q = np.random.default_rng(0).uniform(work.lower, work.upper, (60, 6))
    poses, errors = fit_cameras(model, q[None], model.feature(q))
    assert errors[0] < 1e-3
    np.testing.assert_allclose(poses[0], model.camera, atol=1e-5)


@pytest.mark.parametrize(
    ("coefficients", "last"),
    [((0.0, -0.1, 0.0, 0.0), np.tan(np.sqrt(np.sqrt(2.0)))), ((0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0), 2.0),
     ((0.0, 0.0, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0), 2.0)],
)  # fmt: skip
def test_a_wide_lens_shows_nothing_behind_its_fold_or_pole(coefficients, last):
    # θ (1 − 0.1 θ⁴) turns back at θ⁴ = 2, r / (1 − r²/4) has a pole at r = 2 and r / (1 + r²/4) turns back there.
    point = turning_point(coefficients)
    assert np.sqrt(point) == pytest.approx(last, rel=1e-9)
    k1, *others = coefficients
    further = [1.0, *others[:4], point, *others[4:]]
    if len(coefficients) == 4:
        further = [1.0, others[0], 0.0, 0.0, others[1], point, others[2]]
    size = (1e9, 1e9)
    optics = Optics(np.ones(1), np.full((1, 2), 5e8), np.array([k1]), size, np.array([further]))
    points = np.array([[[0.999 * last, 0.0, 1.0], [1.001 * last, 0.0, 1.0], [1e5, 0.0, 1.0]]])
    np.testing.assert_array_equal(in_image(points, optics), [[True, False, False]])


def test_mismatch_is_drawn_on_top_of_the_file(write):
    robot = robot_with(write(CAMERA + ABOVE))
    model = true_model(
        robot, "pixel", mismatch=Mismatch.parse("camera_rotation=20deg+focal=10%+centre=8px")
    )
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


ROWS = (
    "rows: 3\n  cols: 3\n  dt: d\n  data: [615.0, 0.0, 322.5, 0.0, 617.0, 238.0, 0.0, 0.0, 1.0]\n"
)
NUMBERS = "fx: 615.0\n  fy: 617.0\n  cx: 322.5\n  cy: 238.0\n"
FISHEYE = (0.0034, 0.0007, -0.002, 0.0002)
TOOLS = {
    "opencv5": f"""%YAML 1.2\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n  {ROWS}
distortion_coefficients: !!opencv-nd-matrix\n  sizes: [ 5 ]\n  dt: d\n  data: {list(D)}\n""",
    "autoware": f"%YAML:1.0\n---\nCameraMat: !!opencv-matrix\n  {ROWS}ImageSize: [ 640, 480 ]\n"
    f"DistCoeff: !!opencv-matrix\n  {{rows: 1, cols: 5, dt: d, data: {list(D)}}}\nDistModel: Plumb-Bob\n",
    "kalibr": "cam0:\n  camera_model: pinhole\n  intrinsics: [615.0, 617.0, 322.5, 238.0]\n  resolution: [640, 480]\n"
    f"  distortion_coeffs: {list(FISHEYE)}\n  distortion_model: equidistant\n",
    "vins": "%YAML:1.0\nmodel_type: PINHOLE\nimage_width: 640\nimage_height: 480\ndistortion_parameters:\n"
    f"  k1: 0.12\n  k2: -0.25\n  p1: 0.002\n  p2: -0.001\n  k3: 0.08\nprojection_parameters:\n  {NUMBERS}",
    "vins_fisheye": "model_type: KANNALA_BRANDT\nimage_width: 640\nimage_height: 480\nprojection_parameters:\n"
    "  {k2: 0.0034, k3: 0.0007, k4: -0.002, k5: 0.0002, mu: 615.0, mv: 617.0, u0: 322.5, v0: 238.0}\n",
    "orb": "Camera.type: PinHole\nCamera.width: 640\nCamera.height: 480\nCamera.k1: 0.12\nCamera.k2: -0.25\n"
    "Camera.p1: 0.002\nCamera.p2: -0.001\nCamera.k3: 0.08\n" + "".join(
        f"Camera.{each.strip()}\n" for each in NUMBERS.splitlines()),
    "orb3_fisheye": "Camera.type: KannalaBrandt8\nCamera.width: 640\nCamera.height: 480\nCamera1.k1: 0.0034\n"
    "Camera1.k2: 0.0007\nCamera1.k3: -0.002\nCamera1.k4: 0.0002\n" + "".join(
        f"Camera1.{each.strip()}\n" for each in NUMBERS.splitlines()),
}  # fmt: skip


@pytest.mark.parametrize("tool", TOOLS)
def test_files_of_calibration_tools_give_the_same_camera(write, tool):
    camera = read_camera(write(TOOLS[tool], "tool.yaml"))
    np.testing.assert_array_equal(camera.matrix, K)
    assert (camera.keys.width, camera.keys.height) == (640, 480)
    fisheye = tool in ("kalibr", "vins_fisheye", "orb3_fisheye")
    assert (camera.lens, camera.distortion) == (
        ("equidistant", FISHEYE) if fisheye else ("plumb_bob", D)
    )


BENT = "[0.12, -0.25, 0.002, -0.001, 0.08]"
NO = "[0, 0, 0, 0, 0]"


@pytest.mark.parametrize(
    ("model", "data"),
    [("''", "[]"), ("~", NO), ("none", "[0.0]"), ("None", "~"), ("pinhole", "[]"), ("Inverse Brown Conrady", NO),
     ("modified_brown_conrady", NO), ("rational_polynomial", NO), ("plumb_bob", "[]"), ("radtan", "[[0], [0]]")],
)  # fmt: skip
def test_no_distortion_under_any_name_is_none(write, model, data):
    text = ROS.replace("plumb_bob", model).replace(BENT, data)
    assert read_camera(write(text, "ros.yaml")).distortion == (0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "model", ["radtan", "Plumb Bob", "plumb-bob", "PLUMB_BOB", "Brown Conrady", "opencv"]
)
def test_other_names_of_the_usual_model_are_known(write, model):
    camera = read_camera(write(ROS.replace("plumb_bob", model), "ros.yaml"))
    assert (camera.lens, camera.distortion) == ("plumb_bob", D)


@pytest.mark.parametrize(
    ("model", "data", "said"),
    [
        (
            "Inverse Brown Conrady",
            BENT,
            "'Inverse Brown Conrady' must have no coefficients but 0, got",
        ),
        ("''", BENT, "distortion_model 'none' must have no coefficients but 0"),
        (
            "fov",
            "[0.9]",
            "distortion_model 'fov' is not known; wanted plumb_bob with k1, k2, p1, p2, k3, or rational",
        ),
        ("equidistant", "[0.1, 0.2]", "distortion must be of equidistant with k1, k2, k3, k4, got"),
        ("equidistant", "[]", "distortion must be of equidistant with k1, k2, k3, k4, got"),
        ("equidistant", BENT, "distortion must be of equidistant with k1, k2, k3, k4, got"),
        (
            "plumb_bob",
            "[0.1, -0.2, 0, 0, 0, 0.1, 0, 0]",
            "distortion must be of plumb_bob with k1, k2, p1, p2, k3, got",
        ),
        (
            "rational_polynomial",
            "[0.1, 0, 0, 0, 0, 0.1]",
            "distortion must be of rational_polynomial with k1",
        ),
        (
            "rational_polynomial",
            "[0.1, 0, 0, 0, 0, 0.1, 0, 0, 0.01, 0, 0, 0]",
            "distortion must be of rational_polynom",
        ),
        ("plumb_bob", "{k1: 0.1, k4: 0.2}", "distortion has no coefficient 'k4' in plumb_bob"),
    ],
)
def test_coefficients_that_are_not_those_of_their_model_are_refused(write, model, data, said):
    text = ROS.replace("plumb_bob", model).replace("{rows: 1, cols: 5, data: " + BENT + "}", data)
    with pytest.raises(ValueError, match=said):
        read_camera(write(text, "ros.yaml"))


@pytest.mark.parametrize("name", ["distortion", "coeffs", "kc", "radial", "K1", "RadialDistortion"])
def test_a_distortion_under_a_name_that_is_not_known_is_no_ideal_camera(write, name):
    for text in (name, f"lens: {{{name}: 0.1}}\nunknown"):
        with pytest.raises(
            ValueError, match=f"ros.yaml has '{name}'; wanted the name distortion_coefficients"
        ):
            read_camera(write(ROS.replace("distortion_coefficients", text), "ros.yaml"))


def test_a_projection_that_is_not_known_is_named(write):
    with pytest.raises(ValueError, match="distortion_model 'omni' is not known"):
        read_camera(write(TOOLS["kalibr"].replace("pinhole", "omni"), "tool.yaml"))
    with pytest.raises(
        ValueError, match="tool.yaml is of the projection 'ds', which is not known or lacks its"
    ):
        read_camera(
            write(
                TOOLS["kalibr"]
                .replace("pinhole", "ds")
                .replace("intrinsics: [", "intrinsics: [-0.2, "),
                "tool.yaml",
            )
        )


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ("['0.1', 0, 0, 0, 0]", "a matrix must hold finite numbers, got '0.1'"),
        ("[.nan, 0, 0, 0, 0]", "a matrix must hold finite numbers, got nan"),
        (
            "[0, 0, 0, 0, 0]\nD: [0.1, 0, 0, 0, 0]",
            "ros.yaml has distortion_coefficients and another D; leave one out",
        ),
    ],
)
def test_numbers_that_are_none_or_contradict_each_other_are_refused(write, data, said):
    with pytest.raises(ValueError, match=said):
        read_camera(write(ROS.replace("{rows: 1, cols: 5, data: " + BENT + "}", data), "ros.yaml"))


def test_zeros_by_other_names_and_numbers_that_begin_with_a_point_are_read(write):
    text = ROS.replace(
        "{rows: 1, cols: 5, data: " + BENT + "}",
        "{k1: .12, k2: -.25, k4: 0, p1: .002, p2: -.001, k3: .08}",
    )
    assert read_camera(write(text, "ros.yaml")).distortion == D


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("width = 640", "width = 12", "width must be given in px, from 16"),
        ("width = 640", "", "width must be given in px, from 16 to 20000, got 0"),
        (
            "615.0",
            "0.0036",
            "a focal length of 0.0036 px does not fit a width of 640 px; in px it is the focal length",
        ),
        ("615.0", "3.6", "a focal length of 3.6 px does not fit"),
        ("322.5", "1200.0", r"the principal point \[1200.0, 238.0\] px must be in the image"),
        ("matrix = ", "matrices = ", "has no setting 'matrices': did you mean 'matrix'"),
        (
            "0.12",
            "-3.0",
            "folds an image of 640 × 480 px before its corners, with this matrix; take them from one calibration",
        ),
        (
            "k3",
            "k4",
            "distortion has no coefficient 'k4' in plumb_bob; wanted distortion_model plumb_bob with k1, k2",
        ),
        (
            "height",
            'distortion_model = "omni"\nheight',
            "distortion_model 'omni' is not known; wanted plumb_bob with k1",
        ),
        (
            "height",
            'distortion_model = "equidistant"\nheight',
            "distortion has no coefficient 'p1' in equidistant",
        ),
        (
            "[pose]",
            "vertical_fov = 60.0\n[pose]",
            "either matrix .px. or vertical_fov .deg. must be given, got both",
        ),
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
        (
            "k1 = 0.12, k2 = -0.25",
            "k1 = 12.0, k2 = -25.0",
            "moves points by 144% of their distance from the middle",
        ),
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
        (
            ON_FLANGE,
            ABOVE.replace("1.9]", "15.5]"),
            "pose.position is 15.5, and usually at most 5 m",
        ),
    ]
    own.assert_remarks(caplog, lambda text: read_camera(write(text)), CAMERA + ON_FLANGE, cases)


def test_a_ball_that_hardly_fits_into_the_image_is_remarked_on(write, caplog):
    for radius in ("", "[target]\nradius = 0.08\n", "[target]\nradius = 0.4\n"):
        remark.cache_clear()
        Sensing.parse("pixel:hand").nominal(robot_with(write(CAMERA + ON_FLANGE + radius)))
        assert ("px of an image 480 px high; is it its radius?" in caplog.text) == ("0.4" in radius)


def test_a_camera_that_does_not_fit_the_set_up_is_refused_with_the_remedy(write):
    away = robot_with(write(CAMERA + ABOVE.replace("1.9]", "-1.9]"), "away.toml"))
    with pytest.raises(
        ValueError, match="camera away.toml does not see the target with the arm at home"
    ):
        Sensing.parse("pixel").nominal(away)
    target = robot_with(
        write(
            CAMERA + ON_FLANGE + '[target]\nframe = "flange"\nposition = [0.0, 0.0, 0.1]', "t.toml"
        )
    )
    with pytest.raises(
        ValueError, match="the target must be on the base where the camera is on the flange"
    ):
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
    assert (sensing.frame_period, sensing.latency, sensing.feature_noise) == (
        1.0 / 15.0,
        0.08,
        0.002,
    )
    assert camera.sensing(SensingConfig(), 1.0 / 30.0).frame_period == pytest.approx(
        1.0 / 15.0, abs=1e-12
    )


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


def test_a_drawn_distortion_shows_nothing_behind_its_fold():
    optics = Optics(
        np.array([600.0]), np.array([[320.0, 240.0]]), np.array([-0.05]), (640.0, 480.0)
    )
    angle = np.radians([20.0, 77.4])  # r (1 - 0.05 r²) turns back at 68.8°
    points = np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=-1)[None]
    assert (np.abs(project(points, optics)[0] - (320.0, 240.0)) < 240.0).all()
    np.testing.assert_array_equal(in_image(points, optics), [[True, False]])


def test_a_rate_that_is_no_whole_number_of_milliseconds_is_not_that_of_the_control(write):
    camera = read_camera(write(f"rate = 120\n{CAMERA}"))
    assert camera.sensing(SensingConfig(), 0.008).frame_period == pytest.approx(
        1.0 / 120.0, abs=1e-12
    )
