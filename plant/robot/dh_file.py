"""A robot from a DH table in TOML.

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

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from servobench.plant.contract.checks import FloatArray, as_vector
from servobench.plant.contract.files import read_toml
from servobench.plant.contract.settings import Number, Positive, override, settings
from servobench.plant.robot.arm import SerialArm, arm_from_dh, arm_from_modified_dh
from servobench.plant.robot.bodies import estimate_links
from servobench.plant.robot.limits import JointLimits
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.teaching import find_workspace, with_ball

Column = tuple[Number, ...]


@settings
class DhTable:
    """The keys of a file."""

    a: Column
    """[m] link lengths."""
    d: Column
    """[m] link offsets."""
    alpha: Column
    """[rad] link twists."""
    joint_lower: Column
    """[rad]"""
    joint_upper: Column
    """[rad]"""
    joint_speed: tuple[Positive, ...]
    """[rad/s]"""
    theta: Column = ()
    """[rad] joint offsets; an empty list for none."""
    convention: Literal["standard", "modified"] = "standard"
    """Which of the two DH conventions."""
    name: str = ""
    """In tables; empty for the file's name."""
    joint_names: tuple[str, ...] = ()
    """An empty list for joint_1, joint_2, …"""
    mass: tuple[Positive, ...] = ()
    """[kg] of the links; an empty list for estimates."""
    torque: tuple[Positive, ...] = ()
    """[Nm] largest of the joints; an empty list for estimates."""


REQUIRED = ("a", "d", "alpha", "joint_lower", "joint_upper", "joint_speed")


def read_dh_robot(path: Path) -> Robot:
    """Return the robot of a DH table.

    Raises:
        ValueError: the file is missing, malformed, or describes no arm that can work at a table.
    """
    values = read_toml("robot file", path)
    for key in REQUIRED:
        if key not in values:
            raise ValueError(f"robot file {path}: the key {key!r} is missing; wanted {', '.join(REQUIRED)}")
    blank = DhTable((), (), (), (), (), ())
    table = override(f"robot file {path}", blank, values)
    try:
        return _robot_of(table, path)
    except ValueError as error:
        raise ValueError(f"robot file {path}: {error}") from error


def _robot_of(table: DhTable, path: Path) -> Robot:
    arm = with_ball(_arm_of(table))
    n = arm.n
    limits = JointLimits(
        as_vector("joint_lower", table.joint_lower, n),
        as_vector("joint_upper", table.joint_upper, n),
        as_vector("joint_speed", table.joint_speed, n),
    )
    links = estimate_links(arm, _given("mass", table.mass, n), _given("torque", table.torque, n))
    workspace = find_workspace(arm, (limits.lower, limits.upper), (links.radius, links.aside))
    name = table.name or path.stem
    return Robot(name, name, path.name, arm, limits, links, workspace, note=estimated(table.mass, name))


def _arm_of(table: DhTable) -> SerialArm:
    n = len(table.joint_lower)
    names = table.joint_names or tuple(f"joint_{i}" for i in range(1, n + 1))
    if len(names) != n:
        raise ValueError(f"joint_names must hold {n} names, got {len(names)}")
    if table.convention == "standard":
        arm = arm_from_dh(table.a, table.d, table.alpha, (0.0, 0.0, 0.0), names)
    else:
        arm = arm_from_modified_dh(table.a, table.d, table.alpha, names)
    return replace(arm, joint_offset=as_vector("theta", table.theta, n)) if table.theta else arm


def _given(name: str, values: tuple[float, ...], n: int) -> FloatArray | None:
    return as_vector(name, values, n) if values else None


def estimated(mass: tuple[float, ...], name: str) -> str:
    """Return the line that says what was estimated."""
    return "" if mass else f"{name}: masses, inertia and torque limits are estimated from the lengths of the links"
