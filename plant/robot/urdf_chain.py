"""The chain of rotating joints in a URDF that is the arm, without the tool at its end.

Unless a tip is named, the chain with the most rotating joints is taken, of those that end before the tool. A tool
begins after three rotating joints or more with a joint that others mimic, with one that is called a gripper, or with
fingers: chains that branch from one link, have similar lengths, are not longer than the arm and, if two, mirrored. No
other rotating joint follows after it. Sliding joints are in no chain: at its end those of fingers belong to the tool,
an axis is refused.
"""

import re
from collections import Counter, defaultdict
from math import isclose
from typing import Any, Final, NamedTuple

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.settings import Check, listed, read_value, remark
from servobench.plant.robot.files import Lengths

TURNING: Final = ("revolute", "continuous")
MIN_JOINTS: Final = 3  # least number of rotating joints of an arm
# In the name of a link or a joint
FINGER: Final = re.compile(r"finger|thumb|knuckle|jaw|claw", re.IGNORECASE)
GRIPPER: Final = re.compile(f"{FINGER.pattern}|gripper", re.IGNORECASE)  # in that of a joint
# Turns a whole gripper
WRIST: Final = re.compile(r"wrist|(?<!t)roll|rot|yaw|pitch|base|flange|mount", re.IGNORECASE)
MAX_STROKE: Final = (
    0.1  # [m] longest travel of a sliding joint that is a finger without a name or a companion
)
MIRRORED: Final = (
    0.01  # [1] largest relative difference of the distances of two fingers from their palm
)
LENGTHS: Final = Check.of(Lengths, bare=True)
Ways = dict[str, list[Any]]  # link -> joints from the root to it, as yourdfpy reads them


class Joint(NamedTuple):
    """A rotating joint of the chain."""

    joint: Any  # as yourdfpy reads it
    origin: FloatArray  # (4, 4), the joint in the frame of the turning joint before it, whose z axis is its own
    aligned: FloatArray  # (4, 4), the frame whose z axis is the joint's axis, in the frame of the joint's child link


class Chain(NamedTuple):
    """The joints of an arm."""

    joints: list[Joint]
    flange: FloatArray  # (4, 4), the tip in the frame of the last joint
    tip: str  # link that carries the ball
    ending: str  # the joints taken as the tool, and other chains as long; empty for none


def find_chain(tree: Any, tip: str) -> Chain:  # noqa: ANN401 - yourdfpy is not typed
    """Return the chain from the base to a tip.

    Args:
        tree: links and joints.
        tip: a link; empty for the one that is fixed to the last joint before the tool.

    Raises:
        ValueError: no such chain, or one with joints that are not modelled.
    """
    ways = _ways(tree)
    if tip and tip not in ways:
        raise ValueError(f"it has no link {tip!r}; valid: {', '.join(ways)}")
    tool = _tool(tree, ways)
    free = {link: way for link, way in ways.items() if not any(joint.name in tool for joint in way)}
    named = bool(tip)
    tip = tip or _flange(free)
    way = ways[tip]
    if _count(way) < MIN_JOINTS:
        raise ValueError("it has no chain of at least three turning joints")
    chain = []
    pose = np.eye(4)
    for joint in way:
        if not _is_modelled(joint):
            kind = (
                f"is of type {joint.type}" if joint.mimic is None else "turns with another (mimic)"
            )
            other = _flange(
                {link: way for link, way in free.items() if all(map(_is_modelled, way))}
            )
            remedy = 'write type="fixed" if it can stay at rest'
            if _count(ways[other]) >= MIN_JOINTS:
                remedy = f"name another link, such as #{other}"
            raise ValueError(
                f"joint {joint.name!r} on the way to {tip!r} {kind}, which is not modelled; {remedy}"
            )
        place = pose_of(joint.origin)
        read_value(
            f"joint {joint.name!r}: origin", tuple(place[:3, 3].tolist()), LENGTHS, lambda: "m"
        )
        pose = pose @ place
        if turns(joint):
            if not np.any(joint.axis):
                raise ValueError(
                    f"joint {joint.name!r} turns about the axis 0 0 0; the usual one is 0 0 1"
                )
            aligned = _along(np.asarray(joint.axis, dtype=np.float64))
            chain.append(Joint(joint, pose @ aligned, aligned))
            pose = aligned.T
    ending = ""
    if not named:
        ending = _ending(tree, ways, free, tip, tool)
    return Chain(chain, pose, tip, ending)


