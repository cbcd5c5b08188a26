"""Arm and eye-to-hand camera together: the feature is the ball centre in the camera frame (eqs. 1, 8, 27 of the paper).

y = R_BCᵀ (p_B(q) − p_BC),          ẏ = J q̇,          J = ∂y/∂q = R_BCᵀ ∂p_B/∂q

The robots of many runs side by side are one model, whose arrays have leading axes (`plant.contract.lanes.stack`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray, as_array
from servobench.plant.contract.signals import Channel, PlantSpec
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.limits import JointLimits, narrowed
from servobench.plant.robot.sensed import SensedArm

FEATURE_NAMES = ("x", "y", "z")
FEATURE = Channel(FEATURE_NAMES, "m", 1.0, np.full(3, -np.inf), np.full(3, np.inf))  # the ball centre, camera frame
ROTATION_TOLERANCE = 1e-9  # [1] of the entries of R Rᵀ


@dataclass(frozen=True, eq=False)
class HandEyeModel(SensedArm):
    """A serial arm seen by a fixed camera.

    Attributes:
        arm: the arm with the ball on its flange.
        X_BC: (..., 4, 4), camera in the base frame, with the leading axes of the arm's arrays; z along the optical
            axis, x right and y down in the image.
    """

    arm: SerialArm
    X_BC: FloatArray

    def __post_init__(self) -> None:
        """Check that the camera pose is a rigid transform and freeze it."""
        pose = as_array("X_BC", self.X_BC, (*self.lead, 4, 4))
        R = pose[..., :3, :3]
        deviation = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(initial=0.0)
        if deviation > ROTATION_TOLERANCE or (np.linalg.det(R) < 0.0).any():
            raise ValueError("X_BC must hold a rotation matrix")
        object.__setattr__(self, "X_BC", pose)

    @property
    def channel(self) -> Channel:
        """Names, unit and natural size of the ball's coordinates."""
        return FEATURE

    @property
    def camera(self) -> FloatArray:
        """The pose of the camera in the base frame, X_BC."""
        return self.X_BC

    def with_camera(self, pose: FloatArray) -> Self:
        """Return this model with the camera at another pose, (..., 4, 4)."""
        return replace(self, X_BC=pose)

    def pivot(self, centre: npt.ArrayLike) -> FloatArray:
        """Return the middle of the workspace, about which the camera is turned."""
        return np.asarray(centre, dtype=np.float64)

    def feature(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return the ball centre in the camera frame, (..., 3) m, for joint positions (..., n) in rad."""
        return self.to_camera(self.arm.ball_position(joint_position))

    def jacobian(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return ∂feature/∂(joint position), (..., 3, n) m/rad, for joint positions (..., n) in rad."""
        return self._turned(self.arm.ball_jacobian(joint_position))

    def feature_and_jacobian(self, joint_position: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `feature` and `jacobian`, both read-only, at the cost of one forward kinematics."""
        p_B, J_B = self.arm.ball_and_jacobian(joint_position)
        y, J = self.to_camera(p_B), self._turned(J_B)
        y.setflags(write=False)
        J.setflags(write=False)
        return y, J

    def to_camera(self, p_B: npt.ArrayLike) -> FloatArray:
        """Return points of the base frame in the camera frame, (..., 3) m."""
        return np.asarray(np.vecmat(np.asarray(p_B, dtype=np.float64) - self.X_BC[..., :3, 3], self.X_BC[..., :3, :3]))

    def to_base(self, p_C: npt.ArrayLike) -> FloatArray:
        """Return points of the camera frame in the base frame, (..., 3) m."""
        p = np.asarray(p_C, dtype=np.float64)
        return np.asarray(np.matvec(self.X_BC[..., :3, :3], p) + self.X_BC[..., :3, 3])

    def _turned(self, J_B: FloatArray) -> FloatArray:
        """Return a Jacobian of the base frame, (..., 3, n), in the camera frame."""
        return np.asarray(np.swapaxes(self.X_BC[..., :3, :3], -1, -2) @ J_B)


@dataclass(frozen=True, eq=False)
class TrueJacobian:
    """The Jacobian of a model as a function, of which `servobench.plant.contract.lanes.take` can choose lanes.

    Attributes:
        model: arm and camera.
    """

    model: SensedArm

    def __call__(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return ∂feature/∂(joint position), (..., m, n), for joint positions (..., n) in rad."""
        return self.model.jacobian(joint_position)


def hand_eye_spec(
    model: SensedArm, period: float, max_joint_speed: float, joint_range: float, limits: JointLimits | None = None
) -> PlantSpec:
    """Return the spec of a plant built on `model`.

    Args:
        model: arm and camera.
        period: control period, s.
        max_joint_speed: rad/s, the same for all joints.
        joint_range: rad, each way, the same for all joints.
        limits: of its maker, which hold as well; None for none.

    Raises:
        ValueError: a period, speed or range that is not positive.
    """
    both = narrowed(limits, model.arm.n, max_joint_speed, joint_range)
    spec = PlantSpec.of_joints(model.arm.joint_names, FEATURE_NAMES, both.speed, both.lower, both.upper, period)
    return replace(spec, feature=model.channel)
