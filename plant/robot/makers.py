"""The arms that are known by name, from their makers' tables.

Sources. Universal Robots: "DH parameters for calculations of kinematics and dynamics" (lengths, masses, centres of
mass), "Max. joint torques", and the user manuals (speeds, ranges, loads). Franka: "Robot and interface specifications"
of the Franka Control Interface (lengths by the modified convention, limits); masses and inertia of the Panda, which
its maker does not publish: C. Gaz, M. Cognetti, A. Oliva, P. Robuffo Giordano, A. De Luca, "Dynamic identification of
the Franka Emika Panda robot with retrieval of feasible parameters using penalty-based optimization", IEEE Robotics and
Automation Letters 4 (2019). Radii of tubes are appearance.
"""

from dataclasses import dataclass
from functools import cache
from math import pi
from operator import itemgetter
from pathlib import Path

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray, Triple
from servobench.plant.contract.faults import one_line
from servobench.plant.contract.files import read_text, user_path, yaml_loader
from servobench.plant.robot import ur5
from servobench.plant.robot.arm import (
    JointLimits,
    Links,
    SerialArm,
    arm_from_dh,
    numbered_joints,
    plain_arm,
)
from servobench.plant.robot.robot import Robot, at_far_end, cylinder_inertia
from servobench.plant.robot.workspace import Workspace, find_workspace, length_scale, with_ball

CALIBRATION_BLOCKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
LENGTHS = ("a2", "a3", "d1", "d4", "d5", "d6")  # names of DH lengths that are not 0
ALIKE = (2, 1, 3)  # joints of shoulder, elbow and wrist that share a number of a `Triple`
UR_SOURCE = "Universal Robots, DH parameters for calculations of kinematics and dynamics"
PANDA_SOURCE = "Franka, Robot and interface specifications; masses by Gaz et al. 2019"


@dataclass(frozen=True)
class UniversalRobot:
    """A row of Universal Robots' tables."""

    d1: float  # standard DH lengths [m], down to d6
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float
    mass: tuple[float, ...]  # masses of the links [kg]
    centre: tuple[Triple, ...]  # centres of mass, in DH frames [m]
    torque: Triple  # largest torques of shoulder pan and lift, elbow, and each wrist joint [Nm]
    speed: Triple  # largest speeds of the same [deg/s]
    payload: float  # rated load [kg]

    def arm(self) -> SerialArm:
        """Return the nominal arm without a ball."""
        return _arm_of_lengths(self.a2, self.a3, self.d1, self.d4, self.d5, self.d6)


def _arm_of_lengths(a2: float, a3: float, d1: float, d4: float, d5: float, d6: float) -> SerialArm:
    """Return an arm of Universal Robots' build with given DH lengths [m], without a ball."""
    a = (0.0, a2, a3, 0.0, 0.0, 0.0)
    d = (d1, 0.0, 0.0, d4, d5, d6)
    return arm_from_dh(a, d, ur5.DH_ALPHA, ur5.JOINT_NAMES)


UNIVERSAL_ROBOTS = {
    title: UniversalRobot(**row) for title, row in ur5.ARMS["universal_robots"].items()
}


@cache
def universal_robot(title: str) -> Robot:
    """Return an arm of Universal Robots by its title, such as "UR10e"."""
    row = UNIVERSAL_ROBOTS[title]
    limits = JointLimits(
        np.full(6, -2 * pi),
        np.full(6, 2 * pi),
        np.radians(np.repeat(row.speed, ALIKE)),
    )
    if title == "UR5":
        links = Links(**ur5.LINKS, payload=row.payload)
        workspace = Workspace(**ur5.WORKSPACE)
        return Robot("ur5", title, UR_SOURCE, ur5.ur5_arm(), limits, links, workspace)
    arm = with_ball(row.arm())
    scale = length_scale(arm)
    radius = scale * np.array(ur5.LINKS["radius"])
    mass = np.array(row.mass)
    links = Links(
        mass,
        np.array(row.centre),
        cylinder_inertia(mass, radius, arm),
        np.repeat(row.torque, ALIKE),
        radius,
        scale * np.array(ur5.LINKS["aside"]),
        row.payload,
    )
    workspace = find_workspace(arm, limits, links)
    return Robot(title.lower(), title, UR_SOURCE, arm, limits, links, workspace)


