"""Tests of the Lyapunov estimator: hand arithmetic, the decrease of V along runs, its reset and its refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kit.toy import KNOWLEDGE, only_jacobian
from servobench.controllers.estimators.estimator import Motion
from servobench.controllers.estimators.rbf_lyapunov import RbfLyapunovConfig, RbfLyapunovEstimator
from servobench.controllers.networks.rbf import JacobianNetwork


def started(config, net):
    return RbfLyapunovEstimator(config, KNOWLEDGE, only_jacobian(net))


def network(n=3, m=2, units=4, seed=0):
    rng = np.random.default_rng(seed)
    return JacobianNetwork(
        rng.normal(size=(n, units, n)), rng.uniform(1.0, 2.0, (n, units)), rng.normal(size=(n, m, units))
    )


def test_the_first_update_equals_the_one_computed_by_hand():
    net = JacobianNetwork(np.zeros((1, 1, 1)), np.ones((1, 1)), np.full((1, 1, 1), 2.0))
    estimator = started(RbfLyapunovConfig(n2=0.5, n3=0.1), net)
    # s = (0.5 − 2 · 0.1) / 0.05 = 6, ΔW = 0.1 · (0.1 · 6 − 0.5 · 0.4) · θ(0) = 0.04
    estimator.update(Motion(np.zeros(1), np.array([0.1]), np.array([0.5]), np.array([0.4]), 0.05))
    np.testing.assert_allclose(estimator.jacobian(np.zeros(1)), [[2.04]], atol=1e-14)
    assert estimator.diagnostics()["rate_error"] == pytest.approx(6.0)


def lyapunov_run(true, estimator, config, gain=4.0, dt=1e-3, steps=1500, sign=1.0):
    """Return V and its predicted rate along u = K_p Ĵ⁺ e on the plant ẏ = J(q) q̇ whose J the network can represent."""
    q, e, V, rate = np.array([0.2, -0.1, 0.3]), np.array([0.3, -0.2]), [], []
    for _ in range(steps):
        J_hat, J = estimator.jacobian(q), true.jacobian(q)
        u = gain * np.linalg.pinv(J_hat) @ e
        s = J @ u - J_hat @ u
        V.append(0.5 * config.n2 * e @ e + 0.5 * np.sum((true.weights - estimator.weights) ** 2))
        rate.append(-gain * config.n2 * e @ e - config.n3 * s @ s)
        estimator.update(Motion(q, u * dt, J @ u * dt, sign * e, dt))
        q, e = q + u * dt, e - J @ u * dt
    return np.array(V), np.array(rate), e


def test_v_decreases_along_a_run_and_at_the_predicted_rate():
    true, config, dt = network(seed=3), RbfLyapunovConfig(n2=0.5, n3=0.5), 1e-3
    start = JacobianNetwork(
        true.centres, true.widths, true.weights + 0.2 * np.random.default_rng(4).normal(size=true.weights.shape)
    )
    V, rate, e = lyapunov_run(true, started(config, start), config, dt=dt)
    assert (np.diff(V) < 0.0).all()
    np.testing.assert_allclose(np.diff(V)[:50] / dt, rate[:50], rtol=0.01)
    assert np.linalg.norm(e) < 0.05 * np.linalg.norm([0.3, -0.2])


def test_with_the_paper_s_plus_sign_v_would_not_fall_at_that_rate():
    true, config = network(seed=3), RbfLyapunovConfig(n2=0.5, n3=0.5)
    start = JacobianNetwork(
        true.centres, true.widths, true.weights + 0.2 * np.random.default_rng(4).normal(size=true.weights.shape)
    )
    V, rate, _ = lyapunov_run(true, started(config, start), config, steps=50, sign=-1.0)
    assert np.max(np.abs(np.diff(V) / 1e-3 - rate[:-1]) / np.abs(rate[:-1])) > 0.05


def test_a_constant_error_and_an_exact_jacobian_at_the_target_teach_nothing():
    net, dq = network(), np.array([0.01, -0.02, 0.03])
    estimator = started(RbfLyapunovConfig(), net)
    q = np.zeros(3)
    estimator.update(Motion(q, dq, net.jacobian(q) @ dq, np.zeros(2), 0.05))
    np.testing.assert_allclose(estimator.weights, net.weights, atol=1e-15)


def test_reset_restores_the_offline_network():
    net = network()
    estimator = started(RbfLyapunovConfig(), net)
    estimator.update(Motion(np.zeros(3), np.ones(3), np.ones(2), np.ones(2), 0.05))
    assert not np.array_equal(estimator.weights, net.weights)
    estimator.reset(np.zeros((2, 3)))
    np.testing.assert_array_equal(estimator.weights, net.weights)
    assert estimator.diagnostics()["rate_error"] == 0.0


@settings(max_examples=30, deadline=None, derandomize=True)
@given(n=st.integers(2, 8), m=st.integers(1, 4), seed=st.integers(0, 10**6))
def test_the_jacobian_is_finite_for_any_sizes(n, m, seed):
    rng, estimator = (
        np.random.default_rng(seed),
        started(RbfLyapunovConfig(), network(n, m, seed=seed)),
    )
    for _ in range(12):
        dq, dy, e = 0.05 * rng.normal(size=n), 0.05 * rng.normal(size=m), rng.normal(size=m)
        estimator.update(Motion(rng.normal(size=n), dq, dy, e, 0.05))
    J = estimator.jacobian(rng.normal(size=n))
    assert J.shape == (m, n)
    assert np.isfinite(J).all()


def test_gains_that_are_not_positive_and_other_sizes_are_refused():
    with pytest.raises(ValueError, match="n2 must be above 0, got 0"):
        RbfLyapunovConfig(n2=0.0)
    with pytest.raises(ValueError, match="n3 must be above 0, got -1"):
        RbfLyapunovConfig(n3=-1.0)
    with pytest.raises(ValueError, match=r"jacobian must have shape \(2, 3\)"):
        started(RbfLyapunovConfig(), network()).reset(np.zeros((1, 3)))
