"""Tests of the proposed law: automatic differentiation, contraction, plain loops, a step by hand and refusals."""

import math
from dataclasses import replace
from itertools import pairwise, product

import casadi
import numpy as np
import pytest

from kit.toy import PERIOD, PREVIEW, Commanding, only_controller, plant_spec, seen
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.laws.law import Estimate
from servobench.controllers.laws.rbfnn import (
    RbfnnConfig,
    RbfnnLaw,
    RollOut,
    descent_direction,
    roll_out,
    update_share,
    update_step,
)
from servobench.controllers.networks.rbf import (
    ControllerNetwork,
    controller_output,
    information_vector,
)
from servobench.controllers.stages.finish import scale_to_limit

ONES = Estimate(np.ones((2, 3)))


def network(n=3, m=2, hidden=4, error_history=1, position_history=1, seed=0):
    """A network whose output stays near the newest joint position: ψ = [small, I, 0] plus small random weights."""
    rng = np.random.default_rng(seed)
    p = m * error_history + n * position_history
    centres = rng.normal(size=(hidden, p))
    widths = rng.uniform(2.0, 3.0, hidden)
    weights = 0.02 * rng.normal(size=(n, p, hidden))
    start = m * error_history
    weights[:, start : start + n, :] += np.eye(n)[:, :, None] / hidden
    return ControllerNetwork(centres, widths, weights, error_history, position_history)


def knowledge(n=3, m=2, limit=1e6, preview=PREVIEW):
    return RobotKnowledge(plant_spec(n, m, limit), preview)


def law(net, limit=1e6, preview=PREVIEW, **config):
    known = knowledge(net.n, net.m, limit, preview)
    made = RbfnnLaw(RbfnnConfig(**config), known, only_controller(net))
    return Commanding(made, seen(np.zeros(net.n), np.zeros(net.m)), known)


def case(net, seed=1, horizon=4, limit=1e6):
    """Return a random roll-out: Jacobian, histories, reference steps and what came out."""
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(net.m, net.n))
    history = (
        rng.normal(size=(net.error_history, net.m)),
        rng.normal(size=(net.position_history, net.n)),
    )
    steps = 0.1 * rng.normal(size=(horizon, net.m))
    ahead = roll_out(net, net.weights, J, history, steps, np.full(net.n, limit))
    return J, history, steps, ahead


@pytest.mark.parametrize(("error_history", "position_history"), [(1, 1), (2, 2), (3, 1), (1, 3)])
@pytest.mark.parametrize("limit", [1e6, 0.02])
@pytest.mark.parametrize("offset_free", [False, True])
def test_the_roll_out_equals_a_plain_loop(error_history, position_history, limit, offset_free):
    net = network(error_history=error_history, position_history=position_history)
    net = replace(net, offset_free=offset_free)
    J, (errors, positions), steps, ahead = case(net, limit=limit)
    e_list = list(errors)
    q_list = list(positions)
    wanted = []
    for t in range(4):
        xi = np.concatenate([*e_list[:error_history], *q_list[:position_history]])
        h = np.exp(-np.linalg.norm(xi - net.centres, axis=1) / net.widths**2)
        rest = np.concatenate([np.zeros(net.m * error_history), *q_list[:position_history]])
        h_rest = np.exp(-np.linalg.norm(rest - net.centres, axis=1) / net.widths**2)
        origin = (
            sum(net.weights[:, j] @ h_rest * rest[j] for j in range(len(xi)))
            if offset_free
            else q_list[0]
        )
        wanted.append(sum(net.weights[:, j] @ h * xi[j] for j in range(len(xi))) - origin)
        dq = scale_to_limit(wanted[t], np.full(net.n, limit))
        e_list, q_list = [e_list[0] + steps[t] - J @ dq, *e_list], [q_list[0] + dq, *q_list]
        np.testing.assert_allclose(ahead.errors[t], e_list[0], atol=1e-12)
        np.testing.assert_allclose(ahead.xi[t], xi, atol=1e-12)
        np.testing.assert_allclose(ahead.h[t], h, atol=1e-12)
    np.testing.assert_allclose(ahead.wanted, wanted[0], atol=1e-12)


