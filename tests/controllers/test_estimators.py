"""Tests of the Kalman-like estimators: filters against each other, against batch facts, and steps by hand."""

import numpy as np
import pytest

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.constant import ConstantEstimator
from servobench.controllers.estimators.estimator import Motion
from servobench.controllers.estimators.kalman import (
    KalmanConfig,
    KalmanEstimator,
    kalman_update,
    measurement_matrix,
    split_update,
)
from servobench.controllers.estimators.true import TrueConfig, TrueEstimator
from servobench.controllers.estimators.ukf import UkfConfig, UkfEstimator, sigma_weights, unscented_update
from servobench.plant.faults import FilterDiverged
from servobench.plant.signals import PlantSpec

SIZES = [(2, 1), (6, 3), (8, 4)]


def motion(dq, dy, e=None):
    dq, dy = np.asarray(dq, dtype=float), np.asarray(dy, dtype=float)
    return Motion(np.zeros(dq.size), dq, dy, np.zeros(dy.size) if e is None else e, 0.05)


def random_motions(n, m, count, seed=3):
    """Motions of an arm whose Jacobian walks, seen with 1 mm of noise."""
    rng = np.random.default_rng(seed)
    J = rng.normal(scale=0.4, size=(m, n))
    for _ in range(count):
        J = J + rng.normal(scale=0.01, size=(m, n))
        dq = rng.normal(scale=0.03, size=n)
        yield dq, J @ dq + rng.normal(scale=0.0014, size=m)


@pytest.mark.parametrize(("alpha", "beta", "kappa"), [(1.0, 2.0, 0.0), (1.0, 0.0, 2.0), (0.1, 2.0, 0.0)])
def test_the_unscented_filter_equals_the_kalman_filter_over_1000_random_steps(alpha, beta, kappa):
    n, m = 6, 3
    rng = np.random.default_rng(5)
    A, B, C = (rng.normal(size=(s, s)) for s in (n * m, n * m, m))
    Q, R = 1e-6 * (A @ A.T), 1e-6 * (C @ C.T + np.eye(m))
    J = rng.normal(scale=0.4, size=(m, n))
    P = 1e-3 * (B @ B.T)
    x, P_kalman = J.ravel(), P
    weights = sigma_weights(n * m, alpha, beta, kappa)
    for dq, dy in random_motions(n, m, 1000):
        J, P = unscented_update(J, P, dq, dy, Q=Q, R=R, weights=weights)
        x, P_kalman = kalman_update(x, P_kalman, measurement_matrix(dq, m), dy, Q=Q, R=R)
        np.testing.assert_allclose(J.ravel(), x, atol=1e-9)
        np.testing.assert_allclose(P, P_kalman, atol=1e-9)


@pytest.mark.parametrize(("n", "m"), SIZES)
def test_the_split_forms_equal_the_full_ones(n, m):
    estimators = [
        KalmanEstimator(KalmanConfig(form="full")),
        KalmanEstimator(KalmanConfig(form="split")),
        UkfEstimator(UkfConfig(form="sigma_points")),
        UkfEstimator(UkfConfig(form="split")),
    ]
    for estimator in estimators:
        estimator.reset(np.full((m, n), 0.1))
    for dq, dy in random_motions(n, m, 300):
        for estimator in estimators:
            estimator.update(motion(dq, dy))
    for estimator in estimators[1:]:
        np.testing.assert_allclose(estimator.jacobian(dq), estimators[0].jacobian(dq), atol=1e-10)
        np.testing.assert_allclose(estimator.covariance(), estimators[0].covariance(), atol=1e-12)
        assert estimator.diagnostics() == pytest.approx(estimators[0].diagnostics())


@pytest.mark.parametrize("estimator", [KalmanEstimator(KalmanConfig()), UkfEstimator(UkfConfig())])
def test_a_constant_jacobian_is_found_when_all_joints_move(estimator):
    rng = np.random.default_rng(0)
    J = rng.normal(size=(3, 6))
    estimator.reset(np.zeros((3, 6)))
    for _ in range(200):
        dq = rng.normal(scale=0.05, size=6)
        estimator.update(motion(dq, J @ dq))
    np.testing.assert_allclose(estimator.jacobian(dq), J, atol=0.01)


def test_joseph_form_keeps_the_covariance_positive_definite_under_nearly_exact_measurements():
    P, J = np.eye(6) * 1e4, np.zeros((3, 6))
    rng = np.random.default_rng(8)
    for _ in range(2000):
        dq = rng.normal(size=6)
        J, P = split_update(J, P, dq, rng.normal(size=3), q=0.0, r=1e-10)
        assert (P == P.T).all()
        assert np.linalg.eigvalsh(P).min() > 0.0


