import math
from dataclasses import replace

import casadi
import daqp
import numpy as np
import pytest
from scipy.integrate import quad

from kit.toy import PERIOD, Commanding, plant_spec, seen
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.laws.law import Estimate
from servobench.controllers.laws.mpc.closed_form import (
    Blocks,
    bridging_shares,
    horizon_integrals,
    move_weights,
    preview_weights,
)
from servobench.controllers.laws.mpc.mpc import MpcConfig, MpcLaw
from servobench.controllers.laws.mpc.qp import QpBounds, QpProgram, QpShape, exceeds, view_rows
from servobench.plant.contract.faults import SolverFailed
from servobench.plant.contract.lanes import stack


def make_spec(n=6, m=3, **limits):
    return plant_spec(n, m, **limits)


def observe(spec, position=None, feature=None):
    return seen(
        np.zeros(spec.n) if position is None else position,
        np.zeros(spec.m) if feature is None else feature,
    )


def blocks(count):
    """Settings of a horizon of so many blocks, each as long as a period of the toy."""
    return {"horizon_time": count * PERIOD, "moves": count}


def make_law(spec, preview=20, **settings):
    return Commanding(MpcLaw(MpcConfig(**settings), RobotKnowledge(spec, preview)), observe(spec))


def hold(target, preview=20):
    return np.tile(np.asarray(target, dtype=float), (preview + 1, 1))


def random_jacobian(seed, m=3, n=6):
    return np.random.default_rng(seed).normal(scale=0.4, size=(m, n))


def program(n=4, m=2, horizon=5, constant=False, move=1e3, change=1e3, view=False, seed=0):
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
    return QpProgram(shape, raises=False), shape


def solve_by_qpoases(H, g, A, upper, lower, **_options):
    """Solve a program as `daqp.solve`, by another method."""
    n = len(g)
    structure = {"h": casadi.Sparsity.dense(n, n), "a": casadi.Sparsity.dense(len(A), n)}
    options = {"print_time": False, "printLevel": "none", "terminationTolerance": 1e-12}
    solver = casadi.conic("mpc", "qpoases", structure, options)
    found = solver(h=H, g=g, a=A, lbx=lower[:n], ubx=upper[:n], lba=lower[n:], uba=upper[n:])
    multiplier = np.concatenate([np.asarray(found[name]).ravel() for name in ("lam_x", "lam_a")])
    iterations = solver.stats()["iter_count"]
    answer = {"lam": multiplier, "iterations": iterations}
    return np.asarray(found["x"]).ravel(), float(found["cost"]), 1, answer


def make_bounds(shape, travel=1e3, margin=-1e3):
    largest, travel = shape.largest_move, np.full(shape.n, travel)
    return QpBounds(-largest, largest, -travel, travel, np.full(len(shape.view_rows), margin))


def test_first_step_of_the_constant_mode_by_hand():
    # One joint, J = 1, α = 1, H = 2: a = 8/3, b = 2, c = ∫ τ e^{−τ} dτ = 1 − 3 e^{−2}; with q = 1/3 dq = (b − c) e / 3.
    spec = make_spec(1, 1, speed=10.0)
    law = make_law(spec, mode="constant", **blocks(2), decay=1.0 / PERIOD, move_weight=1 / 3)
    velocity = law.command(Estimate(np.array([[1.0]])), observe(spec), hold([0.3]))
    dq = (1.0 + 3.0 * np.exp(-2.0)) * 0.3 / 3.0
    np.testing.assert_allclose(velocity, [dq / PERIOD], rtol=1e-9)
    # The criterion ½ (a + q) dq² − (b − c) e dq is least there; two blocks go 2 dq.
    assert law.diagnostics()["objective"] == pytest.approx(-1.5 * dq**2, rel=1e-9)
    assert law.diagnostics()["predicted_terminal_error"] == pytest.approx(
        abs(0.3 - 2.0 * dq), rel=1e-9
    )


def test_first_step_of_free_moves_by_hand():
    # H = 1, J = 2, q = 1, β = ½: min ½ (0.5·0.2 − 2 dq)² + ½ dq², so dq = 2·0.1 / (4 + 1) = 0.04.
    spec = make_spec(1, 1)
    law = make_law(spec, **blocks(1), decay=math.log(2.0) / PERIOD, move_weight=1.0)
    velocity = law.command(Estimate(np.array([[2.0]])), observe(spec), hold([0.2]))
    np.testing.assert_allclose(velocity, [0.04 / PERIOD], rtol=1e-9)
    assert law.diagnostics()["objective"] == pytest.approx(0.5 * 0.02**2 + 0.5 * 0.04**2, rel=1e-9)