def test_the_direction_is_the_automatic_derivative_of_each_term_through_its_own_step():
    net = network(error_history=2)
    J, (errors, _), steps, ahead = case(net)
    n, p, hidden = net.weights.shape
    W = casadi.SX.sym("W", n * p * hidden)
    criterion = 0
    before = np.vstack([errors[:1], ahead.errors[:-1]])
    for t in range(4):
        outer = casadi.DM(np.outer(ahead.xi[t], ahead.h[t]).ravel())
        q_cmd = casadi.vertcat(
            *[casadi.dot(W[i * p * hidden : (i + 1) * p * hidden], outer) for i in range(n)]
        )
        q = ahead.xi[t, net.m * 2 : net.m * 2 + n]
        e = casadi.DM(before[t] + steps[t]) - casadi.DM(J) @ (q_cmd - casadi.DM(q))
        criterion += 0.5 * casadi.sumsqr(e)
    function = casadi.Function("g", [W], [criterion, casadi.gradient(criterion, W)])
    value, gradient = function(net.weights.ravel())
    np.testing.assert_allclose(0.5 * np.sum(ahead.errors**2), float(value), rtol=1e-12)
    np.testing.assert_allclose(
        descent_direction(J, ahead).ravel(), -np.asarray(gradient)[:, 0], atol=1e-12
    )


@pytest.mark.parametrize("k", [0.1, 1.0, 1.7])
@pytest.mark.parametrize("row_space_only", [True, False])
def test_one_update_lowers_the_predicted_error_by_1_minus_k_along_itself(k, row_space_only):
    net = network()
    rng = np.random.default_rng(2)
    J = rng.normal(size=(2, 3))
    q = rng.normal(size=3)
    y = rng.normal(size=2)
    ref = rng.normal(size=2)
    made = law(net, horizon=1, k=k, epsilon=0.0, row_space_only=row_space_only)
    xi = information_vector((ref - y)[None], q[None])
    before = ref - y - J @ (net.command(xi) - q)
    u = made.command(Estimate(J), seen(q, y), np.tile(ref, (PREVIEW + 1, 1)))
    after = ref - y - J @ u * PERIOD
    assert after @ before / (before @ before) == pytest.approx(1.0 - k, abs=1e-10)
    assert made.diagnostics()["predicted_error"] == pytest.approx(np.linalg.norm(before))


def test_the_first_step_equals_the_one_computed_by_hand():
    # ξ = [e, q] = [0.4, 1], h = exp(−0) = 1 with the centre on ξ; ψ = [0.5, 1]: q_cmd = 1.2, e(k+1) = 0.4 − 2 · 0.2 = 0
    net = ControllerNetwork(np.array([[0.4, 1.0]]), np.ones(1), np.array([[[0.5], [1.0]]]), 1, 1)
    observation = seen([1.0], [0.0])
    reference = np.full((PREVIEW + 1, 1), 0.4)
    made = law(net, horizon=1, k=0.5, epsilon=0.0)
    u = made.command(Estimate(np.array([[2.0]])), observation, reference)
    np.testing.assert_allclose(u, [0.2 / PERIOD], rtol=1e-12)
    # with Ĵ = 1: e(k+1) = 0.2, G = 0.2 · [0.4, 1], α = 0.5 · 0.04 / 0.0464, dq = 0.2 + α · 0.2 · 1.16 = 0.3
    made = law(net, horizon=1, k=0.5, epsilon=0.0)
    u = made.command(Estimate(np.array([[1.0]])), observation, reference)
    np.testing.assert_allclose(u, [0.3 / PERIOD], rtol=1e-12)


@pytest.mark.parametrize("far", [1.0, 30.0])
def test_without_an_error_the_offset_free_law_rests_also_far_from_its_training(far):
    q = np.full(3, far)
    y = np.array([0.3, -0.2])
    observation = seen(q, y)
    reference = np.tile(y, (PREVIEW + 1, 1))
    printed, ours = (
        law(network(), offset_free=free).command(ONES, observation, reference)
        for free in (False, True)
    )
    assert np.abs(printed).max() > 0.1
    np.testing.assert_array_equal(ours, np.zeros(3))


