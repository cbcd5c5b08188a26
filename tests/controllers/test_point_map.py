"""Tests of the map of what cameras see: batch least squares, the nearest rotation, turned cameras, lost features."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from servobench.controllers.aids import AidsConfig
from servobench.controllers.camera_model import CameraModel, block_diagonal, feature_jacobian, turned_interaction
from servobench.controllers.controller import Delays, RobotKnowledge
from servobench.controllers.estimators.arm import ArmConfig, ArmEstimator
from servobench.controllers.estimators.constant import ConstantEstimator
from servobench.controllers.stages.estimation import Estimation
from servobench.controllers.stages.point_map import ENTRIES, PointBank, near_turn, point_update, turn_deviation
from servobench.controllers.units import in_natural_units
from servobench.plant.cameras.registry import Sensing
from servobench.plant.contract.faults import FilterDiverged
from servobench.plant.contract.signals import Observation
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch

FRAME = 0.3  # σ²
K = 4
PERIOD = 0.05
WORDS = ["pixel", "stereo", "plate", "pixel:hand", "stereo:hand", "plate:hand"]


def motions(count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, K, ENTRIES)), rng.normal(size=(count, K)), rng.uniform(0.1, 2.0, (count, K))


def fresh(features=K):
    theta, P = np.zeros(ENTRIES + features), np.diag([*[0.7] * ENTRIES, *[FRAME] * features])
    theta[:ENTRIES] = np.eye(3).ravel()
    return PointBank(theta, P)


def filtered(H, dy, model, valid=None):
    bank, said = fresh(H.shape[1]), []
    for k in range(len(H)):
        seen = np.full(H.shape[1], True) if valid is None else valid[k]
        bank, innovation = point_update(bank, H[k], dy[k], seen, np.array([FRAME]), model[k])
        said.append(innovation)
    return bank, said


def covariance_of(model):
    """Return the covariance of the steps of all features, which share their frames."""
    count, size = model.shape
    shared = np.eye(count, k=1) + np.eye(count, k=-1)
    return np.kron(2.0 * np.eye(count) - shared, FRAME * np.eye(size)) + np.diag(model.ravel())


def test_the_filter_is_generalised_least_squares_and_its_score_the_likelihood():
    H, dy, model = motions(20)
    bank, said = filtered(H, dy, model)
    X, R = H.reshape(-1, ENTRIES), covariance_of(model)
    information = np.eye(ENTRIES) / 0.7 + X.T @ np.linalg.solve(R, X)
    wanted = np.linalg.solve(information, np.eye(3).ravel() / 0.7 + X.T @ np.linalg.solve(R, dy.ravel()))
    np.testing.assert_allclose(bank.theta[:ENTRIES], wanted, atol=1e-9)
    np.testing.assert_allclose(bank.P[:ENTRIES, :ENTRIES], np.linalg.inv(information), atol=1e-9)
    S, error = 0.7 * X @ X.T + R, dy.ravel() - X @ np.eye(3).ravel()
    np.testing.assert_allclose(sum(each.nis for each in said), error @ np.linalg.solve(S, error), rtol=1e-10)
    np.testing.assert_allclose(sum(each.spread for each in said), np.linalg.slogdet(S)[1], rtol=1e-10)


def test_motions_shorter_than_the_noise_leave_map_and_covariance_and_follow_the_noise():
    H, dy, model = motions(6)
    bank, _ = filtered(H, dy, model)
    new, said = point_update(bank, H[0], dy[0], np.full(K, True), np.array([FRAME]), model[0], learns=False)
    usual, same = point_update(bank, H[0], dy[0], np.full(K, True), np.array([FRAME]), model[0])
    np.testing.assert_array_equal(new.theta[:ENTRIES], bank.theta[:ENTRIES])
    np.testing.assert_allclose(new.P[:ENTRIES, :ENTRIES], bank.P[:ENTRIES, :ENTRIES], atol=1e-12)
    assert not np.allclose(usual.theta[:ENTRIES], bank.theta[:ENTRIES])
    np.testing.assert_array_equal(new.theta[ENTRIES:], usual.theta[ENTRIES:])
    assert said.nis == same.nis


def test_a_feature_that_is_not_seen_is_as_if_it_were_none():
    H, dy, model = motions(12)
    three, said = filtered(H[:, :3], dy[:, :3], model[:, :3])
    dy[:, 3] = 1e3
    bank, all_said = filtered(H, dy, model, np.tile([True, True, True, False], (12, 1)))
    np.testing.assert_allclose(bank.theta[:ENTRIES], three.theta[:ENTRIES], atol=1e-12)
    np.testing.assert_allclose(bank.P[:-1, :-1], three.P, atol=1e-12)
    np.testing.assert_allclose(bank.P[-1], [*[0.0] * (ENTRIES + 3), FRAME], atol=1e-12)  # its noise is unknown
    for all_, own in zip(all_said, said, strict=True):
        np.testing.assert_allclose(all_, own, rtol=1e-10)


def test_the_completed_map_is_the_most_likely_one():
    """The rotation is that of the least cost, by another minimiser from many starts; M̄ is the mean given it."""
    rng = np.random.default_rng(3)
    for seed in range(5):
        turn = Rotation.random(random_state=seed).as_matrix()
        A = rng.normal(size=(6, ENTRIES))
        P = np.linalg.inv(np.eye(ENTRIES) + 30.0 * A.T @ A)
        M = turn.ravel() + 0.05 * rng.normal(size=ENTRIES)
        weight = np.linalg.inv(P + 0.04 * np.eye(ENTRIES))

        def cost(vector, M=M, weight=weight):
            wrong = M - Rotation.from_rotvec(vector).as_matrix().ravel()
            return wrong @ weight @ wrong

        start = Rotation.from_matrix(turn).as_rotvec()
        made = [minimize(cost, start + shift).fun for shift in 0.3 * rng.normal(size=(6, 3))]
        completed, R = near_turn(M.reshape(3, 3), P, 0.2, turn)
        assert cost(Rotation.from_matrix(R).as_rotvec()) <= min(made) * (1.0 + 1e-4) + 1e-9
        wanted = R.ravel() + 0.04 * weight @ (M - R.ravel())
        np.testing.assert_allclose(completed.ravel(), wanted, atol=1e-9)


def test_two_rows_of_a_map_tell_the_third():
    """A camera that sees nothing along its sight tells the first two rows."""
    turn = Rotation.from_euler("xyz", [0.5, -0.4, 2.0]).as_matrix()
    M, P = turn.copy(), np.diag([1e-6] * 6 + [1.0] * 3)
    M[2] = (0.0, 0.0, 1.0)
    completed, R = near_turn(M, P, 0.2, np.eye(3))
    np.testing.assert_allclose(R, turn, atol=0.02)
    np.testing.assert_allclose(completed[2], turn[2], atol=0.05)
    assert turn_deviation(P, 0.2, R) < 0.25 < 0.5 < turn_deviation(np.eye(ENTRIES), 0.2, R)


def test_a_covariance_that_is_none_is_refused():
    bank = fresh()
    with pytest.raises(FilterDiverged, match="covariance of the map is not positive definite"):
        point_update(bank._replace(P=-9.0 * bank.P), *(each[0] for each in motions(1)[:2]), np.full(K, True),
                     np.array([FRAME]), np.zeros(K))  # fmt: skip


def test_blocks_of_points_on_the_diagonal_multiply_as_points_do():
    rng = np.random.default_rng(0)
    rates, turn, G = rng.normal(size=(5, 2, 3, 2, 3)), rng.normal(size=(5, 2, 3, 3)), rng.normal(size=(5, 18, 6))
    np.testing.assert_allclose(turned_interaction(rates, turn) @ G, feature_jacobian(rates, turn, G), atol=1e-12)
    np.testing.assert_array_equal(block_diagonal(rates[0])[8:10, 12:15], rates[0, 1, 1])


class Watching:
    """An arm whose cameras are turned, and what controllers know of it: the cameras as planned."""

    def __init__(self, word, turn, estimator=None, seed=1, **aids):
        robot, sensing = find_robot("ur5"), Sensing.parse(word)
        mismatch = Mismatch.parse(f"camera_rotation={turn}")
        arm, sample = sample_mismatch(mismatch, robot, seed)
        self.true, _ = sensing.true(robot, arm, sample, mismatch, seed)
        nominal = sensing.nominal(robot)
        cameras = CameraModel(
            nominal.setup.cameras, len(nominal.setup.target), nominal.point_motions, nominal.interaction
        )
        spec = hand_eye_spec(nominal, PERIOD, 1.0, 6.0)
        self.knowledge = in_natural_units(RobotKnowledge(spec, 0, nominal.jacobian, nominal_cameras=cameras))
        config = AidsConfig(**{"model": "map", "delay": "given", "noise": "identified", **aids})
        self.stages = Estimation((estimator or (lambda _: ConstantEstimator()))(self.knowledge), self.knowledge, config,
                                 Delays(0.0, 0.0, 0.0))  # fmt: skip
        self.home = robot.workspace.home

    def follow(self, seconds=4.0, lost=(), reach=0.12):
        """Return the relative error of Ĵ against the true Jacobian over time, along a small motion around home."""
        rng, scale, state, errors, late = np.random.default_rng(0), self.knowledge.unit, None, [], None
        rates, phases = rng.uniform(2.0, 5.0, 6), rng.uniform(0.0, 6.0, 6)
        for k in range(round(seconds / PERIOD)):
            q = self.home + reach * (np.sin(rates * k * PERIOD + phases) - np.sin(phases))
            y, J, _ = self.true.observe(q)
            valid = np.full(len(y), True)
            valid[list(lost)] = k < 1
            late = y if late is None else np.where(valid, y, late)
            look = Observation(k * PERIOD, q, late / scale, valid=valid)
            state = state or self.stages.start(look, self.knowledge.nominal_jacobian(q))
            state = self.stages.update(state, look, np.zeros(len(y)))
            errors.append(np.linalg.norm(scale * state.jacobian - J) / np.linalg.norm(J))
        return state, np.array(errors)


@pytest.mark.parametrize("word", WORDS)
def test_before_cameras_as_planned_the_jacobian_is_exact_and_stays_so(word):
    _, errors = Watching(word, "0deg").follow(1.0)
    assert errors[0] < 1e-12
    assert errors.max() < 0.04  # what motions of a period tell where the Jacobian changes


@pytest.mark.parametrize("word", WORDS)
def test_a_turned_camera_is_known_within_seconds(word):
    _, errors = Watching(word, "90deg").follow(2.0)
    assert errors[0] > 1.0
    assert errors[-20:].max() < 0.25  # what the depths by the planned camera leave


@pytest.mark.parametrize(("lost", "learns"), [((0, 1, 2, 3), True), (range(8), False)], ids=["two discs", "all"])
def test_discs_that_are_lost_do_not_stop_learning_from_the_others(lost, learns):
    """They are lost for good after the first frame, when the turned camera is not yet known."""
    _, errors = Watching("plate", "120deg").follow(2.0, lost)
    assert errors[0] > 1.0
    assert (errors[-20:].max() < 0.4) == learns


def test_gear_ratios_are_found_through_a_turned_camera():
    watched = Watching("stereo", "60deg", lambda known: ArmEstimator(ArmConfig(), known))
    gears = np.array([1.05, 0.95, 1.04, 1.0, 1.0, 1.0])
    arm = dataclasses.replace(watched.true.arm, gear_ratio=gears * watched.true.arm.gear_ratio)
    watched.true = dataclasses.replace(watched.true, arm=arm)
    state, errors = watched.follow(5.0, reach=0.3)
    np.testing.assert_allclose(state.learned.estimator.x[:3], gears[:3], atol=0.025)
    assert errors[-20:].mean() < 0.15
