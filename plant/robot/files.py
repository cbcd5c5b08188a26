"""Robots from files: a factory calibration of Universal Robots, a DH table in TOML, a URDF.

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

Of a URDF, read by yourdfpy, the chain with the most rotating joints is taken, with its limits, masses and torques.
"""

import contextlib
import logging
import re
from collections.abc import Mapping
from dataclasses import replace
from math import isfinite, pi
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Le

from servobench.plant.contract.checks import FloatArray, as_array
from servobench.plant.contract.faults import configuration_errors
from servobench.plant.contract.settings import (
    Check,
    JointSpeed,
    Number,
    Positive,
    Usual,
    override,
    read_value,
    remark,
    settings,
)
from servobench.plant.robot.arm import JointLimits, SerialArm, arm_from_dh, rpy_from_rotation
from servobench.plant.robot.makers import MAX_DEVIATION, nearest_title, read_calibration, universal_robot
from servobench.plant.robot.robot import Links, Robot, at_far_end, estimate_links
from servobench.plant.robot.workspace import find_workspace, with_ball


def read_calibrated_robot(path: Path) -> Robot:
    """Return the robot of the data sheet that a calibration file fits, with the measured arm as the true one.

    Raises:
        ValueError: the file is missing, malformed, or fits no data sheet.
    """
    title, deviation = nearest_title(read_calibration(path, np.zeros(3)))
    if deviation > MAX_DEVIATION:
        nearest = f"the {title} comes nearest, and its flange is {1e3 * deviation:.0f} mm away"
        raise ValueError(f"calibration file {path} fits no arm of Universal Robots: {nearest}")
    sheet = universal_robot(title)
    source, measured = f"{path.name}, held against {sheet.source}", read_calibration(path, sheet.arm.tool)
    within = f"its flange within {1e3 * deviation:.1f} mm of the data sheet's"
    roles = f"the true robot is the calibrated arm, controllers know the data sheet's {title}"
    note = f"{path.name} is the factory calibration of a {title} ({within}): {roles}"
    return replace(sheet, name=path.stem, source=source, measured=measured, note=note)


Lengths = tuple[Annotated[Number, Ge(-20.0), Le(20.0), Usual(5.0)], ...]
Twists = tuple[Annotated[Number, Ge(-6.3), Le(6.3)], ...]
Limits = tuple[Annotated[Number, Ge(-30.0), Le(30.0), Usual(4.0 * pi)], ...]
Mass = Annotated[Positive, Usual(500.0)]
LENGTHS: Final = Check.of(Lengths, bare=True)  # of a URDF, as the next ones
LIMITS: Final = Check.of(tuple[Annotated[Number, Usual(4.0 * pi)], ...], bare=True)
SPEEDS: Final = Check.of(tuple[JointSpeed, ...], bare=True)
MASS: Final = Check.of(Mass, bare=True)


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


def read_dh_robot(path: Path, values: Mapping[str, Any]) -> Robot:
    """Return the robot of a DH table with the content of a file.

    Raises:
        ValueError: the content is malformed, or describes no arm that can work at a table.
    """
    for key in REQUIRED:
        if key not in values:
            raise ValueError(f"robot file {path}: the key {key!r} is missing; wanted {', '.join(REQUIRED)}")
    if "convention" not in values:
        remark(f'robot file {path} is read by the standard convention; write convention = "standard" or "modified"')
    table = override(f"robot file {path}", DhTable((), (), (), (), (), ()), values)
    with configuration_errors(f"robot file {path}: "):
        arm = with_ball(_arm_of(table))
        n = arm.n
        given = (as_array(name, getattr(table, name), (n,)) for name in ("joint_lower", "joint_upper", "joint_speed"))
        limits = JointLimits(*given)
        mass, torque = (
            as_array(name, each, (n,)) if (each := getattr(table, name)) else None for name in ("mass", "torque")
        )
        links = estimate_links(arm, mass, torque)
        workspace = find_workspace(arm, (limits.lower, limits.upper), (links.radius, links.aside))
        name = table.name or path.stem
        estimated = "masses, inertia and torque limits are estimated from the lengths of the links"
        note = "" if table.mass else f"{name}: {estimated}"
        return Robot(name, name, path.name, arm, limits, links, workspace, note=note)


