"""Tests of the estimate stage: what the estimator learns from and what Ĵ is made of, under each `aids.model`."""

import dataclasses

import numpy as np
import pytest

from kit.toy import (
    KNOWLEDGE,
    NETWORK,
    PERIOD,
    TURN,
    M,
    N,
    Recorded,
    Recorder,
    late_features,
    path,
    plant_spec,
)
from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import Delays, RobotKnowledge
from servobench.controllers.estimators.projection import BroydenConfig, ProjectionEstimator
from servobench.controllers.stages.estimation import Estimation
from servobench.plant.contract.signals import Observation

NONE = Delays(0.0, 0.0, 0.0)
MODELLED = dataclasses.replace(KNOWLEDGE, nominal_jacobian=NETWORK.jacobian)


def curved(q):
    """The nominal Jacobian of an arm of two joints and one feature."""
    q = np.asarray(q)
    return np.stack([1.0 + q[..., 0], np.full(q.shape[:-1], 0.5)], axis=-1)[..., None, :]


def two_joints():
    return RobotKnowledge(plant_spec(2, 1), 0, nominal_jacobian=curved)


def two_steps(model, **aids):
    """Return stages and state after q = 0 to (0.1, 0.2), in which the feature moved by 0.4; Ĵ₀ = (1.2, 0.5)."""
    broyden = ProjectionEstimator(BroydenConfig(step_factor=0.5))
    stages = Estimation(broyden, two_joints(), AidsConfig(model=model, **aids), NONE)
    looks = [Observation(0.0, [0.0, 0.0], [0.0]), Observation(PERIOD, [0.1, 0.2], [0.4])]
    state = stages.start(looks[0], np.array([[1.2, 0.5]]))
    for look in looks:
        state = stages.update(state, look, np.zeros(1))
    assert stages.diagnostics(state)["jacobian_prediction_error"] == pytest.approx(0.4 - 0.12 - 0.1)
    return stages, state


def test_its_own_jacobian_by_hand():
    # Δy − Ĵ₀Δq = 0.4 − 0.22 = 0.18, ‖Δq‖² = 0.05: Ĵ = Ĵ₀ + 0.5 · 0.18 / 0.05 · (0.1, 0.2)
    np.testing.assert_allclose(two_steps("own")[1].jacobian, [[1.2 + 0.18, 0.5 + 0.36]])


@pytest.mark.parametrize("model", ["nominal", "regression"])
def test_the_deviation_from_a_model_by_hand(model):
    # x = (J_n(0) + J_n(q))/2 Δq = 0.205, E₀ = Ĵ₀ − J_n(0) = (0.2, 0); Δy − x − E₀Δq = 0.4 − 0.205 − 0.02 = 0.175
    E = np.array([[0.2 + 0.175, 0.35]])
    stages, state = two_steps(model)
    B = curved([0.1, 0.2])  # which the regression first changes after this motion
    if model == "regression":
        B = stages.pairing.regression.jacobian(
            state.learned.pair.regression, np.array([0.1, 0.2]), B
        )
        assert B[0, 0] > 1.2
    np.testing.assert_allclose(state.learned.estimator.J, E)
    np.testing.assert_allclose(state.jacobian, B + E)
    np.testing.assert_allclose(stages.ahead(state, np.array([0.1, 0.2]))[0], B + E)


class Modelled(Recorder):
    """An estimator that brings the model E(q) = q₀ J, and learns nothing."""

    brings_model = True

    def jacobian(self, state, joint_position):
        return np.asarray(joint_position)[..., :1, None] * state.J


def test_a_model_that_an_estimator_brings_counts_as_a_deviation_from_how_it_began():
    """E₀ is that of Ĵ₀ = 0, so that E = q₀ J at first: Ĵ = B + E − E₀, and E learns from Δy − B Δq + E₀ Δq."""
    q = np.array([0.3, 0.1])
    dq = np.array([0.1, 0.2])

    class Started(Modelled):
        def start(self, jacobian):
            return Recorded(np.array([[2.0, 1.0]]))

    estimator = Started()
    stages = Estimation(estimator, two_joints(), AidsConfig(model="nominal"), NONE)
    state = stages.start(Observation(0.0, q, [0.0]), np.array([[1.2, 0.5]]))
    state = stages.update(state, Observation(0.0, q, [0.0]), np.zeros(1))
    np.testing.assert_allclose(state.jacobian, curved(q))
    state = stages.update(state, Observation(PERIOD, q + dq, [0.4]), np.zeros(1))
    x = 1.35 * 0.1 + 0.5 * 0.2
    E0 = 0.3 * (2.0 * 0.1 + 1.0 * 0.2)
    np.testing.assert_allclose(estimator.motions[0].feature_step, [0.4 - x + E0])
    own = Estimation(Started(), two_joints(), AidsConfig(noise="identified"), NONE)
    begun = own.start(Observation(0.0, q, [0.0]), np.zeros((1, 2)))
    np.testing.assert_allclose(begun.learned.pair.base, 0.3 * np.array([[2.0, 1.0]]))


def test_with_the_filter_the_estimator_gets_motions_without_the_noise_of_frames():
    q = path(0.6)
    recorder = Recorder()
    y = late_features(q, np.eye(M)) + 0.01 * np.random.default_rng(3).normal(size=(len(q), M))
    states, _ = follow(recorder, q, y, filter=True, feature_noise=0.01)
    e = np.array([state.learned.pair.regression.mean[:, -1] for state in states])
    assert np.abs(e[1:]).min(axis=1).all()
    np.testing.assert_allclose(
        [each.feature_step for each in recorder.motions], np.diff(y - e, axis=0), atol=1e-12
    )


