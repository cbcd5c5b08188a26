import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from kit.toy import PERIOD, plant_spec, seen
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimate import Estimate
from servobench.controllers.laws.mpc.closed_form import UnlimitedPlan, horizon_integrals, move_weights
from servobench.controllers.laws.mpc.mpc import MpcConfig, MpcLaw
from servobench.controllers.laws.mpc.qp import QpBounds, QpProgram, QpShape
from servobench.plant.faults import SolverFailed
from servobench.plant.lanes import stack, take
from servobench.plant.signals import trusted_observation


def make_spec(n=6, m=3, **limits):
    return plant_spec(n, m, **limits)


def observe(spec, position=None, feature=None):
    return seen(np.zeros(spec.n) if position is None else position, np.zeros(spec.m) if feature is None else feature)


class OneRun:
    """A law with the state of one run."""

    def __init__(self, law, spec):
        self.law = law
        self.state = law.start(observe(spec))

    def command(self, J, observation, reference):
        self.state, velocity = self.law.command(self.state, Estimate(np.asarray(J)), observation, reference)
        return velocity

    def diagnostics(self):
        return {name: float(value) for name, value in self.law.diagnostics(self.state).items()}


def make_law(spec, preview=20, **settings):
    return OneRun(MpcLaw(MpcConfig(**settings), RobotKnowledge(spec, preview)), spec)


def hold(target, preview=20):
    return np.tile(np.asarray(target, dtype=float), (preview + 1, 1))


def random_jacobian(seed, m=3, n=6):
    return np.random.default_rng(seed).normal(scale=0.4, size=(m, n))


def program(n=4, m=2, horizon=5, constant=False, move=1e3, change=1e3, view=False, solver="daqp", seed=0):
    rng = np.random.default_rng(seed)
    shape = QpShape(
        weights=move_weights(horizon, 0.9, 1.0),
        move_weight=rng.uniform(0.05, 0.2, n),
        constant_gain=40.0 if constant else None,
        largest_move=np.full(n, move),
        largest_change=np.full(n, change),
        limit_position=True,
        view_rows=rng.normal(size=(3, m)) if view else np.zeros((0, m)),
    )
    return QpProgram(shape, solver), shape


def make_bounds(shape, travel=1e3, margin=-1e3):
    largest, travel = shape.largest_move, np.full(shape.n, travel)
    return QpBounds(-largest, largest, -travel, travel, np.full(len(shape.view_rows), margin))


def test_first_step_of_the_constant_mode_by_hand():
    # One joint, J = 1, α = 1, H = 2: a = 8/3, b = 2, c = ∫ τ e^{−τ} dτ = 1 − 3 e^{−2}; with q = 1/3 dq = (b − c) e / 3.
    spec = make_spec(1, 1, speed=10.0)
    law = make_law(spec, mode="constant", horizon=2, rho=1.0, move_weight=1 / 3)
    velocity = law.command([[1.0]], observe(spec), hold([0.3]))
    np.testing.assert_allclose(velocity, [(1.0 + 3.0 * np.exp(-2.0)) * 0.3 / 3.0 / PERIOD], rtol=1e-9)


def test_first_step_of_free_moves_by_hand():
    # H = 1, J = 2, q = 1, β = ½: min ½ (0.5·0.2 − 2 dq)² + ½ dq², so dq = 2·0.1 / (4 + 1) = 0.04.
    spec = make_spec(1, 1)
    law = make_law(spec, horizon=1, rho=math.log(2.0), move_weight=1.0)
    velocity = law.command([[2.0]], observe(spec), hold([0.2]))
    np.testing.assert_allclose(velocity, [0.04 / PERIOD], rtol=1e-9)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("solver", ["daqp", "qpoases"])
def test_constant_mode_without_active_limits_is_equation_46(seed, solver):
    spec = make_spec(speed=1e3, reach=1e3)
    law = make_law(spec, mode="constant", alpha=0.9, solver=solver, move_weight=0.5, use_preview=False)
    J, e = random_jacobian(seed), np.random.default_rng(seed + 9).normal(scale=0.2, size=3)
    abc = horizon_integrals(10, 0.9, MpcConfig.rho)
    printed = np.linalg.pinv(abc.a * J + np.linalg.pinv(J.T) * 0.5) @ ((abc.b - abc.c) * e)
    np.testing.assert_allclose(law.command(J, observe(spec), hold(e)) * PERIOD, printed, atol=1e-8)


