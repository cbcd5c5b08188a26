"""Tests of the estimators that correct by rank one: Broyden, recursive least squares, compact form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.controllers.estimators.broyden import BroydenConfig, BroydenEstimator, projection_update
from servobench.controllers.estimators.cfdl import CfdlConfig, CfdlEstimator
from servobench.controllers.estimators.estimator import Motion
from servobench.controllers.estimators.rls import RlsConfig, RlsEstimator, rls_update

ALL = [
    BroydenEstimator(BroydenConfig(step_factor=1.0)),
    RlsEstimator(RlsConfig()),
    CfdlEstimator(CfdlConfig(step_factor=1.0, regularisation=1e-6, reset=False)),
]


def motion(dq, dy):
    dq, dy = np.asarray(dq, dtype=float), np.asarray(dy, dtype=float)
    return Motion(np.zeros(dq.size), dq, dy, np.zeros(dy.size), 0.05)


def named(estimator):
    return type(estimator).__name__


@given(seed=st.integers(0, 10**6), n=st.integers(1, 8), m=st.integers(1, 4))
def test_the_compact_form_without_regularisation_is_broydens_update(seed, n, m):
    rng = np.random.default_rng(seed)
    J, dq, dy = rng.normal(size=(m, n)), rng.normal(scale=0.1, size=n), rng.normal(scale=0.1, size=m)
    broyden = BroydenEstimator(BroydenConfig(step_factor=1.0, min_joint_step=1e-9))
    compact = CfdlEstimator(CfdlConfig(step_factor=1.0, regularisation=1e-300, min_joint_step=0.0, reset=False))
    for estimator in (broyden, compact):
        estimator.reset(J)
        estimator.update(motion(dq, dy))
    np.testing.assert_allclose(compact.jacobian(dq), broyden.jacobian(dq), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(broyden.jacobian(dq) @ dq, dy, atol=1e-11)


def test_broydens_update_is_the_smallest_change_that_explains_the_motion():
    rng = np.random.default_rng(4)
    J, dq, dy = rng.normal(size=(3, 6)), rng.normal(size=6), rng.normal(size=3)
    change = projection_update(J, dq, dy, step_factor=1.0, regularisation=0.0) - J
    smallest = np.linalg.lstsq(np.kron(np.eye(3), dq), dy - J @ dq, rcond=None)[0].reshape(3, 6)
    np.testing.assert_allclose(change, smallest, atol=1e-13)


@pytest.mark.parametrize("forgetting", [1.0, 0.9])
def test_recursive_least_squares_equals_weighted_batch_least_squares(forgetting):
    rng = np.random.default_rng(6)
    n, m, count = 6, 3, 40
    J0, P0 = rng.normal(size=(m, n)), np.diag(rng.uniform(1.0, 5.0, n))
    DQ, DY = rng.normal(size=(count, n)), rng.normal(size=(count, m))
    J, P = J0, P0
    for dq, dy in zip(DQ, DY, strict=True):
        J, P = rls_update(J, P, dq, dy, forgetting=forgetting)
    weights = np.sqrt(forgetting ** np.arange(count - 1, -1, -1))[:, None]
    prior = np.sqrt(forgetting**count) * np.diag(1 / np.sqrt(np.diag(P0)))
    A, B = np.vstack([weights * DQ, prior]), np.vstack([weights * DY, prior @ J0.T])
    np.testing.assert_allclose(J, np.linalg.lstsq(A, B, rcond=None)[0].T, atol=1e-10)
    np.testing.assert_allclose(P, np.linalg.inv(A.T @ A), rtol=1e-9, atol=1e-12)


def test_forgetting_does_not_wind_up_while_one_joint_rests():
    estimator, config = RlsEstimator(RlsConfig()), RlsConfig()
    estimator.reset(np.zeros((1, 3)))
    rng = np.random.default_rng(1)
    for _ in range(2000):
        dq = np.array([*rng.normal(scale=0.05, size=2), 0.0])
        estimator.update(motion(dq, [0.3 * dq[0]]))
        assert estimator.diagnostics()["covariance_mean"] <= config.covariance_limit * (1 + 1e-12)
    np.testing.assert_allclose(estimator.jacobian(dq), [[0.3, 0.0, 0.0]], atol=1e-3)


@pytest.mark.parametrize("estimator", ALL, ids=named)
def test_a_constant_jacobian_is_found_when_all_joints_move(estimator):
    rng = np.random.default_rng(0)
    J = rng.normal(size=(3, 6))
    estimator.reset(np.zeros((3, 6)))
    for _ in range(400):
        dq = rng.normal(scale=0.05, size=6)
        estimator.update(motion(dq, J @ dq))
    np.testing.assert_allclose(estimator.jacobian(dq), J, atol=1e-3)


@pytest.mark.parametrize("estimator", ALL, ids=named)
def test_a_motion_too_small_to_tell_anything_is_left_out(estimator):
    estimator.reset(np.ones((3, 6)))
    estimator.update(motion(np.full(6, 1e-4), np.full(3, 0.002)))
    np.testing.assert_array_equal(estimator.jacobian(np.zeros(6)), np.ones((3, 6)))
    assert estimator.diagnostics()["estimator_updated"] == 0.0


def test_the_first_step_of_broyden_equals_the_one_computed_by_hand():
    # Δy − JΔq = 0.4 − 0.2 = 0.2, gain = 0.5 · (1, 1) / 2
    estimator = BroydenEstimator(BroydenConfig(step_factor=0.5))
    estimator.reset(np.array([[0.1, 0.1]]))
    estimator.update(motion([1.0, 1.0], [0.4]))
    np.testing.assert_allclose(estimator.jacobian(np.zeros(2)), [[0.15, 0.15]], atol=1e-15)


def test_the_first_step_of_the_compact_form_equals_the_one_computed_by_hand():
    # the same misfit, gain = 0.5 · (1, 1) / (2 + 2)
    estimator = CfdlEstimator(CfdlConfig(step_factor=0.5, regularisation=2.0))
    estimator.reset(np.array([[0.1, 0.1]]))
    estimator.update(motion([1.0, 1.0], [0.4]))
    np.testing.assert_allclose(estimator.jacobian(np.zeros(2)), [[0.125, 0.125]], atol=1e-15)


def test_the_first_step_of_least_squares_equals_the_one_computed_by_hand():
    # PΔq = (2, 2), K = (2, 2) / (0.5 + 4), misfit 0.2; P = (2I − (2, 2)(2, 2)ᵀ / 4.5) / 0.5
    J, P = rls_update(np.array([[0.1, 0.1]]), 2.0 * np.eye(2), np.ones(2), np.array([0.4]), forgetting=0.5)
    np.testing.assert_allclose(J, [[0.1 + 0.4 / 4.5] * 2], atol=1e-15)
    np.testing.assert_allclose(P, 2.0 * (2.0 * np.eye(2) - 4.0 / 4.5), atol=1e-14)


def test_the_compact_form_returns_to_its_start_when_its_sign_is_lost():
    for reset, expected in ((True, 0.5), (False, -0.5)):
        estimator = CfdlEstimator(CfdlConfig(step_factor=1.0, regularisation=1e-12, reset=reset))
        estimator.reset(np.array([[0.5]]))
        estimator.update(motion([0.1], [-0.05]))
        np.testing.assert_allclose(estimator.jacobian(np.zeros(1)), [[expected]], atol=1e-9)
        assert estimator.diagnostics()["jacobian_resets"] == float(reset)


@pytest.mark.parametrize(
    ("config", "name", "value"),
    [
        (BroydenConfig, "step_factor", 1.5),
        (BroydenConfig, "min_joint_step", 0.0),
        (CfdlConfig, "step_factor", 2.0),
        (CfdlConfig, "regularisation", 0.0),
        (CfdlConfig, "min_joint_step", -1.0),
        (CfdlConfig, "reset_norm", -1.0),
        (RlsConfig, "forgetting", 0.0),
        (RlsConfig, "forgetting", 1.01),
        (RlsConfig, "initial_covariance", 0.0),
        (RlsConfig, "covariance_limit", 1.0),
        (RlsConfig, "min_joint_step", float("nan")),
    ],
)
def test_a_setting_out_of_bounds_is_named(config, name, value):
    with pytest.raises(ValueError, match=name):
        config(**{name: value})
