"""Tests of the last stages: feedforward, posture, and a command within its limits."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kit.toy import KNOWLEDGE, LIMIT, PERIOD, A, M, N, seen
from servobench.controllers.aids import AidsConfig
from servobench.controllers.stages.finish import Finish, redistribute, scale_to_limit
from servobench.plant.contract.lanes import stack

NOTHING = np.zeros(())


def finish(wanted, q=None, forward=NOTHING, J=A, knowledge=KNOWLEDGE, **aids):
    """Return what leaves the chain, and whether it was limited."""
    made = Finish(AidsConfig(**aids), knowledge, "ALaw", ())
    return made.finish(
        np.asarray(wanted), J, np.zeros(np.shape(wanted)) if q is None else q, forward
    )


def test_feedforward_and_posture_by_hand():
    """dq = dq_law + J⁺ r + κ (I − J⁺J)(q_c − q), with the middle of the working region as q_c."""
    region = np.full(N, -0.5), np.full(N, 1.5)
    knowledge = dataclasses.replace(KNOWLEDGE, region=region)
    q = np.full(N, 0.1)
    r = np.array([0.001, 0.0, 0.002])
    wanted = np.linspace(-0.1, 0.1, N)
    pinv = np.linalg.pinv(A)
    posture = (1.0 - np.exp(-0.2 * PERIOD)) * (np.eye(N) - pinv @ A) @ (0.5 - q)
    aids = {"feedforward": True, "posture": True, "posture_gain": 0.2, "damping": 1e-9}
    u, limited = finish(wanted, q, r, knowledge=knowledge, **aids)
    np.testing.assert_allclose(u, wanted + (pinv @ r + posture) / PERIOD, atol=1e-8)
    assert not limited


def test_the_posture_does_not_move_the_feature_and_comes_nearer_to_the_middle():
    q = np.linspace(-1.0, 1.0, N)
    y = A @ q
    null = np.eye(N) - np.linalg.pinv(A) @ A
    for _ in range(200):
        u, _ = finish(np.zeros(N), q, posture=True, posture_gain=0.2, damping=1e-9)
        q = q + u * PERIOD
        np.testing.assert_allclose(A @ q, y, atol=1e-7)
    np.testing.assert_allclose(
        null @ q, np.exp(-0.2 * 200 * PERIOD) * null @ np.linspace(-1.0, 1.0, N), atol=1e-6
    )


@pytest.mark.parametrize("period", [0.1, 0.008])
def test_the_posture_does_not_depend_on_the_control_rate(period):
    ends = []
    for dt in (PERIOD, period):
        knowledge = dataclasses.replace(
            KNOWLEDGE, spec=dataclasses.replace(KNOWLEDGE.spec, period=dt)
        )
        q = np.ones(N)
        for _ in range(round(2.0 / dt)):
            q = q + finish(np.zeros(N), q, posture=True, knowledge=knowledge, damping=1e-9)[0] * dt
        ends.append(q)
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-6)


@pytest.mark.parametrize("limit", ["scale", "clip", "redistribute"])
def test_a_command_within_the_limits_is_sent_as_it_is(limit):
    wanted = np.linspace(-1.0, 1.0, N) * LIMIT
    u, limited = finish(wanted, limit=limit)
    np.testing.assert_allclose(u, wanted, rtol=1e-15)
    assert not limited


def test_a_command_beyond_the_limits_is_scaled_cut_or_taken_over_by_joints_with_room():
    wanted = np.array([1.9, -0.5, 0.2, -1.5, 0.6]) * LIMIT
    scaled, cut, shared = (
        finish(wanted, limit=limit) for limit in ("scale", "clip", "redistribute")
    )
    np.testing.assert_allclose(scaled[0], wanted / 1.9)
    np.testing.assert_array_equal(cut[0], np.clip(wanted, -LIMIT, LIMIT))
    way = A @ wanted
    np.testing.assert_array_less(np.abs(shared[0]), LIMIT * (1.0 + 1e-12))
    assert (A @ shared[0]) @ way > 1.2 * (A @ scaled[0]) @ way
    assert scaled[1] and cut[1] and shared[1]  # noqa: PT018 - all three are limited


def test_a_joint_at_the_edge_of_the_region_does_not_take_over():
    J = np.array([[1.0, 1.0, 0.0, 0.0, 0.0]] * 1)
    wanted = np.array([1.5, 0.0, 0.0, 0.0, 0.0])
    at_edge = np.array([0.0, 6.0, 0.0, 0.0, 0.0])  # the reach of the toy's joints
    free, _ = finish(wanted, J=J, limit="redistribute", damping=1e-6)
    held, _ = finish(wanted, at_edge, J=J, limit="redistribute", damping=1e-6)
    np.testing.assert_allclose(free[:2], [1.0, 0.5], atol=1e-4)
    np.testing.assert_allclose(held[:2], [1.0, 0.0], atol=1e-4)


def test_a_command_that_turns_back_at_its_limit_again_and_again_is_slowed_down():
    """The seventh turn in a row halves the speed; each period without one gives a quarter of it back."""
    stage = Finish(AidsConfig(calming=True), KNOWLEDGE, "ALaw", ())
    full = np.linspace(-1.0, 0.5, N) * LIMIT
    pace = stage.start(seen(np.zeros(N), np.zeros(M)))
    shares = []
    for sign in (1, -1, 1, -1, 1, -1, 1, -1, 1, 1, 1, 1, 1):
        pace, u, limited = stage.calm(pace, sign * full, np.True_)
        shares.append(np.max(u / (sign * full)))
        np.testing.assert_allclose(u, sign * shares[-1] * full, rtol=1e-15)
        assert limited
    np.testing.assert_allclose(shares[:7], 1.0, rtol=0)
    np.testing.assert_allclose(shares[7:], [0.5, 0.25, 0.3125, 0.390625, 0.48828125, 0.6103515625])


def test_calming_leaves_small_commands_and_the_runs_beside_alone():
    stage = Finish(AidsConfig(calming=True), KNOWLEDGE, "ALaw", ())
    rest = seen(np.zeros(N), np.zeros(M))
    pace = stack([stage.start(rest)] * 3)
    size = np.array([[1.0], [0.9], [1.0]]) * np.ones((3, N)) * LIMIT
    signs = np.array([[-1.0], [-1.0], [1.0]])  # a turn each period, one within the limits, no turn
    for period in range(20):
        wanted = size * signs**period
        pace, u, limited = stage.calm(pace, wanted, np.array([True, False, True]))
        np.testing.assert_array_equal(u[1:], wanted[1:])
        assert limited.tolist() == [True, False, True]
    np.testing.assert_allclose(u[0], wanted[0] / 64.0)
    small = np.full((3, N), 0.01 * LIMIT)
    _, u, limited = stage.calm(pace, small, np.zeros(3, dtype=bool))
    np.testing.assert_array_equal(u, small)
    assert not limited.any()


@pytest.mark.parametrize(
    ("excess", "room", "taken"),
    [(5e-6, 1.0, 5e-6), (5e-7, 1.0, 0.0), (0.5, 3e-9, 3e-9), (0.5, 3e-10, 0.0)],
)
def test_only_a_remainder_and_a_room_above_rounding_are_taken_over(excess, room, taken):
    room, wanted, one = np.array([0.0, room]), np.array([1.0 + excess, 0.0]), np.ones(2)
    dq = redistribute(wanted, np.ones((1, 2)), one, 1e-9, (np.zeros(2), room))
    np.testing.assert_allclose(dq, [1.0, taken], rtol=1e-4, atol=1e-14)


@settings(max_examples=60)
@given(n=st.integers(1, 7), m=st.integers(1, 4), seed=st.integers(0, 10**6))
def test_redistribution_keeps_limits_and_direction_and_goes_no_less_far(n, m, seed):
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(m, n))
    limit = rng.uniform(0.05, 0.2, n)
    wanted = rng.normal(size=n)
    dq = redistribute(wanted, J, limit, 1e-6, (limit, limit))
    scaled = scale_to_limit(wanted, limit)
    assert (np.abs(dq) <= limit * (1 + 1e-12)).all()
    way = J @ wanted
    if np.linalg.cond(J) < 100.0:
        share = float((J @ dq) @ way / (way @ way))
        np.testing.assert_allclose(J @ dq, share * way, atol=1e-5)
        assert float((J @ scaled) @ way / (way @ way)) - 1e-6 <= share <= 1.0 + 1e-9
