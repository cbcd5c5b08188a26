"""Tests of all estimators, and of probing, over leading axes; `test_chain_lanes` has them in their chains."""

import dataclasses

import numpy as np
import pytest

from kit.toy import KNOWLEDGE, PERIOD, M, N, assert_lanes, jacobian_network, only_jacobian
from servobench.controllers.estimators.estimator import Motion
from servobench.controllers.initial_jacobian import InitialConfig, initial_jacobian
from servobench.controllers.methods import ESTIMATORS
from servobench.plant.contract.faults import FilterDiverged
from servobench.plant.contract.signals import trusted_observation

LANES = 3
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