@cache
def panda() -> Robot:
    """Return Franka's Panda, the arm with seven joints."""
    facts = ur5.ARMS["panda"]
    arm = with_ball(
        arm_from_dh(facts["a"], facts["d"], facts["alpha"], numbered_joints(7), modified=True)
    )
    limits = JointLimits(facts["lower"], facts["upper"], facts["speed"])
    tensors = [
        [(xx, xy, xz), (xy, yy, yz), (xz, yz, zz)] for xx, xy, xz, yy, yz, zz in facts["inertia"]
    ]
    centre, inertia = at_far_end(arm, np.array(facts["centre"]), np.array(tensors))
    links = Links(
        facts["mass"],
        centre,
        inertia,
        facts["torque"],
        facts["radius"],
        np.zeros(7),
        payload=3.0,
    )
    workspace = find_workspace(arm, limits, links)
    return Robot("panda", "Panda", PANDA_SOURCE, arm, limits, links, workspace)


# Largest deviation of a calibrated arm from the data sheet; real ones differ by a millimetre or two.
MAX_DEVIATION = 0.02  # [m]


def measured_arm(robot: Robot, file: str | None) -> SerialArm:
    """Return the arm of a calibration file, with the ball of `robot`.

    Args:
        robot: the robot whose calibration it must be.
        file: its path; None for the one that came with the robot, or that of one real UR5 which the package brings.

    Raises:
        ValueError: a robot that has no such file, or a file that is missing, malformed or that of another robot.
    """
    if file is None and robot.measured is not None:
        return robot.measured
    if robot.title not in UNIVERSAL_ROBOTS:
        raise ValueError(
            f"mismatch 'factory' needs a calibration file of Universal Robots, which a {robot.title} does not "
            "have; use the axes links and joint_offsets"
        )
    if file is None and robot.title != "UR5":
        other = f"the calibration of one real UR5, and the robot is a {robot.title}"
        raise ValueError(
            f"mismatch 'factory' without a file is {other}; use factory=FILE with its own"
        )
    path = None if file is None else user_path(file)
    arm = read_calibration(path, robot.arm.tool)
    title, deviation = known_title(arm, file)
    if title != robot.title and deviation_from(arm, robot.title) > MAX_DEVIATION:
        other = f"that of a {title} (lengths within {1e3 * deviation:.1f} mm), and the robot is a {robot.title}"
        raise ValueError(
            f"calibration file {file} is {other}; use the robot {title.lower()}, or {file} itself as the robot"
        )
    return arm


def read_calibration(path: Path | None, tool: npt.ArrayLike) -> SerialArm:
    """Return the arm that a Universal Robots factory-calibration file describes.

    Args:
        path: YAML file as the `ur_calibration` tool writes it: six blocks of x, y, z [m], roll, pitch, yaw [rad]; None
            for the file of the package.
        tool: (3,), m, ball centre in the flange frame.

    Returns:
        The arm with gear ratios of 1 and no joint offsets.

    Raises:
        ValueError: the file is missing, is not such a file, or a number in it is not finite.
    """
    import yaml  # noqa: PLC0415 - lists of names start without it

    if path is None:
        path = ur5.CALIBRATION
    keys = ("x", "y", "z", "roll", "pitch", "yaw")
    wanted = f"the blocks {', '.join(CALIBRATION_BLOCKS)}, each with {', '.join(keys)}"
    text = read_text("calibration file", path)
    try:
        blocks = yaml.load(text, yaml_loader())["kinematics"]
        numbers = [[float(blocks[block][key]) for key in keys] for block in CALIBRATION_BLOCKS]
        table = np.array(numbers)
    except yaml.YAMLError as error:
        raise ValueError(f"calibration file {path} is not valid YAML: {one_line(error)}") from error
    except KeyError as error:
        raise ValueError(
            f"calibration file {path} lacks {error}; wanted 'kinematics' with {wanted}"
        ) from error
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        raise ValueError(
            f"calibration file {path} holds something that is not a number where one is wanted: 'kinematics' has "
            f"{wanted}"
        ) from error
    if not np.isfinite(table).all():
        raise ValueError(f"calibration file {path} holds a number that is not finite")
    # The flange is where the last joint is.
    rows = np.vstack([table, np.zeros(6)])
    return plain_arm(ur5.JOINT_NAMES, rows[:, :3], rows[:, 3:], tool)


