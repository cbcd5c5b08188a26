"""Tests of the estimate stage: what the estimator learns from and what Ĵ is made of, under each `aids.model`."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kit.toy import KNOWLEDGE, PERIOD, M, N, Recorder, jacobian_network, only_jacobian, plant_spec
from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import Delays, RobotKnowledge
from servobench.controllers.estimators.projection import BroydenConfig, BroydenEstimator
from servobench.controllers.estimators.rbf import RbfConfig, RbfEstimator
from servobench.controllers.stages.estimation import Estimation
from servobench.plant.contract.signals import Observation

TURN = Rotation.from_rotvec(np.radians(120.0) * np.array([0.36, 0.48, 0.8])).as_matrix()
NONE = Delays(0.0, 0.0, 0.0)
NETWORK = jacobian_network(N, M, units=6)
NETWORK = dataclasses.replace(NETWORK, weights=0.3 * NETWORK.weights)
MODELLED = dataclasses.replace(KNOWLEDGE, nominal_jacobian=NETWORK.jacobian)


def curved(q):
    """The nominal Jacobian of an arm of two joints and one feature."""
    q = np.asarray(q)
    return np.stack([1.0 + q[..., 0], np.full(q.shape[:-1], 0.5)], axis=-1)[..., None, :]


def two_steps(model, **aids):
    """Return Ĵ after the motion from q = 0 to (0.1, 0.2), in which the feature moved by 0.4; Ĵ₀ = (1.2, 0.5)."""
    knowledge = RobotKnowledge(plant_spec(2, 1), 0, nominal_jacobian=curved)
    broyden = BroydenEstimator(BroydenConfig(step_factor=0.5))
    stages = Estimation(broyden, knowledge, AidsConfig(model=model, **aids), NONE)
    looks = [Observation(0.0, [0.0, 0.0], [0.0]), Observation(PERIOD, [0.1, 0.2], [0.4])]
    state = stages.start(looks[0], np.array([[1.2, 0.5]]))
    for look in looks:
        state = stages.update(state, look, np.zeros(1))
    assert stages.diagnostics(state)["jacobian_prediction_error"] == pytest.approx(0.4 - 0.12 - 0.1)
    return state.jacobian


def test_its_own_jacobian_by_hand():
    # Δy − Ĵ₀Δq = 0.4 − 0.22 = 0.18, ‖Δq‖² = 0.05: Ĵ = Ĵ₀ + 0.5 · 0.18 / 0.05 · (0.1, 0.2)
    np.testing.assert_allclose(two_steps("own"), [[1.2 + 0.18, 0.5 + 0.36]])


def test_the_deviation_from_the_nominal_jacobian_by_hand():
    # E₀ = Ĵ₀ − J_n(0) = (0.2, 0); Δy − J_n(0)Δq − E₀Δq = 0.4 − 0.2 − 0.02 = 0.18; J_n(q) = (1.1, 0.5)
    np.testing.assert_allclose(two_steps("nominal"), [[1.1 + 0.2 + 0.18, 0.5 + 0.36]])


@pytest.mark.parametrize("confidence", [0.5, 2.0])
def test_the_map_by_hand(confidence):
    # x = J_n(0)Δq = 0.2, r = 2 · 0.1² + 0.5² · 0.04 = 0.03, s = r + x² = 0.07, P = 1 − x²/s = 3/7, M = 1 + 0.2 · 0.2/s
    # M̄ = 1 + (M − 1) · 0.2² / (P + 0.2²); E learns from Δy − M̄x where √P = 0.65 is below the confidence
    J = two_steps("map", map_error=0.5, feature_noise=0.1, map_walk=0.0, detect_moves=False, confidence=confidence)
    mapped = 1.0 + 0.04 / 0.07 * 0.04 / (3.0 / 7.0 + 0.04)
    E = np.array([[0.2, 0.0]])
    if confidence > 0.65:
        E = E + 0.5 * (0.4 - mapped * 0.2 - 0.02) / 0.05 * np.array([0.1, 0.2])
    np.testing.assert_allclose(J, mapped * np.array([[1.1, 0.5]]) + E)


def path(steps, seed=1):
    """Joint positions (steps + 1, N), rad, of an arm that speeds up, turns and brakes."""
    rng, t = np.random.default_rng(seed), np.arange(steps)[:, None]
    speed = 0.04 * np.sin(2 * np.pi * t / rng.uniform(15.0, 40.0, N) + rng.uniform(0.0, 6.0, N))
    return np.concatenate([np.zeros((1, N)), np.cumsum(speed * np.minimum(1.0, t / 3.0), axis=0)])


def features(q, turn, network=NETWORK, delay=0):
    steps = np.matvec(turn @ network.jacobian(q[:-1]), np.diff(q, axis=0))
    y = np.concatenate([np.zeros((1, M)), np.cumsum(steps, axis=0)])
    return np.concatenate([np.repeat(y[:1], delay, axis=0), y[: len(y) - delay]])


def follow(estimator, q, y, knowledge=MODELLED, **aids):
    """Return the states after each period, and the stages."""
    stages = Estimation(estimator, knowledge, AidsConfig(**aids), NONE)
    state, states = stages.start(Observation(0.0, q[0], y[0]), knowledge.nominal_jacobian(q[0])), []
    for k in range(len(q)):
        state = stages.update(state, Observation(k * knowledge.spec.period, q[k], y[k]), np.zeros(M))
        states.append(state)
    return states, stages


@pytest.mark.parametrize("model", ["nominal", "map"])
@pytest.mark.parametrize("delay", ["given", "identified"])
def test_beside_an_exact_model_the_deviation_learns_nothing(model, delay):
    q = path(60)
    states, _ = follow(BroydenEstimator(BroydenConfig()), q, features(q, np.eye(M)), model=model, delay=delay)
    for k, state in enumerate(states):
        np.testing.assert_allclose(state.learned.estimator.J, 0.0, atol=1e-12)
        np.testing.assert_allclose(state.jacobian, NETWORK.jacobian(q[k]), atol=1e-12)
    own, _ = follow(BroydenEstimator(BroydenConfig()), q, features(q, np.eye(M)), delay=delay)
    assert np.linalg.norm(own[-1].jacobian - NETWORK.jacobian(q[-1])) > 0.05


def test_once_a_turned_camera_is_known_the_deviation_learns_little():
    q = path(150)
    aids = {"model": "map", "delay": "identified", "confidence": 0.02, "map_error": 0.01}
    states, _ = follow(BroydenEstimator(BroydenConfig()), q, features(q, TURN, delay=2), **aids)
    J = TURN @ NETWORK.jacobian(q[-1])
    assert np.linalg.norm(states[-1].learned.estimator.J) < 0.02 * np.linalg.norm(J)
    np.testing.assert_allclose(states[-1].jacobian, J, atol=0.02)


def test_what_no_map_explains_is_left_to_the_deviation():
    """The last joint's column is wrong in the model: with the deviation Ĵ predicts motions better."""
    q = path(200)
    rows = NETWORK.weights.copy()
    rows[-1] *= -0.5
    true = dataclasses.replace(NETWORK, weights=rows)
    found = []
    for confidence in (1e-9, 0.5):
        aids = {"model": "map", "rotation_deviation": 0.0, "confidence": confidence}
        states, _ = follow(BroydenEstimator(BroydenConfig()), q, features(q, TURN, true), **aids)
        found.append(np.mean([state.learned.unexplained for state in states[100:]]))
    assert found[1] < 0.8 * found[0]


