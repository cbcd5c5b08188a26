import json
import math
import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kit.plants import factory_ur5, nominal_ur5
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import (
    AXES,
    MAX_TILT,
    Magnitude,
    Mismatch,
    parse_magnitudes,
    sample_mismatch,
)
from servobench.plant.robot.workspace import CENTRE

POSES = np.random.default_rng(1).uniform(-2.0, 2.0, (50, 6))


def test_no_mismatch_leaves_the_model_as_it_is():
    model, _ = sample_mismatch(Mismatch.parse("none"), find_robot("ur5"), 3)
    np.testing.assert_allclose(
        model.feature(POSES), nominal_ur5().feature(POSES), rtol=0, atol=1e-12
    )


def test_the_same_seed_draws_the_same_robot_and_another_seed_another():
    mismatch = Mismatch.parse("severe")
    records = [
        sample_mismatch(mismatch, find_robot("ur5"), seed)[1].as_record() for seed in (5, 5, 6)
    ]
    assert records[0] == records[1]
    assert records[0] != records[2]
    assert json.loads(json.dumps(records[0])) == records[0]


@pytest.mark.parametrize(
    ("text", "links", "offset", "angle", "tool"),
    [("moderate", 0.05, 3, 15, 0.02), ("severe", 0.1, 6, 45, 0.04)],
)
def test_profiles_stay_within_their_magnitudes_and_use_them(text, links, offset, angle, tool):
    samples = [
        sample_mismatch(Mismatch.parse(text), find_robot("ur5"), seed)[1] for seed in range(200)
    ]
    for values, bound in (
        ([sample.link_scale - 1 for sample in samples], links),
        ([sample.joint_offset for sample in samples], math.radians(offset)),
        ([sample.camera_angle for sample in samples], math.radians(angle)),
        ([sample.tool_offset for sample in samples], tool),
    ):
        assert np.abs(values).max() <= bound
        assert np.max(values) > 0.9 * bound
        assert np.min(values) < -0.9 * bound


@pytest.mark.parametrize("angle", [10, 45, 90, 120, 180])
def test_a_turned_camera_turns_by_the_named_angle_and_still_sees_the_workspace(angle):
    nominal = nominal_ur5()
    for seed in range(100):
        true, _ = sample_mismatch(
            Mismatch.parse(f"camera_rotation={angle}deg"), find_robot("ur5"), seed
        )
        R = nominal.X_BC[:3, :3].T @ true.X_BC[:3, :3]
        assert math.acos(np.clip((np.trace(R) - 1) / 2, -1, 1)) == pytest.approx(
            math.radians(angle), abs=1e-6
        )
        assert math.acos(min(R[2, 2], 1.0)) <= MAX_TILT + 1e-9
        np.testing.assert_allclose(true.to_camera(CENTRE), nominal.to_camera(CENTRE), atol=1e-12)


def test_a_larger_magnitude_goes_further_in_the_same_direction():
    small, large = (
        sample_mismatch(Mismatch.parse(f"links={size}%"), find_robot("ur5"), 4)[1]
        for size in (5, 10)
    )
    np.testing.assert_allclose(2 * (small.link_scale - 1), large.link_scale - 1, atol=1e-12)


def test_an_axis_is_added_to_a_profile_or_replaces_its_own_and_is_refused_twice():
    both, once = (
        Mismatch.parse("moderate+gear_ratio=5%"),
        Mismatch.parse("moderate+camera_rotation=0.5rad"),
    )
    assert (both.size("links"), both.size("gear_ratio"), both.camera_exact) == (0.05, 0.05, False)
    assert (once.size("camera_rotation"), once.camera_exact) == (0.5, True)
    with pytest.raises(ValueError, match="has the axis camera_rotation twice; give it once"):
        Mismatch.parse("moderate+camera_rotation=60deg+camera_rotation=0.5rad")
    with pytest.raises(ValueError, match="has the axis camera_rotation twice"):
        once.with_axis("camera_rotation", Magnitude(60.0, "deg"))


