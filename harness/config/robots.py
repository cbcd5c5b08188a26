"""Robots by the word or file that a user gives."""

from __future__ import annotations

from typing import Final

from servobench.harness.config.settings import ConfigurationError
from servobench.plant.robot import catalogue
from servobench.plant.robot.robot import Robot

DEFAULT_ROBOT: Final = catalogue.UR5
OWN_ROBOT: Final = "own"  # in the column `robot`: the plant brings it


def robot_names() -> list[str]:
    """Return the names of all robots that are known without a file."""
    return list(catalogue.ROBOTS)


def find_robot(name: str) -> Robot:
    """Return the robot that a name or the path of a file stands for.

    Raises:
        ConfigurationError: an unknown name, or a file that cannot be used.
    """
    try:
        return catalogue.find_robot(name)
    except ValueError as error:
        raise ConfigurationError(str(error)) from error
