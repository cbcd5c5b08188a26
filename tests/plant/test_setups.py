"""Sensing set-ups: their features and Jacobians against OpenCV, CasADi and geometry."""

from dataclasses import replace

import casadi
import cv2
import numpy as np
import pytest

from kit.robots import FOUR_JOINTS
from servobench.plant.cameras.optics import Optics, in_image, project
from servobench.plant.cameras.placement import HAND_DISTANCE, draw_cameras
from servobench.plant.cameras.registry import FIXED, HAND, SETUPS, Sensing
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.cameras.symbolic import symbolic_feature
from servobench.plant.contract.lanes import stack
from servobench.plant.robot.camera import CAMERA
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch

WORDS = [str(Sensing(eye, mount)) for eye in SETUPS.values() for mount in (FIXED, HAND)]
MODELS = WORDS[1:]  # the first one is the arm's own model, which has tests of its own
SEVERE = Mismatch.parse("severe+gear_ratio=5%")


def true_model(
    word: str, seed: int = 0, mismatch: Mismatch = SEVERE, robot: str = "ur5"
) -> SetupModel:
    arm = find_robot(robot)
    true, sample = sample_mismatch(mismatch, arm, seed)
    model, _ = Sensing.parse(word).true(arm, true, sample, mismatch, seed)
    assert isinstance(model, SetupModel)
    return model


def postures(count: int, robot: str = "ur5", seed: int = 1) -> np.ndarray:
    work = find_robot(robot).workspace
    return np.random.default_rng(seed).uniform(work.lower, work.upper, (count, len(work.home)))


@pytest.mark.parametrize("word", MODELS)
def test_feature_and_jacobian_are_those_of_casadi(word):
    model = true_model(word)
    function = symbolic_feature(model)
    q = casadi.SX.sym("q", 6)
    derivative = casadi.Function("J", [q], [casadi.jacobian(function(q), q)])
    checked = 0
    for posture in postures(40):
        y, J, seen = model.observe(posture)
        if not seen.all():
            continue
        checked += 1
        np.testing.assert_allclose(np.asarray(function(posture))[:, 0], y, rtol=1e-12, atol=1e-10)
        np.testing.assert_allclose(
            np.asarray(derivative(posture)), J, rtol=1e-10, atol=1e-9 * model.channel.scale
        )
    assert checked >= 1


@pytest.mark.parametrize(
    "word", ["pixel", "stereo", "plate", "pixel:hand", "stereo:hand", "plate:hand"]
)
def test_pixels_are_those_of_opencv(word):
    model = true_model(word)
    for posture in postures(5):
        points = model.points(posture)
        wanted = []
        for c, camera in enumerate(model.cameras):
            f, centre, k = (
                value[c]
                for value in (model.optics.focal, model.optics.centre, model.optics.distortion)
            )
            R = camera[:3, :3].T
            if ((points - camera[:3, 3]) @ camera[:3, 2] < 0.1).any():
                break
            K = np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])
            pixels, _ = cv2.projectPoints(
                points, cv2.Rodrigues(R)[0], -R @ camera[:3, 3], K, np.array([k, 0.0, 0, 0])
            )
            wanted.append(pixels.reshape(-1))
        else:
            np.testing.assert_allclose(
                model.feature(posture), np.concatenate(wanted), rtol=1e-9, atol=1e-8
            )


def test_position_by_a_fixed_camera_is_the_arms_own_model():
    robot = find_robot("ur5")
    true, sample = sample_mismatch(SEVERE, robot, 3)
    assert Sensing().true(robot, true, sample, SEVERE, 3) == (true, None)
    assert Sensing().nominal(robot) is robot.nominal


def test_the_first_fixed_camera_sees_the_ball_of_position():
    robot = find_robot("ur5")
    mismatch = Mismatch.parse("camera_rotation=40deg+tool=20mm+links=5%")
    true, _ = sample_mismatch(mismatch, robot, 5)
    model = true_model("pixel", 5, mismatch)
    for posture in postures(10):
        x, y, z = true.feature(posture)
        wanted = CAMERA.width / 2 + CAMERA.focal * x / z, CAMERA.height / 2 + CAMERA.focal * y / z
        np.testing.assert_allclose(model.feature(posture), wanted, rtol=1e-10)


