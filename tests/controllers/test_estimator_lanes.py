"""Test of all estimators over leading axes: a lane has the same bits alone and among others, in any order."""

import dataclasses
from functools import partial

import numpy as np
import pytest

from kit.toy import KNOWLEDGE, PERIOD, M, N, assert_lanes, jacobian_network, only_jacobian
from servobench.controllers.estimators.estimator import Motion
from servobench.controllers.initial_jacobian import InitialConfig, initial_jacobian
from servobench.controllers.methods import ESTIMATORS
from servobench.plant.contract.faults import FilterDiverged
from servobench.plant.contract.lanes import branch
from servobench.plant.contract.signals import trusted_observation

LANES, PERIODS = 3, 70
NETWORK = jacobian_network(N, M, units=5)
KNOWING = dataclasses.replace(KNOWLEDGE, true_jacobian=NETWORK.jacobian)
SETTINGS = [
    *((name, {}) for name in ESTIMATORS),
    ("kalman", {"form": "full"}),
    ("ukf", {"form": "sigma_points"}),
    ("rbf", {"window": 1}),
]


def made(name, changes):
    part = ESTIMATORS[name]
    return part.make(part.config(**changes), KNOWING, *([only_jacobian(NETWORK)] if part.trained else []))


def seen():
    """Return joint positions, features and where they are valid, each with axes of periods and lanes.

    One lane rests for a while, one loses 20 frames at a stretch, one sees a camera that is moved.
    """
    rng, t = np.random.default_rng(5), np.arange(PERIODS)[:, None, None]
    steps = 0.05 * np.sin(2 * np.pi * t / rng.uniform(10.0, 30.0, (LANES, N)) + rng.uniform(0.0, 6.0, (LANES, N)))
    steps[10:16, 0] = 0.0
    q = np.cumsum(steps, axis=0)
    turns = np.stack([np.eye(M), -np.eye(M), np.eye(M)[[1, 2, 0]]])
    moved = np.concatenate([np.zeros((1, LANES, M)), np.matvec(turns @ NETWORK.jacobian(q[:-1]), np.diff(q, axis=0))])
    y = np.cumsum(moved, axis=0) + 0.001 * rng.normal(size=moved.shape)
    y[40:, 2] += 3.0
    valid = rng.random((PERIODS, LANES)) < 0.85
    valid[20:40, 1] = False
    valid[0] = True
    return q, y, valid


def learned(estimator, lanes):
    """Return Ĵ and diagnostics of every period; from the 30th on the noise is known."""
    q, y, valid = (each[:, lanes] for each in seen())
    state = estimator.start(NETWORK.jacobian(q[0]))
    last, found = (q[0], y[0], np.zeros(np.shape(valid[0]))), []
    for k in range(1, PERIODS):
        noise = 0.001 + 1e-5 * np.asarray(lanes) * k if k > 30 else None
        motion = Motion(last[0], q[k] - last[0], y[k] - last[1], 0.1 - y[k], (k - last[2]) * PERIOD, noise)
        state = branch(valid[k], estimator.update, state, motion)
        last = branch(valid[k], lambda _, now: now, last, (q[k], y[k], np.full(np.shape(valid[k]), float(k))))
        found.append(dict(estimator.diagnostics(state)) | {"J": estimator.jacobian(state, q[k])})
    return found


@pytest.mark.parametrize(("name", "changes"), SETTINGS, ids=lambda part: part if isinstance(part, str) else "")
def test_a_lane_has_the_same_bits_alone_and_among_others_in_any_order(name, changes):
    assert_lanes(partial(learned, made(name, changes)))


@pytest.mark.parametrize(("name", "changes"), SETTINGS, ids=lambda part: part if isinstance(part, str) else "")
def test_at_the_start_each_lane_tells_its_own_numbers(name, changes):
    estimator = made(name, changes)
    for lead in ((), (LANES,), (2, LANES)):
        J = np.ones((*lead, M, N))
        state = estimator.start(J)
        assert {np.shape(value) for value in estimator.diagnostics(state).values()} <= {lead}
        assert estimator.jacobian(state, np.zeros((*lead, N))).shape == J.shape


@pytest.mark.parametrize("name", ["kalman", "ukf", "mckf", "rls", "cfdl", "broyden"])
def test_a_motion_of_the_least_length_counts_and_a_smaller_one_does_not(name):
    estimator = made(name, {"min_joint_step": 0.25})
    for length, counts in ((0.25, True), (0.2499, False)):
        state = estimator.start(np.ones((M, N)))
        way = Motion(np.zeros(N), length * np.eye(N)[1], np.full(M, 0.1), np.zeros(M), np.asarray(PERIOD)[()])
        assert bool(estimator.diagnostics(estimator.update(state, way))["estimator_updated"]) == counts


FILTERS = [each for each in SETTINGS if hasattr(made(*each).start(np.ones((M, N))), "P")]


@pytest.mark.parametrize(("name", "changes"), FILTERS, ids=lambda part: part if isinstance(part, str) else "")
@pytest.mark.parametrize("factor", [-1.0, np.nan])
def test_a_covariance_that_is_not_positive_definite_is_a_named_fault(name, changes, factor):
    estimator = made(name, changes)
    state = estimator.start(np.ones((M, N)))
    way = Motion(np.zeros(N), np.full(N, 0.3), np.zeros(M), np.zeros(M), np.asarray(PERIOD)[()])
    with pytest.raises(FilterDiverged, match="covariance is not"), np.errstate(invalid="ignore"):
        estimator.update(state._replace(P=factor * state.P), way)


def test_estimators_say_which_of_them_bring_a_model():
    assert {name for name in ESTIMATORS if made(name, {}).brings_model} == {"true", "rbf", "rbf_lyapunov"}


def test_probing_has_the_same_bits_alone_and_among_others():
    provider = initial_jacobian(InitialConfig("probe", settle_periods=2, average_periods=2), KNOWLEDGE)
    rng = np.random.default_rng(1)
    valid, noise = rng.random((250, LANES)) < 0.7, 0.001 * rng.normal(size=(250, LANES, M))

    def probed(lanes):
        q, velocities, state = np.zeros((*np.shape(lanes), N)), [], None
        for k in range(250):
            y = np.matvec(NETWORK.jacobian(np.zeros(N)), q) + noise[k, lanes]
            look = trusted_observation(k * PERIOD, q, y, valid[k, lanes], np.repeat(valid[k, lanes][..., None], M, -1))
            state, u, done = provider.step(provider.start(look) if state is None else state, look)
            q = q + u * PERIOD
            velocities.append((u, done))
        return [velocities, provider.jacobian(state)]

    finished = 250 - np.sum([done for _, done in assert_lanes(probed)[0]], axis=0)
    assert len(set(finished.tolist())) > 1  # not all at the same time
    assert finished.max() < 250
