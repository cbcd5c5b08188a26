"""Tests of the Lyapunov estimator: hand arithmetic, the decrease of V along runs, its reset and its refusals."""

import numpy as np
import pytest

from kit.toy import KNOWLEDGE, Learning, motion, only_jacobian
from kit.toy import jacobian_network as network
from servobench.controllers.estimators.rbf import RbfLyapunovConfig, RbfLyapunovEstimator
from servobench.controllers.networks.rbf import JacobianNetwork


def started(config, net):
    return Learning(RbfLyapunovEstimator(config, KNOWLEDGE, only_jacobian(net)), np.zeros((net.m, net.n)))


def test_the_first_update_equals_the_one_computed_by_hand():
    net = JacobianNetwork(np.zeros((1, 1, 1)), np.ones((1, 1)), np.full((1, 1, 1), 2.0))
    estimator = started(RbfLyapunovConfig(n2=0.5, n3=0.1), net)
    # s = (0.5 − 2 · 0.1) / 0.05 = 6, ΔW = 0.1 · (0.1 · 6 − 0.5 · 0.4) · θ(0) = 0.04
    estimator.update(motion([0.1], [0.5], np.array([0.4])))
    np.testing.assert_allclose(estimator.jacobian(np.zeros(1)), [[2.04]], atol=1e-14)
    assert estimator.diagnostics()["rate_error"] == pytest.approx(6.0)


def lyapunov_run(true, estimator, config, gain=4.0, dt=1e-3, steps=1500, sign=1.0):
    """Return V and its predicted rate along u = K_p Ĵ⁺ e on the plant ẏ = J(q) q̇ whose J the network can represent."""
    q, e, V, rate = np.array([0.2, -0.1, 0.3]), np.array([0.3, -0.2]), [], []
    for _ in range(steps):
        J_hat, J = estimator.jacobian(q), true.jacobian(q)
        u = gain * np.linalg.pinv(J_hat) @ e
        s = J @ u - J_hat @ u
        V.append(0.5 * config.n2 * e @ e + 0.5 * np.sum((true.rows - estimator.state.rows) ** 2))
        rate.append(-gain * config.n2 * e @ e - config.n3 * s @ s)
        estimator.update(motion(u * dt, J @ u * dt, sign * e, q, dt))
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
    estimator.update(motion(dq, net.jacobian(np.zeros(3)) @ dq))
    np.testing.assert_allclose(estimator.state.rows, net.rows, atol=1e-15)


def test_an_initial_jacobian_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"jacobian must have shape \(2, 3\)"):
        started(RbfLyapunovConfig(), network()).estimator.start(np.zeros((1, 3)))
