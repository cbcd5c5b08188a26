"""Arms as Universal Robots' factory measured them, and the data sheet to which such a calibration belongs."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.files import user_path
from servobench.plant.robot import ur5
from servobench.plant.robot.arm import SerialArm, arm_from_calibration
from servobench.plant.robot.makers import UNIVERSAL_ROBOTS
from servobench.plant.robot.robot import Robot

MAX_DEVIATION: Final = 0.02  # [m] of a calibrated length from the data sheet; real ones differ by a millimetre or two


def measured_arm(robot: Robot, file: str | None) -> SerialArm:
    """Return the arm of a calibration file, with the ball of `robot`.

    Args:
        robot: whose calibration it must be.
        file: its path; None for the one that came with the robot, or that of one real UR5 which the package brings.

    Raises:
        ValueError: a robot that has no such file, or a file that is missing, malformed or that of another robot.
    """
    if file is None and robot.measured is not None:
        return robot.measured
    if robot.title not in UNIVERSAL_ROBOTS:
        raise ValueError(
            f"mismatch 'factory' needs a calibration file of Universal Robots, which a {robot.title} does not have; "
            "use the axes links and joint_offsets"
        )
    if file is None and robot.title != "UR5":
        raise ValueError(
            f"mismatch 'factory' without a file is the calibration of one real UR5, and the robot is a {robot.title}; "
            "use factory=FILE with its own"
        )
    arm = read_calibration(None if file is None else user_path(file), robot.arm.tool)
    title, deviation = nearest_title(arm)
    if title != robot.title and deviation_from(arm, robot.title) > MAX_DEVIATION:
        raise ValueError(
            f"calibration file {file} is that of a {title} (lengths within {1e3 * deviation:.1f} mm), and the robot is "
            f"a {robot.title}; use --robot {title.lower()}, or --robot {file}"
        )
    return arm


def read_calibration(path: Path | None, tool: FloatArray) -> SerialArm:
    """Return the arm of a calibration file with a ball at `tool` (3,) m; None stands for the file of the package.

    Raises:
        ValueError: the file is missing or malformed.
    """
    return arm_from_calibration(ur5.shipped_calibration() if path is None else path, tool, ur5.JOINT_NAMES)


def nearest_title(arm: SerialArm) -> tuple[str, float]:
    """Return which arm of Universal Robots has the lengths of a calibrated one, and by how much they differ [m]."""
    deviations = {title: deviation_from(arm, title) for title in UNIVERSAL_ROBOTS}
    title = min(deviations, key=lambda each: deviations[each])
    return title, deviations[title]


def deviation_from(arm: SerialArm, title: str) -> float:
    """Return by how much the lengths of a calibrated arm differ from a data sheet at most [m].

    The parallel axes of shoulder lift, elbow and wrist 1 leave the split of d2, d3 and d4 open, so that calibrations
    differ in it by metres and mean the same arm; the ball's place in a few postures tells arms apart.
    """
    nominal = UNIVERSAL_ROBOTS[title].arm()
    postures = np.random.default_rng(0).uniform(-np.pi, np.pi, (32, nominal.n))
    own, other = (each.frames(postures)[:, -1, :3, 3] for each in (arm, nominal))
    return float(np.abs(own - other).max())
