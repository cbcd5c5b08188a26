"""Gear ripple, backlash and a flexible tool: hand-computed steps, closed forms, and both plants that have them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lsim

from kit.plants import configure, mismatched
from servobench.harness.config.registry import find_plant
from servobench.harness.config.sensing import find_sensing
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.signals import Command
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mechanics import MechanicsConfig, Tool
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch
from servobench.plant.robot.ur5 import HOME

ALL = {"backlash": 0.035, "ripple": 0.03, "tool_frequency": 12.0}
COMMANDS = np.random.default_rng(4).uniform(-0.3, 0.3, (12, 6)).repeat(6, axis=0)


def opened(name, model, start, **mechanics):
    entry = find_plant(name)
    config = replace(
        configure(entry.config, feature_noise=0.0), mechanics=MechanicsConfig(**mechanics)
    )
    plant = entry.build(config, PlantSetup(model, start, 0.05))
    plant.reset(0)
    return plant


def walk(plant, commands=COMMANDS):
    rows = []
    for u in commands:
        seen, truth = plant.step(Command(u)), plant.truth()
        rows.append(np.concatenate([seen.joint_position, seen.feature, truth.jacobian.ravel()]))
    return np.array(rows)


def test_a_joint_follows_its_gear_through_the_play():
    gear = MechanicsConfig(backlash=0.1)
    x, came = np.zeros(1), []
    for q in (0.05, 0.1, 0.3, 0.25, 0.15, 0.1, 0.0, -0.2, -0.1, 0.05):
        x = gear.driven(x, np.array([q]))
        came.append(float(x[0]))
    np.testing.assert_allclose(
        came, [0.0, 0.0, 0.2, 0.2, 0.2, 0.2, 0.1, -0.1, -0.1, -0.05], atol=1e-15
    )
    q, v = np.array([0.3, 0.3, 0.3]), np.array([1.0, -1.0, 1.0])
    np.testing.assert_array_equal(gear.driven_velocity(q - [0.1, 0.1, 0.0], q, v), [1.0, 0.0, 0.0])


def test_ripple_leads_the_joint_eight_times_in_a_turn():
    gear = MechanicsConfig(ripple=0.03)
    quarter = np.pi / 16  # of the first period
    q = np.array([0.0, quarter, 2 * quarter, 3 * quarter, 0.1])
    np.testing.assert_allclose(
        gear.driven(q, q) - q, [0.0, 0.03, 0.0, -0.03, 0.03 * np.sin(0.8)], atol=1e-15
    )
    np.testing.assert_allclose(gear.slope(q)[:4], [1.24, 1.0, 0.76, 1.0], atol=1e-12)


@pytest.mark.parametrize("damping", [0.02, 0.5])
def test_a_flexible_tool_answers_a_step_of_acceleration_as_a_second_order_system(damping):
    omega, time = 12.0, np.arange(201) * 0.005
    acceleration = np.array([2.0, -1.0, 0.5])
    mechanics = MechanicsConfig(tool_frequency=omega, tool_damping=damping)

    def carrier(t):
        return 0.5 * acceleration * t**2, acceleration * t

    tool, came = Tool(np.zeros(3), np.zeros(3)), [np.zeros(3)]
    for t in time[:-1]:
        tool = mechanics.swung(tool, carrier(t), carrier(t + 0.005), 0.005)
        came.append(tool.deflection)
    for k, a in enumerate(acceleration):
        system = [-1.0], [1.0, 2.0 * damping * omega, omega**2]
        _, wanted, _ = lsim(system, np.full(time.size, a), time)
        np.testing.assert_allclose(np.array(came)[:, k], wanted, rtol=0, atol=1e-12)
    one = mechanics.swung(Tool(np.zeros(3), np.zeros(3)), carrier(0.0), carrier(1.0), 1.0)
    np.testing.assert_allclose(tool.deflection, one.deflection, rtol=0, atol=1e-12)
    np.testing.assert_allclose(tool.velocity, one.velocity, rtol=0, atol=1e-12)


@pytest.mark.parametrize("frequency", [1e-4, 0.09, 2e6])
def test_a_frequency_whose_closed_form_has_no_digits_is_refused(frequency):
    with pytest.raises(ValueError, match="tool_frequency must be 0 or from 0.1 to 1e.06, got"):
        MechanicsConfig(tool_frequency=frequency)


def test_a_flexible_tool_answers_a_changing_acceleration_exactly():
    mechanics = MechanicsConfig(tool_frequency=12.0, tool_damping=0.1)
    time = np.linspace(0.0, 0.3, 30001)
    _, wanted, _ = lsim(([-1.0], [1.0, 2.4, 144.0]), 2.0 - 9.0 * time, time)
    speed = 2.0 * 0.3 - 4.5 * 0.3**2
    carried = (np.array([0.3**2 - 1.5 * 0.3**3]), np.array([speed]))
    tool = mechanics.swung(Tool(np.zeros(1), np.zeros(1)), (np.zeros(1), np.zeros(1)), carried, 0.3)
    np.testing.assert_allclose(tool.deflection, wanted[-1:], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("sensing", "mechanics"),
    [
        ("position", ALL),
        ("position", {"tool_frequency": 12.0}),
        ("plate", {"backlash": 0.035, "ripple": 0.03}),
    ],
)
def test_both_plants_agree(sensing, mechanics):
    mismatch, robot, walked = Mismatch.parse("severe"), find_robot("ur5"), []
    arm, sample = sample_mismatch(mismatch, robot, 3)
    model, _ = find_sensing(sensing).true(robot, arm, sample, mismatch, 3)
    for name, parts in (("kinematic", mechanics), ("fmu", mechanics), ("kinematic", {})):
        plant = opened(name, model, np.array(HOME), **parts)
        walked.append(walk(plant))
        plant.close()
    kinematic, fmu, rigid = walked
    np.testing.assert_allclose(fmu, kinematic, rtol=1e-9, atol=1e-9)
    assert np.abs(rigid - kinematic)[:, 6:9].max() > 1e-3


def test_a_saved_state_keeps_play_and_tool():
    for name in ("kinematic", "fmu"):
        plant = opened(name, mismatched("moderate"), np.array(HOME), **ALL)
        walk(plant, COMMANDS[:40])
        state = plant.save()
        first = walk(plant, COMMANDS[40:60])
        plant.restore(state)
        np.testing.assert_array_equal(walk(plant, COMMANDS[40:60]), first)
        plant.close()


@pytest.mark.parametrize("name", ["kinematic", "fmu"])
def test_a_flexible_tool_needs_the_ball_in_space(name):
    plate = find_sensing("plate").nominal(find_robot("ur5"))
    with pytest.raises(ValueError, match="tool_frequency needs the sensing position"):
        opened(name, plate, np.array(HOME), tool_frequency=12.0)


def test_the_words_of_a_mismatch_are_settings_of_the_plant():
    mismatch = Mismatch.parse("moderate+backlash=2deg+ripple=0.03rad+flexible_tool=12")
    found = {
        "mechanics.backlash": np.radians(2.0),
        "mechanics.ripple": 0.03,
        "mechanics.tool_frequency": 12.0,
    }
    assert mismatch.plant_settings == pytest.approx(found)
    assert Mismatch.parse(str(mismatch)) == mismatch
