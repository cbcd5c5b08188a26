"""The structured estimate of the arm, against a noise-free arm of the same structure."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from kit.plants import nominal_ur5
from servobench.controllers.camera_model import CameraModel
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.arm import ArmConfig, ArmEstimator, ArmState
from servobench.controllers.estimators.estimator import Motion
from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.hand_eye import HandEyeModel, hand_eye_spec
from servobench.plant.robot.ur5 import TRAINING_LOWER, TRAINING_UPPER

GEARS = np.array([1.1, 0.95, 1.05, 0.9, 1.08, 1.0])
OFFSETS = np.array([0.0, 0.05, -0.08, 0.06, 0.1, 0.0])  # a turn of the first joint is one of the camera


def estimator(**values: float) -> ArmEstimator:
    model = nominal_ur5()
    knowledge = RobotKnowledge(hand_eye_spec(model, 0.05, 1.0, 6.0), 10, nominal_jacobian=model.jacobian)
    return ArmEstimator(ArmConfig(**values), knowledge)


def bent_arm() -> HandEyeModel:
    model = nominal_ur5()
    return replace(model, arm=replace(model.arm, gear_ratio=GEARS, joint_offset=OFFSETS))


def walk(seed: int, count: int = 400) -> FloatArray:
    generator = np.random.default_rng(seed)
    corners = generator.uniform(TRAINING_LOWER, TRAINING_UPPER, (count // 20 + 1, 6))
    return np.concatenate([np.linspace(a, b, 20, endpoint=False) for a, b in itertools.pairwise(corners)])


def motions(path: FloatArray) -> list[Motion]:
    y, zero = bent_arm().feature(path), np.zeros(3)
    time = np.asarray(0.05)[()]
    return [Motion(path[k], path[k + 1] - path[k], y[k + 1] - y[k], zero, time) for k in range(len(path) - 1)]


def learned(arm: ArmEstimator, path: FloatArray) -> ArmState:
    state = arm.start(nominal_ur5().jacobian(path[0]))
    for motion in motions(path):
        state = arm.update(state, motion)
    return state


def test_gears_and_zeros_of_a_noise_free_arm_are_found() -> None:
    state = learned(estimator(model_error=0.0, feature_noise=1e-5), walk(1))
    seen = slice(1, 5)  # the last joint turns the ball about its own axis, the first one's zero turns the camera
    np.testing.assert_allclose(state.x[:6][seen], GEARS[seen], atol=6e-3)
    np.testing.assert_allclose(state.x[6:][seen], OFFSETS[seen], atol=2e-2)


def test_the_jacobian_elsewhere_is_that_of_the_bent_arm() -> None:
    arm, elsewhere = estimator(), walk(2, 40)
    state = learned(arm, walk(1))
    true = bent_arm().jacobian(elsewhere)
    estimated = np.stack([arm.jacobian(state, q) for q in elsewhere])
    error = np.linalg.norm(estimated - true) / np.linalg.norm(true)
    nominal = np.linalg.norm(nominal_ur5().jacobian(elsewhere) - true) / np.linalg.norm(true)
    assert error < 0.1 * nominal


def with_camera_model() -> ArmEstimator:
    """Return an estimator that also knows how the ball moves, as a point."""

    def kinematics(q: FloatArray) -> tuple[FloatArray, FloatArray]:
        y, J = nominal_ur5().feature_and_jacobian(q)
        return y[..., None, None, :], J[..., None, None, :, :]

    model = nominal_ur5()
    cameras = CameraModel(1, 1, kinematics, lambda _, depth: np.eye(3) * depth[..., None, None])
    spec = hand_eye_spec(model, 0.05, 1.0, 6.0)
    return ArmEstimator(ArmConfig(), RobotKnowledge(spec, 10, nominal_jacobian=model.jacobian, nominal_cameras=cameras))


def test_features_that_are_known_to_move_with_points_teach_what_the_points_teach() -> None:
    path, turn = walk(4, 40), np.eye(3)[[1, 2, 0]]
    expected = learned(estimator(), path)
    arm = with_camera_model()
    plain = turned = arm.start(nominal_ur5().jacobian(path[0]))
    for motion in motions(path):
        plain = arm.update(plain, motion)
        turned = arm.update(turned, replace(motion, feature_step=turn @ motion.feature_step, interaction=turn))
    np.testing.assert_array_equal(plain.x, expected.x)
    np.testing.assert_allclose(turned.x, expected.x, atol=1e-9)
    np.testing.assert_allclose(turned.P, expected.P, atol=1e-9)


def test_points_move_as_the_bent_arm_moves_them() -> None:
    model, q = nominal_ur5(), walk(4, 20)[3]
    arm = with_camera_model()
    state = arm.start(model.jacobian(q))._replace(x=np.concatenate([GEARS, OFFSETS]))
    np.testing.assert_allclose(arm.motions(state, q), bent_arm().jacobian(q), atol=1e-12)
    told = arm.diagnostics(state)
    assert told["largest_offset"] == 0.1
    assert abs(told["largest_gear_error"] - 0.1) < 1e-12


def test_it_starts_as_the_nominal_arm_and_learns_nothing_from_short_ways() -> None:
    arm, path = estimator(min_joint_step=50.0), walk(3, 40)
    state = learned(arm, path)
    np.testing.assert_array_equal(arm.jacobian(state, path[0]), nominal_ur5().jacobian(path[0]))


def test_motions_that_do_not_join_begin_a_new_way() -> None:
    arm, path = estimator(min_joint_step=50.0), walk(3, 60)
    pieces = motions(path)
    state = arm.start(nominal_ur5().jacobian(path[0]))
    for motion in [*pieces[:5], *pieces[9:11]]:
        state = arm.update(state, motion)
    np.testing.assert_array_equal(state.begin, path[9])
    np.testing.assert_allclose(state.joint_step, path[11] - path[9])
    np.testing.assert_allclose(state.duration, 2 * 0.05)


def test_a_way_counts_by_its_noise_the_error_of_the_model_and_the_time_it_takes() -> None:
    noise, model_error, gear_walk, deviation = 0.005, 0.3, 0.02, 0.05
    arm = estimator(
        feature_noise=noise, model_error=model_error, walk=gear_walk, gear_deviation=deviation,
        offset_deviation=deviation, min_joint_step=0.1,
    )  # fmt: skip
    model, q = nominal_ur5(), walk(5, 20)[0]
    path = q + 0.02 * np.arange(4)[:, None]  # three motions of 0.049 rad each
    J0, J1 = model.jacobian(path[0]), model.jacobian(path[-1])
    H = np.hstack([J1 * path[-1] - J0 * path[0], J1 - J0])
    predicted = model.feature(path[-1]) - model.feature(path[0])
    R = (2.0 * noise**2 + model_error**2 * predicted @ predicted) * np.eye(3)
    P = (deviation**2 + gear_walk**2 * 3 * 0.05) * np.eye(12)
    P -= P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
    np.testing.assert_allclose(learned(arm, path).P, P, atol=1e-7 * deviation**2)