@pytest.mark.parametrize("model", ["own", "regression"])
def test_what_an_estimator_learned_from_false_frames_is_taken_back_with_them(model):
    """Once the next true frame is seen, it has learned from the motion over both as if they had been lost."""
    q = path(2)
    found = []
    y = late_features(q, np.eye(M))
    valid = np.full(len(q), True)
    valid[[20, 29, 30]] = False
    for false in (0.0, 0.3):
        shown = y + np.where(valid, 0.0, false)[:, None]
        stages = Estimation(
            ProjectionEstimator(BroydenConfig()),
            MODELLED,
            AidsConfig(model=model, filter=True, feature_noise=5e-4),
            NONE,
        )
        state = stages.start(Observation(0.0, q[0], y[0]), np.full((M, N), 0.1))
        for k in range(len(q)):
            seen = valid[k] if false == 0.0 else True
            state = stages.update(state, Observation(k * PERIOD, q[k], shown[k], seen), np.zeros(M))
        found.append((state.learned.estimator.J, state.jacobian))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9, atol=1e-12)
    assert np.linalg.norm(found[0][0]) > 0.1


def follow(estimator, q, y, knowledge=MODELLED, **aids):
    """Return the states after each period, and the stages."""
    stages = Estimation(estimator, knowledge, AidsConfig(**aids), NONE)
    state = stages.start(Observation(0.0, q[0], y[0]), knowledge.nominal_jacobian(q[0]))
    states = []
    for k in range(len(q)):
        state = stages.update(
            state, Observation(k * knowledge.spec.period, q[k], y[k]), np.zeros(M)
        )
        states.append(state)
    return states, stages


@pytest.mark.parametrize("model", ["nominal", "regression"])
@pytest.mark.parametrize("delay", ["given", "identified"])
def test_beside_an_exact_model_the_deviation_learns_nothing(model, delay):
    q = path(3)
    states, _ = follow(
        ProjectionEstimator(BroydenConfig()),
        q,
        late_features(q, np.eye(M)),
        model=model,
        delay=delay,
    )
    for k, state in enumerate(states):
        np.testing.assert_allclose(state.learned.estimator.J, 0.0, atol=1e-12)
        np.testing.assert_allclose(state.jacobian, NETWORK.jacobian(q[k]), atol=1e-12)
    own, _ = follow(
        ProjectionEstimator(BroydenConfig()), q, late_features(q, np.eye(M)), delay=delay
    )
    assert np.linalg.norm(own[-1].jacobian - NETWORK.jacobian(q[-1])) > 0.05


@pytest.mark.parametrize("aids", [{}, {"delay": "given"}], ids=["as read", "paired"])
@pytest.mark.parametrize(
    ("period", "count"), [(0.1, 1), (0.05, 1), (0.02, 2), (0.008, 6), (0.004, 12)]
)
def test_as_much_is_learned_in_a_second_at_every_rate(period, count, aids):
    knowledge = dataclasses.replace(
        MODELLED, spec=dataclasses.replace(KNOWLEDGE.spec, period=period)
    )
    t = period * np.arange(round(2.0 / period))
    q = np.outer(t, np.arange(1.0, N + 1.0))
    recorder = Recorder()
    follow(recorder, q, 0.1 * q[:, :M], knowledge, **aids)
    assert len(recorder.motions) == (len(t) - 1) // count
    for motion in recorder.motions:
        assert motion.duration == pytest.approx(count * period)
        np.testing.assert_allclose(
            motion.joint_step, count * period * np.arange(1.0, N + 1.0), rtol=1e-9
        )


def test_a_motion_is_paired_with_that_of_the_joints_when_its_frames_were_exposed():
    q = path(1.5)
    recorder = Recorder()
    stages = Estimation(
        recorder, MODELLED, AidsConfig(delay="given", noise="identified"), Delays(0.15, 0.0, 0.0)
    )
    state = stages.start(Observation(0.0, q[0], np.zeros(M)), NETWORK.jacobian(q[0]))
    for k in range(30):
        state = stages.update(
            state, Observation(k * PERIOD, q[k], 0.01 * k * np.ones(M)), np.full(M, 1.0)
        )
    for k, motion in enumerate(recorder.motions, start=1):
        np.testing.assert_array_equal(motion.joint_position, q[max(k - 4, 0)])
        np.testing.assert_allclose(
            motion.joint_step, q[max(k - 3, 0)] - q[max(k - 4, 0)], atol=1e-15
        )
        np.testing.assert_allclose(motion.error, 1.0 - 0.01 * k)
        assert motion.noise > 0.0
    assert len(recorder.motions) == 29


def test_without_a_nominal_model_the_first_jacobian_stands_for_it():
    q = path(2)
    J = NETWORK.jacobian(q[0])
    unknown = dataclasses.replace(MODELLED, nominal_jacobian=None)
    stages = Estimation(
        ProjectionEstimator(BroydenConfig()), unknown, AidsConfig(model="regression"), NONE
    )
    state = stages.start(Observation(0.0, q[0], np.zeros(M)), J)
    y = np.matvec(TURN @ J, q)
    for k in range(40):
        state = stages.update(state, Observation(k * PERIOD, q[k], y[k]), np.zeros(M))
    np.testing.assert_allclose(state.jacobian, TURN @ J, atol=0.08)
