"""Tests of the pair stage: it finds delay, map and noise at every rate, and knows a moved camera."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kit.toy import KNOWLEDGE, PERIOD, SPEC, M, N, jacobian_network, seen
from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import Delays
from servobench.controllers.estimators.constant import ConstantEstimator
from servobench.controllers.stages.estimation import Estimation
from servobench.controllers.stages.pairing import Pairing
from servobench.plant.contract.signals import Observation

TURN = Rotation.from_rotvec(np.radians(120.0) * np.array([0.36, 0.48, 0.8])).as_matrix()
NETWORK = dataclasses.replace(jacobian_network(N, M, units=6), weights=0.3 * jacobian_network(N, M, units=6).weights)
MAPPED = {"delay": "identified", "noise": "identified", "model": "map"}


class Following:
    """Pair and estimate stages of an arm whose model is `NETWORK`, with the state of one run."""

    def __init__(self, period=PERIOD, latency=0.0, **aids):
        knowledge = dataclasses.replace(
            KNOWLEDGE, spec=dataclasses.replace(SPEC, period=period), nominal_jacobian=NETWORK.jacobian
        )
        self.period, self.k, self.state = period, 0, None
        delays = Delays(latency, 0.0, 0.0)
        self.stages = Estimation(ConstantEstimator(), knowledge, AidsConfig(**{**MAPPED, **aids}), delays)

    def see(self, q, y, valid=True):
        look = Observation(self.k * self.period, q, y, valid)
        if self.state is None:
            self.state = self.stages.start(look, NETWORK.jacobian(q))
        self.state = self.stages.update(self.state, look, np.zeros(M))
        self.k += 1

    def follow(self, q, y, valid=None):
        for k in range(len(q)):
            self.see(q[k], y[k], valid is None or bool(valid[k]))
        return self

    @property
    def pair(self):
        return self.state.learned.pair

    @property
    def found(self):
        return self.stages.pairing.diagnostics(self.pair)

    @property
    def bank(self):
        """Return map and covariance of the present delay."""
        bank = self.pair.bank[self.pair.candidate]
        return bank[:M, :M], bank[M:-1, :M]


def path(duration, period=PERIOD, seed=1):
    """Joint positions, rad, of an arm that speeds up, turns and brakes."""
    rng, t = np.random.default_rng(seed), period * np.arange(round(duration / period))[:, None]
    speed = 0.8 * np.sin(2 * np.pi * t / rng.uniform(0.75, 2.0, N) + rng.uniform(0.0, 6.0, N)) * np.minimum(1, t / 0.15)
    return np.concatenate([np.zeros((1, N)), np.cumsum(period * speed, axis=0)])


def features(q, turn, delay, network=NETWORK):
    """The feature along a path, late by `delay` periods: summed in the very steps in which it is predicted."""
    steps = np.matvec(turn @ network.jacobian(q[:-1]), np.diff(q, axis=0))
    y = np.concatenate([np.zeros((1, M)), np.cumsum(steps, axis=0)])
    return np.concatenate([np.repeat(y[:1], delay, axis=0), y[: len(y) - delay]])


@pytest.mark.parametrize("delay", range(6))
@pytest.mark.parametrize("turn", [np.eye(M), TURN], ids=["as modelled", "turned"])
def test_delay_and_map_are_found_in_noise(delay, turn):
    q = path(4.0)
    made = Following().follow(q, features(q, turn, delay) + 2e-4 * np.random.default_rng(0).normal(size=(len(q), M)))
    assert made.found["delay"] == pytest.approx(delay * PERIOD)
    np.testing.assert_allclose(made.pair.map, turn, atol=0.03)
    wanted = np.arccos((np.trace(turn) - 1.0) / 2.0)
    assert made.found["map_rotation"] == pytest.approx(wanted, abs=0.03)
    np.testing.assert_allclose(made.state.jacobian, turn @ NETWORK.jacobian(q[-1]), atol=0.03)


@pytest.mark.parametrize(("period", "latency"), [(0.1, 0.2), (0.05, 0.15), (0.008, 0.12), (0.004, 0.12), (0.004, 0.0)])
def test_the_latency_in_seconds_is_found_at_every_rate(period, latency):
    q = path(4.0, period)
    noise = 2e-4 * np.random.default_rng(0).normal(size=(len(q), M))
    made = Following(period).follow(q, features(q, TURN, round(latency / period)) + noise)
    assert made.found["delay"] == pytest.approx(latency, abs=1.5 * max(period, 0.25 / 24))
    assert len(made.pair.scores) <= 25
    np.testing.assert_allclose(made.pair.map, TURN, atol=0.1)  # the delay may lie between two candidates


@pytest.mark.parametrize(("period", "latency"), [(0.05, 0.025), (0.05, 0.0875), (0.02, 0.05)])
def test_a_latency_between_two_periods_is_found(period, latency):
    fine, parts = path(4.0, period / 8), 8
    y = features(fine, TURN, round(parts * latency / period))[::parts]
    made = Following(period).follow(fine[::parts], y + 2e-4 * np.random.default_rng(0).normal(size=y.shape))
    assert made.found["delay"] == pytest.approx(latency, abs=0.007)
    np.testing.assert_allclose(made.pair.map, TURN, atol=0.05)


def test_the_delay_is_found_within_a_few_motions():
    q, found = path(0.6), []
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(scale=0.001, size=(len(q), M))
        found.append(round(Following().follow(q, features(q, TURN, 2) + noise).found["delay"] / PERIOD))
    assert found.count(2) >= 18


@pytest.mark.parametrize("latency", [0.0, 0.06, 0.1, 0.25])
def test_a_given_delay_is_used_as_it_is(latency):
    made, q = Following(latency=latency, delay="given"), path(1.0)
    made.follow(q, features(q, TURN, 4))
    assert made.found["delay"] == pytest.approx(latency)
    _, exposed, before, _ = made.stages.pairing.past(made.pair, q[-1], 1)
    at, rows = len(q) - 1 - latency / PERIOD, np.arange(len(q))
    wanted = [np.array([np.interp(place, rows, joint) for joint in q.T]) for place in (at, at - 1.0)]
    np.testing.assert_allclose(exposed, wanted[0], atol=1e-15)
    np.testing.assert_allclose(before, wanted[0] - wanted[1], atol=1e-15)


def test_the_map_is_that_of_generalised_least_squares():
    """With P⁻¹ = I and M = I at first, motions that share the noise of frames, and no walk."""
    q, sigma = path(2.0), 0.003
    y = features(q, TURN, 1) + sigma * np.random.default_rng(4).normal(size=(len(q), M))
    plain = {"noise": "given", "delay": "given", "map_walk": 0.0, "map_error": 0.0, "detect_moves": False}
    made = Following(latency=0.05, feature_noise=sigma, **plain).follow(q, y)
    X, Y = np.diff(features(q, np.eye(M), 1), axis=0), np.diff(y, axis=0)
    count = len(X)
    weight = np.linalg.inv(sigma**2 * (2.0 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)))
    normal = X.T @ weight @ X + np.eye(M)
    map_, P = made.bank
    np.testing.assert_allclose(map_, np.linalg.solve(normal, X.T @ weight @ Y + np.eye(M)).T, rtol=1e-7)
    np.testing.assert_allclose(P, np.linalg.inv(normal), rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("sigma", [3e-4, 0.002])
def test_the_noise_is_found(sigma):
    q = path(15.0)
    y = features(q, TURN, 1) + sigma * np.random.default_rng(4).normal(size=(len(q), M))
    found = Following(map_error=0.0, map_walk=0.0).follow(q, y).found["noise_level"]
    assert found == pytest.approx(sigma, rel=0.25)


@pytest.mark.parametrize(("memory", "kept"), [(1.0, True), (0.97, False)])
def test_on_a_steady_circle_the_delay_is_kept_as_its_beginning_showed_it(memory, kept):
    """There a delay and a turn of the map explain the same, so that the latest motions say nothing of it."""
    angle = np.cumsum(0.05 * np.minimum(1.0, np.arange(401) / 5.0))[:, None]
    a, b = np.random.default_rng(3).normal(scale=0.5, size=(2, N))
    q = (np.cos(angle) - 1.0) * a + np.sin(angle) * b
    J = np.random.default_rng(0).normal(size=(M, N))
    late = np.concatenate([q[:1], q[:-1]])
    y = late @ J.T + np.random.default_rng(1).normal(scale=0.0004, size=(401, M))
    made, delays = Following(score_memory=memory), []
    made.stages._nominal = lambda position: np.broadcast_to(J, (*np.shape(position)[:-1], M, N))
    for k in range(401):
        made.see(q[k], y[k])
        delays.append(round(made.found["delay"] / PERIOD))
    assert (set(delays[30:]) == {1}) == kept


def test_lost_frames_do_not_mislead_map_and_delay():
    q, rng = path(6.0), np.random.default_rng(3)
    made = Following().follow(q, features(q, TURN, 2), rng.random(len(q)) < 0.5)
    assert made.found["delay"] == pytest.approx(2 * PERIOD)
    np.testing.assert_allclose(made.pair.map, TURN, atol=0.05)


@pytest.mark.parametrize("period", [0.05, 0.008])
def test_after_a_gap_that_is_longer_than_the_memory_nothing_is_learned_from_it(period):
    q = path(5.0, period)
    y, valid = features(q, TURN, 0), np.full(len(q), True)
    lost = slice(round(2.0 / period), round(4.0 / period))
    valid[lost] = False
    made = Following(period).follow(q[: lost.stop], y[: lost.stop], valid)
    before = made.pair
    made.see(q[lost.stop], y[lost.stop])
    np.testing.assert_array_equal(made.pair.bank[:, :M, :M], before.bank[:, :M, :M])
    np.testing.assert_array_equal(made.pair.bank[:, M:-1, :M], before.bank[:, M:-1, :M])
    assert not made.pair.bank[:, :M, -1].any()  # the noise of the frame before the gap is in no motion
    np.testing.assert_array_equal(made.pair.moves, before.moves)
    made.follow(q[lost.stop + 1 :], y[lost.stop + 1 :])
    assert made.found["camera_moves"] == 0
    np.testing.assert_allclose(made.pair.map, TURN, atol=0.05)


def test_a_jump_of_the_feature_is_no_motion_and_makes_the_map_unknown_again():
    q = path(1.5)
    made, y = Following(), features(q, np.eye(M), 0)
    made.follow(q[:30], y[:30])
    before, P = made.pair.map, made.bank[1]
    assert np.trace(P) < 0.5
    made.see(q[30], y[30] + 0.3)
    np.testing.assert_array_equal(made.pair.map, before)
    np.testing.assert_array_equal(made.bank[1], np.eye(M))
    assert made.found["camera_moves"] == 1
    assert made.found["map_deviation"] == pytest.approx(1.0)
    assert not made.stages.pairing.is_known(made.pair)


def moved_without_a_jump(**aids):
    """The error of the map after the camera was turned about the ball itself: only motions show it."""
    q = path(4.5)
    noise = np.random.default_rng(2).normal(scale=1e-4, size=(len(q), M))
    before, after = features(q, np.eye(M), 0), features(q, TURN, 0)
    y = np.concatenate([before[:61], after[61:] - after[60] + before[60]]) + noise
    made = Following(delay="given", **aids).follow(q[:70], y[:70])
    return np.linalg.norm(made.pair.map - TURN), made.found["camera_moves"]


def test_a_camera_turned_without_a_jump_is_known_by_surprises_that_add_up():
    (found, moves), (kept, none) = moved_without_a_jump(), moved_without_a_jump(detect_moves=False)
    assert found < 0.5 < 0.6 < kept
    assert moves >= 1
    assert none == 0


def test_without_the_map_the_delay_is_still_found():
    q = path(2.0)
    made = Following(model="nominal").follow(q, features(q, np.eye(M), 3))
    assert made.found["delay"] == pytest.approx(3 * PERIOD)
    assert "map_rotation" not in made.found
    np.testing.assert_array_equal(made.pair.map, np.eye(M))


def test_the_weighted_error_of_the_map_falls_by_each_innovation():
    """V = tr([M̃ ẽ] P⁻¹ [M̃ ẽ]ᵀ) with P as it is, its walk and bound included: V(k+1) ≤ V(k) − ‖ν‖²/s."""
    q = path(4.0)
    y, made, moved = features(q, TURN, 0), Following(delay="given"), 0.0
    made.see(q[0], y[0])

    def weighted():
        bank = made.pair.bank[made.pair.candidate]
        wrong = np.column_stack([TURN, np.zeros(M)]) - bank[:M]
        return float(np.trace(wrong @ np.linalg.solve(bank[M:], wrong.T)))

    for k in range(1, 80):
        before, moves = weighted(), made.found["camera_moves"]
        made.see(q[k], y[k])
        fall = made.pair.nis * M
        moved += fall
        assert made.found["camera_moves"] == moves
        assert weighted() <= before - fall + 1e-9 * (1.0 + before)
    assert moved > 1.0


def test_nothing_is_identified_where_nothing_is_asked_for():
    pairing = Pairing(AidsConfig(filter=True), SPEC, 0.0)
    state = pairing.advance(pairing.start(seen(np.zeros(N), np.zeros(M)), np.ones((M, N))), np.full(N, 0.01))
    after, paired = pairing.learn(state, np.full(M, 0.3), np.float64(PERIOD), np.zeros(M), np.full(M, True))
    assert after is state
    np.testing.assert_allclose(paired.joint_step, 0.01)
    np.testing.assert_allclose(paired.predicted, 0.05)
    assert pairing.is_known(state)
    assert pairing.noise(state) is None
    assert set(pairing.diagnostics(state)) == {"delay"}
