"""Arms that nobody knows: `--robot random_arm:7`, drawn by its number, of which controllers know the joints alone.

Number of joints, lengths and offsets of the links, twists and the signs of the gears are drawn; the arm is as long as a
UR5, and drawn again until it can work at the bench. What hangs at its flange and how the camera is turned are those of
the run's mismatch. Controllers know limits of the joints and how many features there are, and no model.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from servobench.plant.contract.seeds import named_generator
from servobench.plant.robot.arm import SerialArm, arm_from_dh
from servobench.plant.robot.bodies import estimate_links
from servobench.plant.robot.limits import JointLimits
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.teaching import find_workspace, with_ball

RANDOM_ARM: Final = "random_arm"  # before a colon and the number
MAX_NUMBER: Final = 1_000_000
JOINTS: Final = (3, 7)  # fewest and most
LENGTH: Final = 1.2  # [m] of all links, about that of a UR5
SKEW: Final = math.radians(10.0)  # of a twist from the nearest quarter of a turn
SHARE: Final = 0.6  # of the lengths and offsets that are not zero
LIMIT: Final = 0.9 * math.pi  # [rad] of a joint to either side
SPEED: Final = math.pi  # [rad/s] of a joint
MAX_DRAWS: Final = 200


def random_robot(number: int) -> Robot:
    """Return the arm of a number, the same for ever.

    Raises:
        ValueError: a number out of its bounds.
    """
    if not 0 <= number <= MAX_NUMBER:
        raise ValueError(f"the number of a {RANDOM_ARM} must be from 0 to {MAX_NUMBER:,}, got {number}")
    generator = named_generator(number, RANDOM_ARM)
    n, name = int(generator.integers(JOINTS[0], JOINTS[1] + 1)), f"{RANDOM_ARM}_{number}"
    limits = JointLimits(np.full(n, -LIMIT), np.full(n, LIMIT), np.full(n, SPEED))
    for _ in range(MAX_DRAWS):
        arm = _drawn(n, generator)
        links = estimate_links(arm, None, None)
        try:
            workspace = find_workspace(arm, (limits.lower, limits.upper), (links.radius, links.aside))
        except ValueError:
            continue
        source = f"drawn from the number {number}"
        return Robot(name, name, source, arm, limits, links, workspace, note=f"{name} has {n} joints", known=False)
    raise ValueError(f"none of {MAX_DRAWS} arms drawn for {name} can work at the bench; take another number")


def _drawn(n: int, generator: np.random.Generator) -> SerialArm:
    lengths = generator.uniform(0.2, 1.0, (2, n)) * (generator.random((2, n)) < SHARE)
    lengths[0, 0] = max(lengths[0, 0], 0.2)  # one link at least
    a, d = LENGTH / lengths.sum() * lengths
    quarters = generator.choice([-1.0, 0.0, 1.0], n)
    twists = 0.5 * math.pi * quarters + generator.uniform(-SKEW, SKEW, n)
    names = tuple(f"joint_{i}" for i in range(1, n + 1))
    arm = arm_from_dh(a, d, twists, (0.0, 0.0, 0.0), names)
    return replace(with_ball(arm), gear_ratio=generator.choice([-1.0, 1.0], n))
