"""A robot as its maker describes it: the nominal arm, its joint limits, its links and its workspace.

A controller may know all of this. The true robot of a run differs from it by a mismatch, and for a robot that is given
by a factory calibration also by that calibration.

Unpublished masses, inertia and torque limits are estimated. An estimated link is a solid cylinder of its
tube's radius, as long as the distance of its joints plus a joint housing of one diameter, with the mean density of the
UR5's links. A joint's torque limit is 1.5 times the torque that holds the stretched arm with its rated load against
gravity; a UR5 has 1.2 times this torque in its shoulder and more in its wrists.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm
from servobench.plant.robot.arm import JointLimits, Links, SerialArm, rotation_from_rpy
from servobench.plant.robot.camera import CAMERA, PinholeCamera
from servobench.plant.robot.camera_file import OwnCamera
from servobench.plant.robot.hand_eye import HandEyeModel
from servobench.plant.robot.twin import Twin
from servobench.plant.robot.workspace import Clearance, Workspace


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot by its maker's description."""

    name: str  # in tables, names of files and of FMUs
    title: str  # in texts, such as "UR5"
    source: str  # where the numbers come from
    arm: SerialArm  # the nominal arm with the ball on its flange
    limits: JointLimits  # those of its joints, by its maker
    links: Links  # masses and shapes
    workspace: Workspace  # where it works, and where the camera hangs
    # The arm as its factory measured it; None where only the nominal one is known
    measured: SerialArm | None = None
    note: str = ""  # a line for the user about assumptions; empty for none
    flaw: str = ""  # why the physics engines cannot move it; empty for a robot that they can
    # Whether controllers may know it; of another one they know joints and features alone.
    known: bool = True
    camera: OwnCamera | None = None  # the user's, in place of the bench's; None for none
    # The true robot as identified from a log, in place of mismatches; None for none
    twin: Twin | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.arm.n

    @cached_property
    def nominal(self) -> HandEyeModel:
        """The nominal arm under the camera as planned, which controllers may know."""
        return HandEyeModel(self.arm, self.camera_pose)

    @property
    def camera_pose(self) -> FloatArray:
        """The first fixed camera as planned, X_BC (4, 4)."""
        if self.camera is not None and self.camera.keys.pose.frame == "base":
            return self.camera.keys.pose.matrix
        return self.workspace.camera_pose()

    @property
    def pinhole(self) -> PinholeCamera:
        """Size and focal length of the image as planned."""
        if self.camera is None:
            return CAMERA
        return self.camera.pinhole

    def equipped(self, camera: OwnCamera) -> Self:
        """Return the robot with a camera and a target of the user."""
        target = camera.keys.target
        arm = self.arm
        measured = self.measured
        if target.frame == "flange":
            arm = replace(arm, tool=np.array(target.position))
            if measured is not None:
                measured = replace(measured, tool=arm.tool)
        robot = replace(self, arm=arm, measured=measured, camera=camera)
        clear = self.workspace.clear
        if isinstance(clear, Clearance):
            clear = replace(clear, arm=arm, X_BC=robot.camera_pose, camera=camera.pinhole)
        workspace = replace(self.workspace, ball=target.radius, clear=clear)
        return replace(robot, workspace=workspace)


DENSITY = 1100.0  # [kg/m³] mean density of the UR5's links as cylinders
TUBE_SHARE = 0.055  # radius of the first tube over the arm's length from the shoulder on
TAPER = 0.65  # radius of the last tube over that of the first
TORQUE_FACTOR = 1.5  # torque limit over the torque that holds the stretched arm
MIN_TORQUE = 5.0  # [Nm] least torque limit that is estimated
GRAVITY = 9.81  # [m/s²]
# Centres of mass (n, 3) [m] and inertia (n, 3, 3) [kg m²] of links
Bodies = tuple[FloatArray, FloatArray]
PAYLOAD_SHARE = 0.27  # rated load over the arm's own mass, that of a UR5


def cylinder_inertia(mass: FloatArray, radius: FloatArray, arm: SerialArm) -> FloatArray:
    """Return the inertia of links as solid cylinders, across and along them, (n, 2) kg m²."""
    length = norm(arm.translation[1:]) + 2.0 * radius
    across = mass * (3.0 * radius**2 + length**2) / 12.0
    along = mass * radius**2 / 2.0
    return np.stack([across, along], axis=-1)


def at_far_end(arm: SerialArm, centre: FloatArray, inertia: FloatArray) -> Bodies:
    """Return centres of mass (n, 3) m and inertia (n, 3, 3) kg m², given in joint frames, in the frames of `Links`."""
    R = rotation_from_rpy(arm.rpy[1:])
    turned_back = R.mT
    moved_centre = np.vecmat(centre - arm.translation[1:], R)
    return moved_centre, turned_back @ inertia @ R


def estimate_links(
    arm: SerialArm,
    mass: FloatArray | None = None,
    torque: FloatArray | None = None,
    bodies: Bodies | None = None,
) -> Links:
    """Return links with their known values, and estimates in place of the rest.

    Args:
        arm: the nominal arm.
        mass: (n,) kg, if known.
        torque: (n,) Nm, largest of each joint, if known.
        bodies: centres of mass (n, 3) m and inertia (n, 3, 3) kg m², as `at_far_end` returns them, if known.
    """
    n = arm.n
    # [m] from each joint to the next one, or to the flange
    length = norm(arm.translation[1:])
    reach = float(length[1:].sum())
    radius = TUBE_SHARE * reach * np.linspace(1.0, TAPER, n)
    if mass is None:
        mass = DENSITY * np.pi * radius**2 * (length + 2.0 * radius)
    if bodies is None:
        # A cylinder's centre is halfway from the frame at its far end back to its joint.
        R = rotation_from_rpy(arm.rpy[1:])
        centre = -0.5 * np.vecmat(arm.translation[1:], R)
        inertia = cylinder_inertia(mass, radius, arm)
    else:
        centre, inertia = bodies
    payload = PAYLOAD_SHARE * float(mass.sum())
    if torque is None:
        torque = _torque_limits(length, mass, payload)
    return Links(
        mass,
        centre,
        inertia,
        torque,
        radius,
        np.zeros(n),
        payload,
    )


def _torque_limits(length: FloatArray, mass: FloatArray, payload: float) -> FloatArray:
    """Return the torque limits, (n,) Nm, that follow from the weight of the level, stretched arm beyond each joint."""
    ends = np.cumsum(length)
    starts = ends - length
    middles = ends - length / 2.0
    moments = []  # [kg m]
    for i, start in enumerate(starts):
        own = float(mass[i:] @ (middles[i:] - start))
        carried = payload * float(ends[-1] - start)
        moments.append(own + carried)
    holding = GRAVITY * np.array(moments)
    return np.maximum(TORQUE_FACTOR * holding, MIN_TORQUE)
