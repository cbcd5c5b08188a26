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
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.settings import Check, listed, read_value, remark
from servobench.plant.robot.files import Lengths
from servobench.plant.robot.urdf_elements import Tree

TURNING = ("revolute", "continuous")
MIN_JOINTS = 3  # least number of rotating joints of an arm
# Parts of names: of the links and joints of fingers, of the joints of grippers, and of joints that turn a whole gripper
FINGER = re.compile(r"finger|thumb|knuckle|jaw|claw", re.IGNORECASE)
GRIPPER = re.compile(f"{FINGER.pattern}|gripper", re.IGNORECASE)
WRIST = re.compile(r"wrist|(?<!t)roll|rot|yaw|pitch|base|flange|mount", re.IGNORECASE)
# Longest travel of a sliding joint that is a finger without a name or a companion
MAX_STROKE = 0.1  # [m]
# Largest relative difference of the distances of two fingers from their palm
MIRRORED = 0.01  # [1]
LENGTHS = Check.of(Lengths, bare=True)
# A joint as yourdfpy, which is not typed, reads it
JointElement: TypeAlias = Any
Ways = dict[str, list[JointElement]]  # link -> joints from the root to it, as yourdfpy reads them


class Joint(NamedTuple):
    """A rotating joint of the chain."""

    joint: JointElement  # as yourdfpy reads it
    origin: FloatArray  # (4, 4), the joint in the frame of the turning joint before it, whose z axis is its own
    aligned: FloatArray  # (4, 4), the frame whose z axis is the joint's axis, in the frame of the joint's child link


class Chain(NamedTuple):
    """The joints of an arm."""

    joints: list[Joint]
    flange: FloatArray  # (4, 4), the tip in the frame of the last joint
    tip: str  # link that carries the ball
    ending: str  # the joints taken as the tool, and other chains as long; empty for none


def find_chain(tree: Tree, tip: str) -> Chain:
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
    chain, flange = _along_way(way, tip, free)
    ending = ""
    if not named:
        ending = _ending(tree, ways, free, tip, tool)
    return Chain(chain, flange, tip, ending)


def _along_way(way: list[JointElement], tip: str, free: Ways) -> tuple[list[Joint], FloatArray]:
    """Return the rotating joints on the way to a tip, and the tip in the frame of the last one, (4, 4).

    Raises:
        ValueError: a joint that is not modelled, or has no axis or an impossible origin.
    """
    chain = []
    pose = np.eye(4)
    for joint in way:
        if not _is_modelled(joint):
            raise _not_modelled(joint, tip, free)
        place = pose_of(joint.origin)
        position = tuple(place[:3, 3].tolist())
        read_value(f"joint {joint.name!r}: origin", position, LENGTHS, lambda: "m")
        pose = pose @ place
        if turns(joint):
            if not np.any(joint.axis):
                raise ValueError(
                    f"joint {joint.name!r} turns about the axis 0 0 0; the usual one is 0 0 1"
                )
            aligned = _along(np.asarray(joint.axis, dtype=np.float64))
            chain.append(Joint(joint, pose @ aligned, aligned))
            # The link behind the joint is given in the joint's own frame, not in the aligned one.
            pose = aligned.T
    return chain, pose


def _not_modelled(joint: JointElement, tip: str, free: Ways) -> ValueError:
    """Return the error about a joint on the way to a tip that is not modelled, with another tip if there is one."""
    kind = "turns with another (mimic)"
    if joint.mimic is None:
        kind = f"is of type {joint.type}"
    modelled = {link: way for link, way in free.items() if all(map(_is_modelled, way))}
    other = _flange(modelled)
    remedy = 'write type="fixed" if it can stay at rest'
    if _count(modelled[other]) >= MIN_JOINTS:
        remedy = f"name another link, such as #{other}"
    return ValueError(
        f"joint {joint.name!r} on the way to {tip!r} {kind}, which is not modelled; {remedy}"
    )


def _ways(tree: Tree) -> Ways:
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


def turns(joint: JointElement) -> bool:
    """Return whether a joint rotates by itself."""
    return joint.type in TURNING and joint.mimic is None


def _count(way: list[JointElement]) -> int:
    return sum(map(turns, way))


def _is_modelled(joint: JointElement) -> bool:
    return turns(joint) or joint.type == "fixed"


def _flange(ways: Ways) -> str:
    """Return the link that is fixed to the last of the most rotating ones; that one itself if there is none."""

    def rank(link: str) -> tuple[int, bool]:
        """Most rotating joints first, and of those the link that is behind the last one itself."""
        way = ways[link]
        return _count(way), bool(way) and turns(way[-1])

    last = max(ways, key=rank)
    fixed = []
    for link, way in ways.items():
        if way and way[:-1] == ways[last] and way[-1].type == "fixed":
            fixed.append(link)
    # Fingers and cameras follow after the flange; ROS puts the frame of a force sensor before it.
    if "flange" in fixed:
        return "flange"
    return fixed[0] if fixed else last


