"""A robot from a URDF: its chain of rotating joints, with its limits, masses and torques."""

from collections import defaultdict
from math import inf, isfinite, pi
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Le

from servobench.plant.contract.checks import FloatArray, as_array
from servobench.plant.contract.faults import configuration_errors
from servobench.plant.contract.settings import Check, Number, Positive, read_value, remark
from servobench.plant.robot.arm import JointLimits, Links, SerialArm, plain_arm, rpy_from_rotation
from servobench.plant.robot.files import Mass
from servobench.plant.robot.robot import Robot, at_far_end, estimate_links
from servobench.plant.robot.urdf_chain import Chain, Joint, JointElement, find_chain, pose_of
from servobench.plant.robot.urdf_elements import Tree, read_elements
from servobench.plant.robot.workspace import find_workspace, with_ball

LIMITS = Check.of(tuple[Annotated[Number, Ge(-30.0), Le(30.0)], ...], bare=True)
SPEEDS = Check.of(tuple[Positive, ...], bare=True)
MASS = Check.of(Mass, bare=True)
USUAL_LIMIT = 4.0 * pi  # [rad]
USUAL_SPEEDS = (0.01, 20.0)  # [rad/s]
UNLIMITED = 1e3  # [rad], [rad/s] from which on a limit is none
DEFAULT_RANGE = 2.0 * pi  # [rad] to either side, where a joint's limit is not given
DEFAULT_SPEED = pi  # [rad/s] where a joint's limit is not given
DEFAULTS = "±2π rad and π rad/s"
# Share of the largest principal moment by which the others' sum is above it despite rounding
INERTIA_MARGIN = 1e-6  # [1]
# Share of itself by which the largest principal moment may exceed the others' sum without a remark
ROUNDED_INERTIA = 5e-3  # [1]
# Share of itself by which it exceeds the others' sum in no real file
FLAT_INERTIA = 0.9  # [1]
# Largest radius of gyration over the arm's length; 1/2 for weights at both ends of a rod
MAX_GYRATION = 2.0 / 3.0  # [1]
# Density of osmium, whose sphere has the least inertia of a mass
MAX_DENSITY = 22_600.0  # [kg/m³]


def read_urdf_robot(path: Path, tip: str) -> Robot:
    """Return the robot of a URDF.

    Args:
        path: the file; meshes are not read.
        tip: the link that carries the ball; empty for the last link before the tool, see `find_chain`.

    Raises:
        ValueError: the file is missing, malformed, or describes no serial arm with turning joints.
    """
    tree = read_elements(path)
    flaws = list[str]()
    with configuration_errors(f"robot file {path}: "):
        chain = find_chain(tree, tip)
        arm = _arm(chain)
        limits = _limits([link.joint for link in chain.joints])
        links, estimates = _links(tree, chain.joints, arm, flaws)
        try:
            workspace = find_workspace(arm, limits, links)
        except ValueError as error:
            raise ValueError(f"{error}; {chain.ending}".removesuffix("; ")) from error
    flaw = ""
    if flaws:
        flaw = flaws[0]
        remark(f"robot file {path}: {flaw}; the physics engines refuse it")
    names = arm.joint_names
    line = f"{path.name}: {arm.n} joints from {names[0]} to {names[-1]}, the ball on {chain.tip}"
    lines = [each for each in (line, chain.ending, estimates) if each]
    note = "; ".join(lines)
    title = str(tree.name)
    return Robot(path.stem, title, path.name, arm, limits, links, workspace, note=note, flaw=flaw)


def _arm(chain: Chain) -> SerialArm:
    """Return the kinematics of a chain, with a ball."""
    names = tuple(link.joint.name for link in chain.joints)
    origins = np.stack([*(link.origin for link in chain.joints), chain.flange])
    rpy = rpy_from_rotation(origins[:, :3, :3])
    return with_ball(plain_arm(names, origins[:, :3, 3], rpy))


