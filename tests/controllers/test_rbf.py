"""Tests of the network estimators: automatic differentiation, plain loops, hand arithmetic and the Lyapunov proofs."""

from dataclasses import replace

import casadi
import numpy as np
import pytest

from kit.toy import KNOWLEDGE, Learning, jacobian_features, motion, only_jacobian
from kit.toy import jacobian_network as network
from servobench.controllers.estimators.rbf import (
    RbfConfig,
    RbfEstimator,
    RbfLyapunovConfig,
    RbfLyapunovEstimator,
    window_step,
)
from servobench.controllers.networks.rbf import JacobianNetwork


def started(config, net):
    return Learning(RbfEstimator(config, KNOWLEDGE, only_jacobian(net)), np.zeros((net.m, net.n)))


def window(net, count, seed=1):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, net.n))
    dq = rng.normal(size=(count, net.n))
    dy = rng.normal(size=(count, net.m))
    return jacobian_features(q, net.centres, net.widths), net.features(q), dq, dy


def step_of(theta, dq, k2, epsilon):
    """Return α₂ of a full window."""
    return window_step((theta**2).sum(axis=2), dq, len(dq), k2, epsilon)


def test_the_gradient_is_that_of_automatic_differentiation():
    net = network()
    theta, layers, dq, dy = window(net, 5)
    n, m, units = net.weights.shape
    W = casadi.SX.sym("W", n * m * units)
    Q = 0
    for t in range(5):
        predicted = sum(
            casadi.reshape(W[i * m * units : (i + 1) * m * units], units, m).T
            @ casadi.DM(theta[t, i])
            * dq[t, i]
            for i in range(n)
        )
        Q += casadi.sumsqr(casadi.DM(dy[t]) - predicted)
    expected = casadi.Function("g", [W], [casadi.gradient(Q, W)])(net.weights.ravel())
    errors = dy - np.matvec(net.output(net.rows, layers), dq)
    gradient = net.gradient(errors, dq, layers)
    np.testing.assert_allclose(
        -2.0 * gradient.swapaxes(0, 1), np.asarray(expected).reshape(n, m, units), atol=1e-12
    )


def test_the_first_update_equals_the_one_computed_by_hand():
    net = JacobianNetwork(np.zeros((1, 1, 1)), np.ones((1, 1)), np.full((1, 1, 1), 2.0))
    estimator = started(RbfConfig(window=4, k2=0.5, epsilon=0.01), net)
    # θ(0) = 1, Ĵ = 2, error 0.5 − 2 · 0.1 = 0.3, α₂ = 0.5 / (0.01 + 0.01) = 25, W = 2 + 25 · 0.3 · 0.1
    estimator.update(motion([0.1], [0.5]))
    np.testing.assert_allclose(estimator.state.rows, [[[2.75]]], atol=1e-14)
    np.testing.assert_allclose(estimator.jacobian(np.zeros(1)), [[2.75]], atol=1e-14)
    assert estimator.diagnostics()["estimator_step_size"] == pytest.approx(25.0)
    assert estimator.diagnostics()["window_error"] == pytest.approx(0.3)


def test_epsilon_grows_with_the_square_of_the_noise_that_is_known():
    net = JacobianNetwork(np.zeros((1, 1, 1)), np.ones((1, 1)), np.full((1, 1, 1), 2.0))
    estimator = started(RbfConfig(window=4, k2=0.5, epsilon=0.01), net)
    # Twice the usual millimetre: α₂ = 0.5 / (4 · 0.01 + 0.01) = 10
    estimator.update(replace(motion([0.1], [0.5]), noise=np.asarray(0.002)))
    assert estimator.diagnostics()["estimator_step_size"] == pytest.approx(10.0)
    # Two motions of two joints: α₂ = 0.5 / (0.01 + 0.12 + 0.18 + 0.01 · 8 / 4)
    sizes = np.array([[1.0, 3.0], [2.0, 2.0]])
    steps = np.array([[0.1, 0.2], [0.3, 0.0]])
    assert window_step(sizes, steps, np.int_(2), 0.5, 0.01) == pytest.approx(0.5 / 0.33)


@pytest.mark.parametrize("k2", [0.1, 1.0, 1.9])
def test_the_weights_never_move_away_from_those_of_a_representable_jacobian(k2):
    true = network(seed=5)
    rng = np.random.default_rng(6)
    start = JacobianNetwork(
        true.centres, true.widths, true.weights + rng.normal(size=true.weights.shape)
    )
    estimator = started(RbfConfig(window=1, k2=k2, epsilon=0.0), start)
    V = np.sum((estimator.state.rows - true.rows) ** 2)
    first = V
    for _ in range(200):
        q = rng.normal(size=3)
        dq = rng.normal(size=3)
        estimator.update(motion(dq, true.jacobian(q) @ dq, q=q))
        V, before = np.sum((estimator.state.rows - true.rows) ** 2), V
        assert before * (1 + 1e-12) >= V
    assert first * 0.9 > V


def test_an_arm_at_rest_teaches_nothing_even_without_epsilon():
    estimator = started(RbfConfig(epsilon=0.0), network())
    estimator.update(motion(np.zeros(3), [1e-3, 0.0]))
    np.testing.assert_array_equal(estimator.state.rows, network().rows)


