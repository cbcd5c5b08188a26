from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from servobench.plant.kinematic import KinematicConfig, KinematicPlant, discretise_lag
from servobench.plant.plant import PlantSetup
from servobench.plant.robot.ur5 import HOME, nominal_ur5
from servobench.plant.sensing import FeatureChannel
from servobench.plant.signals import Command

START = np.array(HOME)
QUIET = {"feature_noise": 0.0, "command_delay_periods": 0}


def make(period: float = 0.05, **settings) -> KinematicPlant:
    return KinematicPlant(KinematicConfig(**settings), PlantSetup(nominal_ur5(), START, period))


def test_the_lag_is_discretised_exactly():
    A, B = discretise_lag(0.07, 0.05)
    solution = solve_ivp(lambda _, x: [x[1], (0.8 - x[1]) / 0.07], (1.0, 1.05), [0.3, -0.2], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(A @ [0.3, -0.2] + B * 0.8, solution.y[:, -1], atol=1e-11)


def test_two_half_periods_are_one_period():
    whole, half = make(0.1, **QUIET), make(0.05, **QUIET)
    command = Command(np.linspace(-0.4, 0.4, 6))
    whole.step(command)
    half.step(command)
    half.step(command)
    np.testing.assert_allclose(whole.truth().feature, half.truth().feature, atol=1e-14)


def test_without_a_lag_a_joint_moves_by_its_command():
    plant = make(lag=0.0, **QUIET)
    u = np.linspace(-0.4, 0.4, 6)
    np.testing.assert_allclose(plant.step(Command(u)).joint_position, START + 0.05 * u, atol=1e-15)


def test_a_command_arrives_after_its_delay():
    plant = make(lag=0.0, feature_noise=0.0, command_delay_periods=2)
    moved = [plant.step(Command(np.full(6, 0.1))).joint_position[0] - START[0] for _ in range(4)]
    np.testing.assert_allclose(moved, [0, 0, 0.005, 0.01], atol=1e-15)


def test_a_feature_arrives_after_its_latency():
    late, prompt = make(latency_periods=2, **QUIET), make(**QUIET)
    rng = np.random.default_rng(0)
    seen = {0: prompt.reset(0).feature, -1: prompt.reset(0).feature, -2: prompt.reset(0).feature}
    late.reset(0)
    for k in range(1, 6):
        command = Command(rng.uniform(-0.5, 0.5, 6))
        seen[k] = prompt.step(command).feature
        np.testing.assert_array_equal(late.step(command).feature, seen[k - 2])


def test_feature_noise_has_the_configured_spread():
    plant = make(feature_noise=0.003, command_delay_periods=0)
    errors = [plant.step(Command(np.zeros(6))).feature - plant.truth().feature for _ in range(1500)]
    assert np.std(errors) == pytest.approx(0.003, rel=0.05)
    assert abs(np.mean(errors)) < 0.0003


def test_a_joint_stops_at_its_range():
    plant = make(joint_range=2.4, **QUIET)
    for _ in range(40):
        observation = plant.step(Command(-np.ones(6)))
    assert observation.joint_position[2] == -2.4
    moved = plant.step(Command(np.ones(6))).joint_position[2] + 2.4
    assert 0 < moved < 0.05  # no wind-up at the stop


def test_a_lost_frame_is_not_valid_and_the_last_feature_is_held():
    plant = make(drop_probability=0.5, **QUIET)
    held = plant.reset(4).feature
    valid = []
    for _ in range(200):
        observation = plant.step(Command(np.full(6, 0.1)))
        valid.append(observation.feature_valid)
        if not observation.feature_valid:
            np.testing.assert_array_equal(observation.feature, held)
        held = observation.feature
    assert 60 < sum(valid) < 140


def test_a_frame_without_the_feature_comes_out_late_as_well():
    channel = FeatureChannel(latency_periods=1, drop_probability=0.0)
    channel.reset(np.array([1.0]), np.random.default_rng(0))
    got = [channel.deliver(value) for value in (None, np.array([3.0]), np.array([4.0]))]
    assert [(float(feature[0]), valid) for feature, valid in got] == [(1.0, True), (1.0, False), (3.0, True)]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("lag", -0.1),
        ("command_delay_periods", -1),
        ("feature_noise", -0.001),
        ("latency_periods", -1),
        ("drop_probability", 1.0),
        ("max_joint_speed", 0.0),
        ("joint_range", 0.0),
    ],
)
def test_a_setting_out_of_bounds_is_named(name, value):
    with pytest.raises(ValueError, match=f"{name} must be"):
        make(**{name: value})


def test_a_period_must_be_positive():
    with pytest.raises(ValueError, match="period must be positive"):
        make(period=0.0)