@pytest.mark.parametrize(
    "text",
    [
        "none",
        "severe",
        "none+links=10%",
        "moderate+camera_rotation=60deg",
        "links=20%+tool=1.5cm",
        "gear_ratio=0.05",
        "factory",
        "factory=~/arm.yaml+camera_move=90deg",
    ],
)
def test_a_mismatch_prints_the_text_it_was_read_from_and_travels(text):
    mismatch = Mismatch.parse(text)
    assert str(mismatch) == text
    assert {pickle.loads(pickle.dumps(mismatch)), mismatch} == {Mismatch.parse(str(mismatch))}


def test_an_axis_is_put_on_top_of_a_mismatch():
    turned = Magnitude(60.0, "deg")
    assert str(Mismatch().with_axis("camera_rotation", turned)) == "camera_rotation=60deg"
    assert (
        str(Mismatch.parse("moderate").with_axis("camera_rotation", turned))
        == "moderate+camera_rotation=60deg"
    )
    assert (
        str(Mismatch.parse("tool=5mm").with_axis("camera_rotation", turned))
        == "tool=5mm+camera_rotation=60deg"
    )


def test_factory_takes_the_arm_of_the_calibration_file():
    true, _ = sample_mismatch(Mismatch.parse("factory"), find_robot("ur5"), 0)
    np.testing.assert_allclose(true.arm.ball_position(POSES), factory_ur5().ball_position(POSES))


def test_a_gear_ratio_scales_the_motion_but_not_the_reported_position():
    true, sample = sample_mismatch(Mismatch.parse("gear_ratio=5%"), find_robot("ur5"), 0)
    expected = nominal_ur5().jacobian(sample.gear_ratio * POSES) * sample.gear_ratio
    np.testing.assert_allclose(true.jacobian(POSES), expected, atol=1e-12)


def test_a_negative_magnitude_is_refused():
    with pytest.raises(ValueError, match="tool must be at least 0"):
        Mismatch().with_axis("tool", Magnitude(-0.1, "m"))


@pytest.mark.parametrize(
    ("axis", "text", "magnitudes"),
    [
        ("camera_rotation", "0:90:45deg", ("0deg", "45deg", "90deg")),
        ("links", "0:30:10%", ("0%", "10%", "20%", "30%")),
        ("tool", "5/12.5mm", ("5mm", "12.5mm")),
        ("outliers", "0:40:20%", ("0%", "20%", "40%")),
        ("stable", "1/1.5/2", ("1", "1.5", "2")),
        ("gear_ratio", "0.1", ("0.1",)),
        ("joint_offsets", "0:0.3:0.1rad", ("0rad", "0.1rad", "0.2rad", "0.3rad")),
    ],
)
def test_a_range_of_magnitudes_includes_both_ends(axis, text, magnitudes):
    assert tuple(str(each) for each in parse_magnitudes(axis, text)) == magnitudes


@pytest.mark.parametrize("axis", AXES)
def test_a_range_of_every_axis_has_an_example_that_can_be_used(axis):
    with pytest.raises(ValueError, match=f"such as {axis}=") as refusal:
        parse_magnitudes(axis, "")
    example = str(refusal.value).partition(f"such as {axis}=")[2].partition(";")[0]
    assert len(parse_magnitudes(axis, example)) > 1


@pytest.mark.parametrize("seed", range(20))
def test_a_camera_that_is_moved_keeps_the_workspace_in_view(seed):
    model, sample = sample_mismatch(Mismatch.parse("camera_move=120deg"), find_robot("ur5"), seed)
    moved = sample.moved(model, find_robot("ur5"))
    turn = Rotation.from_matrix(model.X_BC[:3, :3].T @ moved.X_BC[:3, :3])
    assert turn.magnitude() == pytest.approx(np.radians(120.0))
    tilt = np.arccos(model.X_BC[:3, 2] @ moved.X_BC[:3, 2])
    assert tilt <= np.radians(30.0) + 1e-9
    np.testing.assert_allclose(model.to_camera(CENTRE), moved.to_camera(CENTRE), atol=1e-12)


def test_without_a_move_there_is_no_moved_robot():
    model, sample = sample_mismatch(Mismatch.parse("severe"), find_robot("ur5"), 0)
    assert sample.moved(model, find_robot("ur5")) is None
