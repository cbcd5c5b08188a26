import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize

from servobench.controllers.laws.mpc.closed_form import (
    UnlimitedPlan,
    decay_shares,
    decay_targets,
    horizon_integrals,
    move_weights,
    preview_weights,
)

ALPHAS = (1.0, 1.0 - 1e-15, 1.0 - 1e-12, 1.0 - 1e-9, 1.0 - 1e-6, 0.999, 0.96, 0.95, 0.9, 0.5, 0.05)


def integral(function, horizon):
    return quad(function, 0.0, horizon, epsabs=0.0, epsrel=1e-13, limit=200)[0]


@pytest.mark.parametrize("alpha", ALPHAS)
@pytest.mark.parametrize("horizon", [1, 2, 10, 40])
def test_a_b_and_c_equal_quadrature(alpha, horizon):
    found = horizon_integrals(horizon, alpha, 0.1)
    assert found.a == pytest.approx(integral(lambda t: t**2 * alpha**t, horizon), rel=1e-10)
    assert found.b == pytest.approx(integral(lambda t: t * alpha**t, horizon), rel=1e-10)
    for rho in (1e-9, 1e-4, 0.01, 0.2, 5.0):
        found = horizon_integrals(horizon, alpha, rho)
        beta = np.exp(-rho)
        assert found.c == pytest.approx(integral(lambda t, beta=beta: t * (alpha * beta) ** t, horizon), rel=1e-10)


@pytest.mark.parametrize("horizon", [1, 3, 10, 100])
def test_the_limits_without_forgetting_and_decay_are_exact(horizon):
    found = horizon_integrals(horizon, 1.0, 0.0)
    assert found.a == pytest.approx(horizon**3 / 3, rel=1e-15)
    assert found.b == pytest.approx(horizon**2 / 2, rel=1e-15)
    assert found.c == found.b


def test_extreme_forgetting_stays_finite():
    found = horizon_integrals(40, 1e-300, 700.0)
    assert 0.0 < found.c < found.b < 1e-4
    assert not move_weights(40, 1e-300, 0.0).any()
    assert np.isfinite(preview_weights(40, 1e-300)).all()


@pytest.mark.parametrize("alpha", [1.0, 0.95, 0.3])
def test_preview_weights_integrate_a_broken_line_exactly(alpha):
    horizon = 6
    r = np.random.default_rng(0).normal(size=horizon + 1)
    r[0] = 0.0
    nodes = np.arange(horizon + 1)
    pieces = [
        quad(lambda t: t * alpha**t * np.interp(t, nodes, r), start, start + 1, epsabs=1e-14)[0] for start in nodes[:-1]
    ]
    assert preview_weights(horizon, alpha) @ r[1:] == pytest.approx(sum(pieces), abs=1e-12)
    # A unit ramp turns ∫ τ α^τ τ dτ into a.
    assert preview_weights(horizon, alpha) @ nodes[1:] == pytest.approx(
        horizon_integrals(horizon, alpha, 0.1).a, rel=1e-12
    )


def random_problem(seed, m=3, n=6):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(m, n)), rng.normal(size=m), rng.uniform(0.1, 1.0, n)


def constant_step(J, target, a, Q):
    return UnlimitedPlan.of_constant_step(a, 10, Q).minimise(J, target[None])[0][0]


def printed_equation_46(J, e, Q, abc):
    return np.linalg.pinv(abc.a * J + np.linalg.pinv(J.T) @ Q) @ ((abc.b - abc.c) * e)


@pytest.mark.parametrize("seed", range(5))
def test_equation_46_as_printed_is_the_minimiser_for_a_multiple_of_the_identity(seed):
    J, e, _ = random_problem(seed)
    abc = horizon_integrals(10, 0.9, 0.2)
    step = constant_step(J, (abc.b - abc.c) * e, abc.a, np.full(6, 0.7))
    np.testing.assert_allclose(printed_equation_46(J, e, 0.7 * np.eye(6), abc), step, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_equation_46_as_printed_is_another_step_for_other_weights(seed):
    J, e, Q = random_problem(seed)
    abc = horizon_integrals(2, 0.9, 0.2)
    step = constant_step(J, (abc.b - abc.c) * e, abc.a, Q)
    printed = printed_equation_46(J, e, np.diag(Q), abc)
    assert np.abs(printed - step).max() > 1e-4

    def criterion(dq):
        return 0.5 * abc.a * (J @ dq) @ (J @ dq) - (abc.b - abc.c) * e @ J @ dq + 0.5 * dq @ (Q * dq)

    assert criterion(step) < criterion(printed)


@pytest.mark.parametrize("seed", range(3))
def test_constant_step_minimises_the_integral_criterion(seed):
    J, e, Q = random_problem(seed, m=2, n=3)
    H, alpha, rho = 4, 0.8, 0.3
    abc = horizon_integrals(H, alpha, rho)
    step = constant_step(J, (abc.b - abc.c) * e, abc.a, Q)

    def criterion(dq):
        def miss(t):
            return alpha**t * np.sum((e * (1 - np.exp(-rho * t)) - t * J @ dq) ** 2)

        return 0.5 * integral(miss, H) + 0.5 * dq @ (Q * dq)

    found = minimize(criterion, np.zeros(3), method="BFGS", options={"gtol": 1e-7})
    np.testing.assert_allclose(step, found.x, atol=1e-6)


def test_constant_step_by_hand():
    # One joint, one feature, J = 2, target = 3, a = 4, Q = 2: (4·4 + 2) dq = 2·3, dq = 1/3.
    np.testing.assert_allclose(constant_step(np.array([[2.0]]), np.array([3.0]), 4.0, np.array([2.0])), [1 / 3])


def test_free_moves_satisfy_the_stationarity_of_their_criterion():
    J, e, Q = random_problem(1)
    targets = decay_targets(e, np.random.default_rng(0).normal(size=(5, 3)), decay_shares(5, 0.3))
    weights = move_weights(5, 0.9, 2.0)
    moves, travel = UnlimitedPlan.of_free_moves(weights, Q).minimise(J, targets)
    np.testing.assert_allclose(travel, np.cumsum(moves, axis=0), atol=1e-14)
    misses = targets - np.cumsum(moves, axis=0) @ J.T
    for s in range(5):
        gradient = -J.T @ (weights[s:, None] * misses[s:]).sum(axis=0) + Q * moves[s]
        np.testing.assert_allclose(gradient, 0.0, atol=1e-11)


def test_decay_targets_leave_the_share_beta_of_the_error():
    e = np.array([0.2, -0.1])
    reference_step = np.array([[0.01, 0.0], [0.02, 0.0]])
    left = e + reference_step - decay_targets(e, reference_step, decay_shares(2, 0.5))
    np.testing.assert_allclose(left, np.exp(-0.5 * np.array([[1.0], [2.0]])) * e, atol=1e-15)
