"""Robots from files: a factory calibration of Universal Robots and a DH table in TOML.

A DH table:

    name = "my_arm"                          # by default the file's name
    convention = "standard"                  # or "modified"
    a = [0.0, -0.425, -0.392, 0.0, 0.0, 0.0]           # [m]
    d = [0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996]     # [m]
    alpha = [1.5708, 0.0, 0.0, 1.5708, -1.5708, 0.0]   # [rad]
    theta = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]   # [rad] joint offsets; by default 0
    joint_lower = [-3.14, -3.14, -3.14, -3.14, -3.14, -3.14]     # [rad]
    joint_upper = [3.14, 3.14, 3.14, 3.14, 3.14, 3.14]           # [rad]
    joint_speed = [2.0, 2.0, 2.0, 2.0, 2.0, 2.0]                 # [rad/s]

`joint_names`, `mass` [kg] and `torque` [Nm] may be given too. By the modified convention the lists of a, d and alpha
may have one entry more, which leads to the flange.
"""

from dataclasses import replace
from math import pi
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le

from servobench.plant.contract.checks import as_array
from servobench.plant.contract.faults import configuration_errors
from servobench.plant.contract.settings import (
    JointSpeed,
    Number,
    Positive,
    Section,
    Usual,
    override,
    remark,
    settings,
)
from servobench.plant.robot.arm import JointLimits, SerialArm, arm_from_dh, numbered_joints
from servobench.plant.robot.makers import known_title, read_calibration, universal_robot
from servobench.plant.robot.robot import Robot, estimate_links
from servobench.plant.robot.workspace import find_workspace, with_ball


def read_calibrated_robot(path: Path) -> Robot:
    """Return the robot of the data sheet that a calibration file fits, with the measured arm as the true one.

    Raises:
        ValueError: the file is missing, malformed, or fits no data sheet.
    """
    arm = read_calibration(path, np.zeros(3))
    title, deviation = known_title(arm, path)
    sheet = universal_robot(title)
    measured = read_calibration(path, sheet.arm.tool)
    source = f"{path.name}, held against {sheet.source}"
    note = (
        f"{path.name} is the factory calibration of a {title} (its flange within {1e3 * deviation:.1f} mm of the "
        f"data sheet's): the true robot is the calibrated arm, controllers know the data sheet's {title}"
    )
    return replace(sheet, name=path.stem, source=source, measured=measured, note=note)


Lengths = tuple[Annotated[Number, Ge(-20.0), Le(20.0), Usual(5.0)], ...]
Twists = tuple[Annotated[Number, Ge(-6.3), Le(6.3)], ...]
Limits = tuple[Annotated[Number, Ge(-30.0), Le(30.0), Usual(4.0 * pi)], ...]
Mass = Annotated[Positive, Usual(500.0)]


@settings
class DhTable:
    """The keys of a file."""

    a: Lengths
    """[m] link lengths."""
    d: Lengths
    """[m] link offsets."""
    alpha: Twists
    """[rad] link twists."""
    joint_lower: Limits
    """[rad]"""
    joint_upper: Limits
    """[rad]"""
    joint_speed: tuple[Annotated[JointSpeed, Le(60.0)], ...]
    """[rad/s]"""
    theta: Twists = ()
    """[rad] joint offsets; an empty list for none."""
    convention: Literal["standard", "modified"] = "standard"
    """Which of the two DH conventions."""
    name: str = ""
    """In tables; empty for the file's name."""
    joint_names: tuple[str, ...] = ()
    """An empty list for joint_1, joint_2, …"""
    mass: tuple[Mass, ...] = ()
    """[kg] of the links; an empty list for estimates."""
    torque: tuple[Annotated[Positive, Usual(20_000.0, 0.01)], ...] = ()
    """[Nm] largest of the joints; an empty list for estimates."""


REQUIRED = ("a", "d", "alpha", "joint_lower", "joint_upper", "joint_speed")


def read_dh_robot(path: Path, values: Section) -> Robot:
    """Return the robot of a DH table with the content of a file.

    Raises:
        ValueError: the content is malformed, or describes no arm that can work at a table.
    """
    for key in REQUIRED:
        if key not in values:
            raise ValueError(
                f"robot file {path}: the key {key!r} is missing; wanted {', '.join(REQUIRED)}"
            )
    if "convention" not in values:
        remark(
            f'robot file {path} is read by the standard convention; write convention = "standard" or "modified"'
        )
    table = override(f"robot file {path}", DhTable((), (), (), (), (), ()), values)
    with configuration_errors(f"robot file {path}: "):
        arm = with_ball(_arm_of(table))
        n = arm.n
        limits = JointLimits(
            as_array("joint_lower", table.joint_lower, (n,)),
            as_array("joint_upper", table.joint_upper, (n,)),
            as_array("joint_speed", table.joint_speed, (n,)),
        )
        mass = as_array("mass", table.mass, (n,)) if table.mass else None
        torque = as_array("torque", table.torque, (n,)) if table.torque else None
        links = estimate_links(arm, mass, torque)
        workspace = find_workspace(arm, limits, links)
        name = table.name or path.stem
        note = ""
        if not table.mass:
            note = f"{name}: masses, inertia and torque limits are estimated from the lengths of the links"
        return Robot(name, name, path.name, arm, limits, links, workspace, note=note)


def _arm_of(table: DhTable) -> SerialArm:
    """Return the arm of a DH table, without a ball."""
    n = len(table.joint_lower)
    names = table.joint_names or numbered_joints(n)
    if len(names) != n:
        raise ValueError(f"joint_names must hold {n} names, got {len(names)}")
    arm = arm_from_dh(table.a, table.d, table.alpha, names, modified=table.convention == "modified")
    if not table.theta:
        return arm
    return replace(arm, joint_offset=as_array("theta", table.theta, (n,)))
