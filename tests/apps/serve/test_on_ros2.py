"""The logic of docs/examples/on_ros2.py under planted faults, the velocities that a served arm follows, and refusals.

Nothing here needs ROS 2; tests/apps/serve/test_ros2.py talks through it.
"""

import math
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kit.planted import NODE, START, Planted, ball, joint_states, link, stamped
from kit.served import REQUEST
from servobench.harness.apps.serve.served import Served, Velocities
from servobench.harness.config.settings import Settings

HARMLESS = ("", "gripper", "one_frame_lost")
FAULTS = {  # planted fault -> the reason that is named
    "joints_lost": "joint_states: late, lost or frozen",
    "joints_frozen": "joint_states: late, lost or frozen",
    "joints_backwards": "joint_states: late, lost or frozen",
    "joints_nan": "joint_position must be finite",
    "joint_missing": "KeyError('wrist_3_joint')",
    "ball_lost": "feature: late, lost or frozen",
    "ball_late": "feature: late, lost or frozen",
    "stamps_frozen": "feature: late, lost or frozen",
    "picture_frozen": "feature: not found, or the same in two frames",
    "ball_nan": "feature: not found, or the same in two frames",
    "ball_infinite": "feature: not found, or the same in two frames",
    "node_killed": "joint_states: late, lost or frozen",
    "second_commander": "another node commands the robot",
    "controller_late": "the controller is late",
    "command_nan": "joint_velocity must be finite",
}
PERIODS = (0.05, 0.008, 0.002)


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("period", PERIODS)
def test_a_planted_fault_ends_by_name_within_two_periods(fault, period):
    # At 0.25 rad/s the joints move too little in two short periods to tell.
    longest = 6.0 if (fault, period) == ("picture_frozen", 0.002) else 2.0
    for at in range(10, 35, 5):
        played = Planted(link(period), fault, at, seed=at).play()
        assert FAULTS[fault] in played.own.fault
        assert played.stopped - played.began <= longest * period + 1e-9
        assert max(np.abs(v).max() for _, v in played.sent) <= 0.25
        assert all(now <= played.stopped for now, _ in played.sent)
        assert len(played.sent) >= at - 1


@pytest.mark.parametrize("fault", HARMLESS)
@pytest.mark.parametrize("simulated", [False, True])
def test_what_is_no_fault_does_not_end_it(fault, simulated):
    played = Planted(link(simulated=simulated), fault).play()
    # In simulated time stamps are those of the clock, which begins anew here.
    if not simulated:
        assert not played.own.fault
        assert len(played.sent) == 40


def test_joints_are_taken_by_name_in_any_order_and_among_others():
    own = link()
    names = list(own.config.joints)
    for k in range(20):
        order = np.random.default_rng(k).permutation(6)
        mixed = ["finger", *(names[i] for i in order)]
        own.hear_joints(stamped(k, name=mixed, position=[9.0, *START[order]]), 0.0)
        own.hear_ball(ball(k, (0.0, 0.0, 1.0 + k)), 0.0)
        assert np.array_equal(own.observe().joint_position, START)


def test_a_range_that_would_be_left_ends_it_before_anything_is_sent():
    narrow = link(box=(-0.1, -0.1, 0.0, 0.1, 0.1, 0.1))
    own = Planted(narrow).play()
    assert "joints or ball leave their range" in own.own.fault
    assert not own.sent
    far = link(0.5, speed=3.0)
    away = Planted(far, "runs_away", at=0).play(60)
    assert "joints or ball leave their range" in away.own.fault
    assert away.sent
    assert (np.abs(away.q) <= math.tau).all()


def test_the_time_of_capture_is_the_stamp_and_stays_where_nothing_was_found():
    own = link()
    own.hear_joints(joint_states(own, 50_000_000, START), 0.0)
    own.hear_ball(ball(150_000_000, (0.0, 0.0, 1.0)), 0.0)
    assert own.observe().capture_time == pytest.approx(0.15, abs=1e-15)
    own.hear_joints(joint_states(own, 100_000_000, START), 0.0)
    own.hear_ball(ball(150_001_000, [math.nan] * 3), 0.0)
    seen = own.observe()
    assert (seen.time, seen.feature_valid) == (0.05, False)
    assert seen.capture_time == pytest.approx(0.15, abs=1e-15)
    assert seen.feature.tolist() == [0.0, 0.0, 1.0]


def test_a_first_frame_without_a_ball_is_an_end():
    own = link()
    own.hear_joints(joint_states(own, 1, START), 0.0)
    own.hear_ball(ball(1, [math.nan] * 3), 0.0)
    with pytest.raises(RuntimeError, match="feature: not found"):
        own.observe()


def test_simulated_time_is_late_by_its_own_clock():
    own = link(simulated=True)
    own.hear_joints(joint_states(own, 0, START), 0.0)
    own.hear_ball(ball(0, (0.0, 0.0, 1.0)), 0.0)
    own.observe()
    own.send(np.zeros(6), 0.0)
    own.watch(0.05)
    own.hear_joints(joint_states(own, 50_000_000, START), 0.05)
    # The clock that a node has may be a period behind what it hears.
    own.hear_ball(ball(50_000_000, (0.0, 0.0, 1.1)), 0.0)
    own.observe()
    own.send(np.zeros(6), 0.05)
    own.watch(0.1)
    own.check()
    own.watch(0.15)
    with pytest.raises(RuntimeError, match="joint_states: late, lost or frozen"):
        own.check()


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["joints", "ball", "control", "command"]),
        st.integers(-3, 3),  # steps of the stamp
        st.floats(0.0, 0.1),  # until the next event [s]
        st.floats(allow_nan=True, width=16),
    ),
    max_size=60,
)