def _limits(joints: list[JointElement]) -> JointLimits:
    """Return the limits; soft limits of a safety controller count where they are narrower."""
    remarks = defaultdict[str, list[str]](list)  # remark -> limits or joints
    rows = []
    for joint in joints:
        name = f"joint {joint.name!r}"
        lower, upper = _range(joint, remarks)
        speed = _limit(joint, "velocity", DEFAULT_SPEED, remarks)
        read_value(f"{name}: limits", (float(lower), float(upper)), LIMITS, lambda: "rad")
        read_value(f"{name}: velocity", (float(speed),), SPEEDS, lambda: "rad/s")
        if lower >= upper:
            raise ValueError(f"{name}: lower must be below upper, got {lower:g} and {upper:g}")
        if max(-lower, upper) > USUAL_LIMIT:
            remarks["limits beyond ±4π rad; angles of a URDF are in rad"].append(joint.name)
        slowest, fastest = USUAL_SPEEDS
        if not slowest <= speed <= fastest:
            usual = "velocities that are usually from 0.01 to 20 rad/s"
            remarks[f"{usual}; those of a URDF are in rad/s"].append(joint.name)
        rows.append((lower, upper, speed))
    for text, names in remarks.items():
        remark(f"{text}: {', '.join(names)}")
    lowers, uppers, speeds = np.array(rows, dtype=np.float64).T
    return JointLimits(lowers, uppers, speeds)


def _range(joint: JointElement, remarks: dict[str, list[str]]) -> tuple[float, float]:
    """Return the lower and the upper limit of a joint [rad]."""
    if joint.type == "continuous":
        return -DEFAULT_RANGE, DEFAULT_RANGE
    lower = _limit(joint, "lower", -DEFAULT_RANGE, remarks)
    upper = _limit(joint, "upper", DEFAULT_RANGE, remarks)
    safety = joint.safety_controller
    if safety is not None and safety.soft_lower_limit is not None:
        lower = max(lower, safety.soft_lower_limit)
    if safety is not None and safety.soft_upper_limit is not None:
        upper = min(upper, safety.soft_upper_limit)
    return lower, upper


def _limit(joint: JointElement, word: str, default: float, remarks: dict[str, list[str]]) -> float:
    """Return a limit of a joint; the default where it is not given or infinite."""
    given = getattr(joint.limit, word, None)
    limit = f"{word} of {joint.name}"
    if given is None or (given == 0.0 and word == "velocity"):
        remarks[f"limits that the URDF lacks are taken as {DEFAULTS}"].append(limit)
        return default
    if abs(given) == inf or (abs(given) >= UNLIMITED and word != "velocity"):
        remarks[f"unlimited in the URDF, and taken as {DEFAULTS}"].append(limit)
        return default
    return float(given)


def _links(tree: Tree, chain: list[Joint], arm: SerialArm, flaws: list[str]) -> tuple[Links, str]:
    """Return the links, estimated where the file has no values, and a line about the estimates.

    Args:
        tree: the file.
        chain: the joints.
        arm: the arm of these joints.
        flaws: takes values that no body has.
    """
    inertials = {link.name: link.inertial for link in tree.links}
    efforts = [getattr(link.joint.limit, "effort", None) or 0.0 for link in chain]
    torque = None
    if all(isfinite(effort) and effort > 0.0 for effort in efforts):
        torque = np.array(efforts)
    lacking = []
    for link in chain:
        own = inertials[link.joint.child]
        if own is None or not own.mass or not np.any(own.inertia):
            lacking.append(link.joint.child)
    if lacking:
        estimated = "masses, inertia"
        if torque is None:
            estimated += ", torque limits"
        if len(lacking) < len(chain):
            estimated += f" (no mass or inertia of {', '.join(lacking)})"
        return estimate_links(arm, torque=torque), f"estimated: {estimated}"
    reach = float(np.linalg.norm(arm.translation[1:], axis=1).sum())
    bodies = [_body(tree, chain, link, reach, flaws) for link in chain]
    mass, centre, inertia = (np.array(each) for each in zip(*bodies, strict=True))
    links = estimate_links(arm, mass, torque, at_far_end(arm, centre, inertia))
    return links, "" if torque is not None else "estimated: torque limits"


class Body(NamedTuple):
    """The inertial values of a link in the frame of the joint before it."""

    link: str
    mass: float  # [kg]
    centre: FloatArray  # (3,) [m]
    inertia: FloatArray  # (3, 3) [kg m²], about the centre


