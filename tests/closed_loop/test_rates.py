"""Tests that the laws are as good at fast control rates as at 20 Hz, on a robot whose joints follow at once.

Around the law everything is exact, so that a difference between rates is the law's own: the Jacobian is the true one at
the measured joints, and the camera sees the feature with the noise of 1 mm that it has in one frame.
"""

import math

import numpy as np
import pytest

from kit.plants import nominal_ur5
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.laws.law import Estimate
from servobench.controllers.laws.mpc.mpc import MpcConfig, MpcLaw
from servobench.controllers.laws.rbfnn import RbfnnConfig, RbfnnLaw
from servobench.controllers.networks.config import ControllerTraining, JacobianTraining, TrainingConfig
from servobench.controllers.networks.fit import train
from servobench.controllers.stages.finish import scale_to_limit
from servobench.plant.contract.signals import Observation
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.robot.ur5 import HOME, TRAINING_LOWER, TRAINING_UPPER

MODEL = nominal_ur5()
SLOW, FAST = 0.05, 0.008  # [s] control periods
DURATION, PREVIEW, NOISE, BAND = 4.0, 0.5, 0.001, 0.01  # s, s, m, m


def spec(period):
    return hand_eye_spec(MODEL, period, 1.0, 2 * math.pi)


@pytest.fixture(scope="module")
def networks():
    config = TrainingConfig(
        lower=tuple(TRAINING_LOWER),
        upper=tuple(TRAINING_UPPER),
        jacobian=JacobianTraining(centres=10, samples=50),
        controller=ControllerTraining(hidden=20, samples=800, width_scales=(4.0,), regularisations=(1e-10,)),
    )
    return train(config, MODEL.jacobian, spec(SLOW))


def make(name, period, networks):
    knowledge = RobotKnowledge(spec(period), math.ceil(PREVIEW / period))
    if name == "mpc":
        return MpcLaw(MpcConfig(), knowledge)
    return RbfnnLaw(RbfnnConfig(), knowledge, networks)


def errors(law, period, moves):
    """Return the distance to the target in each period, (periods,), m."""
    rng, q, limit = np.random.default_rng(1), np.array(HOME), spec(period).joint_velocity_limit
    times = period * np.arange(math.ceil((DURATION + PREVIEW) / period) + 1)
    start, found = MODEL.feature(q), []
    angle = 2 * math.pi / 5.0 * times[:, None] * moves
    path = start + [0.1, -0.08, 0.05] + 0.05 * np.concatenate([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    rows = math.ceil(PREVIEW / period)
    for k in range(round(DURATION / period)):
        y = MODEL.feature(q)
        found.append(np.linalg.norm(path[k] - y))
        seen = Observation(k * period, q, y + NOISE * rng.normal(size=3))
        if k == 0:
            state = law.start(seen)
        state, u = law.command(state, Estimate(MODEL.jacobian(q)), seen, path[k : k + rows + 1])
        sent = scale_to_limit(u, limit)
        state = law.noted(state, sent, np.abs(u).max() > 1.0)
        q = q + sent * period
    return np.array(found)


@pytest.mark.parametrize("moves", [0.0, 1.0])
@pytest.mark.parametrize("name", ["mpc", "rbfnn"])
def test_a_fast_rate_is_as_good_as_20_hertz(name, moves, networks):
    slow, fast = (errors(make(name, period, networks), period, moves) for period in (SLOW, FAST))
    arrival = [period * (1 + np.flatnonzero(found > BAND)[-1]) for period, found in ((SLOW, slow), (FAST, fast))]
    assert arrival[1] <= arrival[0] + 0.1
    late = [np.sqrt(np.mean(found[len(found) * 3 // 4 :] ** 2)) for found in (slow, fast)]
    assert late[1] < 1.1 * late[0]
