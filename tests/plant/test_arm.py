from dataclasses import replace

import casadi
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from kit.plants import factory_ur5, nominal_ur5
from servobench.fmus.export import arm_layout
from servobench.fmus.sources import core_functions
from servobench.fmus.variables import parameters_of
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.cameras.symbolic import symbolic_feature
from servobench.plant.contract.lanes import stack
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.arm import SerialArm, arm_from_dh, rotation_from_rpy, rpy_from_rotation
from servobench.plant.robot.hand_eye import HandEyeModel, rotation_matrix
from servobench.plant.robot.makers import CALIBRATION_BLOCKS, read_calibration
from servobench.plant.robot.ur5 import DH_A, DH_ALPHA, DH_D, TOOL, ur5_arm


def poses(count, n=6, seed=0):
    return np.random.default_rng(seed).uniform(-2 * np.pi, 2 * np.pi, (count, n))


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 1e-3, 0.3, 7.0])
def test_the_matrix_of_a_rotation_vector_has_the_bits_of_scipy_in_lanes_and_alone(size):
    vectors = size * np.random.default_rng(0).normal(size=(500, 3))
    wanted = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_array_equal(rotation_matrix(vectors), wanted)
    np.testing.assert_array_equal([rotation_matrix(vector) for vector in vectors[:50]], wanted[:50])