def _ways(tree: Any) -> Ways:  # noqa: ANN401
    """Return the joints from the root to each link."""
    above = {joint.child: joint for joint in tree.joints}
    links = [link.name for link in tree.links]
    ends = {joint.parent for joint in tree.joints} | set(above)
    for joint in tree.joints:
        lost = {joint.parent, joint.child} - set(links)
        if lost:
            raise ValueError(
                f"joint {joint.name!r} is between links of which the file has no {min(lost)!r}"
            )
    if not links or not tree.joints:
        raise ValueError(
            "it has no links and joints; of a xacro file, take the output of `xacro FILE`"
        )
    roots = sorted(ends - set(above))
    if len(roots) > 1:
        raise ValueError(
            f"both {' and '.join(roots)} are without a parent: a joint is missing or turned round"
        )
    for joint in tree.joints:
        other = above[joint.child]
        if other is not joint:
            raise ValueError(
                f"link {joint.child!r} is the child of both {joint.name!r} and {other.name!r}"
            )
    lonely = [link for link in links if link not in ends]
    if lonely:
        remark(f"links without a joint are left out: {listed(lonely, 6)}")
    ways = {}
    for link in links:
        way = []
        place = link
        while place in above:
            way.append(above[place])
            place = above[place].parent
            if len(way) > len(above):
                raise ValueError(f"the joints before link {link!r} form a circle")
        ways[link] = way[::-1]
    return ways


def turns(joint: Any) -> bool:  # noqa: ANN401
    """Return whether a joint rotates by itself."""
    return joint.type in TURNING and joint.mimic is None


def _count(way: list[Any]) -> int:
    return sum(map(turns, way))


def _is_modelled(joint: Any) -> bool:  # noqa: ANN401
    return turns(joint) or joint.type == "fixed"


def _flange(ways: Ways) -> str:
    """Return the link that is fixed to the last of the most rotating ones; that one itself if there is none."""
    last = max(
        ways, key=lambda name: (_count(ways[name]), bool(ways[name]) and turns(ways[name][-1]))
    )
    # Fingers and cameras follow after the flange; ROS puts the frame of a force sensor before it.
    fixed = [
        name
        for name, way in ways.items()
        if way and way[:-1] == ways[last] and way[-1].type == "fixed"
    ]
    return "flange" if "flange" in fixed else fixed[0] if fixed else last


def _tool(tree: Any, ways: Ways) -> dict[str, str]:  # noqa: ANN401
    """Return why a rotating joint is one of the tool, by its name."""
    tool = _fingers(tree, ways)
    followers = Counter(joint.mimic.joint for joint in tree.joints if joint.mimic is not None)
    onward = defaultdict[str, list[Any]](list)
    for joint in filter(turns, tree.joints):
        for before in ways[joint.parent]:
            onward[before.name].append(joint)
    for joint in sorted(filter(turns, tree.joints), key=lambda joint: -len(ways[joint.child])):
        follows = any(other.name not in tool for other in onward[joint.name])
        if follows or _count(ways[joint.parent]) < MIN_JOINTS:
            continue
        if followers[joint.name]:
            tool[joint.name] = f"mimicked by {followers[joint.name]}"
        elif (GRIPPER.search(joint.name) or FINGER.search(joint.child)) and not WRIST.search(
            joint.name
        ):
            tool[joint.name] = "by its name"
    return tool


