import numpy as np
import pytest
from scipy.linalg import expm

from kit.plants import configure, nominal_ur5
from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.signals import Command
from servobench.plant.kinematic import (
    KinematicConfig,
    build_kinematic,
    discretise_lag,
    follow_with_overshoot,
)
from servobench.plant.robot.ur5 import HOME

START = np.array(HOME)
QUIET = {"feature_noise": 0.0, "command_delay": 0.0}


def make(period: float = 0.05, **settings) -> Bench:
    plant = build_kinematic(
        configure(KinematicConfig, **settings), PlantSetup(nominal_ur5(), START, period)
    )
    plant.reset(0)
    return plant


@pytest.mark.parametrize("lag", [0.002, 0.07, 5.0])
def test_the_lag_is_discretised_exactly(lag):
    A, B = discretise_lag(lag, 0.05)
    # of q, v and the held u
    rate = np.array([[0.0, 1.0, 0.0], [0.0, -1.0 / lag, 1.0 / lag], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(np.column_stack([A, B]), expm(0.05 * rate)[:2], atol=1e-14)


@pytest.mark.parametrize("overshoot", [0.05, 0.6])
def test_joints_with_overshoot_follow_the_second_order_system_and_pass_a_step_by_it(overshoot):
    config = configure(KinematicConfig, lag=0.04, overshoot=overshoot)
    zeta = -np.log(overshoot) / np.hypot(np.pi, np.log(overshoot))
    rate = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, -625.0, -50.0 * zeta, 625.0], [0, 0, 0, 0]])
    start = np.array([0.3, -0.2, 1.5, 0.7])  # q, v, a, u
    expected = expm(0.05 * rate) @ start
    found = follow_with_overshoot(tuple(start[:3, None]), start[3:], config, 0.05)
    np.testing.assert_allclose(np.concatenate(found), expected[:3], atol=1e-14)
    step = [
        follow_with_overshoot((np.zeros(1),) * 3, np.ones(1), config, t)[1][0]
        for t in np.arange(1, 400) * 0.001
    ]
    assert max(step) == pytest.approx(1.0 + overshoot, abs=1e-3)


def test_overshoot_needs_a_lag():
    with pytest.raises(
        ValueError, match="lag must be above 0 for velocity loops with overshoot, got 0"
    ):
        configure(KinematicConfig, lag=0.0, overshoot=0.1)


def test_without_a_lag_a_joint_moves_by_its_command():
    plant = make(lag=0.0, **QUIET)
    u = np.linspace(-0.4, 0.4, 6)
    np.testing.assert_allclose(plant.step(Command(u)).joint_position, START + 0.05 * u, atol=1e-15)


def test_a_joint_stops_at_its_range():
    plant = make(joint_range=2.4, **QUIET)
    for _ in range(40):
        observation = plant.step(Command(-np.ones(6)))
    assert observation.joint_position[2] == -2.4
    moved = plant.step(Command(np.ones(6))).joint_position[2] + 2.4
    assert 0 < moved < 0.05  # no wind-up at the stop