@settings(max_examples=60, deadline=None)
@given(EVENTS)
def test_whatever_comes_nothing_beyond_the_limits_or_after_the_end_is_sent(events):
    own = link(box=(-1.0, -1.0, 0.0, 1.0, 1.0, 1.5))
    now, stamp = 0.0, 10**9
    for kind, step, wait, number in events:
        now, stamp = now + wait, stamp + step * 10**7
        ended = own.fault
        try:
            if kind == "joints":
                own.hear_joints(joint_states(own, stamp, [*START[:5], number]), now)
            elif kind == "ball":
                own.hear_ball(ball(stamp, (number, 0.0, 1.0)), now)
            elif kind == "command" and number != 0.0:
                own.hear_command(stamped(0, data=[number]), now)
            elif own.ready:
                own.observe()
                v = own.send([number] * 6, now)
                assert not ended
                assert (np.abs(v) <= 0.25).all()
            own.watch(now)
        except (RuntimeError, ValueError):
            own.end("an error")
            assert own.fault


@pytest.mark.skipif(find_spec("rclpy") is not None, reason="ROS 2 is installed here")
def test_without_ros_2_the_remedy_is_said(refusal_of):
    setup = None
    with pytest.raises(ValueError, match=r"needs rclpy: on Python 3.12 pip install 'servobench\["):
        NODE.ROS2(NODE.ROS2Config(), setup)
    line = refusal_of("serve", "--protocol", "ros2")
    assert "--protocol ros2 needs rclpy (No module named 'rclpy'): on Python 3.12 pip" in line
    assert "source an installed ROS 2" in line


def test_an_address_is_refused_where_ros_2_has_none(refusal_of):
    line = refusal_of("serve", "--protocol", "ros2", "--address", "127.0.0.2")
    assert "for ros2 set the variable ROS_AUTOMATIC_DISCOVERY_RANGE" in line


def test_the_arm_follows_commands_and_stands_after_silence():
    lines = []
    followed = Velocities(2, 0.1, lines.append)
    assert not followed.at(0.0).any()
    followed.take([0.1, -0.2], 1.0)
    assert followed.at(1.1).tolist() == [0.1, -0.2]
    assert not followed.at(1.11).any()
    assert not followed.at(9.0).any()
    assert lines == ["the arm stands: no command for 100 ms"]


@pytest.mark.parametrize("numbers", [[0.1], [0.1] * 3, [0.1, math.nan], [math.inf, 0.0], []])
def test_a_command_that_is_none_lets_the_arm_stand(numbers):
    lines = []
    followed = Velocities(2, 0.1, lines.append)
    for _ in range(3):
        followed.take([0.3, 0.3], 0.0)
        followed.came = False
        followed.take(numbers, 0.0)
        assert followed.came
        assert not followed.at(0.0).any()
        followed.take(numbers, 0.0)
    assert len(lines) == 3
    assert lines[0].startswith("the arm stands: a command must hold 2 finite numbers, got [")


@pytest.mark.parametrize("lockstep", [True, False])
def test_a_served_plant_tells_every_frame_and_when_it_was_exposed(lockstep):
    request = replace(REQUEST, varied={"latency": 0.1})
    served = Served(request, Settings({}), print, lockstep=lockstep, stamps=True)
    told = []
    for _ in range(5 * served.frames + 1):
        if served.advance(np.zeros(6)):
            seen = served.rollout.observation
            told.append((seen.time, float(seen.capture_time)))
    served.plant.close()
    assert len(told) >= 5
    late = [time - captured for time, captured in told[3:]]
    assert late == pytest.approx([0.1] * len(late))
    assert served.frames == (1 if lockstep else 25)


def test_a_backlog_is_dropped_with_a_line():
    lines = []
    served = Served(REQUEST, Settings({}), lines.append, lockstep=False)
    assert served.next_period(1.0, 1.05) == pytest.approx(1.002)
    assert served.next_period(1.0, 1.302) == pytest.approx(1.302)
    served.plant.close()
    assert lines == ["the plant is slower than the wall clock: 300 ms are left out"]


def test_the_first_picture_may_stay_while_the_arm_begins_to_move():
    own = link()
    for k in range(7):
        own.hear_joints(
            joint_states(own, k * 50_000_000, START + 0.02 * k * np.eye(6)[0]), 0.05 * k
        )
        own.hear_ball(ball(k * 50_000_000, (0.0, 0.0, 1.0)), 0.05 * k)
        if k == 6:
            with pytest.raises(RuntimeError, match="the same in two frames as the joints move"):
                own.observe()
            return
        seen = own.observe()
        assert seen.feature_valid == (k < 5)
        assert seen.capture_time == pytest.approx(0.05 * k)
        own.send(np.full(6, 0.2), 0.05 * k)