@pytest.mark.parametrize("word", MODELS)
@pytest.mark.parametrize("robot", ["ur5", "ur10e", "panda"])
def test_the_planned_cameras_see_the_target_in_the_middle_at_home(word, robot):
    arm = find_robot(robot)
    model = Sensing.parse(word).nominal(arm)
    home = arm.workspace.home
    assert model.valid(home).all()
    middle = model.points(home).mean(axis=0)
    for pose in model.cameras:
        ahead = (middle - pose[:3, 3]) @ pose[:3, :3]
        assert np.hypot(*ahead[:2]) < 0.15 * ahead[2]
        np.testing.assert_allclose(ahead[2], model.distance, rtol=0.15)
    if word.endswith(HAND):
        np.testing.assert_allclose(model.distance, HAND_DISTANCE * arm.workspace.scale)


def test_out_of_view_the_jacobian_is_that_of_the_last_posture_in_view_on_the_way():
    arm = find_robot("ur5")
    model = Sensing.parse("pixel").nominal(arm)
    home = arm.workspace.home
    ends = home + 2.0 * (2.0 * np.random.default_rng(0).random((20, 6)) - 1.0)
    moved = 0
    for q in ends:
        way = (home + share * (q - home) for share in np.arange(20, -1, -1) / 20.0)
        last = next(posture for posture in way if model.valid(posture).all())
        moved += not np.array_equal(last, q)
        found = model.valid_jacobian(q, home)
        np.testing.assert_allclose(found, model.jacobian(last), rtol=1e-12, atol=1e-9)
    assert 3 < moved < 17
    np.testing.assert_array_equal(
        model.valid_jacobian(ends, home), [model.valid_jacobian(q, home) for q in ends]
    )


@pytest.mark.parametrize("word", ["pixel", "stereo:hand", "plate:hand"])
def test_a_metre_across_the_sight_changes_a_pixel_by_the_scale(word):
    model = Sensing.parse(word).nominal(find_robot("ur5"))
    pose, step = model.cameras[0], 1e-6
    ahead = pose[:3, 3] + model.distance * pose[:3, 2]
    there, here = (
        model.feature_at((ahead + side * pose[:3, 0])[None].repeat(len(model.target), 0))
        for side in (step, 0.0)
    )
    np.testing.assert_allclose((there - here)[0] / step, model.channel.scale, rtol=1e-6)


