"""The symbolic twin of `plant.robot.arm` and `plant.robot.hand_eye` in CasADi, written from the same table.

θ = g ⊙ q + o,     p_B = p_flange + R_flange t,     y = R_BCᵀ (p_B − p_BC),     ∂y/∂q_i = g_i R_BCᵀ (z_i × (p_B − p_i))

The core takes symbols or numbers for everything, so that one expression serves both a model with fixed
numbers and a function (or generated C code) whose geometry is a parameter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Self, TypeAlias

import casadi

from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.hand_eye import HandEyeModel

SX: TypeAlias = Any  # casadi.SX; its own annotations do not cover element access


class ArmGeometry(NamedTuple):
    """Everything that describes an arm without its ball, as CasADi symbols or constants.

    Attributes:
        translation: (n+1, 3), m; see `servobench.plant.robot.arm.SerialArm`.
        rpy: (n+1, 3), rad.
        joint_offset: o, (n,), rad.
        gear_ratio: g, (n,).
    """

    translation: SX
    rpy: SX
    joint_offset: SX
    gear_ratio: SX

    @classmethod
    def of(cls, arm: SerialArm) -> Self:
        """Return the geometry of `arm` as constants."""
        return cls(*map(casadi.SX, (arm.translation, arm.rpy, arm.joint_offset, arm.gear_ratio)))


@dataclass(frozen=True, eq=False)
class HandEyeGeometry:
    """Everything that describes arm and camera, as CasADi symbols or constants.

    Attributes:
        translation: (n+1, 3), m; see `servobench.plant.robot.arm.SerialArm`.
        rpy: (n+1, 3), rad.
        joint_offset: o, (n,), rad.
        gear_ratio: g, (n,).
        tool: t, (3,), m.
        R_BC: (3, 3), camera in the base frame.
        p_BC: (3,), m, camera in the base frame.
    """

    translation: SX
    rpy: SX
    joint_offset: SX
    gear_ratio: SX
    tool: SX
    R_BC: SX
    p_BC: SX

    @property
    def arm(self) -> ArmGeometry:
        """What describes the arm."""
        return ArmGeometry(self.translation, self.rpy, self.joint_offset, self.gear_ratio)


def geometry_of(model: HandEyeModel) -> HandEyeGeometry:
    """Return the geometry of `model` as constants."""
    arm = model.arm
    numbers = (arm.translation, arm.rpy, arm.joint_offset, arm.gear_ratio, arm.tool)
    return HandEyeGeometry(*(casadi.SX(number) for number in (*numbers, model.X_BC[:3, :3], model.X_BC[:3, 3])))


def feature_and_jacobian(joint_position: SX, geometry: HandEyeGeometry) -> tuple[SX, SX]:
    """Return the ball centre in the camera frame and its Jacobian as expressions.

    Args:
        joint_position: q, (n, 1), rad, as reported.
        geometry: symbols or constants for n joints.

    Returns:
        y, (3, 1), m, and ∂y/∂q, (3, n), m/rad.
    """
    axes, origins, rotation, position = arm_frames(joint_position, geometry.arm)
    ball = position + rotation @ geometry.tool
    columns = [
        geometry.gear_ratio[i] * casadi.cross(axis, ball - origin)
        for i, (axis, origin) in enumerate(zip(axes, origins, strict=True))
    ]
    return geometry.R_BC.T @ (ball - geometry.p_BC), geometry.R_BC.T @ casadi.horzcat(*columns)


def arm_frames(joint_position: SX, geometry: ArmGeometry) -> tuple[list[SX], list[SX], SX, SX]:
    """Return the axes z_i and origins p_i of the joints, and rotation and position of the flange, as expressions.

    Args:
        joint_position: q, (n, 1), rad, as reported.
        geometry: symbols or constants for n joints.
    """
    rotation, position = _rotation(geometry.rpy[0, :]), geometry.translation[0, :].T
    axes, origins = [], []
    for i in range(joint_position.numel()):
        theta = geometry.gear_ratio[i] * joint_position[i] + geometry.joint_offset[i]
        axes.append(rotation[:, 2])
        origins.append(position)
        rotation = rotation @ _turn_z(theta)
        position = position + rotation @ geometry.translation[i + 1, :].T
        rotation = rotation @ _rotation(geometry.rpy[i + 1, :])
    return axes, origins, rotation, position


def symbolic_feature(model: HandEyeModel) -> casadi.Function:
    """Return q -> feature, (n,) rad -> (3,) m, with the numbers of `model` bound."""
    q = casadi.SX.sym("joint_position", model.arm.n)
    feature = feature_and_jacobian(q, geometry_of(model))[0]
    return casadi.Function("feature", [q], [feature], ["joint_position"], ["feature"])


def _rotation(rpy: SX) -> SX:
    """Rz(yaw) Ry(pitch) Rx(roll), as `servobench.plant.robot.arm.rotation_from_rpy`."""
    c: SX = casadi.cos(rpy)
    s: SX = casadi.sin(rpy)
    roll = casadi.vertcat(casadi.horzcat(1, 0, 0), casadi.horzcat(0, c[0], -s[0]), casadi.horzcat(0, s[0], c[0]))
    pitch = casadi.vertcat(casadi.horzcat(c[1], 0, s[1]), casadi.horzcat(0, 1, 0), casadi.horzcat(-s[1], 0, c[1]))
    return _turn_z(rpy[2]) @ pitch @ roll


def _turn_z(angle: SX) -> SX:
    c, s = casadi.cos(angle), casadi.sin(angle)
    return casadi.vertcat(casadi.horzcat(c, -s, 0), casadi.horzcat(s, c, 0), casadi.horzcat(0, 0, 1))
