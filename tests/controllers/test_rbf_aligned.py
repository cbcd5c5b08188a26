"""Tests of the aligned estimator: it finds rotation and delay, knows a moved camera, and is `rbf` when switched off."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kit.toy import KNOWLEDGE, PERIOD, Learning, M, N, motion, only_jacobian
from servobench.controllers.estimators.rbf import RbfConfig, RbfEstimator
from servobench.controllers.estimators.rbf_aligned import RbfAlignedConfig, RbfAlignedEstimator
from servobench.controllers.networks.rbf import JacobianNetwork

TURN = Rotation.from_rotvec(np.radians(120.0) * np.array([0.36, 0.48, 0.8])).as_matrix()


def network(units=6):
    rng = np.random.default_rng(0)
    return JacobianNetwork(
        rng.normal(size=(N, units, N)), rng.uniform(2.0, 3.0, (N, units)), 0.3 * rng.normal(size=(N, M, units))
    )


def estimator(net=None, **config):
    made = RbfAlignedEstimator(RbfAlignedConfig(**config), KNOWLEDGE, only_jacobian(network() if net is None else net))
    return Learning(made, np.zeros((M, N)))


def covariance(made):
    """Return P of the present delay."""
    return made.estimator.covariance(made.state)


def path(steps, seed=1):
    """Joint positions (steps + 1, N), rad, of an arm that speeds up, turns and brakes."""
    rng, t = np.random.default_rng(seed), np.arange(steps)[:, None]
    speed = 0.04 * np.sin(2 * np.pi * t / rng.uniform(15.0, 40.0, N) + rng.uniform(0.0, 6.0, N))
    return np.concatenate([np.zeros((1, N)), np.cumsum(speed * np.minimum(1.0, t / 3.0), axis=0)])


def features(net, q, turn, delay):
    """The feature along a path, late by `delay`: summed in the very steps in which the estimator predicts it."""
    steps = [turn @ net.jacobian(q[k]) @ (q[k + 1] - q[k]) for k in range(len(q) - 1)]
    y = np.concatenate([np.zeros((1, M)), np.cumsum(steps, axis=0)])
    return np.concatenate([np.repeat(y[:1], delay, axis=0), y[: len(y) - delay]])


def feed(made, q, y, every=1):
    for begin in range(0, len(q) - every, every):
        end = begin + every
        made.update(motion(q[end] - q[begin], y[end] - y[begin], q=q[begin], duration=every * PERIOD))


@pytest.mark.parametrize("delay", range(6))
@pytest.mark.parametrize("turn", [np.eye(M), TURN], ids=["as drawn", "turned"])
def test_the_delay_and_the_map_of_clean_data_are_found(delay, turn):
    net, q = network(), path(60)
    made = estimator(net)
    feed(made, q, features(net, q, turn, delay))
    assert made.state.delay == delay
    np.testing.assert_allclose(made.state.map, turn, atol=0.02)
    np.testing.assert_allclose(made.jacobian(q[-1]), turn @ net.jacobian(q[-1]), atol=0.02)


def test_the_delay_is_found_within_a_few_motions_and_in_noise():
    net, q, found = network(), path(12), []
    for seed in range(20):
        made, noise = estimator(net), np.random.default_rng(seed).normal(scale=0.001, size=(13, M))
        feed(made, q, features(net, q, TURN, 2) + noise)
        found.append(made.state.delay)
    assert found.count(2) >= 19


@pytest.mark.parametrize(("forgetting", "kept"), [(1.0, True), (0.97, False)])
def test_on_a_steady_circle_the_delay_is_kept_as_its_beginning_told_it(forgetting, kept):
    """There a delay and a turn of the map explain the same, so that the latest motions tell nothing of it."""
    net = JacobianNetwork(np.zeros((N, 1, N)), np.full((N, 1), 1e3), np.random.default_rng(0).normal(size=(N, M, 1)))
    angle = np.cumsum(0.05 * np.minimum(1.0, np.arange(401) / 5.0))[:, None]
    a, b = np.random.default_rng(3).normal(scale=0.5, size=(2, N))
    q = (np.cos(angle) - 1.0) * a + np.sin(angle) * b
    y = features(net, q, np.eye(M), 1) + np.random.default_rng(1).normal(scale=0.0004, size=(401, M))
    made, delays = estimator(net, forgetting=forgetting, learn=False), []
    for k in range(400):
        feed(made, q[k : k + 2], y[k : k + 2])
        delays.append(int(made.state.delay))
    assert (set(delays[30:]) == {1}) == kept


def test_lost_frames_do_not_mislead_map_and_delay():
    net, q = network(), path(120)
    made = estimator(net)
    feed(made, q, features(net, q, TURN, 2), every=2)
    assert made.state.delay == 2
    np.testing.assert_allclose(made.state.map, TURN, atol=0.05)


def test_after_a_gap_that_is_longer_than_its_memory_the_past_is_forgotten():
    net, q = network(), path(80)
    made, y = estimator(net), features(net, q, TURN, 0)
    feed(made, q[:40], y[:40])
    before = made.state.map
    made.update(motion(q[79] - q[39], y[79] - y[39], q=q[39], duration=40 * PERIOD))
    np.testing.assert_array_equal(made.state.map, before)


def test_a_jump_of_the_feature_is_no_motion_and_makes_the_map_unknown_again():
    net, q = network(), path(60)
    made, y = estimator(net), features(net, q, np.eye(M), 0)
    feed(made, q[:30], y[:30])
    before = made.state.map
    assert np.trace(covariance(made)) < 0.5
    made.update(motion(q[30] - q[29], np.full(M, 0.2), q=q[29]))
    np.testing.assert_array_equal(made.state.map, before)
    np.testing.assert_array_equal(covariance(made), np.eye(M))
    assert made.diagnostics()["camera_moves"] == 1.0


def moved_without_a_jump(**config):
    """The error of the map after the camera was turned about the ball itself: all that tells is how it moves."""
    net, q = network(), path(90)
    made = estimator(net, **config)
    noise = np.random.default_rng(2).normal(scale=1e-4, size=(len(q), M))
    before, after = features(net, q, np.eye(M), 0) + noise, features(net, q, TURN, 0) + noise
    feed(made, q[:61], before[:61])
    feed(made, q[60:70], after[60:70])
    return np.linalg.norm(made.state.map - TURN)


def test_a_camera_turned_without_a_jump_is_known_by_surprises_that_add_up():
    assert moved_without_a_jump() < 0.5
    assert moved_without_a_jump(detect_moves=False) > 0.8


def test_the_network_learns_in_its_own_frame_what_the_rotation_does_not_explain():
    net, q = network(), path(400)
    true = JacobianNetwork(net.centres, net.widths, 1.1 * net.weights)
    y = features(true, q, TURN, 1)
    errors = []
    for learn in (True, False):
        made = estimator(net, learn=learn, rotation_deviation=0.0, walk=0.0)
        feed(made, q, y)
        wanted = TURN @ true.jacobian(q[-1])
        errors.append(np.linalg.norm(made.jacobian(q[-1]) - wanted) / np.linalg.norm(wanted))
    assert errors[0] < 0.7 * errors[1]


def test_with_all_additions_off_it_is_the_estimator_of_the_paper():
    net, q = network(), path(50)
    y = features(net, q, TURN, 0)
    off = estimator(net, window=8, epsilon=1e-3, align=False, find_delay=False, detect_moves=False, find_noise=False)
    plain = Learning(RbfEstimator(RbfConfig(), KNOWLEDGE, only_jacobian(net)), np.zeros((M, N)))
    feed(off, q, y)
    feed(plain, q, y)
    np.testing.assert_allclose(off.jacobian(q[-1]), plain.jacobian(q[-1]), atol=1e-12)
    assert np.linalg.norm(off.jacobian(q[-1]) - net.jacobian(q[-1])) > 1e-3


def test_without_the_map_the_delay_is_still_found():
    net, q = network(), path(40)
    made = estimator(net, align=False)
    feed(made, q, features(net, q, np.eye(M), 3))
    assert made.state.delay == 3
    np.testing.assert_array_equal(made.state.map, np.eye(M))


def test_the_weighted_error_of_the_map_falls_by_each_innovation():
    """V = tr(M̃ P⁻¹ M̃ᵀ) with P as it is, its walk and bound included: V(k+1) ≤ V(k) − ‖ν‖²/s."""
    net, q = network(), path(80)
    y = features(net, q, TURN, 0)
    made, moved = estimator(net, find_delay=False, learn=False), 0.0

    def weighted():
        error = TURN - made.state.bank[0, :M]
        return float(np.trace(error @ np.linalg.solve(covariance(made), error.T)))

    for k in range(80):
        before = weighted()
        feed(made, q[k : k + 2], y[k : k + 2])
        fall = made.state.nis * M
        moved += fall
        assert weighted() <= before - fall + 1e-9 * (1.0 + before)
    assert moved > 1.0