@pytest.mark.parametrize("solver", ["daqp", "qpoases"])
@pytest.mark.parametrize("seed", range(3))
def test_program_without_active_limits_is_the_closed_form(solver, seed):
    qp, shape = program(solver=solver, view=True, seed=seed)
    J, targets = random_jacobian(seed, 2, 4), np.random.default_rng(seed).normal(size=(5, 2))
    expected, _ = UnlimitedPlan.of_free_moves(shape.weights, shape.move_weight).minimise(J, targets)
    np.testing.assert_allclose(qp.solve(J, targets, make_bounds(shape)).moves, expected, atol=1e-8)

    qp, shape = program(constant=True, solver=solver, seed=seed)
    expected, _ = UnlimitedPlan.of_constant_step(40.0, 5, shape.move_weight).minimise(J, targets[:1])
    np.testing.assert_allclose(qp.solve(J, targets[:1], make_bounds(shape)).moves, expected, atol=1e-8)


@pytest.mark.parametrize("constant", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_both_solvers_find_the_same_plan_multipliers_and_criterion(constant, seed):
    found = []
    for solver in ("daqp", "qpoases"):
        qp, shape = program(solver=solver, constant=constant, move=0.3, change=0.12, view=True, seed=seed)
        targets = np.random.default_rng(seed).normal(size=(shape.moves, 2)) * (40.0 if constant else 1.0)
        found.append(qp.solve(random_jacobian(seed, 2, 4), targets, make_bounds(shape, travel=0.7, margin=-0.2)))
        assert found[-1].success
        assert found[-1].iterations > 0
    one, other = found
    np.testing.assert_allclose(one.moves, other.moves, atol=1e-8)
    np.testing.assert_allclose(one.multiplier, other.multiplier, atol=1e-6)
    assert one.objective == pytest.approx(other.objective, abs=1e-8)
    assert np.count_nonzero(np.abs(one.multiplier) > 1e-6) > 0


@pytest.mark.parametrize("constant", [False, True])
@pytest.mark.parametrize("travel", [0.4, 1.4, 1.6])
def test_position_rows_out_of_reach_change_nothing(constant, travel):
    # Five moves of at most 0.3 rad reach 1.5 rad: a limit at 1.6 rad is left out, nearer ones are not.
    qp, shape = program(constant=constant, move=0.3)
    J, targets = random_jacobian(1, 2, 4), np.full((shape.moves, 2), 3.0 * (40.0 if constant else 1.0))
    found = qp.solve(J, targets, make_bounds(shape, travel=travel))
    far = qp.solve(J, targets, make_bounds(shape, travel=1e3))
    rows = found.multiplier.size - far.multiplier.size
    assert rows == {0.4: shape.moves * 4 if constant else 16, 1.4: 4, 1.6: 0}[travel]
    if travel > 1.5:
        np.testing.assert_array_equal(found.moves, far.moves)
    else:
        assert np.abs(found.moves.sum(axis=0) * (5 / shape.moves)).max() == pytest.approx(travel, abs=1e-9)


def test_solvers_print_nothing_and_keep_nothing_of_the_solve_before(capfd):
    for solver in ("daqp", "qpoases"):
        (qp, shape), (fresh, _) = (program(solver=solver, move=0.3, change=0.12) for _ in range(2))
        bounds = make_bounds(shape, travel=0.7)
        qp.solve(random_jacobian(5, 2, 4), -np.ones((5, 2)), bounds)
        arguments = random_jacobian(0, 2, 4), np.ones((5, 2)), bounds
        np.testing.assert_array_equal(qp.solve(*arguments).moves, fresh.solve(*arguments).moves)
    assert capfd.readouterr() == ("", "")


def test_shapes_are_equal_if_all_their_entries_are():
    (_, one), (_, same), (_, other) = program(), program(), program(seed=1)
    assert len({one, same, other, replace(one, view_rows=np.zeros((0, 3)))}) == 3
    assert one != "a shape"


def gradient(config, J, e, ahead, plan):
    """The gradient of the criterion in the docstring of `MpcLaw`, term by term; the integral by quadrature."""
    H, beta, Q = config.horizon, np.exp(-config.rho), config.move_weight
    knots = np.concatenate([np.zeros((1, len(e))), ahead])

    def pull(tau, travel):
        target = [np.interp(tau, np.arange(H + 1), column) for column in knots.T] + (1.0 - beta**tau) * e
        return J.T @ (J @ travel - target)

    found = Q * plan
    if config.mode == "moves":
        for tau in range(1, H + 1):
            weight = config.alpha**tau + config.terminal_weight * (tau == H)
            found[:tau] += weight * pull(tau, plan[:tau].sum(axis=0))
        return found
    nodes, weights = np.polynomial.legendre.leggauss(20)
    for start in range(H):
        for x, weight in zip(start + 0.5 * (nodes + 1.0), 0.5 * weights, strict=True):
            found[0] += weight * x * config.alpha**x * pull(x, x * plan[0])
    found[0] += config.terminal_weight * H * pull(H, H * plan[0])
    return found


def half_spaces(config, spec, J, last, q, y, moves):
    """The limits in the docstring of `qp` as A x ≤ b, row by row."""
    A, b, n, most = [], [], spec.n, spec.joint_velocity_limit * spec.period
    change = config.joint_acceleration_limit * spec.period**2

    def add(t, direction, bound, before=None):
        row = np.zeros((moves, n))
        row[t] = direction
        if before is not None:
            row[before] = -direction
        A.append(row.ravel())
        b.append(bound)

    steps = [[t] for t in range(moves)]
    for joint, axis in enumerate(np.eye(n)):
        lower, upper = min(spec.joint_lower[joint] - q[joint], 0.0), max(spec.joint_upper[joint] - q[joint], 0.0)
        for t in range(moves):
            for sign in (1.0, -1.0):
                add(steps[t], sign * axis, most[joint])
                add(steps[t], sign * axis, change + sign * last[joint]) if t == 0 else add(
                    steps[t], sign * axis, change, steps[t - 1]
                )
            ahead, scale = list(range(t + 1)), (1.0 if config.mode == "moves" else config.horizon)
            add(ahead, scale * axis, upper)
            add(ahead, -scale * axis, -lower)
    if config.view_tangent:
        h, v = config.view_tangent
        for row in np.array([[1.0, 0.0, h], [-1.0, 0.0, h], [0.0, 1.0, v], [0.0, -1.0, v]]):
            for t in range(moves):
                scale = 1.0 if config.mode == "moves" else config.horizon
                add(list(range(t + 1)), -scale * row @ J, -min(-row @ y, 0.0))
    A, b = np.array(A), np.array(b)
    return A[np.isfinite(b)], b[np.isfinite(b)]


def many(spec, q, feature):
    lead = feature.shape[:-1]
    return trusted_observation(0.0, q, feature, np.full(lead, True), np.full(feature.shape, True))


def random_lanes(rng, spec, lanes, scale):
    """Observation, references, Jacobians and a direction in which all references run."""
    q, y = rng.uniform(-0.28, 0.28, (lanes, spec.n)), rng.normal(scale=0.25, size=(lanes, spec.m)) + [0.0, 0.0, 1.0]
    way = rng.normal(scale=0.1 * scale, size=(lanes, 21, spec.m)).cumsum(axis=1)
    reference = y[:, None] + scale * rng.normal(size=(lanes, 1, spec.m)) + way
    return many(spec, q, y), reference, rng.normal(scale=0.4, size=(lanes, spec.m, spec.n))


LIMITS = {
    "speed": {"limit_position": False},
    "acceleration": {"joint_acceleration_limit": 6.0, "limit_position": False},
    "position": {},
    "view": {"view_tangent": (0.3, 0.25), "limit_position": False},
    "all": {"joint_acceleration_limit": 12.0, "view_tangent": (0.3, 0.25), "alpha": 0.9, "terminal_weight": 0.5},
}


@pytest.mark.parametrize("mode", ["moves", "constant"])
@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize("scale", [1e-3, 0.05, 1.0])
def test_every_plan_satisfies_the_optimality_conditions_of_the_problem_as_it_is_documented(mode, limits, scale):
    spec = make_spec(4, 3, reach=0.3 if limits in {"position", "all"} else 6.0)
    config = MpcConfig(mode=mode, horizon=6, delay_periods=2, rho=0.4, **LIMITS[limits])
    law, rng = MpcLaw(config, RobotKnowledge(spec, 20)), np.random.default_rng(7)
    observation, reference, J = random_lanes(rng, spec, 6, scale)
    state, solved, active = law.start(observation), 0, 0
    for _ in range(4):
        before = state
        state, _ = law.command(before, Estimate(J), observation, reference)
        y = observation.feature + np.array([J[i] @ before.sent[i].sum(axis=0) for i in range(6)])
        for i in np.flatnonzero(state.plan.success):
            rows, plan = reference[i, 2:9], state.plan.moves[i]
            down = gradient(config, J[i], rows[0] - y[i], rows[1:] - rows[0], plan).ravel()
            A, b = half_spaces(config, spec, J[i], before.last[i], observation.joint_position[i], y[i], len(plan))
            slack = b - A @ plan.ravel()
            assert slack.min() > -1e-8
            touched = A[slack < 1e-8]
            residual = nnls(touched.T, -down)[1] if len(touched) else np.linalg.norm(down)
            assert residual < 1e-7 * max(1.0, np.abs(down).max())
            solved += 1
            active += state.plan.active_limits[i] > 0
        observation, reference, J = random_lanes(rng, spec, 6, scale)
    assert solved > 12
    assert active == 0 if scale == 1e-3 and limits == "speed" else active > 0 or scale < 1.0


def equal(one, other):
    for a, b in zip(one, other, strict=True):
        equal(a, b) if isinstance(a, tuple) else np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("mode", ["moves", "constant"])
@pytest.mark.parametrize("fallback", ["hold", "closed_form"])
def test_a_lane_has_the_same_bits_alone_among_others_and_in_another_order(mode, fallback):
    spec = make_spec(6, 3, reach=0.3)
    config = MpcConfig(mode=mode, delay_periods=2, fallback=fallback, **LIMITS["all"])
    law, rng = MpcLaw(config, RobotKnowledge(spec, 20)), np.random.default_rng(3)
    blocks = ([0, 1, 2], [2, 0, 1], 0, 1, 2)
    states, kinds = [None] * len(blocks), set()
    for _ in range(12):
        observation, reference, J = random_lanes(rng, spec, 3, rng.choice([1e-3, 0.1, 0.5]))
        # The second lane wants little, so that limits are active in some lanes only.
        reference[1] = observation.feature[1] + 0.01 * (reference[1] - observation.feature[1])
        for i, lanes in enumerate(blocks):
            seen_there = many(spec, observation.joint_position[lanes], observation.feature[lanes])
            state = states[i] or law.start(seen_there)
            states[i], _ = law.command(state, Estimate(J[lanes]), seen_there, reference[lanes])
        together, turned, *alone = states
        equal(stack(alone), together)
        equal(turned, take(together, [2, 0, 1]))
        for name, value in law.diagnostics(together).items():
            np.testing.assert_array_equal(value, [law.diagnostics(state)[name] for state in alone])
        kinds |= set(zip(together.plan.success, together.plan.active_limits > 0, strict=True))
    assert {(1.0, True), (1.0, False)} <= kinds


def test_a_moving_reference_is_met_with_the_feedforward_of_its_preview():
    spec = make_spec(2, 2, speed=10.0)
    ramp = np.outer(np.arange(21), [0.01, -0.02])
    J = np.eye(2)
    for mode in ("moves", "constant"):
        law = make_law(spec, mode=mode, move_weight=1e-9)
        np.testing.assert_allclose(law.command(J, observe(spec), ramp) * PERIOD, [0.01, -0.02], rtol=1e-6)
    held = make_law(spec, preview=0, use_preview=False)
    np.testing.assert_allclose(held.command(J, observe(spec), ramp[:1]), 0.0, atol=1e-12)


def test_commands_already_sent_bridge_the_delay():
    # A pure delay of two periods, exact J: with the bridge the error decays as β^τ from the first command on.
    spec = make_spec(2, 2, speed=10.0)
    law = make_law(spec, delay_periods=2, horizon=1, rho=0.5, move_weight=1e-9)
    q, queue, errors = np.zeros(2), [np.zeros(2)] * 2, []
    for _ in range(8):
        errors.append(np.array([0.3, -0.2]) - q)
        queue.append(law.command(np.eye(2), observe(spec, q, q), hold([0.3, -0.2])) * PERIOD)
        q = q + queue.pop(0)
    for k in range(2, 7):
        np.testing.assert_allclose(errors[k + 1], np.exp(-0.5) * errors[k], rtol=1e-6)


def test_acceleration_is_limited_between_commands():
    spec = make_spec()
    law = make_law(spec, joint_acceleration_limit=2.0)
    J = random_jacobian(3)
    last = np.zeros(6)
    for target in ([0.5, 0.5, 0.5], [0.5, 0.5, 0.5], [-0.5, 0.5, 0.0], [-0.5, 0.0, 0.0]):
        velocity = law.command(J, observe(spec), hold(target))
        assert np.abs(velocity - last).max() <= 2.0 * PERIOD + 1e-8
        last = velocity
    assert law.diagnostics()["active_limits"] > 0
    assert law.diagnostics()["fallbacks"] == 0


@pytest.mark.parametrize("mode", ["moves", "constant"])
def test_position_limits_are_kept_and_an_arm_outside_may_return(mode):
    spec = make_spec(1, 1, reach=1.0)
    law = make_law(spec, mode=mode)
    near = law.command([[1.0]], observe(spec, np.array([0.99])), hold([5.0]))
    assert 0.0 < near[0] <= 0.01 / PERIOD + 1e-7
    outside = observe(spec, np.array([1.2]))
    assert law.command([[1.0]], outside, hold([5.0]))[0] == pytest.approx(0.0, abs=1e-7)
    assert law.command([[1.0]], outside, hold([-5.0]))[0] < -0.1
    assert law.diagnostics()["solver_success"] == 1.0
    free = make_law(spec, mode=mode, limit_position=False)
    assert free.command(np.array([[1.0]]), outside, hold([5.0]))[0] > 0.1


@pytest.mark.parametrize("mode", ["moves", "constant"])
def test_the_predicted_feature_stays_in_the_pyramid_of_view(mode):
    spec = make_spec(3, 3)
    settings = {"mode": mode, "view_tangent": (0.5, 0.4), "rho": 3.0, "horizon": 4}
    law = make_law(spec, **settings)
    y = np.array([0.46, 0.0, 1.0])
    velocity = law.command(np.eye(3), observe(spec, feature=y), hold([0.9, 0.0, 1.0]))
    reached = y + velocity * PERIOD
    assert reached[0] <= 0.5 * reached[2] + 1e-8
    assert law.diagnostics()["active_limits"] > 0
    unlimited = make_law(spec, **{**settings, "view_tangent": ()})
    reached = y + unlimited.command(np.eye(3), observe(spec, feature=y), hold([0.9, 0.0, 1.0])) * PERIOD
    assert reached[0] > 0.5 * reached[2] + 1e-3 or mode == "constant"
    back = law.command(np.eye(3), observe(spec, feature=[0.6, 0.0, 1.0]), hold([0.0, 0.0, 1.0]))
    assert back[0] < 0.0


def infeasible(fallback, mode="moves"):
    """A joint at full speed right before its limit cannot brake in time at so low an acceleration."""
    spec = make_spec(2, 2, reach=1.0)
    config = {"fallback": fallback, "mode": mode, "joint_acceleration_limit": 0.5, "rho": 3.0, "horizon": 5}
    law = make_law(spec, **config)
    J = np.eye(2)
    for _ in range(40):
        law.command(J, observe(spec, [-0.9, 0.0], [-0.9, 0.0]), hold([5.0, 0.0]))
    assert law.diagnostics()["fallbacks"] == 0
    return law, J, observe(spec, [0.99, 0.0], [0.99, 0.0]), hold([5.0, 0.0])


@pytest.mark.parametrize("mode", ["moves", "constant"])
def test_without_a_solution_the_arm_holds_and_it_is_counted(mode):
    law, J, observation, reference = infeasible("hold", mode)
    np.testing.assert_array_equal(law.command(J, observation, reference), 0.0)
    diagnostics = law.diagnostics()
    assert diagnostics["fallbacks"] == 1
    assert diagnostics["solver_success"] == 0.0
    assert math.isnan(diagnostics["objective"])
    assert math.isnan(diagnostics["active_limits"])
    assert law.command(J, observation, reference).any()  # at rest it may go on
    assert law.diagnostics()["fallbacks"] == 1


@pytest.mark.parametrize("mode", ["moves", "constant"])
def test_without_a_solution_the_closed_form_is_scaled_to_the_speed_limit(mode):
    law, J, observation, reference = infeasible("closed_form", mode)
    velocity = law.command(J, observation, reference)
    assert law.diagnostics()["fallbacks"] == 1
    assert velocity[0] == pytest.approx(1.0)  # 4 m away: the limit binds, the direction stays
    assert abs(velocity[1]) < 1e-6


def test_without_a_solution_and_fallback_it_is_a_named_failure():
    law, J, observation, reference = infeasible("raise")
    with pytest.raises(SolverFailed, match="daqp found no solution within the limits"):
        law.command(J, observation, reference)
    assert SolverFailed.status == "solver_failed"


@pytest.mark.parametrize("solver", ["daqp", "qpoases"])
def test_a_command_depends_on_its_state_alone(solver):
    spec = make_spec()
    law = make_law(spec, solver=solver, joint_acceleration_limit=3.0, delay_periods=2)

    def commands(first):
        return [law.command(random_jacobian(k), observe(spec), hold([1.0, k, -0.3])) for k in range(first, first + 4)]

    commands(0)
    saved = law.state
    expected = commands(4)
    law.state = saved
    np.testing.assert_array_equal(commands(4), expected)


@settings(max_examples=40)
@given(
    n=st.integers(2, 8), m=st.integers(1, 4), mode=st.sampled_from(["moves", "constant"]), seed=st.integers(0, 2**32)
)
def test_commands_are_finite_and_within_the_limits_for_any_size(n, m, mode, seed):
    rng = np.random.default_rng(seed)
    spec = make_spec(n, m, speed=float(rng.uniform(0.1, 3.0)))
    law = make_law(spec, mode=mode, horizon=4, joint_acceleration_limit=8.0, fallback="closed_form")
    scale = 10.0 ** rng.uniform(-6, 3)
    for _ in range(3):
        observation = observe(spec, rng.uniform(-7.0, 7.0, n), scale * rng.normal(size=m))
        velocity = law.command(rng.normal(size=(m, n)), observation, scale * rng.normal(size=(21, m)))
        assert np.isfinite(velocity).all()
        assert (np.abs(velocity) <= spec.joint_velocity_limit).all()


def test_a_jacobian_of_zeros_asks_for_nothing():
    spec = make_spec()
    for mode in ("moves", "constant"):
        np.testing.assert_allclose(
            make_law(spec, mode=mode).command(np.zeros((3, 6)), observe(spec), hold([1, 2, 3])), 0
        )


def test_diagnostics_tell_the_predicted_error_of_the_plan():
    spec = make_spec(1, 1, speed=100.0)
    law = make_law(spec, horizon=3, rho=0.4, move_weight=1e-10)
    law.command([[1.0]], observe(spec), hold([0.5]))
    diagnostics = law.diagnostics()
    assert diagnostics["predicted_terminal_error"] == pytest.approx(np.exp(-1.2) * 0.5, rel=1e-6)
    assert diagnostics["objective"] == pytest.approx(0.0, abs=1e-9)
    assert diagnostics["active_limits"] == 0


def test_settings_that_do_not_fit_the_plant_are_named():
    config = MpcConfig()
    with pytest.raises(ValueError, match=r"preview must be at least horizon \+ delay_periods = 10, got 9"):
        MpcLaw(config, RobotKnowledge(make_spec(), 9))
    with pytest.raises(ValueError, match=r"preview must be at least horizon \+ delay_periods = 13, got 10"):
        MpcLaw(replace(config, delay_periods=3), RobotKnowledge(make_spec(), 10))
    with pytest.raises(ValueError, match="view_tangent needs the 3 features x, y, z, got 2 features"):
        MpcLaw(replace(config, view_tangent=(0.5, 0.5)), RobotKnowledge(make_spec(m=2), 10))
    with pytest.raises(ValueError, match=r"joint_weight must have shape \(6,\), got \(2,\)"):
        MpcLaw(replace(config, joint_weight=(1.0, 2.0)), RobotKnowledge(make_spec(), 10))
