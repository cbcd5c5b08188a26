"""Robots from files: a factory calibration of Universal Robots, a DH table in TOML, a URDF."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from servobench.plant.contract.files import user_path
from servobench.plant.robot.dh_file import read_dh_robot
from servobench.plant.robot.makers import universal_robot
from servobench.plant.robot.measured import MAX_DEVIATION, nearest_title, read_calibration
from servobench.plant.robot.robot import Robot


def read_robot(text: str) -> Robot:
    """Return the robot that a file describes; its kind is told by its ending.

    Args:
        text: the path; that of a URDF may end in `#LINK`, the link that carries the ball.

    Raises:
        ValueError: a file that cannot be used.
    """
    name, _, tip = text.partition("#")
    path = user_path(name)
    kind = path.suffix.lower()
    if kind == ".urdf":
        from servobench.plant.robot.urdf_file import read_urdf_robot  # noqa: PLC0415 - an extra brings its reader

        return read_urdf_robot(path, tip)
    if tip:
        raise ValueError(f"robot {text!r}: only a .urdf has links to be named after '#'")
    return read_dh_robot(path) if kind == ".toml" else _read_calibrated(path)


def _read_calibrated(path: Path) -> Robot:
    """Return the robot of the data sheet that a calibration file fits, with the measured arm as the true one.

    Raises:
        ValueError: the file is missing, malformed, or fits no data sheet.
    """
    title, deviation = nearest_title(read_calibration(path, np.zeros(3)))
    if deviation > MAX_DEVIATION:
        raise ValueError(
            f"calibration file {path} fits no arm of Universal Robots: the {title} comes nearest, and its flange is "
            f"{1e3 * deviation:.0f} mm away"
        )
    sheet = universal_robot(title)
    return Robot(
        name=path.stem,
        title=sheet.title,
        source=f"{path.name}, held against {sheet.source}",
        arm=sheet.arm,
        limits=sheet.limits,
        links=sheet.links,
        workspace=sheet.workspace,
        measured=read_calibration(path, sheet.arm.tool),
        note=(
            f"{path.name} is the factory calibration of a {title} (its flange within {1e3 * deviation:.1f} mm of the "
            f"data sheet's): the true robot is the calibrated arm, controllers know the data sheet's {title}"
        ),
    )