def test_cameras_on_the_hand_do_not_see_how_the_base_stands():
    """A target that is carried along with the base turned under the arm looks the same."""
    model = true_model("plate:hand")
    q = find_robot("ur5").workspace.home
    turn = 0.4
    R = np.array(
        [[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    turned = replace(model, target=model.target @ R.T)
    moved = q + turn / model.arm.gear_ratio * (np.arange(6) == 0)
    np.testing.assert_allclose(turned.feature(moved), model.feature(q), rtol=1e-10)


@pytest.mark.parametrize("word", MODELS)
def test_a_lane_has_the_bits_of_a_single_run(word):
    models = [true_model(word, seed) for seed in range(3)]
    q = postures(3)
    together = stack(models).observe(q)
    for lane, (model, posture) in enumerate(zip(models, q, strict=True)):
        for many, one in zip(together, model.observe(posture), strict=True):
            np.testing.assert_array_equal(many[lane], one)


def test_what_is_behind_the_camera_or_out_of_the_image_is_not_seen():
    optics = Optics(np.array([200.0]), np.array([[160.0, 120.0]]), np.zeros(1), (320.0, 240.0))
    points = np.array(
        [[[0, 0, 1], [0, 0, -1.0], [0.79, 0, 1], [0.81, 0, 1], [0, 0.61, 1]]], dtype=float
    )
    assert in_image(points, optics).tolist() == [[True, False, True, False, False]]
    assert np.isfinite(project(points, optics)).all()


def test_only_the_disc_that_leaves_the_image_is_lost_and_none_is_seen_from_behind():
    model = Sensing.parse("plate").nominal(find_robot("ur5"))
    pose = model.cameras[0]

    def seen(points: np.ndarray) -> list[bool]:
        return model.valid_at(points @ pose[:3, :3].T + pose[:3, 3]).tolist()

    square = np.array([[-0.1, -0.1, 0.65], [0.1, -0.1, 0.65], [0.1, 0.1, 0.65], [-0.1, 0.1, 0.65]])
    assert all(seen(square))
    half = 0.65 * CAMERA.width / (2 * CAMERA.focal)
    assert seen(square + [half - 0.05, 0, 0]) == [
        True,
        True,
        False,
        False,
        False,
        False,
        True,
        True,
    ]
    assert not any(seen(square[::-1]))


def test_a_camera_that_loses_the_ball_makes_its_own_features_invalid_only():
    model = Sensing.parse("stereo").nominal(find_robot("ur5"))
    pose = model.cameras[0]
    high = pose[:3, 3] - 0.3 * pose[:3, 2]  # behind the camera above, before the one in front
    assert model.valid_at(high[None])[:2].tolist() == [False, False]


def test_draws_of_the_optics_stay_within_their_magnitudes_for_any_number_of_cameras():
    mismatch = Mismatch.parse("focal=10%+centre=8px+distortion=5%+mount=4deg+camera_rotation=30deg")
    two = [draw_cameras(mismatch, 2, seed) for seed in range(200)]
    focal = np.array([each.focal for each in two])
    centre = np.array([each.centre for each in two])
    mount = np.linalg.norm([each.mount for each in two], axis=-1)
    assert (np.abs(focal - 1) <= 0.1).all()
    assert np.abs(focal - 1).max() > 0.095
    assert (np.abs(centre) <= 8).all()
    assert np.abs(centre).max() > 7.8
    assert (mount <= np.radians(4)).all()
    assert mount.max() > np.radians(3.9)
    np.testing.assert_allclose(
        np.linalg.norm([each.turn[1] for each in two], axis=-1), np.radians(30)
    )
    one = draw_cameras(mismatch, 1, 7)
    assert one.focal[0] == two[7].focal[0]
    np.testing.assert_array_equal(one.centre[0], two[7].centre[0])


def test_the_same_seed_gives_the_same_arm_under_every_sensing():
    robot = find_robot("ur5")
    arms = [true_model(word, 4).arm for word in MODELS]
    true, _ = sample_mismatch(SEVERE, robot, 4)
    for arm in arms:
        np.testing.assert_array_equal(arm.translation, true.arm.translation)
        np.testing.assert_array_equal(arm.joint_offset, true.arm.joint_offset)


@pytest.mark.parametrize("word", ["pixel", "pixel:hand", "stereo"])
def test_a_camera_that_is_moved_turns_about_what_it_looks_at(word):
    robot = find_robot("ur5")
    model = Sensing.parse(word).nominal(robot)
    moved = model.turned(np.array([0.0, 0.0, 0.7]), robot.workspace.centre)
    pivot = model.pivot(robot.workspace.centre)
    np.testing.assert_allclose(
        moved.feature_at(pivot[None])[:2], model.feature_at(pivot[None])[:2], rtol=1e-9
    )
    np.testing.assert_array_equal(moved.cameras[1:], model.cameras[1:])
    assert not np.allclose(moved.camera, model.camera)


def test_words_of_sensing_are_read_and_written():
    assert [str(Sensing.parse(word)) for word in WORDS] == WORDS
    assert str(Sensing.parse(" stereo:fixed ")) == "stereo"
    with pytest.raises(ValueError, match="unknown sensing 'pixle': did you mean 'pixel'"):
        Sensing.parse("pixle")
    with pytest.raises(ValueError, match="unknown sensing 'pixel:head'"):
        Sensing.parse("pixel:head")


def test_an_axis_that_the_cameras_do_not_have_is_refused():
    robot = find_robot("ur5")
    for text, word, wanted in (
        ("focal=10%", "position", "focal needs a camera that sees pixels"),
        ("mount=5deg", "pixel", "mount needs a camera on the hand"),
    ):
        mismatch = Mismatch.parse(text)
        true, sample = sample_mismatch(mismatch, robot, 0)
        with pytest.raises(ValueError, match=wanted):
            Sensing.parse(word).true(robot, true, sample, mismatch, 0)


def test_a_plate_needs_six_joints(tmp_path):
    file = tmp_path / "four.toml"
    file.write_text(FOUR_JOINTS)
    with pytest.raises(
        ValueError, match="sensing plate needs an arm of 6 joints or more, and .* has 4"
    ):
        Sensing.parse("plate").nominal(find_robot(str(file)))


def in_place(points, optics):
    points[..., 0] += 1.0
    return points[..., 0, 0, :2]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"measure": in_place, "rates": None},
            "measure and rates must not change their arguments; work on a copy",
        ),
        (
            {"measure": lambda points, _: points[0, 0, :2]},
            r"measure must return .* of shape \(5, 2\) for points \(5, 1, 1, 3\), .* got float64 of shape \(1, 3\)",
        ),
        (
            {"measure": lambda points, _: np.ma.masked_less(points[..., 0, 0, :2], 0.5)},
            "measure must return .*, got MaskedArray",
        ),
        (
            {"measure": lambda points, _: points[..., 0, 0, :2].tolist()},
            "measure must return .*, got list",
        ),
        (
            {"measure": lambda points, _: points[..., 0, 0, :2].astype(np.float16)},
            "measure must return .*, got float16",
        ),
        ({"features": ()}, "features must be one name or more, got none"),
        (
            {"measure": lambda points, _: np.nan * points[..., 0, 0, :2]},
            "measure must return finite numbers, got .nan",
        ),
        (
            {"rates": lambda points, motions, _: motions[..., 0, 0, 0, :]},
            r"rates must return .* shape \(5, 2, 2\) for",
        ),
        (
            {"rates": lambda *given: 1.01 * SETUPS["pixel"].rates(*given)},
            "rates is not the derivative of measure",
        ),
    ],
)
def test_functions_that_break_their_contract_are_refused(changes, message):
    with pytest.raises(ValueError, match=f"sensing pixel: {message}"):
        replace(SETUPS["pixel"], **changes).check()
    for setup in SETUPS.values():
        setup.check()
    with pytest.raises(FloatingPointError, match="invalid value"):
        replace(
            SETUPS["pixel"], measure=lambda points, _: np.log(points[..., 0, 0, :2] - 9.0)
        ).check()