def elementary(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    i, j = {"x": (1, 2), "z": (0, 1)}[axis]
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def shift(axis, length):
    matrix = np.eye(4)
    matrix["xyz".index(axis), 3] = length
    return matrix


def test_dh_arm_equals_the_explicit_product_of_elementary_matrices():
    for q in poses(50):
        expected = np.eye(4)
        for angle, a, d, alpha in zip(q, DH_A, DH_D, DH_ALPHA, strict=True):
            expected = (
                expected
                @ elementary("z", angle)
                @ shift("z", d)
                @ shift("x", a)
                @ elementary("x", alpha)
            )
        np.testing.assert_allclose(ur5_arm().frames(q)[-1], expected, atol=1e-14)
        np.testing.assert_allclose(
            ur5_arm().ball_position(q), (expected @ [*TOOL, 1.0])[:3], atol=1e-14
        )


def random_model(seed, n=6):
    rng = np.random.default_rng(seed)
    arm = SerialArm(
        tuple(f"joint_{i}" for i in range(n)),
        rng.uniform(-0.5, 0.5, (n + 1, 3)),
        rng.uniform(-np.pi, np.pi, (n + 1, 3)),
        rng.uniform(-0.3, 0.3, n),
        rng.uniform(0.8, 1.2, n),
        rng.uniform(-0.2, 0.2, 3),
    )
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = rng.uniform(-1.0, 1.0, 3)
    return HandEyeModel(arm, pose)


@pytest.mark.parametrize(
    "model",
    [nominal_ur5(), *(random_model(seed, n) for seed, n in enumerate((6, 6, 6, 2, 3, 7, 8)))],
)
def test_the_symbolic_feature_and_its_jacobians_equal_the_numpy_ones(model):
    n, layout = model.arm.n, arm_layout(model.arm.n)
    q, values = (
        casadi.SX.sym("q", n),
        parameters_of(PlantSetup(model, np.zeros(n), 0.05), KinematicConfig()),
    )
    p = casadi.DM(np.concatenate([np.ravel(values[group.name]) for group in layout.kinematic]))
    exported_feature, exported_jacobian, *_ = core_functions(layout)
    feature = symbolic_feature(model)(q)
    states, play = casadi.vertcat(q, casadi.DM.zeros(n + 6)), casadi.DM.zeros(n)
    exported = exported_feature(states, p, play)[:3], exported_jacobian(states, p, play)
    outputs = [feature, casadi.jacobian(feature, q), *exported]
    function = casadi.Function("all", [q], outputs)
    for pose in np.random.default_rng(1).uniform(-2 * np.pi, 2 * np.pi, (50, n)):
        y, J, exported_y, exported_J = (np.asarray(value) for value in function(pose))
        np.testing.assert_allclose(
            [y, exported_y], [model.feature(pose)[:, None]] * 2, rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(
            [J, exported_J.reshape(3, n)], [model.jacobian(pose)] * 2, rtol=0, atol=1e-12
        )


def test_rotations_are_rotations_in_the_urdf_order():
    rpy = np.random.default_rng(0).uniform(-np.pi, np.pi, (10, 3))
    for (roll, pitch, yaw), R in zip(rpy, rotation_from_rpy(rpy), strict=True):
        about_y = np.array(
            [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
        )
        expected = elementary("z", yaw)[:3, :3] @ about_y @ elementary("x", roll)[:3, :3]
        np.testing.assert_allclose(R, expected, atol=1e-15)


@pytest.mark.parametrize("pitch", [None, np.pi / 2, -np.pi / 2])
def test_roll_pitch_and_yaw_are_found_again_also_where_the_pitch_is_upright(pitch):
    rpy = np.random.default_rng(1).uniform(-np.pi, np.pi, (20, 3)) * [1.0, 0.5, 1.0]
    if pitch is not None:
        rpy[:, 1] = pitch
    R = rotation_from_rpy(rpy)
    found = rpy_from_rotation(R)
    np.testing.assert_allclose(rotation_from_rpy(found), R, atol=1e-12)
    if pitch is None:
        np.testing.assert_allclose(found, rpy, atol=1e-12)


def test_what_a_model_hands_out_cannot_be_changed():
    pose = np.eye(4)
    model = HandEyeModel(ur5_arm(), pose)
    pose[0, 3] = 1.0
    assert model.X_BC[0, 3] == 0.0
    assert not any(array.flags.writeable for array in (model.X_BC, *model.observe(np.zeros(6))[:2]))


def test_factory_calibration_is_millimetres_from_the_data_sheet():
    q = poses(200)
    distance = np.linalg.norm(factory_ur5().ball_position(q) - ur5_arm().ball_position(q), axis=-1)
    assert np.median(distance) > 1e-4
    assert distance.max() < 0.01


def calibration(**changes):
    """The text of a calibration file in which some blocks have other entries."""
    blocks = {
        name: dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 0.1)
        for name in CALIBRATION_BLOCKS
    }
    blocks |= {name: entries and blocks[name] | entries for name, entries in changes.items()}
    return yaml.safe_dump({"kinematics": blocks}).encode()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            calibration().replace(b"wrist_2", b"wrist_7"),
            "lacks 'wrist_2'; wanted 'kinematics' with the blocks",
        ),
        (calibration().replace(b"yaw", b"jaw"), "lacks 'yaw'"),
        (calibration(shoulder={"x": "long"}), "holds something that is not a number"),
        (calibration(shoulder=None), "holds something that is not a number"),
        (calibration(wrist_1={"z": float("nan")}), "holds a number that is not finite"),
        (None, "cannot be read: No such file"),
        (b"{ not: [yaml", "is not valid YAML"),
        (calibration() + b"kinematics: 1\n", "is not valid YAML: kinematics is there twice"),
        (b"", "holds something that is not a number"),
        (b"other: 1\n", "lacks 'kinematics'"),
        (b"\xff\xfe\xfa\x00", "is no text in UTF-8; save it in this encoding"),
    ],
)
def test_a_malformed_calibration_is_one_clear_error(tmp_path, content, message):
    path = tmp_path / "calibration.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(
        ValueError, match=f"calibration.yaml .*{message}|{message} .*calibration.yaml"
    ) as caught:
        read_calibration(path, TOOL)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: arm_from_dh([1.0], [0.0, 0.0], [0.0, 0.0], ("i", "j")),
            r"a must have shape \(2,\), got \(1,\)",
        ),
        (
            lambda: replace(arm_from_dh([1.0], [0.0], [0.0], ("i",)), tool=np.zeros(1)),
            r"tool must have shape \(3,\)",
        ),
        (
            lambda: ur5_arm().ball_position(np.zeros(5)),
            r"joint_position must have shape \(..., 6\), got \(5,\)",
        ),
        (
            lambda: SerialArm(
                ("i",), np.zeros((1, 3)), np.zeros((2, 3)), np.zeros(1), np.ones(1), np.zeros(3)
            ),
            r"translation must have shape \(2, 3\), got \(1, 3\)",
        ),
        (
            lambda: SerialArm(
                ("i",),
                np.zeros((2, 3)),
                np.full((2, 3), np.nan),
                np.zeros(1),
                np.ones(1),
                np.zeros(3),
            ),
            "rpy must be finite",
        ),
        (
            lambda: HandEyeModel(ur5_arm(), np.eye(3)),
            r"X_BC must have shape \(4, 4\), got \(3, 3\)",
        ),
        (
            lambda: HandEyeModel(ur5_arm(), np.diag([1.0, 1.0, -1.0, 1.0])),
            "X_BC must hold a rotation matrix",
        ),
        (
            lambda: HandEyeModel(ur5_arm(), np.diag([1.0, 1.0, 1.1, 1.0])),
            "X_BC must hold a rotation matrix",
        ),
        (
            lambda: HandEyeModel(stack([ur5_arm()] * 2), np.stack([np.eye(4), -np.eye(4)])),
            "must hold a rotation matrix",
        ),
    ],
)
def test_a_wrong_argument_is_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize("rows", [3, 4])
def test_the_modified_convention_turns_about_the_axis_behind_a_link(rows):
    """A product of Craig's transforms, Rx(α) Tx(a) Rz(θ) Tz(d); a fourth row leads to the flange."""
    rng = np.random.default_rng(5)
    a, d, alpha = rng.uniform(-1.0, 1.0, (3, rows))
    arm, angles = (
        arm_from_dh(a, d, alpha, ("a", "b", "c"), modified=True),
        rng.uniform(-3.0, 3.0, 3),
    )
    pose = np.eye(4)
    for a_i, d_i, alpha_i, angle in zip(a, d, alpha, [*angles, 0.0], strict=False):
        along, up = np.eye(4), np.eye(4)
        along[0, 3], up[2, 3] = a_i, d_i
        pose = pose @ elementary("x", alpha_i) @ along @ elementary("z", angle) @ up
    np.testing.assert_allclose(arm.ball_position(angles), pose[:3, 3], atol=1e-12)
    with pytest.raises(ValueError, match="d must have shape"):
        arm_from_dh(a, d[:2], alpha, ("a", "b", "c"), modified=True)