def test_only_the_last_motions_of_the_window_count():
    net = network()
    rng = np.random.default_rng(9)
    motions = [
        motion(rng.normal(size=3), rng.normal(size=2), q=rng.normal(size=3)) for _ in range(5)
    ]
    estimator = started(RbfConfig(window=2), net)
    for each in motions[:-1]:
        estimator.update(each)
    rows = estimator.state.rows
    estimator.update(motions[-1])
    names = "joint_position", "joint_step", "feature_step"
    q, dq, dy = (np.array([getattr(each, name) for each in motions[-2:]]) for name in names)
    gradient = net.gradient(dy - np.matvec(net.jacobian(q, rows), dq), dq, net.features(q))
    expected = (
        rows + step_of(jacobian_features(q, net.centres, net.widths), dq, 0.5, 1e-3) * gradient
    )
    np.testing.assert_allclose(estimator.state.rows, expected, atol=1e-13)


def test_what_was_learned_fades_by_its_leak_per_second():
    net = network()
    leak = 0.4
    keeping, fading = (started(RbfConfig(leak=each), net) for each in (0.0, leak))
    moved = motion([0.1, -0.2, 0.05], [0.01, 0.02])
    for estimator in (keeping, fading):
        estimator.update(moved)
    learned, kept = (each.state.rows - net.rows for each in (keeping, fading))
    np.testing.assert_allclose(
        kept, np.exp(-leak * moved.duration) * learned, rtol=1e-12, atol=1e-15
    )
    assert np.abs(learned).max() > 1e-4


def test_what_was_learned_is_the_jacobian_without_that_of_the_first_weights():
    net = network()
    run = started(RbfConfig(), net)
    first = run.state
    for q in np.random.default_rng(6).normal(size=(3, 3)):
        run.update(motion(q, [0.01, 0.02]))
        learned = run.estimator.deviation(run.state, first, q)
        expected = net.jacobian(q, run.state.rows) - net.jacobian(q, first.rows)
        np.testing.assert_allclose(learned, expected, rtol=1e-9, atol=1e-14)
        assert np.abs(learned).max() > 1e-6
        whole = run.estimator.deviation(run.state, None, q)
        np.testing.assert_array_equal(whole, net.jacobian(q, run.state.rows))


def test_a_kept_value_is_returned_only_for_the_same_position_and_weights():
    net = network()
    first, second = np.random.default_rng(5).normal(size=(2, 3))
    run = started(RbfConfig(), net)
    for q in (first, first, second, first):
        np.testing.assert_array_equal(run.estimator.features(q), net.features(q))
    q = first.copy()
    run.estimator.features(q)
    q[0] += 1.0
    np.testing.assert_array_equal(run.estimator.features(q), net.features(q))
    for rows in (net.rows, 2.0 * net.rows):
        state = run.state._replace(rows=rows)
        for q in (first, first, second, np.stack([first, second])):
            np.testing.assert_array_equal(run.estimator.jacobian(state, q), net.jacobian(q, rows))


def started_lyapunov(config, net):
    return Learning(
        RbfLyapunovEstimator(config, KNOWLEDGE, only_jacobian(net)), np.zeros((net.m, net.n))
    )


def test_the_first_lyapunov_update_equals_the_one_computed_by_hand():
    net = JacobianNetwork(np.zeros((1, 1, 1)), np.ones((1, 1)), np.full((1, 1, 1), 2.0))
    estimator = started_lyapunov(RbfLyapunovConfig(n2=0.5, n3=0.1), net)
    # s = (0.5 − 2 · 0.1) / 0.05 = 6, ΔW = 0.1 · (0.1 · 6 − 0.5 · 0.4) · θ(0) = 0.04
    estimator.update(motion([0.1], [0.5], np.array([0.4])))
    np.testing.assert_allclose(estimator.jacobian(np.zeros(1)), [[2.04]], atol=1e-14)
    assert estimator.diagnostics()["rate_error"] == pytest.approx(6.0)


def lyapunov_run(gain=4.0, dt=1e-3, steps=1500):
    """Return V and its predicted rate along u = K_p Ĵ⁺ e on the plant ẏ = J(q) q̇ whose J the network can represent."""
    true = network(seed=3)
    config = RbfLyapunovConfig(n2=0.5, n3=0.5)
    rng = np.random.default_rng(4)
    weights = true.weights + 0.2 * rng.normal(size=true.weights.shape)
    estimator = started_lyapunov(config, JacobianNetwork(true.centres, true.widths, weights))
    q = np.array([0.2, -0.1, 0.3])
    e = np.array([0.3, -0.2])
    V = []
    rate = []
    for _ in range(steps):
        J_hat = estimator.jacobian(q)
        J = true.jacobian(q)
        u = gain * np.linalg.pinv(J_hat) @ e
        s = J @ u - J_hat @ u
        V.append(0.5 * config.n2 * e @ e + 0.5 * np.sum((true.rows - estimator.state.rows) ** 2))
        rate.append(-gain * config.n2 * e @ e - config.n3 * s @ s)
        estimator.update(motion(u * dt, J @ u * dt, e, q, dt))
        q, e = q + u * dt, e - J @ u * dt
    return np.array(V), np.array(rate), e


def test_v_decreases_along_a_run_and_at_the_predicted_rate():
    V, rate, e = lyapunov_run()
    assert (np.diff(V) < 0.0).all()
    np.testing.assert_allclose(np.diff(V)[:50] / 1e-3, rate[:50], rtol=0.01)
    assert np.linalg.norm(e) < 0.05 * np.linalg.norm([0.3, -0.2])