def _fingers(tree: Any, ways: Ways) -> dict[str, str]:  # noqa: ANN401
    """Return the rotating joints of fingers, which may mimic others, as `_tool` does."""
    lengths = dict.fromkeys(ways, 0)  # link -> most rotating joints after it
    branches = defaultdict[str, list[tuple[int, Any]]](list)
    for joint in sorted(tree.joints, key=lambda joint: -len(ways[joint.child])):
        length = lengths[joint.child] + (joint.type in TURNING)
        lengths[joint.parent] = max(lengths[joint.parent], length)
        branches[joint.parent].append((length, joint))
    hands = {}
    for link, parts in branches.items():
        longest = max(length for length, _ in parts)
        alike = [(length, joint) for length, joint in parts if 2 * length >= longest > 0]
        is_palm = len(alike) > 1 and _count(ways[link]) >= max(MIN_JOINTS, longest)
        if is_palm and _are_fingers(alike):
            hands[link] = f"one of {len(alike)} fingers"
    found = {}
    for joint in filter(turns, tree.joints):
        palms = [before.parent for before in ways[joint.child] if before.parent in hands]
        if palms:
            found[joint.name] = hands[palms[0]]
    return found


def _are_fingers(branches: list[tuple[int, Any]]) -> bool:
    """Return whether branches of one link are fingers: more than two, or called so, or two that mirror each other.

    A camera that turns and a bar beside the wrist are no fingers.
    """
    if len(branches) > 2:
        return True
    lengths = set[int]()
    reaches = list[float]()
    for length, joint in branches:
        if GRIPPER.search(f"{joint.name} {joint.child}"):
            return True
        lengths.add(length)
        reaches.append(float(np.linalg.norm(pose_of(joint.origin)[:3, 3])))
    return len(lengths) == 1 and isclose(*reaches, rel_tol=MIRRORED)


def _ending(tree: Any, ways: Ways, free: Ways, tip: str, tool: dict[str, str]) -> str:  # noqa: ANN401
    """Return a line on the joints after the last one of a chain, and on other chains as long.

    Raises:
        ValueError: an axis follows that is not modelled.
    """
    last = next(joint for joint in reversed(ways[tip]) if turns(joint))
    following = []
    for joint in tree.joints:
        moving = [before for before in ways[joint.parent] if before.type != "fixed"]
        if joint.type != "fixed" and moving and moving[-1].name == last.name:
            following.append(joint)
    mimicked = {joint.mimic.joint for joint in tree.joints if joint.mimic is not None}
    if len(following) == 1 and following[0].name not in mimicked and _is_axis(following[0]):
        joint = following[0]
        remedy = f"#{tip} leaves it out"
        raise ValueError(
            f"joint {joint.name!r} after {last.name!r} is of type prismatic, which is not modelled; {remedy}"
        )
    lines = []
    if following:
        why = [f"{joint.name} ({_reason(joint, tool)})" for joint in following]
        taken = next(
            (
                f"; #{joint.child} would take it as a joint"
                for joint in following
                if joint.name in tool
            ),
            "",
        )
        lines.append(f"the tool, at rest, begins with {listed(why, 3)}{taken}")
    equal = [
        link
        for link, way in free.items()
        if way and turns(way[-1]) and _count(way) == _count(ways[tip])
    ]
    others = [f"#{link}" for link in equal if link != last.child]
    if others:
        lines.append(f"as many joints lead to {listed(others, 3)}")
    return "; ".join(lines)


def _reason(joint: Any, tool: dict[str, str]) -> str:  # noqa: ANN401
    if joint.mimic is not None:
        return f"mimics {joint.mimic.joint}"
    return tool.get(joint.name, str(joint.type))


def _is_axis(joint: Any) -> bool:  # noqa: ANN401
    """Return whether a single sliding joint at the end of a chain is an axis of the arm and no finger."""
    if (
        joint.type != "prismatic"
        or joint.mimic is not None
        or GRIPPER.search(f"{joint.name} {joint.child}")
    ):
        return False
    if joint.limit is None or joint.limit.lower is None or joint.limit.upper is None:
        return True
    return bool(joint.limit.upper - joint.limit.lower > MAX_STROKE)


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


def pose_of(origin: FloatArray | None) -> FloatArray:
    """Return the pose (4, 4) of an origin; the identity without one."""
    return np.eye(4) if origin is None else np.asarray(origin, dtype=np.float64)
