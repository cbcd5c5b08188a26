"""Tests of the estimators: against each other, against batch facts, steps by hand, and all of them over lanes."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kit.toy import (
    KNOWLEDGE,
    PERIOD,
    Learning,
    M,
    N,
    jacobian_network,
    motion,
    only_jacobian,
    plant_spec,
)
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.constant import ConstantEstimator, TrueConfig, TrueEstimator
from servobench.controllers.estimators.estimator import Motion
from servobench.controllers.estimators.kalman import (
    KalmanConfig,
    RandomWalkEstimator,
    RlsConfig,
    RlsEstimator,
    UkfConfig,
    kalman_estimator,
    sigma_weights,
    split_update,
    ukf_estimator,
    unscented_update,
)
from servobench.controllers.estimators.projection import (
    BroydenConfig,
    CfdlConfig,
    ProjectionEstimator,
    projection_update,
)
from servobench.controllers.methods import ESTIMATORS
from servobench.plant.contract.faults import FilterDiverged


def covariance_of(state):
    """Return the covariance of vec(J) by rows, (mn, mn)."""
    return np.kron(np.eye(state.J.size // len(state.P)), state.P)


def kalman_update(J, P, joint_step, feature_step, *, r):
    """Correct vec(J) by one motion, as printed: K = P Hᵀ (H P Hᵀ + R)⁻¹, covariance in Joseph form."""
    *lead, m, n = J.shape
    x = J.reshape(*lead, m * n)
    blocks = np.eye(m)[..., None] * joint_step[..., None, None, :]
    H = blocks.reshape(*lead, m, m * n)
    R = r[..., None, None] * np.eye(m)
    HP = H @ P
    S = HP @ H.mT + R
    K = np.linalg.solve(S, HP).mT
    A = np.eye(m * n) - K @ H
    P = A @ P @ A.mT + K @ R @ K.mT
    nu = feature_step - np.matvec(H, x)
    x = x + np.matvec(K, nu)
    return x.reshape(J.shape), (P + P.mT) / 2


def forgetting_update(J, P, joint_step, feature_step, forgetting):
    """Correct by one motion with recursive least squares, after which P may be as large as it likes."""
    config = RlsConfig(memory=1.0, covariance_limit=1e12, min_joint_step=0.0)
    estimator = RlsEstimator(config)
    state = estimator.start(J)._replace(P=P)
    given = motion(joint_step, feature_step, duration=-np.log(forgetting))
    after = estimator.update(state, given)
    return after.J, after.P


def random_motions(n, m, count, seed=3):
    """Motions of an arm whose Jacobian walks, seen with 1 mm of noise."""
    rng = np.random.default_rng(seed)
    J = rng.normal(scale=0.4, size=(m, n))
    for _ in range(count):
        J = J + rng.normal(scale=0.01, size=(m, n))
        dq = rng.normal(scale=0.03, size=n)
        yield dq, J @ dq + rng.normal(scale=0.0014, size=m)


@pytest.mark.parametrize(
    ("estimator", "jacobian", "dq", "expected"),
    [
        # Δy − JΔq = 0.4 − 0.2 = 0.2, gain = 0.5 · (1, 1) / 2, and with μ = 2 it is 0.5 · (1, 1) / (2 + 2)
        (
            ProjectionEstimator(BroydenConfig(step_factor=0.5)),
            [[0.1, 0.1]],
            [1.0, 1.0],
            [[0.15, 0.15]],
        ),
        (
            ProjectionEstimator(CfdlConfig(step_factor=0.5, regularisation=2.0)),
            [[0.1, 0.1]],
            [1.0, 1.0],
            [[0.125, 0.125]],
        ),
        # P = 1/4, r = 2 · 1/8 = 1/4, Δq = (1, 0): S = 1/2, K = (1/2, 0), innovation 0.4 − 0.2 = 0.2
        (
            RandomWalkEstimator(KalmanConfig(0.5, 0.0, np.sqrt(0.125)), kalman_update, "full"),
            [[0.2, 0.3]],
            [1, 0],
            [[0.3, 0.3]],
        ),
        (
            kalman_estimator(KalmanConfig(0.5, 0.0, np.sqrt(0.125))),
            [[0.2, 0.3]],
            [1, 0],
            [[0.3, 0.3]],
        ),
        (
            ukf_estimator(UkfConfig(0.5, 0.0, np.sqrt(0.125), form="sigma_points")),
            [[0.2, 0.3]],
            [1, 0],
            [[0.3, 0.3]],
        ),
    ],
)
def test_the_first_step_equals_the_one_computed_by_hand(estimator, jacobian, dq, expected):
    run = Learning(estimator, np.array(jacobian))
    run.update(motion(dq, [0.4]))
    np.testing.assert_allclose(run.jacobian(), expected, atol=1e-15)
    if isinstance(estimator, RandomWalkEstimator):  # P → 1/8 and 1/4
        np.testing.assert_allclose(covariance_of(run.state), np.diag([0.125, 0.25]), atol=1e-15)


def test_the_first_step_of_least_squares_equals_the_one_computed_by_hand():
    # PΔq = (2, 2), K = (2, 2) / (0.5 + 4), misfit 0.2; P = (2I − (2, 2)(2, 2)ᵀ / 4.5) / 0.5
    J, P = forgetting_update(np.array([[0.1, 0.1]]), 2.0 * np.eye(2), [1.0, 1.0], [0.4], 0.5)
    np.testing.assert_allclose(J, [[0.1 + 0.4 / 4.5] * 2], atol=1e-15)
    np.testing.assert_allclose(P, 2.0 * (2.0 * np.eye(2) - 4.0 / 4.5), atol=1e-14)


@pytest.mark.parametrize(
    ("alpha", "beta", "kappa"), [(1.0, 2.0, 0.0), (1.0, 0.0, 2.0), (0.1, 2.0, 0.0)]
)
def test_the_unscented_filter_equals_the_kalman_filter_over_1000_random_steps(alpha, beta, kappa):
    n = 6
    m = 3
    rng = np.random.default_rng(5)
    A, B = (rng.normal(size=(n * m, n * m)) for _ in range(2))
    Q = 1e-6 * (A @ A.T)
    r = np.float64(4e-6)
    J = rng.normal(scale=0.4, size=(m, n))
    P = 1e-3 * (B @ B.T)
    J_kalman = J
    P_kalman = P
    config = UkfConfig(alpha=alpha, beta=beta, kappa=kappa)
    for dq, dy in random_motions(n, m, 1000):
        J, P = unscented_update(J, P + Q, dq, dy, r=r, config=config)
        J_kalman, P_kalman = kalman_update(J_kalman, P_kalman + Q, dq, dy, r=r)
        np.testing.assert_allclose(J, J_kalman, atol=1e-9)
        np.testing.assert_allclose(P, P_kalman, atol=1e-9)


@pytest.mark.parametrize(("n", "m"), [(2, 1), (6, 3), (8, 4)])
def test_the_split_forms_equal_the_full_ones(n, m):
    estimators = [
        RandomWalkEstimator(KalmanConfig(), kalman_update, "full"),
        kalman_estimator(KalmanConfig()),
        ukf_estimator(UkfConfig(form="sigma_points")),
        ukf_estimator(UkfConfig(form="split")),
    ]
    runs = [Learning(estimator, np.full((m, n), 0.1)) for estimator in estimators]
    for dq, dy in random_motions(n, m, 300):
        for run in runs:
            run.update(motion(dq, dy))
    for run in runs[1:]:
        np.testing.assert_allclose(run.jacobian(), runs[0].jacobian(), atol=1e-10)
        np.testing.assert_allclose(
            covariance_of(run.state), covariance_of(runs[0].state), atol=1e-12
        )
        assert run.diagnostics() == pytest.approx(runs[0].diagnostics())


def test_a_covariance_in_joseph_form_stays_positive_definite_under_tiny_noise():
    P = np.eye(6) * 1e4
    J = np.zeros((3, 6))
    rng = np.random.default_rng(8)
    for _ in range(2000):
        dq = rng.normal(size=6)
        J, P = split_update(J, P, dq, rng.normal(size=3), r=np.float64(1e-10))
        assert (P == P.T).all()
        assert np.linalg.eigvalsh(P).min() > 0.0


def test_the_weights_of_sigma_points_are_those_computed_by_hand():
    weights = sigma_weights(3, 0.5, 2.0, 1.0)  # spread 0.25 · (3 + 1) = 1
    assert weights.reach == 1.0
    assert weights.mean.tolist() == [-2.0, *[0.5] * 6]
    assert weights.covariance.tolist() == [-2.0 + 1.0 - 0.25 + 2.0, *[0.5] * 6]


def test_least_squares_forgets_by_the_time_of_a_motion():
    dq = np.array([0.1, -0.2])
    dy = np.array([0.3])
    estimator = RlsEstimator(RlsConfig(memory=2.0))
    begun = estimator.start(np.zeros((1, 2)))
    for duration in (0.1, 0.5):
        after = estimator.update(begun, motion(dq, dy, duration=duration))
        J, _ = split_update(begun.J, begun.P, dq, dy, r=np.exp(np.array(-duration / 2.0)))
        np.testing.assert_array_equal(after.J, J)


@given(seed=st.integers(0, 10**6), n=st.integers(1, 8), m=st.integers(1, 4))
def test_the_compact_form_without_regularisation_is_broydens_update(seed, n, m):
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(m, n))
    dq = rng.normal(scale=0.1, size=n)
    dy = rng.normal(scale=0.1, size=m)
    broyden = ProjectionEstimator(BroydenConfig(step_factor=1.0, min_joint_step=1e-9))
    compact = ProjectionEstimator(
        CfdlConfig(step_factor=1.0, regularisation=1e-300, min_joint_step=0.0, reset=False)
    )
    found, expected = (each.update(each.start(J), motion(dq, dy)).J for each in (compact, broyden))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(expected @ dq, dy, atol=1e-11)


def test_broydens_update_is_the_smallest_change_that_explains_the_motion():
    rng = np.random.default_rng(4)
    J = rng.normal(size=(3, 6))
    dq = rng.normal(size=6)
    dy = rng.normal(size=3)
    change = projection_update(J, dq, dy, step_factor=1.0, regularisation=0.0) - J
    smallest = np.linalg.lstsq(np.kron(np.eye(3), dq), dy - J @ dq, rcond=None)[0].reshape(3, 6)
    np.testing.assert_allclose(change, smallest, atol=1e-13)


@pytest.mark.parametrize("forgetting", [1.0, 0.9])
def test_recursive_least_squares_equals_weighted_batch_least_squares(forgetting):
    rng = np.random.default_rng(6)
    n = 6
    m = 3
    count = 40
    J0 = rng.normal(size=(m, n))
    P0 = np.diag(rng.uniform(1.0, 5.0, n))
    DQ = rng.normal(size=(count, n))
    DY = rng.normal(size=(count, m))
    J = J0
    P = P0
    for dq, dy in zip(DQ, DY, strict=True):
        J, P = forgetting_update(J, P, dq, dy, forgetting)
    weights = np.sqrt(forgetting ** np.arange(count - 1, -1, -1))[:, None]
    prior = np.sqrt(forgetting**count) * np.diag(1 / np.sqrt(np.diag(P0)))
    A = np.vstack([weights * DQ, prior])
    B = np.vstack([weights * DY, prior @ J0.T])
    np.testing.assert_allclose(J, np.linalg.lstsq(A, B, rcond=None)[0].T, atol=1e-10)
    np.testing.assert_allclose(P, np.linalg.inv(A.T @ A), rtol=1e-9, atol=1e-12)


def test_forgetting_does_not_wind_up_while_one_joint_rests():
    run = Learning(RlsEstimator(RlsConfig()), np.zeros((1, 3)))
    config = RlsConfig()
    assert run.diagnostics()["covariance_mean"] == pytest.approx(config.initial_covariance)
    rng = np.random.default_rng(1)
    for _ in range(2000):
        dq = np.array([*rng.normal(scale=0.05, size=2), 0.0])
        run.update(motion(dq, [0.3 * dq[0]]))
        assert run.diagnostics()["covariance_mean"] <= config.covariance_limit * (1 + 1e-12)
    np.testing.assert_allclose(run.jacobian(), [[0.3, 0.0, 0.0]], atol=1e-3)


def test_the_constant_estimator_keeps_the_first_jacobian():
    J = np.arange(6.0).reshape(2, 3)
    run = Learning(ConstantEstimator(), J)
    run.update(motion(np.ones(3), np.ones(2)))
    np.testing.assert_array_equal(run.jacobian(np.ones(3)), J)


def test_the_true_estimator_answers_with_the_truth_where_the_arm_is():
    knowledge = RobotKnowledge(plant_spec(2, 1), 0, true_jacobian=lambda q: q[None, :] ** 2)
    estimator = TrueEstimator(TrueConfig(), knowledge)
    run = Learning(estimator, np.zeros((1, 2)))
    np.testing.assert_array_equal(run.jacobian(np.array([2.0, 3.0])), [[4.0, 9.0]])
    assert estimator.brings_model


def test_an_estimator_that_lacks_what_it_needs_is_refused():
    knowledge = RobotKnowledge(plant_spec(3, 2), 1)
    with pytest.raises(ValueError, match="true_jacobian must be known for the estimator 'true'"):
        TrueEstimator(TrueConfig(), knowledge)
    with pytest.raises(ValueError, match="covariance_limit must be at least initial_covariance"):
        RlsConfig(initial_covariance=2.0, covariance_limit=1.0)


@pytest.mark.parametrize(
    ("settings", "size", "expected"),
    [
        ({"reset_norm": 0.01}, 0.011, 0.011),
        ({"reset_norm": 0.01}, 0.009, 0.5),
        ({}, -0.5, 0.5),
        ({"reset": False}, -0.5, -0.5),
    ],
)
def test_the_compact_form_returns_to_its_start_when_it_vanishes_or_its_sign_is_lost(
    settings, size, expected
):
    estimator = ProjectionEstimator(CfdlConfig(step_factor=1.0, regularisation=1e-12, **settings))
    run = Learning(estimator, np.array([[0.5]]))
    run.update(motion([0.1], [0.1 * size]))
    assert run.diagnostics()["jacobian_resets"] == float(expected == 0.5)
    np.testing.assert_allclose(run.jacobian(), [[expected]], atol=1e-9)


NETWORK = jacobian_network(N, M, units=5)
KNOWING = dataclasses.replace(KNOWLEDGE, true_jacobian=NETWORK.jacobian)
SETTINGS = [
    *((name, {}) for name in ESTIMATORS),
    ("ukf", {"form": "sigma_points"}),
    ("rbf", {"window": 1}),
]


def made(name, changes):
    part = ESTIMATORS[name]
    return part.make(
        part.config(**changes), KNOWING, *([only_jacobian(NETWORK)] if part.trained else [])
    )


@pytest.mark.parametrize(
    ("name", "changes"), SETTINGS, ids=lambda part: part if isinstance(part, str) else ""
)
def test_at_the_start_each_lane_tells_its_own_numbers(name, changes):
    estimator = made(name, changes)
    for lead in ((), (3,), (2, 3)):
        J = np.ones((*lead, M, N))
        state = estimator.start(J)
        assert {np.shape(value) for value in estimator.diagnostics(state).values()} <= {lead}
        assert estimator.jacobian(state, np.zeros((*lead, N))).shape == J.shape


@pytest.mark.parametrize("name", ["kalman", "ukf", "mckf", "rls", "cfdl", "broyden"])
def test_a_motion_of_the_least_length_counts_and_a_smaller_one_does_not(name):
    estimator = made(name, {"min_joint_step": 0.25})
    for length, counts in ((0.25, True), (0.2499, False)):
        state = estimator.start(np.ones((M, N)))
        way = Motion(
            np.zeros(N), length * np.eye(N)[1], np.full(M, 0.1), np.zeros(M), np.asarray(PERIOD)[()]
        )
        after = estimator.update(state, way)
        assert bool(estimator.diagnostics(after)["estimator_updated"]) == counts
        assert counts != (after.J == state.J).all()


FILTERS = [each for each in SETTINGS if hasattr(made(*each).start(np.ones((M, N))), "P")]


@pytest.mark.parametrize(
    ("name", "changes"), FILTERS, ids=lambda part: part if isinstance(part, str) else ""
)
@pytest.mark.parametrize("factor", [-1.0, np.nan])
def test_a_covariance_that_is_not_positive_definite_is_a_named_fault(name, changes, factor):
    estimator = made(name, changes)
    state = estimator.start(np.ones((M, N)))
    way = Motion(np.zeros(N), np.full(N, 0.3), np.zeros(M), np.zeros(M), np.asarray(PERIOD)[()])
    with pytest.raises(FilterDiverged, match="covariance is not"), np.errstate(invalid="ignore"):
        estimator.update(state._replace(P=factor * state.P), way)


def test_estimators_say_which_of_them_bring_a_model():
    assert {name for name in ESTIMATORS if made(name, {}).brings_model} == {
        "true",
        "rbf",
        "rbf_lyapunov",
    }