def null_motion(row_space_only):
    """Return how fast a law, taught under one Jacobian, moves in the null space of another at zero error."""
    made = law(network(), row_space_only=row_space_only)
    rng = np.random.default_rng(6)
    J, J_later = rng.normal(size=(2, 2, 3))
    q = np.zeros(3) + 0.5
    reference = np.ones((PREVIEW + 1, 2))
    for _ in range(20):
        made.command(Estimate(J), seen(q, np.zeros(2)), reference)
    at_target = seen(q, np.ones(2))
    before = law(network()).command(Estimate(J_later), at_target, reference)
    u = made.command(Estimate(J_later), at_target, reference) - before
    return np.linalg.norm(u - np.linalg.pinv(J_later) @ J_later @ u)


def test_without_the_projection_what_was_learned_leaks_into_the_null_space():
    assert null_motion(row_space_only=True) < 1e-9
    assert null_motion(row_space_only=False) > 1e-2


@pytest.mark.parametrize(("step", "learns"), [(0.15, False), (0.25, True)])
def test_beyond_the_limit_nothing_is_learned_that_leads_further_beyond(step, learns):
    # As above with Ĵ = 1: the weights ask for 0.2 rad, and for more after the update.
    net = ControllerNetwork(np.array([[0.4, 1.0]]), np.ones(1), np.array([[[0.5], [1.0]]]), 1, 1)
    made = law(net, limit=step / PERIOD, horizon=1, k=0.5, epsilon=0.0)
    made.command(Estimate(np.array([[1.0]])), seen([1.0], [0.0]), np.full((PREVIEW + 1, 1), 0.4))
    assert bool(made.diagnostics()["step_size"] > 0.0) == bool(made.state.learned.any()) == learns


def test_a_lost_feature_teaches_nothing():
    made = law(network())
    u = made.command(ONES, seen(np.zeros(3), np.zeros(2), valid=False), np.ones((PREVIEW + 1, 2)))
    assert not made.state.learned.any()
    assert made.diagnostics()["step_size"] == 0.0
    assert np.isfinite(u).all()


def without_preview():
    net = network()
    made = RbfnnLaw(RbfnnConfig(preview=False), knowledge(preview=0), only_controller(net))
    return Commanding(made, seen(np.zeros(3), np.zeros(2)))


def test_the_preview_is_used_only_where_it_is_switched_on():
    ramp = np.linspace(0.1, 1.0, PREVIEW + 1)[:, None] * np.ones(2)
    flat = np.tile(ramp[0], (PREVIEW + 1, 1))
    J = np.ones((2, 3)) + np.eye(2, 3)
    look = seen(np.zeros(3), np.zeros(2))
    on = [law(network()).command(Estimate(J), look, reference) for reference in (ramp, flat)]
    off = [
        without_preview().command(Estimate(J), look, reference) for reference in (ramp, flat[:1])
    ]
    assert not np.allclose(on[0], on[1])
    np.testing.assert_array_equal(off[0], off[1])
    np.testing.assert_array_equal(off[0], on[1])


def test_the_roll_out_follows_the_reference_from_step_to_step():
    net = network()
    rng = np.random.default_rng(4)
    reference = rng.normal(size=(PREVIEW + 1, 2))
    q = rng.normal(size=3)
    y = rng.normal(size=2)
    made = law(net, horizon=4)
    J = rng.normal(size=(2, 3))
    made.command(Estimate(J), seen(q, y), reference)
    history = (reference[:1] - y, q[None])
    ahead = roll_out(net, net.weights, J, history, np.diff(reference[:5], axis=0), np.full(3, 1e6))
    np.testing.assert_allclose(made.state.predicted, ahead.errors, rtol=1e-12)


def test_weight_norms_are_reported():
    made = law(network(), limit=1e-3)
    made.command(ONES, seen(np.ones(3), np.zeros(2)), np.full((PREVIEW + 1, 2), 5.0))
    found = made.diagnostics()
    assert made.limited
    assert found["controller_weight_norm"] == pytest.approx(
        np.linalg.norm(network().weights + made.state.learned)
    )
    assert set(found) >= {"criterion", "step_size", "predicted_error", "learned_weight_norm"}


