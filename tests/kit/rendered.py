"""The rendered plants for tests."""

import numpy as np

from kit.plants import configure
from servobench.harness.config.registry import find_plant
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.signals import Command
from servobench.plant.rendered.settings import DriveConfig, RenderedConfig
from servobench.plant.robot import ur5
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import HandEyeModel

HOME = np.array(ur5.HOME)
BARE = RenderedConfig(scenery=False)
IDEAL = configure(
    RenderedConfig,
    scenery=False,
    lag=0.0,
    drives=DriveConfig(dynamics=False),
    encoder_resolution=0.0,
    depth_noise="none",
    colour_noise=0.0,
    depth_quantisation=0.0,
    latency=0.0,
    drop_probability=0.0,
)
UR5 = find_robot("ur5")
MODEL = UR5.nominal


def build(config=BARE, start=HOME, period=0.05, model=MODEL, *, engine):
    """Return a plant, which is to be closed."""
    return find_plant(engine).build(config, PlantSetup(model, start, period))


def wiggle(plant, seed, periods=12) -> np.ndarray:
    """Rows of everything that is observed under seeded commands."""
    rng, seen = np.random.default_rng(7), [plant.reset(seed)]
    seen += [plant.step(Command(rng.uniform(-0.5, 0.5, 6))) for _ in range(periods)]
    return np.array([[o.time, *o.joint_position, *o.feature, o.feature_valid] for o in seen])


def geared_ur5() -> HandEyeModel:
    arm = ur5.ur5_arm()
    gear, offset = (
        np.array([1.1, 0.9, 1.05, 0.95, -1.0, 1.0]),
        np.array([0.05, -0.05, 0.02, 0.0, 0.1, -0.1]),
    )
    return HandEyeModel(
        SerialArm(arm.joint_names, arm.translation, arm.rpy, offset, gear, arm.tool), MODEL.X_BC
    )
