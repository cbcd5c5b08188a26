"""The four canonical tasks of Gans, Hutchinson and Corke for a target with a pose.

"Performance Tests for Visual Servo Control Systems, with Application to Partitioned Approaches to Visual Servo
Control", International Journal of Robotics Research 22 (2003). The arm's home is the goal, and its image is the
reference. At the start the target stands differently before the first camera:

    X_CT(start) = D X_CT(home)

| task | D |
|---|---|
| `axis_turn` | a turn about the optical axis |
| `retreat` | nearer along the optical axis, so that the camera has to retreat |
| `camera_turn` | a turn about the camera's y axis through its centre |
| `plane_turn` | a turn about an axis in the plane of the features, through their middle |

The start is found on the nominal arm. Where an arm cannot reach it with the target in view, D is made smaller.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import Gt, Le
from scipy.spatial.transform import Rotation

from servobench.plant.cameras.model import EyeModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.settings import Positive, settings
from servobench.plant.robot.inverse import reach_pose
from servobench.plant.robot.robot import Robot

REACHED: Final = 1e-6  # of the error that `reach_pose` returns
SHARES: Final = (1.0, 0.8, 0.6, 0.4, 0.2)  # of D that are tried
STEPS: Final = 8  # in which the arm is led from home to the start
IN_VIEW: Final = 0.9  # of the image's half sides in which the target is seen at the start


@settings
class PoseTask:
    """A move of a target with a pose, or of cameras before one, from a displaced start to home."""

    displacement: Literal["axis_turn", "retreat", "camera_turn", "plane_turn"] = "axis_turn"
    """which of the four canonical ones"""
    angle: Annotated[float, Gt(0.0), Le(180.0)] = 45.0
    """[deg] of a turn"""
    nearer: Annotated[float, Gt(0.0), Le(0.8)] = 0.25
    """[1] share of the distance by which the start is nearer, of a retreat"""
    duration: Positive = 10.0
    """[s] length of the run"""


def displaced(config: PoseTask, middle: FloatArray) -> FloatArray:
    """Return D, (4, 4), for a target whose middle is at (3,) m in the camera frame at home; see the module."""
    D, angle = np.eye(4), np.radians(config.angle)
    match config.displacement:
        case "axis_turn":
            D[:3, :3] = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
        case "retreat":
            D[2, 3] = -config.nearer * middle[2]
        case "camera_turn":
            D[:3, :3] = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
        case "plane_turn":
            D[:3, :3] = Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix()
            D[:3, 3] = middle - D[:3, :3] @ middle
    return D


def pose_start(config: PoseTask, robot: Robot, nominal: EyeModel) -> FloatArray:
    """Return the start, (n,) rad, on the nominal arm with its cameras as planned.

    Raises:
        ValueError: no share of the displacement can be reached with the target in view.
    """
    camera, home = nominal.camera, robot.workspace.home
    inverse = np.linalg.inv(camera)
    middle = inverse[:3, :3] @ nominal.points(home).mean(axis=0) + inverse[:3, 3]
    for share in SHARES:
        start = _led(config, share, robot, nominal, middle)
        if start is not None and nominal.in_view(nominal.points(start), IN_VIEW).all():
            return start
    raise ValueError(f"{robot.title} cannot reach the start of {config.displacement} with the target in view")


def _led(config: PoseTask, share: float, robot: Robot, nominal: EyeModel, middle: FloatArray) -> FloatArray | None:
    """Return the joint positions at a share of the displacement, led there from home in steps; None if out of reach."""
    arm, limits, q, camera = robot.arm, robot.limits, robot.workspace.home, nominal.camera
    at_home = arm.frames(q)[-1]
    for step in np.linspace(0.0, share, STEPS + 1)[1:].tolist():
        D = displaced(replace(config, angle=step * config.angle, nearer=step * config.nearer), middle)
        moved = camera @ D @ np.linalg.inv(camera)  # of the target in the frame that the camera is mounted on
        pose = moved @ at_home if nominal.mount == "fixed" else at_home @ np.linalg.inv(moved)
        q, error = reach_pose(arm, pose, q, limits.lower, limits.upper)
        if error > REACHED:
            return None
    return q