def test_a_joint_of_twice_the_weight_moves_less():
    # As above with q = 2 for the second joint alone: dq = J Q⁻¹ 0.1 / (1 + J Q⁻¹ Jᵀ), J = [2, 2].
    spec = make_spec(2, 1)
    law = make_law(
        spec, **blocks(1), decay=math.log(2.0) / PERIOD, move_weight=1.0, joint_weight=(1.0, 2.0)
    )
    velocity = law.command(Estimate(np.array([[2.0, 2.0]])), observe(spec), hold([0.2]))
    np.testing.assert_allclose(velocity * PERIOD, [0.2 / 7.0, 0.1 / 7.0], rtol=1e-9)


@pytest.mark.parametrize("constant", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_another_solver_finds_the_same_plan_multipliers_and_criterion(constant, seed, monkeypatch):
    found = []
    for solve in (daqp.solve, solve_by_qpoases):
        monkeypatch.setattr(daqp, "solve", solve)
        qp, shape = program(constant=constant, move=0.3, change=0.12, view=True, seed=seed)
        targets = np.random.default_rng(seed).normal(size=(shape.moves, 2)) * (
            40.0 if constant else 1.0
        )
        found.append(
            qp.solve(
                random_jacobian(seed, 2, 4), targets, make_bounds(shape, travel=0.7, margin=-0.2)
            )
        )
        assert found[-1].success
        assert found[-1].iterations > 0
    one, other = found
    np.testing.assert_allclose(one.moves, other.moves, atol=1e-8)
    np.testing.assert_allclose(one.multiplier, other.multiplier, atol=1e-6)
    assert one.objective == pytest.approx(other.objective, abs=1e-8)
    assert np.count_nonzero(np.abs(one.multiplier) > 1e-6) > 0


def test_the_objective_is_the_criterion_of_the_moves():
    qp, shape = program(move=0.3, change=0.12)
    J = random_jacobian(0, 2, 4)
    targets = np.random.default_rng(0).normal(size=(shape.moves, 2))
    found = qp.solve(J, targets, make_bounds(shape, travel=0.7))
    missed = targets - np.cumsum(found.moves, axis=0) @ J.T
    criterion = 0.5 * (
        np.sum(shape.weights @ missed**2) + np.sum(found.moves**2 @ shape.move_weight)
    )
    assert found.objective == pytest.approx(criterion, rel=1e-9)


def test_the_rows_of_the_view_are_positive_inside_its_pyramid_alone():
    rows = view_rows((0.5, 0.4), 3)
    assert (rows @ [0.49, -0.39, 1.0] > 0.0).all()
    for outside in ([0.51, 0.0, 1.0], [-0.51, 0.0, 1.0], [0.0, 0.41, 1.0], [0.0, -0.41, 1.0]):
        assert np.count_nonzero(rows @ outside < 0.0) == 1
    assert view_rows((), 2).shape == (0, 2)


BREACHES = {  # one limit each: first moves, later ones, and the ways of two joints [rad]
    "none": [[0.4, -0.4], [0.8, -0.8], [0.3, -0.3]],
    "a move": [[0.4, 0.0], [0.8, -0.1], [1.1, -0.4]],
    "the first move": [[0.6, 0.0], [0.8, 0.0], [0.3, 0.0]],
    "the first move back": [[0.0, -0.6], [0.0, -0.8], [0.0, -0.3]],
    "a change": [[0.4, 0.0], [0.7, -0.4], [0.1, -0.4]],
    "a way": [[0.5, 0.0], [0.9, 0.0], [0.7, 0.0]],
    "a way back": [[0.0, -0.5], [0.0, -0.9], [0.0, -0.7]],
    "the view": [[0.2, -0.5], [0.2, -0.7], [0.2, -0.4]],
}


def test_a_plan_is_checked_against_every_limit_for_each_run():
    shape = QpShape(
        np.ones(3), np.ones(2), None, np.ones(2), np.full(2, 0.5), True, np.array([[1.0, 1.0]])
    )
    count = len(BREACHES)
    bounds = QpBounds(
        *(np.full((count, 2), value) for value in (-0.5, 0.5, -2.0, 2.0)),
        view_margin=np.where(np.array(list(BREACHES)) == "the view", -0.9, -9.0)[:, None],
    )
    plans = np.array(list(BREACHES.values()))
    broken = exceeds(shape, bounds, np.eye(2), plans, np.cumsum(plans, axis=1))
    assert broken.tolist() == [False] + [True] * (count - 1)
    unlimited = replace(
        shape, largest_change=None, limit_position=False, view_rows=np.zeros((0, 2))
    )
    broken = exceeds(unlimited, bounds, np.eye(2), plans, np.cumsum(plans, axis=1))
    assert broken.tolist() == [name == "a move" for name in BREACHES]


@pytest.mark.parametrize("constant", [False, True])
@pytest.mark.parametrize("travel", [0.4, 1.4, 1.6])
def test_position_rows_out_of_reach_change_nothing(constant, travel):
    # Five moves of at most 0.3 rad reach 1.5 rad: a limit at 1.6 rad is left out, nearer ones are not.
    qp, shape = program(constant=constant, move=0.3)
    J = random_jacobian(1, 2, 4)
    targets = np.full((shape.moves, 2), 3.0 * (40.0 if constant else 1.0))
    found = qp.solve(J, targets, make_bounds(shape, travel=travel))
    far = qp.solve(J, targets, make_bounds(shape, travel=1e3))
    rows = found.multiplier.size - far.multiplier.size
    assert rows == {0.4: shape.moves * 4 if constant else 16, 1.4: 4, 1.6: 0}[travel]
    if travel > 1.5:
        np.testing.assert_array_equal(found.moves, far.moves)
    else:
        assert np.abs(found.moves.sum(axis=0) * (5 / shape.moves)).max() == pytest.approx(
            travel, abs=1e-9
        )


def test_the_solver_prints_nothing_and_keeps_nothing_of_the_solve_before(capfd):
    (qp, shape), (fresh, _) = (program(move=0.3, change=0.12) for _ in range(2))
    bounds = make_bounds(shape, travel=0.7)
    qp.solve(random_jacobian(5, 2, 4), -np.ones((5, 2)), bounds)
    arguments = random_jacobian(0, 2, 4), np.ones((5, 2)), bounds
    np.testing.assert_array_equal(qp.solve(*arguments).moves, fresh.solve(*arguments).moves)
    assert capfd.readouterr() == ("", "")


def test_shapes_are_equal_if_all_their_entries_are():
    _, one = program()
    _, same = program()
    _, other = program(seed=1)
    assert len({one, same, other, replace(one, view_rows=np.zeros((0, 3)))}) == 3
    assert one != "a shape"


def test_a_moving_reference_is_met_with_the_feedforward_of_its_preview():
    spec = make_spec(2, 2, speed=10.0)
    ramp = np.outer(np.arange(21), [0.01, -0.02])
    J = np.eye(2)
    for mode in ("moves", "constant"):
        law = make_law(spec, mode=mode, move_weight=1e-9)
        np.testing.assert_allclose(
            law.command(Estimate(J), observe(spec), ramp) * PERIOD, [0.01, -0.02], rtol=1e-6
        )
    held = make_law(spec, preview=0, use_preview=False)
    np.testing.assert_allclose(held.command(Estimate(J), observe(spec), ramp[:1]), 0.0, atol=1e-12)


@pytest.mark.parametrize("mode", ["moves", "constant"])
def test_position_limits_are_kept_and_an_arm_outside_may_return(mode):
    spec = make_spec(1, 1, reach=1.0)
    law = make_law(spec, mode=mode)
    near = law.command(Estimate(np.array([[1.0]])), observe(spec, np.array([0.99])), hold([5.0]))
    assert 0.0 < near[0] <= 0.01 / PERIOD + 1e-7
    outside = observe(spec, np.array([1.2]))
    assert law.command(Estimate(np.array([[1.0]])), outside, hold([5.0]))[0] == pytest.approx(
        0.0, abs=1e-7
    )
    assert law.command(Estimate(np.array([[1.0]])), outside, hold([-5.0]))[0] < -0.1
    assert law.diagnostics()["solver_success"] == 1.0
    free = make_law(spec, mode=mode, limit_position=False)
    assert free.command(Estimate(np.array([[1.0]])), outside, hold([5.0]))[0] > 0.1


def infeasible(fallback, mode="moves"):
    """A joint at full speed right before its limit cannot brake in time at so low an acceleration."""
    spec = make_spec(2, 2, reach=1.0)
    config = {"fallback": fallback, "mode": mode, "joint_acceleration_limit": 0.5}
    config |= {"decay": 3.0 / PERIOD, **blocks(5)}
    law = make_law(spec, **config)
    J = np.eye(2)
    for _ in range(40):
        law.command(Estimate(J), observe(spec, [-0.9, 0.0], [-0.9, 0.0]), hold([5.0, 0.0]))
    assert law.diagnostics()["fallbacks"] == 0
    return law, J, observe(spec, [0.99, 0.0], [0.99, 0.0]), hold([5.0, 0.0])


@pytest.mark.parametrize("mode", ["moves", "constant"])
def test_without_a_solution_the_arm_holds_and_it_is_counted(mode):
    law, J, observation, reference = infeasible("hold", mode)
    np.testing.assert_array_equal(law.command(Estimate(J), observation, reference), 0.0)
    diagnostics = law.diagnostics()
    assert diagnostics["fallbacks"] == 1
    assert diagnostics["solver_success"] == 0.0
    assert math.isnan(diagnostics["objective"])
    assert math.isnan(diagnostics["active_limits"])
    assert law.command(Estimate(J), observation, reference).any()  # at rest it may go on
    assert law.diagnostics()["fallbacks"] == 1


def test_states_of_single_runs_can_be_stacked():
    fell_back, J, observation, reference = infeasible("hold")
    fell_back.command(Estimate(J), observation, reference)
    goes_on = Commanding(fell_back.law, observation)
    goes_on.command(Estimate(J), observation, hold(observation.feature))
    both = goes_on.law.diagnostics(stack([goes_on.state, fell_back.state]))
    for name, value in both.items():
        np.testing.assert_array_equal(
            value, [goes_on.diagnostics()[name], fell_back.diagnostics()[name]]
        )
    assert both["fallbacks"].tolist() == [0.0, 1.0]


def test_without_a_solution_and_fallback_it_is_a_named_failure():
    law, J, observation, reference = infeasible("raise")
    with pytest.raises(SolverFailed, match="daqp found no solution within the limits"):
        law.command(Estimate(J), observation, reference)
    assert SolverFailed.status == "solver_failed"


def test_a_command_depends_on_its_state_alone():
    spec = make_spec()
    law = make_law(spec, joint_acceleration_limit=3.0, delay=2 * PERIOD)

    def commands(first):
        return [
            law.command(Estimate(random_jacobian(k)), observe(spec), hold([1.0, k, -0.3]))
            for k in range(first, first + 4)
        ]

    commands(0)
    saved = law.state
    expected = commands(4)
    law.state = saved
    np.testing.assert_array_equal(commands(4), expected)


def test_a_jacobian_of_zeros_asks_for_nothing():
    spec = make_spec()
    for mode in ("moves", "constant"):
        np.testing.assert_allclose(
            make_law(spec, mode=mode).command(
                Estimate(np.zeros((3, 6))), observe(spec), hold([1, 2, 3])
            ),
            0,
        )


def test_the_predicted_error_is_from_the_reference_at_the_end_of_the_horizon():
    spec = make_spec(1, 1, speed=100.0)
    law = make_law(spec, **blocks(4), decay=0.4 / PERIOD)
    ramp = 0.3 + 0.1 * np.arange(21.0)[:, None]
    law.command(Estimate(np.array([[1.0]])), observe(spec, feature=[0.2]), ramp)
    missed = ramp[4, 0] - 0.2 - law.state.plan.moves.sum()
    assert law.diagnostics()["predicted_terminal_error"] == pytest.approx(abs(missed), rel=1e-12)


def test_settings_that_do_not_fit_the_plant_are_named():
    config = MpcConfig()
    with pytest.raises(
        ValueError, match=r"preview must reach horizon_time \+ delay = 0.5 s, got 9 rows of 0.05 s"
    ):
        MpcLaw(config, RobotKnowledge(make_spec(), 9))
    with pytest.raises(
        ValueError,
        match=r"preview must reach horizon_time \+ delay = 0.65 s, got 10 rows of 0.05 s",
    ):
        MpcLaw(replace(config, delay=0.15), RobotKnowledge(make_spec(), 10))
    with pytest.raises(
        ValueError, match="view_tangent needs the 3 features x, y, z, got 2 features"
    ):
        MpcLaw(replace(config, view_tangent=(0.5, 0.5)), RobotKnowledge(make_spec(m=2), 10))
    with pytest.raises(
        ValueError,
        match=r"forgetting must be at most 400 1/s for blocks of 0.05 s.*; got 1e\+06 1/s",
    ):
        MpcLaw(replace(config, forgetting=1e6), RobotKnowledge(make_spec(), 10))
    assert np.isfinite(make_law(make_spec(), forgetting=400.0).law._integrals).all()
    with pytest.raises(ValueError, match=r"joint_weight must have shape \(6,\), got \(2,\)"):
        MpcLaw(replace(config, joint_weight=(1.0, 2.0)), RobotKnowledge(make_spec(), 10))


@pytest.mark.parametrize("mode", ["moves", "constant"])
@pytest.mark.parametrize("period", [0.02, 0.008, 0.004])
def test_the_control_rate_changes_neither_the_plan_nor_the_command(mode, period):
    J = random_jacobian(4)
    y = np.array([0.1, -0.2, 0.05])
    sent = np.array([0.1, 0.0, -0.2, 0.3, 0.0, 0.1])
    commands = []
    for rate in (PERIOD, period):
        spec = replace(make_spec(speed=0.5), period=rate)
        ramp = np.outer(np.arange(0.0, 1.0, rate), [0.2, -0.1, 0.4])
        law = MpcLaw(MpcConfig(mode=mode, delay=0.1), RobotKnowledge(spec, len(ramp) - 1))
        state = law.start(observe(spec))
        for _ in range(math.ceil(0.1 / rate)):
            state = law.noted(state, sent, np.False_)
        state, velocity = law.command(state, Estimate(J), observe(spec, feature=y), ramp)
        assert state.plan.moves.shape == (10 if mode == "moves" else 1, 6)
        assert state.plan.active_limits > 0 or mode == "constant"
        commands.append(velocity)
    np.testing.assert_allclose(commands[1], commands[0], rtol=1e-7, atol=1e-9)


def test_a_slow_rate_has_fewer_and_longer_blocks_of_the_same_weights():
    assert Blocks.of(0.5, 10, 0.05) == Blocks(10, 0.05, 0.05)
    assert Blocks.of(0.45, 10, 0.1) == Blocks(4, 0.1125, 0.1)
    assert Blocks.of(0.02, 10, 0.1) == Blocks(1, 0.1, 0.1)
    np.testing.assert_allclose(Blocks(2, 0.1, 0.04).places(0.06), [1.5, 4.0, 6.5])
    np.testing.assert_allclose(bridging_shares(0.1, 0.05), [1.0, 1.0])
    np.testing.assert_allclose(bridging_shares(0.05, 0.02), [0.5, 1.0, 1.0])
    assert bridging_shares(0.0, 0.02).shape == (0,)


@pytest.mark.parametrize("mode", ["moves", "constant"])
@pytest.mark.parametrize("moves", [5, 20])
def test_the_optimum_in_continuous_time_does_not_depend_on_the_length_of_the_blocks(mode, moves):
    # In constant mode the integrals are exact, in the other one the sums tend to them.
    J = random_jacobian(5)
    spec = replace(make_spec(speed=1e3, reach=1e3), period=0.025)
    found = [
        make_law(
            spec, mode=mode, moves=count, decay=2.0, move_weight=5.0, terminal_weight=1.0
        ).command(Estimate(J), observe(spec), hold([0.1, -0.2, 0.05]))
        for count in (10, moves)
    ]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9 if mode == "constant" else 0.15)


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
        assert found.c == pytest.approx(
            integral(lambda t, beta=beta: t * (alpha * beta) ** t, horizon), rel=1e-10
        )


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
        quad(lambda t: t * alpha**t * np.interp(t, nodes, r), start, start + 1, epsabs=1e-14)[0]
        for start in nodes[:-1]
    ]
    assert preview_weights(horizon, alpha) @ r[1:] == pytest.approx(sum(pieces), abs=1e-12)
    # A unit ramp turns ∫ τ α^τ τ dτ into a.
    assert preview_weights(horizon, alpha) @ nodes[1:] == pytest.approx(
        horizon_integrals(horizon, alpha, 0.1).a, rel=1e-12
    )