@pytest.mark.parametrize(
    "estimator",
    [
        KalmanEstimator(KalmanConfig(0.5, 0.0, np.sqrt(0.5) / 2, form="full")),
        KalmanEstimator(KalmanConfig(0.5, 0.0, np.sqrt(0.5) / 2, form="split")),
        UkfEstimator(UkfConfig(0.5, 0.0, np.sqrt(0.5) / 2)),
    ],
)
def test_the_first_step_equals_the_one_computed_by_hand(estimator):
    # P = 1/4, r = 2 · 1/8 = 1/4, Δq = (1, 0): S = 1/2, K = (1/2, 0), innovation 0.4 − 0.2 = 0.2, P → 1/8 and 1/4
    estimator.reset(np.array([[0.2, 0.3]]))
    estimator.update(motion([1.0, 0.0], [0.4]))
    np.testing.assert_allclose(estimator.jacobian(np.zeros(2)), [[0.3, 0.3]], atol=1e-15)
    np.testing.assert_allclose(estimator.covariance(), np.diag([0.125, 0.25]), atol=1e-15)


@pytest.mark.parametrize("estimator", [KalmanEstimator(KalmanConfig()), UkfEstimator(UkfConfig())])
def test_a_motion_too_small_to_tell_anything_is_left_out(estimator):
    estimator.reset(np.ones((3, 6)))
    before = estimator.covariance()
    estimator.update(motion(np.full(6, 1e-4), np.full(3, 0.002)))
    np.testing.assert_array_equal(estimator.jacobian(np.zeros(6)), np.ones((3, 6)))
    np.testing.assert_array_equal(estimator.covariance(), before)
    assert estimator.diagnostics()["estimator_updated"] == 0.0


def test_sigma_points_have_the_mean_and_covariance_of_the_state():
    weights = sigma_weights(4, 0.5, 2.0, 1.0)
    points = np.vstack([np.zeros(4), weights.reach * np.eye(4), -weights.reach * np.eye(4)])
    assert weights.mean.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(points.T @ np.diag(weights.covariance) @ points, np.eye(4), atol=1e-14)


@pytest.mark.parametrize("P", [np.diag([1.0, -1.0]), np.diag([1.0, np.nan])])
def test_a_covariance_that_is_not_positive_definite_is_a_named_fault(P):
    with pytest.raises(FilterDiverged, match="covariance is not"):
        unscented_update(
            np.zeros((1, 2)),
            P,
            np.ones(2),
            np.ones(1),
            Q=np.zeros((2, 2)),
            R=np.eye(1),
            weights=sigma_weights(2, 1.0, 2.0, 0.0),
        )


def test_the_constant_estimator_keeps_the_first_jacobian():
    estimator, J = ConstantEstimator(), np.arange(6.0).reshape(2, 3)
    estimator.reset(J)
    estimator.update(motion(np.ones(3), np.ones(2)))
    np.testing.assert_array_equal(estimator.jacobian(np.ones(3)), J)


def test_the_true_estimator_answers_with_the_truth_where_the_arm_is():
    spec = PlantSpec.of_joints(("a", "b"), ("y",), np.ones(2), -np.ones(2), np.ones(2), 0.05)
    estimator = TrueEstimator(TrueConfig(), RobotKnowledge(spec, 0, true_jacobian=lambda q: q[None, :] ** 2))
    estimator.reset(np.zeros((1, 2)))
    np.testing.assert_array_equal(estimator.jacobian(np.array([2.0, 3.0])), [[4.0, 9.0]])
    with pytest.raises(ValueError, match="true_jacobian must be known"):
        TrueEstimator(TrueConfig(), RobotKnowledge(spec, 0))


@pytest.mark.parametrize("config", [KalmanConfig, UkfConfig])
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("initial_deviation", 0.0),
        ("process_deviation", -1.0),
        ("feature_noise", 0.0),
        ("min_joint_step", -0.1),
        ("form", "cubature"),
    ],
)
def test_a_filter_setting_out_of_bounds_is_named(config, name, value):
    with pytest.raises(ValueError, match=name):
        config(**{name: value})


@pytest.mark.parametrize(("name", "value"), [("alpha", 0.0), ("beta", -1.0), ("kappa", -1.0)])
def test_a_sigma_point_setting_out_of_bounds_is_named(name, value):
    with pytest.raises(ValueError, match=name):
        UkfConfig(**{name: value})