def _body(
    tree: Tree, chain: list[Joint], link: Joint, reach: float, flaws: list[str]
) -> tuple[float, FloatArray, FloatArray]:
    """Return mass [kg], centre (3,) [m] and inertia (3, 3) [kg m²] of a link and of all that hangs on it.

    These are links behind fixed joints, such as a tool, and behind joints that no controller moves, such as fingers.
    """
    bodies = _hanging_bodies(tree, chain, link, reach, flaws)
    mass = sum(body.mass for body in bodies)
    moments = [body.mass * body.centre for body in bodies]
    centre = np.sum(moments, axis=0) / mass
    inertia = np.zeros((3, 3))
    for body in bodies:
        # Parallel axes: I + m (‖r‖² 1 − r rᵀ)
        r = body.centre - centre
        inertia += body.inertia + body.mass * (r @ r * np.eye(3) - np.outer(r, r))
    if not flaws:
        culprit = max(bodies, key=lambda body: float(np.trace(body.inertia)))
        flaws += _implausible(culprit.link, mass, inertia, reach)
    return mass, centre, inertia


def _hanging_bodies(
    tree: Tree, chain: list[Joint], link: Joint, reach: float, flaws: list[str]
) -> list[Body]:
    """Return the bodies with a mass that move with the link behind a joint of the chain, that link's own first."""
    inertials = {each.name: each.inertial for each in tree.links}
    onward = {each.joint.name for each in chain}
    waiting = [(link.joint.child, link.aligned.T)]
    met = set[str]()
    bodies = []
    while waiting:
        name, pose = waiting.pop()
        met.add(name)
        for joint in tree.joints:
            hangs_on_it = joint.parent == name and joint.name not in onward
            if hangs_on_it and joint.child not in met:
                waiting.append((joint.child, pose @ pose_of(joint.origin)))
        own = inertials[name]
        if own is not None and own.mass:
            mass = float(own.mass)
            read_value(f"link {name!r}: mass", mass, MASS, lambda: "kg")
            placed = pose @ pose_of(own.origin)
            R = placed[:3, :3]
            inertia = np.zeros((3, 3))
            if np.any(own.inertia):
                inertia = _balanced(name, own.inertia, flaws)
            bodies.append(Body(name, mass, placed[:3, 3], R @ inertia @ R.T))
            away = float(np.linalg.norm(placed[:3, 3]))
            if away > reach:
                flaws.append(
                    f"link {name!r}: its centre of mass is {away:.3g} m from joint {link.joint.name!r}"
                )
    return bodies


def _implausible(link: str, mass: float, inertia: FloatArray, reach: float) -> list[str]:
    """Return why no link of an arm of length `reach` [m] has this mass [kg] and inertia (3, 3) [kg m²]."""
    largest = float(np.linalg.eigvalsh(inertia)[-1])
    most = mass * (MAX_GYRATION * reach) ** 2
    # The smallest body is a sphere: m = 4/3 π r³ ρ, with the moment 2/5 m r².
    radius = (3.0 * mass / (4.0 * pi * MAX_DENSITY)) ** (1.0 / 3.0)
    least = 0.4 * mass * radius**2
    if least <= largest <= most:
        return []
    bounds = f"from {least:.2g} to {most:.2g} for {mass:.3g} kg on an arm of {reach:.2g} m"
    return [
        f"link {link!r}: inertia is implausible, as its largest moment is {largest:.3g} kg m²; possible: {bounds}"
    ]


def _balanced(link: str, given: FloatArray, flaws: list[str]) -> FloatArray:
    """Return the nearest inertia, (3, 3) kg m², whose largest principal moment is at most the sum of the others.

    Published files exceed it, by rounding or by more: PyBullet then takes no inertia, and MuJoCo refuses the body.
    """
    inertia = as_array(f"link {link!r}: inertia", given, (3, 3))
    moments, axes = np.linalg.eigh(inertia)
    came = f"principal moments {', '.join(f'{moment:.3g}' for moment in moments)} kg m²"
    if not moments[0] > 0.0:
        flaws.append(
            f"link {link!r}: inertia must be positive definite, got {came}; for an estimate write zeros"
        )
        return np.zeros((3, 3))
    excess = (1.0 + INERTIA_MARGIN) * moments[2] - moments[0] - moments[1]
    if excess <= 0.0:
        return inertia
    if excess > FLAT_INERTIA * moments[2]:
        flaws.append(f"link {link!r}: no body has the {came}, one far above the others' sum")
    # The nearest moments without excess: each gives the same share of it.
    moments = moments + excess / (3.0 + INERTIA_MARGIN) * np.array([1.0, 1.0, -1.0])
    if excess > ROUNDED_INERTIA * moments[2]:
        taken = ", ".join(f"{moment:.3g}" for moment in moments)
        remark(
            f"link {link!r}: no body has the {came}, one above the others' sum; taken as {taken}"
        )
    return axes * moments @ axes.T