def _arm_of(table: DhTable) -> SerialArm:
    n = len(table.joint_lower)
    names = table.joint_names or tuple(f"joint_{i}" for i in range(1, n + 1))
    if len(names) != n:
        raise ValueError(f"joint_names must hold {n} names, got {len(names)}")
    arm = arm_from_dh(table.a, table.d, table.alpha, names, modified=table.convention == "modified")
    return replace(arm, joint_offset=as_array("theta", table.theta, (n,))) if table.theta else arm


TURNING: Final = ("revolute", "continuous")
COMMENT: Final = re.compile(r"<!--.*?-->", re.DOTALL)
RPY: Final = re.compile(r"""\brpy\s*=\s*["']([^"']*)""")
INERTIA_MARGIN: Final = 1e-6  # [1] of the largest moment, by which the others' sum is above it despite rounding
ROUNDED_INERTIA: Final = 5e-3  # [1] of the largest moment, by which it exceeds the others' sum without a remark
DEFAULT_SPEED: Final = pi  # [rad/s] of a joint whose limit is not given


class Joint(NamedTuple):
    """A rotating joint of the chain."""

    joint: Any  # as yourdfpy reads it
    origin: FloatArray  # (4, 4), the joint in the frame of the turning joint before it, whose z axis is its own
    aligned: FloatArray  # (4, 4), the frame whose z axis is the joint's axis, in the frame of the joint's child link


def read_urdf_robot(path: Path, tip: str) -> Robot:
    """Return the robot of a URDF.

    Args:
        path: the file; meshes are not read.
        tip: the link that carries the ball; empty for the last link after the most turning joints.

    Raises:
        ValueError: the file is missing, malformed, or describes no serial arm with turning joints.
    """
    tree = _read(path)
    with configuration_errors(f"robot file {path}: "):
        chain, flange, tip = _chain(tree, tip)
        names = tuple(link.joint.name for link in chain)
        origins = np.stack([*(link.origin for link in chain), flange])
        n, rpy = len(chain), rpy_from_rotation(origins[:, :3, :3])
        arm = with_ball(SerialArm(names, origins[:, :3, 3], rpy, np.zeros(n), np.ones(n), np.zeros(3)))
        limits = _limits(chain)
        links, note = _links(tree, chain, arm)
        workspace = find_workspace(arm, (limits.lower, limits.upper), (links.radius, links.aside))
    lines = [f"{path.name}: {n} joints from {names[0]} to {names[-1]}, the ball on {tip}", *([note] if note else [])]
    return Robot(path.stem, str(tree.name), path.name, arm, limits, links, workspace, note="; ".join(lines))