def test_nothing_to_descend_gives_no_step():
    ahead = RollOut(np.zeros((2, 2)), np.ones((2, 5)), np.ones((2, 4)), np.zeros(3))
    assert update_step(descent_direction(np.ones((2, 3)), ahead), ahead, 0.5, 0.0) == 0.0
    assert controller_output(np.zeros((3, 5, 4)), ahead.xi[0], ahead.h[0]).tolist() == [
        0.0,
        0.0,
        0.0,
    ]


def test_a_short_preview_is_refused():
    with pytest.raises(
        ValueError, match="preview must reach the law's horizon = 0.4 s, got 7 rows of 0.05 s"
    ):
        RbfnnLaw(RbfnnConfig(horizon=8), knowledge(preview=7), only_controller(network()))


def at_rate(rate, net, **config):
    """Return a law that is asked every `rate` seconds, and its preview of a reference at rest."""
    spec = replace(plant_spec(net.n, net.m, 1e6), period=rate)
    made = RbfnnLaw(
        RbfnnConfig(**config), RobotKnowledge(spec, math.ceil(0.5 / rate)), only_controller(net)
    )
    return made, math.ceil(0.5 / rate) + 1


def test_every_update_removes_its_part_of_what_the_updates_of_one_step_remove():
    assert update_share(0.1, 0.05, 0.05) == 0.1
    assert (1.0 - update_share(0.4, 0.01, 0.05)) ** 5 == pytest.approx(1.0 - 0.4)
    # An update acts after the delay only, so that no more can be removed
    assert update_share(0.4, 0.2, 0.05) == 0.4
    assert update_share(1.7, 0.01, 0.05) == pytest.approx(0.34)
    assert update_share(1.7, 1.0, 0.05) == 1.7


@pytest.mark.parametrize(("error_history", "position_history"), [(1, 1), (3, 2)])
def test_what_is_seen_at_another_rate_asks_for_the_same_velocity(error_history, position_history):
    # Feature, joints and reference move evenly. Without learning every rate has the same ξ and the same command, and
    # the commanded position may stand in for the measured one.
    net = network(error_history=error_history, position_history=position_history)
    J = np.ones((2, 3)) + np.eye(2, 3)
    velocity = np.array([0.3, -0.2, 0.1])
    commands = []
    predicted = []
    for rate, position in product((PERIOD, 0.1, 0.02, 0.004), ("measured", "commanded")):
        made, rows = at_rate(rate, net, k=1e-9, position=position)
        ahead = 0.5 + np.outer(np.arange(rows) * rate, [0.2, 0.4])
        state = made.start(seen(-velocity, np.zeros(2)))
        for k in range(-round(1.0 / rate), 1):
            look = seen(velocity * k * rate, -J @ velocity * k * rate)
            state, u = made.command(state, Estimate(J), look, ahead)
            state = made.noted(state, velocity, np.asarray(False))
        commands.append(u)
        predicted.append(state.predicted)
    np.testing.assert_allclose(commands, np.tile(commands[0], (8, 1)), rtol=0, atol=1e-6)
    np.testing.assert_allclose(predicted, np.tile(predicted[0], (8, 1, 1)), rtol=0, atol=1e-6)


def test_learning_per_second_does_not_depend_on_the_rate():
    net = network()
    J = np.ones((2, 3)) + np.eye(2, 3)
    look = seen(np.full(3, 0.5), np.zeros(2))
    learned = []
    for rate in (0.01, 0.005, 0.0025):
        made, rows = at_rate(rate, net, k=0.1)
        state = made.start(look)
        for _ in range(round(0.5 / rate)):
            state, _ = made.command(state, Estimate(J), look, np.full((rows, 2), 0.3))
        learned.append(state.learned)
    np.testing.assert_allclose(learned[2], learned[1], rtol=0, atol=0.05 * np.abs(learned[1]).max())
    coarse, fine = (np.abs(one - two).max() for one, two in pairwise(learned))
    assert fine == pytest.approx(coarse / 2.0, rel=0.2)  # an Euler step of the same integration