def test_an_estimator_with_a_model_learns_in_its_own_frame_what_the_rotation_does_not_explain():
    q, true = path(400), dataclasses.replace(NETWORK, weights=1.1 * NETWORK.weights)
    y, found = features(q, TURN, true, delay=1), []
    for confidence in (0.5, 1e-9):
        rbf = RbfEstimator(RbfConfig(), KNOWLEDGE, only_jacobian(NETWORK))
        aids = {"delay": "identified", "rotation_deviation": 0.0, "map_walk": 0.0, "confidence": confidence}
        states, _ = follow(rbf, q, y, model="map", **aids)
        wanted = TURN @ true.jacobian(q[-1])
        found.append(np.linalg.norm(states[-1].jacobian - wanted) / np.linalg.norm(wanted))
    assert found[0] < 0.7 * found[1]


@pytest.mark.parametrize("aids", [{}, {"delay": "given"}], ids=["as read", "paired"])
@pytest.mark.parametrize(("period", "count"), [(0.1, 1), (0.05, 1), (0.02, 2), (0.008, 6), (0.004, 12)])
def test_as_much_is_learned_in_a_second_at_every_rate(period, count, aids):
    knowledge = dataclasses.replace(MODELLED, spec=dataclasses.replace(KNOWLEDGE.spec, period=period))
    t = period * np.arange(round(2.0 / period))
    q, recorder = np.outer(t, np.arange(1.0, N + 1.0)), Recorder()
    follow(recorder, q, 0.1 * q[:, :M], knowledge, **aids)
    assert len(recorder.motions) == (len(t) - 1) // count
    for motion in recorder.motions:
        assert motion.duration == pytest.approx(count * period)
        np.testing.assert_allclose(motion.joint_step, count * period * np.arange(1.0, N + 1.0), rtol=1e-9)


def test_a_motion_is_paired_with_that_of_the_joints_when_its_frames_were_exposed():
    q, recorder = path(30), Recorder()
    stages = Estimation(recorder, MODELLED, AidsConfig(delay="given", noise="identified"), Delays(0.15, 0.0, 0.0))
    state = stages.start(Observation(0.0, q[0], np.zeros(M)), NETWORK.jacobian(q[0]))
    for k in range(30):
        state = stages.update(state, Observation(k * PERIOD, q[k], 0.01 * k * np.ones(M)), np.full(M, 1.0))
    for k, motion in enumerate(recorder.motions, start=1):
        np.testing.assert_array_equal(motion.joint_position, q[max(k - 4, 0)])
        np.testing.assert_allclose(motion.joint_step, q[max(k - 3, 0)] - q[max(k - 4, 0)], atol=1e-15)
        np.testing.assert_allclose(motion.error, 1.0 - 0.01 * k)
        assert motion.noise > 0.0
    assert len(recorder.motions) == 29


def test_a_second_model_is_refused():
    rbf = RbfEstimator(RbfConfig(), KNOWLEDGE, only_jacobian(NETWORK))
    with pytest.raises(ValueError, match=r"^aids.model must be 'own' or 'map' for RbfEstimator, which brings a model$"):
        Estimation(rbf, KNOWLEDGE, AidsConfig(model="nominal"), NONE)


def test_without_a_nominal_model_the_first_jacobian_stands_for_it():
    q = path(40)
    J = NETWORK.jacobian(q[0])
    unknown = dataclasses.replace(MODELLED, nominal_jacobian=None)
    stages = Estimation(BroydenEstimator(BroydenConfig()), unknown, AidsConfig(model="map"), NONE)
    state, y = stages.start(Observation(0.0, q[0], np.zeros(M)), J), np.matvec(TURN @ J, q)
    for k in range(40):
        state = stages.update(state, Observation(k * PERIOD, q[k], y[k]), np.zeros(M))
    np.testing.assert_allclose(state.jacobian, TURN @ J, atol=0.03)
