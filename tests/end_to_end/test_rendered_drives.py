"""How the arm of the rendered plant moves: drives, loads, encoders, stops, and what it meets."""

from dataclasses import replace

import numpy as np
import pytest

from kit.rendered import BARE, HOME, IDEAL, MODEL, geared_ur5
from servobench.plant.contract.faults import Collision, FeatureLost
from servobench.plant.contract.signals import Command
from servobench.plant.rendered.drives import PHYSICS_STEP
from servobench.plant.rendered.settings import DriveConfig


def turn(plant, joint_velocity, periods) -> None:
    """Hold a command."""
    for _ in range(periods):
        plant.step(Command(joint_velocity))


@pytest.mark.parametrize("model", [MODEL, geared_ur5()], ids=["nominal", "geared"])
def test_reported_joints_move_as_commanded(open_plant, model):
    start = (HOME - model.arm.joint_offset) / model.arm.gear_ratio
    plant = open_plant(IDEAL, start, model=model)
    plant.reset(0)
    u = np.array([0.3, -0.2, 0.1, 0.4, -0.3, 0.5])
    for k in range(1, 5):
        np.testing.assert_allclose(
            plant.step(Command(u)).joint_position, start + u * 0.05 * k, atol=1e-8
        )


def test_without_dynamics_a_joint_follows_a_first_order_lag(open_plant):
    plant = open_plant(replace(IDEAL, lag=0.08))
    plant.reset(0)
    u, decay = np.full(6, 0.4), np.exp(-PHYSICS_STEP / 0.08)
    for k in range(1, 8):
        moved = plant.step(Command(u)).joint_position - HOME
        steps = 50 * k
        expected = 0.4 * PHYSICS_STEP * (steps - decay * (1 - decay**steps) / (1 - decay))
        np.testing.assert_allclose(moved, expected, atol=1e-12)


def test_joints_with_inertia_rise_about_as_fast_as_the_lag_of_kinematic(open_plant):
    plant = open_plant(period=0.001)
    plant.reset(0)
    command, moved = Command(np.array([0.3, -0.3, 0.3, 0.3, 0.3, 0.3])), [HOME]
    moved += [plant.step(command).joint_position for _ in range(100)]
    rise = np.abs(moved[100] - moved[0]) / 0.3
    ideal = 0.1 - 0.05 * (1 - np.exp(-2.0))
    np.testing.assert_allclose(rise, ideal, rtol=0.15)
    assert np.abs(rise - ideal).max() > 1e-3 * ideal


@pytest.mark.parametrize("period", [0.004, 0.008, 0.02, 0.1])
def test_the_arm_moves_alike_under_every_control_period(open_plant, period):
    config = replace(BARE, encoder_resolution=0.0)
    ends = []
    for each in (period, 0.2):
        plant = open_plant(config, period=each)
        plant.reset(0)
        for _ in range(round(0.2 / each)):
            observation = plant.step(Command(np.full(6, 0.3)))
        ends.append(observation.joint_position)
    np.testing.assert_array_equal(*ends)


def test_a_load_that_the_drives_do_not_know_of_disturbs_the_joints(open_plant):
    def path(**load):
        plant = open_plant(replace(BARE, drives=DriveConfig(**load), encoder_resolution=0.0))
        plant.reset(0)
        return np.array([plant.step(Command(np.eye(6)[1] * 0.5)).joint_position for _ in range(6)])

    known, unknown = path(payload=0.9), path()
    assert 1e-4 < np.abs(known - unknown).max() < 0.05
    np.testing.assert_array_equal(path(), unknown)


def test_positions_are_reported_in_steps_of_the_encoders(open_plant):
    plant = open_plant(replace(BARE, encoder_resolution=1e-3))
    plant.reset(0)
    q = plant.step(Command(np.full(6, 0.3))).joint_position / 1e-3
    np.testing.assert_allclose(q, np.round(q), atol=1e-9)


def test_joints_stop_at_their_range(open_plant):
    plant = open_plant(replace(BARE, joint_range=2.4))
    plant.reset(0)
    for _ in range(8):
        observation = plant.step(Command(-np.eye(6)[2]))
    assert observation.joint_position[2] == pytest.approx(-2.4, abs=5e-5)
    for _ in range(3):
        back = plant.step(Command(np.eye(6)[2])).joint_position[2]
    assert back > -2.39


def test_meeting_the_table_ends_the_run_with_names_and_time(open_plant):
    plant = open_plant(replace(BARE, room_contact=True))
    plant.reset(0)
    with pytest.raises(Collision, match=r"meets table at \d\.\d{3} s") as error:
        turn(plant, np.eye(6)[1], 60)
    assert error.value.status == "collision"
    free = open_plant(replace(BARE, room_contact=False))
    free.reset(0)
    turn(free, np.eye(6)[1], 60)


def test_meeting_itself_ends_the_run_where_that_is_wanted(open_plant):
    fold = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    plant = open_plant(replace(BARE, self_contact=True))
    plant.reset(0)
    with pytest.raises(Collision, match="shoulder_lift meets wrist"):
        turn(plant, fold, 20)
    free = open_plant()
    free.reset(0)
    turn(free, fold, 20)


def test_an_obstacle_hides_the_ball_and_stands_in_the_way(open_plant):
    above, lost = (0.5, 0.0, 0.6, 0.3, 0.3, 0.02), pytest.raises(FeatureLost, match="not visible")
    with lost:
        open_plant(replace(BARE, obstacles=(above,))).reset(0)
    inside = (0.5, 0.0, 0.3, 0.1, 0.1, 0.1)
    with pytest.raises(Collision, match=r"wrist_3 meets obstacle 1 at 0\.000 s"):
        open_plant(replace(BARE, obstacles=(inside,))).reset(0)


def test_neighbouring_links_never_count_as_contact(open_plant):
    own = replace(BARE, self_contact=True)
    contacts, rng = (
        open_plant(replace(own, room_contact=False)).world._contacts,
        np.random.default_rng(0),
    )
    names = ["base", *MODEL.arm.joint_names]
    met = [contacts.find(rng.uniform(-np.pi, np.pi, 6)) for _ in range(200)]
    assert open_plant(own).world._contacts.find(HOME) is None
    pairs = [pair for pair in met if pair is not None]
    assert 5 < len(pairs) < 195
    assert all(names.index(second) - names.index(first) > 1 for first, second in pairs)