def test_units_other_than_lengths_need_a_natural_size_and_single_features_a_point():
    for unit, metre in (("mm", 1000.0), ("cm", 100.0), ("m", 1.0)):
        assert replace(SETUPS["position"], unit=unit).channel(500.0, 2.0).scale == metre
    with pytest.raises(
        ValueError, match="sensing position: features in rad need their natural size; give scale="
    ):
        replace(SETUPS["position"], unit="rad")
    with pytest.raises(
        ValueError,
        match="sensing stereo: single needs as many features for each of 2 points, got 3",
    ):
        replace(SETUPS["stereo"], features=("u1", "v1", "u2"))


def test_features_without_a_derivative_are_differentiated():
    exact = SETUPS["pixel"]
    numeric = replace(exact, rates=None)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4, 1, 1, 3)) * 0.2 + [0.0, 0.0, 1.0]
    motions = rng.normal(size=(4, 1, 1, 3, 6))
    optics = Optics(np.array([200.0]), np.array([[160.0, 120.0]]), np.array([0.05]), (320.0, 240.0))
    wanted = exact.change(points, motions, optics)
    np.testing.assert_allclose(
        numeric.change(points, motions, optics), wanted, rtol=1e-6, atol=1e-5
    )
    # Which is no lack of precision
    wrapped = replace(numeric, measure=lambda *given: exact.measure(*given) % 1.0)
    np.testing.assert_allclose(
        wrapped.change(points, motions, optics), wanted, rtol=1e-6, atol=1e-5
    )
    single = replace(numeric, measure=lambda *given: exact.measure(*given).astype(np.float32))
    assert (
        np.abs(single.change(points, motions, optics) - wanted).max() < 1e-3 * np.abs(wanted).max()
    )