def _tool(tree: Tree, ways: Ways) -> dict[str, str]:
    """Return why a rotating joint is one of the tool, by its name."""
    tool = _fingers(tree, ways)
    followers = Counter(joint.mimic.joint for joint in tree.joints if joint.mimic is not None)
    onward = defaultdict[str, list[JointElement]](list)
    for joint in filter(turns, tree.joints):
        for before in ways[joint.parent]:
            onward[before.name].append(joint)
    # The last joints come first, so that it is known of all joints behind one whether they are of the tool.
    for joint in sorted(filter(turns, tree.joints), key=lambda joint: -len(ways[joint.child])):
        leads_on = any(other.name not in tool for other in onward[joint.name])
        if leads_on or _count(ways[joint.parent]) < MIN_JOINTS:
            continue
        if followers[joint.name]:
            tool[joint.name] = f"mimicked by {followers[joint.name]}"
        elif WRIST.search(joint.name):  # It may turn a whole gripper.
            continue
        elif GRIPPER.search(joint.name) or FINGER.search(joint.child):
            tool[joint.name] = "by its name"
    return tool


def _fingers(tree: Tree, ways: Ways) -> dict[str, str]:
    """Return the rotating joints of fingers, which may mimic others, as `_tool` does."""
    lengths = dict.fromkeys(ways, 0)  # link -> most rotating joints after it
    branches = defaultdict[str, list[tuple[int, JointElement]]](list)
    for joint in sorted(tree.joints, key=lambda joint: -len(ways[joint.child])):
        length = lengths[joint.child] + (joint.type in TURNING)
        lengths[joint.parent] = max(lengths[joint.parent], length)
        branches[joint.parent].append((length, joint))
    hands = {}
    for link, parts in branches.items():
        longest = max(length for length, _ in parts)
        alike = [(length, joint) for length, joint in parts if 2 * length >= longest > 0]
        is_behind_arm = _count(ways[link]) >= max(MIN_JOINTS, longest)
        if len(alike) > 1 and is_behind_arm and _are_fingers(alike):
            hands[link] = f"one of {len(alike)} fingers"
    found = {}
    for joint in filter(turns, tree.joints):
        palms = [before.parent for before in ways[joint.child] if before.parent in hands]
        if palms:
            found[joint.name] = hands[palms[0]]
    return found


def _are_fingers(branches: list[tuple[int, JointElement]]) -> bool:
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


def _ending(tree: Tree, ways: Ways, free: Ways, tip: str, tool: dict[str, str]) -> str:
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
    if len(following) == 1:
        (joint,) = following
        if joint.name not in mimicked and _is_axis(joint):
            raise ValueError(
                f"joint {joint.name!r} after {last.name!r} is of type prismatic, which is not modelled; #{tip} "
                "leaves it out"
            )
    lines = []
    if following:
        why = []
        for joint in following:
            reason = tool.get(joint.name, joint.type)
            if joint.mimic is not None:
                reason = f"mimics {joint.mimic.joint}"
            why.append(f"{joint.name} ({reason})")
        taken = ""
        rotating = [joint for joint in following if joint.name in tool]
        if rotating:
            taken = f"; #{rotating[0].child} would take it as a joint"
        lines.append(f"the tool, at rest, begins with {listed(why, 3)}{taken}")
    others = []
    for link, way in free.items():
        is_end = way and turns(way[-1]) and link != last.child
        if is_end and _count(way) == _count(ways[tip]):
            others.append(f"#{link}")
    if others:
        lines.append(f"as many joints lead to {listed(others, 3)}")
    return "; ".join(lines)


def _is_axis(joint: JointElement) -> bool:
    """Return whether a single sliding joint at the end of a chain is an axis of the arm and no finger."""
    if joint.type != "prismatic" or joint.mimic is not None:
        return False
    if GRIPPER.search(f"{joint.name} {joint.child}"):
        return False
    limit = joint.limit
    if limit is None or limit.lower is None or limit.upper is None:
        return True
    return bool(limit.upper - limit.lower > MAX_STROKE)


def _along(axis: FloatArray) -> FloatArray:
    """Return a frame (4, 4) whose z axis is `axis` (3,); the identity if that is z already."""
    z = axis / np.linalg.norm(axis)
    frame = np.eye(4)
    if z[2] < 1.0 - 1e-12:
        # x is near the x axis, or if z is near it, near the y axis.
        side = np.array([1.0, 0.0, 0.0])
        if abs(z[0]) >= 0.9:
            side = np.array([0.0, 1.0, 0.0])
        x = side - (side @ z) * z
        x /= np.linalg.norm(x)
        frame[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    return frame


def pose_of(origin: FloatArray | None) -> FloatArray:
    """Return the pose (4, 4) of an origin; the identity without one."""
    if origin is None:
        return np.eye(4)
    return np.asarray(origin, dtype=np.float64)
