"""The drives without PyBullet: one joint by hand, equilibria, limits, friction."""

from dataclasses import replace

import numpy as np
import pytest

from servobench.plant.rendered.drives import (
    PHYSICS_STEP,
    STICKING_SPEED,
    Drives,
    DriveState,
    RigidBody,
)
from servobench.plant.rendered.settings import DriveConfig, RenderedConfig

FREE = DriveConfig(
    coulomb_friction=(0.0,),
    viscous_friction=(0.0,),
    rotor_inertia=(0.5,),
    velocity_bandwidth=(2.0,),
    torque_limit=(100.0,),
)
WIDE = np.full(2, -9.0), np.full(2, 9.0)
INERTIA = np.array([[1.5, 0.2], [0.2, 0.5]])


def body(bias=(0.0, 0.0), assumed=(0.0, 0.0)) -> RigidBody:
    return RigidBody(INERTIA.copy(), np.array(bias), np.array(assumed))


def drives(config=FREE, lag=0.0, stops=WIDE, step=PHYSICS_STEP) -> Drives:
    return Drives(config, lag, INERTIA, stops, physics_step=step)


def run(joints: Drives, state: DriveState, command, steps, load=body) -> DriveState:
    joints.take(state, np.asarray(command))
    for _ in range(steps):
        joints.drive(load())
    return joints.give()


@pytest.mark.parametrize("h", [PHYSICS_STEP, 1.0 / 30.0 / 34.0])
def test_the_first_step_is_that_of_the_equations(h):
    joints, command = drives(step=h), np.array([0.3, 0.0])
    state = run(joints, joints.start(np.zeros(2), body()), command, 1)
    pole = 2 * np.pi * 2.0
    reference = h * command
    error = command + pole / 4 * reference
    torque = pole * (np.array([1.5, 0.5]) + 0.5) * error
    np.testing.assert_allclose(
        state.speed, h * np.linalg.inv(INERTIA + 0.5 * np.eye(2)) @ torque, rtol=1e-12
    )
    np.testing.assert_allclose(state.angle, h * state.speed, rtol=1e-12)
    np.testing.assert_allclose(state.integral, h * pole / 10 * torque, rtol=1e-12)


@pytest.mark.parametrize("h", [PHYSICS_STEP, 1.0 / 30.0 / 34.0])
def test_the_reference_is_the_first_order_lag_of_the_command(h):
    joints, decay, command = drives(lag=0.08, step=h), np.exp(-h / 0.08), np.array([0.4, -0.2])
    joints.take(joints.start(np.zeros(2), body()), command)
    for k in range(1, 40):
        joints.track()
        moved = h * (k - decay * (1 - decay**k) / (1 - decay))
        np.testing.assert_allclose(joints.angle, command * moved, atol=1e-14)


def test_joints_at_rest_stay_where_gravity_is_misjudged_at_the_start():
    def sagging():
        return body((20.0, -3.0), (15.0, 1.0))

    state = run(
        drives(), drives().start(np.array([0.1, 0.2]), sagging()), np.zeros(2), 500, sagging
    )
    np.testing.assert_allclose(state.angle, [0.1, 0.2], atol=1e-12)


def test_a_load_that_appears_later_is_carried_by_the_integrals_in_the_end():
    state = run(
        drives(), drives().start(np.zeros(2), body()), np.zeros(2), 300, lambda: body((2.0, 0.0))
    )
    sag = abs(state.angle[0])
    assert sag > 1e-3
    state = run(drives(), state, np.zeros(2), 20_000, lambda: body((2.0, 0.0)))
    assert abs(state.angle[0]) < 1e-3 * sag
    assert state.integral[0] == pytest.approx(2.0, rel=1e-3)


def test_torque_never_exceeds_its_limit_and_integrals_wait_meanwhile():
    weak = drives(replace(FREE, torque_limit=(0.5,)))
    state = run(weak, weak.start(np.zeros(2), body()), (0.5, 0.0), 100)
    inertia = INERTIA + 0.5 * np.eye(2)
    assert abs((inertia @ state.speed)[0]) <= 0.5 * 0.1 + 1e-12
    assert state.integral[0] == 0.0
    assert (
        run(drives(), drives().start(np.zeros(2), body()), (0.5, 0.0), 100).speed[0]
        > 2 * state.speed[0]
    )


def test_a_reference_waits_for_a_joint_that_cannot_follow():
    stuck = drives(replace(FREE, torque_limit=(1e-6,)))
    state = run(stuck, stuck.start(np.zeros(2), body()), (1.0, 0.0), 1000)
    assert state.reference[0] - state.angle[0] <= 0.1 + PHYSICS_STEP + 1e-9


def test_friction_holds_a_joint_against_a_smaller_torque():
    held = drives(replace(FREE, coulomb_friction=(3.0,), torque_limit=(1e-6,)))
    state = run(held, held.start(np.zeros(2), body()), np.zeros(2), 1000, lambda: body((2.0, 0.0)))
    assert abs(state.speed[0]) < STICKING_SPEED
    moves = run(held, held.start(np.zeros(2), body()), np.zeros(2), 1000, lambda: body((4.0, 0.0)))
    assert abs(moves.speed[0]) > 100 * STICKING_SPEED


def test_friction_takes_more_torque_in_proportion_unless_it_is_compensated():
    def lost(share):
        config = replace(FREE, viscous_friction=(2.0,), friction_compensation=share)
        joints = drives(config)
        state = run(joints, joints.start(np.zeros(2), body()), (0.4, 0.0), 20_000)
        assert state.speed[0] == pytest.approx(0.4, rel=1e-6)
        return state.integral[0]

    assert lost(0.0) == pytest.approx(0.8, rel=1e-6)
    assert lost(0.75) == pytest.approx(0.2, rel=1e-6)


def test_a_state_that_was_given_is_a_value_that_drives_go_on_from():
    joints = drives(lag=0.03)
    early = run(joints, joints.start(np.zeros(2), body()), (0.5, -0.1), 20)
    kept = [part.copy() for part in early]
    late = run(joints, early, (0.2, 0.4), 30)
    np.testing.assert_array_equal(kept, early)
    np.testing.assert_array_equal(run(drives(lag=0.03), early, (0.2, 0.4), 30), late)


def test_joints_stop_at_their_stops_and_come_back():
    joints = drives(stops=(np.full(2, -0.05), np.full(2, 0.05)))
    state = run(joints, joints.start(np.zeros(2), body()), (0.5, 0.0), 1500)
    assert state.angle[0] == pytest.approx(0.05, abs=1e-9)
    assert run(joints, state, (-0.5, 0.0), 400).angle[0] < 0.04


def test_a_list_of_another_length_is_refused():
    with pytest.raises(ValueError, match="torque_limit must have 1 or 6 numbers, got 2"):
        DriveConfig(torque_limit=(1.0, 2.0)).check(6)
    with pytest.raises(ValueError, match="must be at least 0"):
        DriveConfig(coulomb_friction=(-1.0,))


def test_an_obstacle_that_is_no_box_is_refused():
    with pytest.raises(ValueError, match="obstacles"):
        RenderedConfig(obstacles=((0.1, 0.2, 0.3),))