def nearest_title(arm: SerialArm) -> tuple[str, float]:
    """Return the title of the arm of Universal Robots that is nearest to a calibrated one, and its deviation [m]."""
    deviations = ((title, deviation_from(arm, title)) for title in UNIVERSAL_ROBOTS)
    return min(deviations, key=itemgetter(1))


def known_title(arm: SerialArm, file: object) -> tuple[str, float]:
    """Return title and deviation as `nearest_title`, for a calibration `file` of an arm in the catalogue.

    Raises:
        ValueError: the arm fits no data sheet; it names the lengths of an arm of the same build.
    """
    title, deviation = nearest_title(arm)
    if deviation <= MAX_DEVIATION:
        return title, deviation
    found = f"calibration file {file} fits no arm of Universal Robots"
    lengths, apart = nearest_lengths(arm)
    if apart <= MAX_DEVIATION:
        named = zip(LENGTHS, lengths.tolist(), strict=True)
        sizes = ", ".join(f"{name} = {length:.4f}" for name, length in named)
        found = (
            f"calibration file {file} looks like an arm of Universal Robots that is not in the catalogue: bring "
            f"its URDF, or a DH table with {sizes} m"
        )
    raise ValueError(
        f"{found}; the {title} comes nearest, and its flange is {1e3 * deviation:.0f} mm away"
    )


def nearest_lengths(arm: SerialArm) -> tuple[FloatArray, float]:
    """Return the lengths of the data sheet that an arm fits best, (6,) m, and the deviation of its flange [m].

    The place of the flange is linear in the lengths: p(q) = Σ L_i p_i(q), p_i being that of an arm of length L_i = 1.
    """
    unit_places = []
    for unit_lengths in np.eye(len(LENGTHS)).tolist():
        unit_arm = _arm_of_lengths(*unit_lengths)
        unit_places.append(_flange_positions(unit_arm).ravel())
    matrix = np.transpose(unit_places)
    own_places = _flange_positions(arm).ravel()
    lengths = np.linalg.lstsq(matrix, own_places, rcond=None)[0]
    deviation = float(np.abs(matrix @ lengths - own_places).max())
    return np.asarray(lengths, dtype=np.float64), deviation


def _flange_positions(arm: SerialArm) -> FloatArray:
    """Return the positions of the flange in a few postures, (k, 3) m."""
    postures = np.random.default_rng(0).uniform(-np.pi, np.pi, (32, arm.n))
    return arm.frames(postures)[:, -1, :3, 3]


def deviation_from(arm: SerialArm, title: str) -> float:
    """Return the largest deviation of a calibrated arm's flange from that of a data sheet [m].

    The parallel axes of shoulder lift, elbow and wrist 1 leave the split of d2, d3 and d4 open, so that calibrations
    differ in it by metres and mean the same arm, so arms are compared by the position of the flange in a few postures.
    """
    sheet = UNIVERSAL_ROBOTS[title].arm()
    deviations = _flange_positions(arm) - _flange_positions(sheet)
    return float(np.abs(deviations).max())
