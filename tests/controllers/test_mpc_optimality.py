"""Test of the predictive law against the problem as its docstrings state it, apart from all code that solves it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls

from kit.toy import plant_spec
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.laws.law import Estimate
from servobench.controllers.laws.mpc.mpc import MpcConfig, MpcLaw
from servobench.plant.contract.signals import trusted_observation

LANES = 6
N = 4
M = 3
PREVIEW = 40
BLOCK = 0.05  # [s]
LIMITS = {
    "speed": {"limit_position": False},
    "acceleration": {"joint_acceleration_limit": 6.0, "limit_position": False},
    "position": {},
    "view": {"view_tangent": (0.3, 0.25), "limit_position": False},
    "all": {
        "joint_acceleration_limit": 12.0,
        "view_tangent": (0.3, 0.25),
        "forgetting": 2.1,
        "terminal_weight": 0.5,
    },
}


def gradient(config, J, e, ahead, plan):
    """The gradient of the criterion in the docstring of `MpcLaw`, term by term; the integral by quadrature."""
    H = config.moves
    block = config.horizon_time / config.moves
    beta = np.exp(-config.decay * block)
    alpha = np.exp(-config.forgetting * block)
    Q = config.move_weight
    knots = np.concatenate([np.zeros((1, len(e))), ahead])

    def pull(tau, travel):
        target = [np.interp(tau, np.arange(H + 1), column) for column in knots.T] + (
            1.0 - beta**tau
        ) * e
        return J.T @ (J @ travel - target)

    found = Q * plan
    if config.mode == "moves":
        for tau in range(1, H + 1):
            weight = alpha**tau + config.terminal_weight * (tau == H)
            found[:tau] += weight * pull(tau, plan[:tau].sum(axis=0))
        return found
    nodes, weights = np.polynomial.legendre.leggauss(20)
    for start in range(H):
        for x, weight in zip(start + 0.5 * (nodes + 1.0), 0.5 * weights, strict=True):
            found[0] += weight * x * alpha**x * pull(x, x * plan[0])
    found[0] += config.terminal_weight * H * pull(H, H * plan[0])
    return found


def half_spaces(config, spec, J, last, q, y, moves):
    """The limits in the docstring of `qp` as A x ≤ b, row by row."""
    A = []
    b = []
    block = config.horizon_time / config.moves
    most, last = spec.joint_velocity_limit * block, last / spec.period * block
    # The one constant step is made H times
    stretch = 1.0 if config.mode == "moves" else config.moves

    def add(t, direction, bound, before=slice(0)):
        row = np.zeros((moves, spec.n))
        row[t] = direction
        row[before] = -direction
        A.append(row.ravel())
        b.append(bound)

    for t in range(moves):
        until = slice(t + 1)
        before = [t - 1] if t else slice(0)
        for joint, axis in enumerate(np.eye(spec.n)):
            for sign, limit in ((1.0, spec.joint_upper), (-1.0, -spec.joint_lower)):
                add([t], sign * axis, most[joint])
                change = config.joint_acceleration_limit * block * (block if t else spec.period)
                add([t], sign * axis, change + (0.0 if t else sign * last[joint]), before)
                add(until, sign * stretch * axis, max(limit[joint] - sign * q[joint], 0.0))
        for h, v in [config.view_tangent] if config.view_tangent else []:
            for row in np.array([[1.0, 0.0, h], [-1.0, 0.0, h], [0.0, 1.0, v], [0.0, -1.0, v]]):
                add(until, -stretch * row @ J, max(row @ y, 0.0))
    A, b = np.array(A), np.array(b)
    return A[np.isfinite(b)], b[np.isfinite(b)]


def random_lanes(rng, scale):
    """Return an observation of an arm near its position limits, references and Jacobians."""
    q = rng.uniform(-0.28, 0.28, (LANES, N))
    y = rng.normal(scale=0.25, size=(LANES, M)) + [0.0, 0.0, 1.0]
    way = rng.normal(scale=0.1 * scale, size=(LANES, 1 + PREVIEW, M)).cumsum(axis=1)
    reference = y[:, None] + scale * rng.normal(size=(LANES, 1, M)) + way
    look = trusted_observation(0.0, q, y, np.full(LANES, True), np.full((LANES, M), True))
    return look, reference, rng.normal(scale=0.4, size=(LANES, M, N))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["moves", "constant"])
@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize(
    ("scale", "period"), [(1e-3, 0.05), (0.05, 0.05), (1.0, 0.05), (1.0, 0.02), (0.05, 0.0125)]
)
def test_every_plan_satisfies_the_optimality_conditions_of_the_documented_problem(
    mode, limits, scale, period
):
    spec = replace(
        plant_spec(N, M, reach=0.3 if limits in {"position", "all"} else 6.0), period=period
    )
    config = MpcConfig(mode=mode, horizon_time=0.3, moves=6, delay=0.1, decay=8.0, **LIMITS[limits])
    law = MpcLaw(config, RobotKnowledge(spec, PREVIEW))
    rng = np.random.default_rng(7)
    observation, reference, J = random_lanes(rng, scale)
    state = law.start(observation)
    solved = 0
    active = 0
    for _ in range(4):
        before = state
        state, velocity = law.command(before, Estimate(J), observation, reference)
        state = law.noted(state, velocity, np.full(LANES, False))
        y = observation.feature + np.array(
            [J[i] @ before.sent[i].sum(axis=0) for i in range(LANES)]
        )
        places = (config.delay + BLOCK * np.arange(7)) / period
        for i in np.flatnonzero(state.plan.success):
            rows = np.stack(
                [np.interp(places, np.arange(1 + PREVIEW), line) for line in reference[i].T],
                axis=-1,
            )
            plan = state.plan.moves[i]
            down = gradient(config, J[i], rows[0] - y[i], rows[1:] - rows[0], plan).ravel()
            A, b = half_spaces(
                config, spec, J[i], before.last[i], observation.joint_position[i], y[i], len(plan)
            )
            slack = b - A @ plan.ravel()
            assert slack.min() > -1e-8
            touched = A[slack < 1e-8]
            residual = nnls(touched.T, -down)[1] if len(touched) else np.linalg.norm(down)
            assert residual < 1e-7 * max(1.0, np.abs(down).max())
            solved += 1
            active += state.plan.active_limits[i] > 0
        observation, reference, J = random_lanes(rng, scale)
    assert solved > 12
    assert active == 0 if scale == 1e-3 and limits == "speed" else active > 0 or scale < 1.0