def _read(path: Path) -> Any:  # noqa: ANN401 - yourdfpy is not typed
    """Return the elements of a URDF."""
    try:
        import yourdfpy  # noqa: PLC0415 - only the extra urdf brings it
    except ImportError as error:
        raise ValueError(f"robot file {path}: a URDF needs yourdfpy: pip install 'servobench[urdf]'") from error
    said: list[str] = []  # of a text that is no XML, of which yourdfpy reads the rest nevertheless

    def collect(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.ERROR:
            said.append(record.getMessage())
        return record.levelno < logging.ERROR

    log = logging.getLogger(yourdfpy.urdf.__name__)
    log.addFilter(collect)
    try:
        read = yourdfpy.URDF.load(
            str(path), build_scene_graph=False, load_meshes=False, build_collision_scene_graph=False
        ).robot
    except Exception as error:  # noqa: BLE001 - the line repeats any error
        said.append(f"it lacks {error}" if isinstance(error, KeyError) else str(error) or type(error).__name__)
    finally:
        log.removeFilter(collect)
    if said:
        raise ValueError(f"robot file {path} is no URDF, with a <robot> as its root: {' '.join(said[0].split())}")
    turns = " ".join(RPY.findall(COMMENT.sub("", path.read_text(encoding="utf-8", errors="replace")))).split()
    with contextlib.suppress(ValueError):  # of a word that the reader above did not need
        if large := [turn for turn in turns if abs(float(turn)) > 7.0]:
            remark(f"robot file {path} has an rpy of {large[0]}, and angles of a URDF are in rad")
    return read


def _chain(tree: Any, tip: str) -> tuple[list[Joint], FloatArray, str]:  # noqa: ANN401
    """Return the rotating joints from the base to a tip, the flange after the last one, and the name of the tip."""
    above = {joint.child: joint for joint in tree.joints}
    links = [link.name for link in tree.links]
    for joint in tree.joints:
        if lost := {joint.parent, joint.child} - set(links):
            raise ValueError(f"joint {joint.name!r} is between links of which the file has no {min(map(str, lost))!r}")
    if not links or not tree.joints:
        raise ValueError("it has no links and joints; of a xacro file, take what `xacro FILE` prints")
    roots = sorted({joint.parent for joint in tree.joints} - set(above))
    if len(roots) > 1:
        raise ValueError(f"both {' and '.join(roots)} are without a parent: a joint is missing or turned round")
    if tip and tip not in links:
        raise ValueError(f"it has no link {tip!r}; valid: {', '.join(links)}")
    ways = {name: _way(name, above) for name in links}
    tip = tip or _flange(ways)
    way = ways[tip]
    if sum(map(_turns, way)) < 3:
        raise ValueError("it has no chain of at least three turning joints")
    chain, pose = [], np.eye(4)
    for joint in way:
        if not _modelled(joint):
            kind = f"is of type {joint.type}" if joint.mimic is None else "turns with another (mimic)"
            other = _flange({name: way for name, way in ways.items() if all(map(_modelled, way))})
            remedy = 'write type="fixed" if it can stay at rest'
            if sum(map(_turns, ways[other])) >= 3:
                remedy = f"name another link, such as #{other}"
            raise ValueError(f"joint {joint.name!r} on the way to {tip!r} {kind}, which is not modelled; {remedy}")
        read_value(f"joint {joint.name!r}: origin", tuple(_pose(joint.origin)[:3, 3].tolist()), LENGTHS, lambda: "m")
        pose = pose @ _pose(joint.origin)
        if _turns(joint):
            if not np.any(joint.axis):
                raise ValueError(f"joint {joint.name!r} turns about the axis 0 0 0; the usual one is 0 0 1")
            aligned = _along(np.asarray(joint.axis, dtype=np.float64))
            chain.append(Joint(joint, pose @ aligned, aligned))
            pose = aligned.T
    return chain, pose, tip


def _turns(joint: Any) -> bool:  # noqa: ANN401
    return joint.type in TURNING and joint.mimic is None


def _modelled(joint: Any) -> bool:  # noqa: ANN401
    return _turns(joint) or joint.type == "fixed"


def _way(link: str, above: dict[str, Any]) -> list[Any]:
    """Return the joints from the root to a link."""
    way: list[Any] = []
    while link in above and len(way) <= len(above):
        way.append(above[link])
        link = above[link].parent
    return way[::-1]


def _flange(ways: dict[str, list[Any]]) -> str:
    """Return the link that is fixed to the last of the most rotating ones; that one itself if there is none."""
    last = max(ways, key=lambda name: (sum(map(_turns, ways[name])), bool(ways[name]) and _turns(ways[name][-1])))
    # Fingers and cameras follow after the flange; ROS puts the frame of a force sensor before it.
    fixed = [name for name, way in ways.items() if way and way[:-1] == ways[last] and way[-1].type == "fixed"]
    return "flange" if "flange" in fixed else fixed[0] if fixed else last


def _along(axis: FloatArray) -> FloatArray:
    """Return a frame (4, 4) whose z axis is `axis` (3,); the identity if that is z already."""
    z = axis / np.linalg.norm(axis)
    frame = np.eye(4)
    if z[2] < 1.0 - 1e-12:
        side = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
        x = side - (side @ z) * z
        x /= np.linalg.norm(x)
        frame[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    return frame


def _limits(chain: list[Joint]) -> JointLimits:
    """Return the limits; soft limits of a safety controller count where they are narrower."""
    rows, lacking = [], list[str]()
    for link in chain:
        limit, safety, endless = link.joint.limit, link.joint.safety_controller, link.joint.type == "continuous"
        ranged = limit is not None and limit.lower is not None and limit.upper is not None
        lower, upper = (limit.lower, limit.upper) if ranged and not endless else (-2 * pi, 2 * pi)
        speed = 0.0 if limit is None else limit.velocity or 0.0
        given = {"range": ranged or endless, "velocity": speed}
        lacking += [f"{word} of {link.joint.name}" for word in given if not given[word]]
        speed = speed or DEFAULT_SPEED
        if safety is not None and not endless:
            lower = max(lower, lower if safety.soft_lower_limit is None else safety.soft_lower_limit)
            upper = min(upper, upper if safety.soft_upper_limit is None else safety.soft_upper_limit)
        name = f"joint {link.joint.name!r}"
        read_value(f"{name}: limits", (float(lower), float(upper)), LIMITS, lambda: "rad")
        read_value(f"{name}: velocity", (float(speed),), SPEEDS, lambda: "rad/s")
        rows.append((lower, upper, speed))
    if lacking:
        remark(f"limits that the URDF lacks are taken as ±2π rad and π rad/s: {', '.join(lacking)}")
    lowers, uppers, speeds = np.array(rows, dtype=np.float64).T
    return JointLimits(lowers, uppers, speeds)


def _links(tree: Any, chain: list[Joint], arm: SerialArm) -> tuple[Links, str]:  # noqa: ANN401
    """Return the links, estimated where the file has no values, and a line about the estimates."""
    inertials = {link.name: link.inertial for link in tree.links}
    own = [inertials[link.joint.child] for link in chain]
    efforts = [0.0 if link.joint.limit is None else link.joint.limit.effort or 0.0 for link in chain]
    torque = np.array(efforts) if all(isfinite(effort) and effort > 0.0 for effort in efforts) else None
    given = [inertial is not None and inertial.mass and np.any(inertial.inertia) for inertial in own]
    if not all(given):
        further = "" if torque is not None else ", torque limits"
        lacking = ", ".join(link.joint.child for link, known in zip(chain, given, strict=True) if not known)
        cause = f" (no mass or inertia of {lacking})" if any(given) else ""
        return estimate_links(arm, torque=torque), f"estimated: masses, inertia{further}{cause}"
    mass, centre, inertia = (np.array(each) for each in zip(*(_body(tree, chain, link) for link in chain), strict=True))
    links = estimate_links(arm, mass, torque, at_far_end(arm, centre, inertia))
    return links, "" if torque is not None else "estimated: torque limits"


def _body(tree: Any, chain: list[Joint], link: Joint) -> tuple[float, FloatArray, FloatArray]:  # noqa: ANN401
    """Return mass [kg], centre (3,) [m] and inertia (3, 3) [kg m²] of a link and of all that hangs on it.

    These are links behind fixed joints, such as a tool, and behind joints that no controller moves, such as fingers.
    """
    inertials, onward = {each.name: each.inertial for each in tree.links}, {each.joint.name for each in chain}
    waiting, met, parts = [(link.joint.child, link.aligned.T)], set[str](), list[tuple[float, FloatArray, FloatArray]]()
    while waiting:
        name, pose = waiting.pop()
        met.add(name)
        waiting += [
            (joint.child, pose @ _pose(joint.origin))
            for joint in tree.joints
            if joint.parent == name and joint.name not in onward and joint.child not in met
        ]
        if (own := inertials[name]) is not None and own.mass:
            read_value(f"link {name!r}: mass", float(own.mass), MASS, lambda: "kg")
            placed = pose @ _pose(own.origin)
            R, inertia = placed[:3, :3], _balanced(name, own.inertia) if np.any(own.inertia) else np.zeros((3, 3))
            parts.append((float(own.mass), placed[:3, 3], R @ inertia @ R.T))
    mass = sum(each for each, _, _ in parts)
    centre = np.sum([each * place for each, place, _ in parts], axis=0) / mass
    whole = np.zeros((3, 3))
    for each, place, inertia in parts:
        off = place - centre
        whole += inertia + each * (off @ off * np.eye(3) - np.outer(off, off))
    return mass, centre, whole


def _balanced(link: str, given: FloatArray) -> FloatArray:
    """Return the nearest inertia, (3, 3) kg m², whose largest principal moment is at most the sum of the others.

    Published files exceed it, by rounding or by more: PyBullet then takes no inertia, and MuJoCo refuses the body.
    """
    inertia = as_array(f"link {link!r}: inertia", given, (3, 3))
    moments, axes = np.linalg.eigh(inertia)
    came = f"principal moments {', '.join(f'{moment:.3g}' for moment in moments)} kg m²"
    if not moments[0] > 0.0:
        raise ValueError(f"link {link!r}: inertia must be positive definite, got {came}; for an estimate write zeros")
    excess = (1.0 + INERTIA_MARGIN) * moments[2] - moments[0] - moments[1]
    if excess <= 0.0:
        return inertia
    moments = moments + excess / (3.0 + INERTIA_MARGIN) * np.array([1.0, 1.0, -1.0])
    if excess > ROUNDED_INERTIA * moments[2]:
        taken = ", ".join(f"{moment:.3g}" for moment in moments)
        remark(f"link {link!r}: no body has the {came}, one above the others' sum; taken as {taken}")
    return np.asarray(axes * moments @ axes.T)


def _pose(origin: FloatArray | None) -> FloatArray:
    return np.eye(4) if origin is None else np.asarray(origin, dtype=np.float64)
