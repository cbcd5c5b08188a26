"""Arm and eye-to-hand camera together: the feature is the ball centre in the camera frame (eqs. 1, 8, 27 of the paper).

y = R_BCᵀ (p_B(q) − p_BC),          ẏ = J q̇,          J = ∂y/∂q = R_BCᵀ ∂p_B/∂q
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servobench.plant.checks import FloatArray
from servobench.plant.robot.arm import SerialArm
from servobench.plant.signals import PlantSpec

FEATURE_NAMES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class HandEyeModel:
    """A serial arm seen by a fixed camera.

    Attributes:
        arm: the arm with the ball on its flange.
        X_BC: (4, 4), camera in the base frame; z along the optical axis, x right and y down in the image.
    """

    arm: SerialArm
    X_BC: FloatArray

    def __post_init__(self) -> None:
        """Check that the camera pose is a rigid transform and freeze it."""
        pose = np.array(self.X_BC, dtype=np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"X_BC must be a finite (4, 4) matrix, got shape {pose.shape}")
        R = pose[:3, :3]
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-9) or np.linalg.det(R) < 0.0:
            raise ValueError("X_BC must hold a rotation matrix")
        pose.flags.writeable = False
        object.__setattr__(self, "X_BC", pose)

    def feature(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return the ball centre in the camera frame, (..., 3) m, for joint positions (..., n) in rad."""
        return self.to_camera(self.arm.ball_position(joint_position))

    def jacobian(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return ∂feature/∂(joint position), (..., 3, n) m/rad, for joint positions (..., n) in rad."""
        return np.asarray(self.X_BC[:3, :3].T @ self.arm.ball_jacobian(joint_position))

    def feature_and_jacobian(self, joint_position: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `feature` and `jacobian`, both read-only, at the cost of one forward kinematics."""
        p_B, J_B = self.arm.ball_and_jacobian(joint_position)
        y, J = self.to_camera(p_B), np.asarray(self.X_BC[:3, :3].T @ J_B)
        y.setflags(write=False)
        J.setflags(write=False)
        return y, J

    def to_camera(self, p_B: npt.ArrayLike) -> FloatArray:
        """Return points of the base frame in the camera frame, (..., 3) m."""
        return np.asarray((np.asarray(p_B, dtype=np.float64) - self.X_BC[:3, 3]) @ self.X_BC[:3, :3])

    def to_base(self, p_C: npt.ArrayLike) -> FloatArray:
        """Return points of the camera frame in the base frame, (..., 3) m."""
        return np.asarray(np.asarray(p_C, dtype=np.float64) @ self.X_BC[:3, :3].T + self.X_BC[:3, 3])


@dataclass(frozen=True, eq=False)
class TrueJacobian:
    """The Jacobian of a model as a function of the joint positions, which keeps its lanes."""

    model: HandEyeModel

    def __call__(self, joint_position: FloatArray) -> FloatArray:
        """Return J, (..., m, n), at (..., n) [rad]."""
        return self.model.jacobian(joint_position)


def hand_eye_spec(model: HandEyeModel, period: float, max_joint_speed: float, joint_range: float) -> PlantSpec:
    """Return the spec of a plant built on `model`.

    Args:
        model: arm and camera.
        period: control period, s.
        max_joint_speed: rad/s, the same for all joints.
        joint_range: rad, each way, the same for all joints.

    Raises:
        ValueError: a period, speed or range that is not positive.
    """
    speed, reach = np.full(model.arm.n, max_joint_speed), np.full(model.arm.n, joint_range)
    return PlantSpec.of_joints(model.arm.joint_names, FEATURE_NAMES, speed, -reach, reach, period)
