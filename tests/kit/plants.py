"""Robots and settings of plants for tests."""

from dataclasses import fields, replace
from importlib.util import find_spec

import numpy as np
import pytest

from servobench.harness.config.registry import plant_names
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.makers import read_calibration
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch
from servobench.plant.robot.ur5 import HOME, ur5_arm

NEEDS_BULLET = pytest.mark.skipif(
    find_spec("pybullet") is None,
    reason="PyBullet is not installed; from Python 3.12 on it has no wheel",
)

NEEDS_MUJOCO = pytest.mark.skipif(
    find_spec("mujoco") is None, reason="the extra mujoco is not installed"
)
NEEDS = {"bullet": NEEDS_BULLET, "mujoco": NEEDS_MUJOCO}


def plant_parameters(names):
    """Return names of plants as parameters of a test; rendered ones are slow, and skipped where they cannot run."""
    return [
        pytest.param(name, marks=[NEEDS[name], pytest.mark.slow]) if name in NEEDS else name
        for name in names
    ]


ALL_PLANTS = plant_parameters(plant_names())


def nominal_ur5():
    """Return the nominal UR5 under its camera."""
    return find_robot("ur5").nominal


def factory_ur5():
    """Return the arm of the factory calibration of one real UR5."""
    return read_calibration(None, find_robot("ur5").arm.tool)


def odd_ur5():
    """Return the arm of a UR5 with every kind of mismatch at once."""
    rng, arm = np.random.default_rng(4), ur5_arm()
    return SerialArm(
        arm.joint_names,
        arm.translation * rng.uniform(0.9, 1.1, arm.translation.shape),
        arm.rpy + rng.uniform(-0.05, 0.05, arm.rpy.shape),
        rng.uniform(-0.1, 0.1, 6),
        rng.uniform(0.9, 1.1, 6),
        arm.tool + rng.uniform(-0.04, 0.04, 3),
    )


def mismatched(text, seed=3):
    """Return the true robot of a mismatch."""
    return sample_mismatch(Mismatch.parse(text), find_robot("ur5"), seed)[0]


def setup(text="none", period=0.05):
    """Return the setup of a plant at home."""
    return PlantSetup(mismatched(text), np.array(HOME), period)


def configure(kind, **values):
    """Return settings of class `kind` from flat keywords; those of the section `sensing` are sorted into it."""
    default = kind()
    names = {field.name for field in fields(SensingConfig)}
    sensing = replace(
        default.sensing, **{name: value for name, value in values.items() if name in names}
    )
    rest = {name: value for name, value in values.items() if name not in names}
    return replace(default, sensing=sensing, **rest)
