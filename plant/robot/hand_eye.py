"""Arm and eye-to-hand camera together: the feature is the ball centre in the camera frame (eqs. 1, 8, 27 of the paper).

y = R_BCᵀ (p_B(q) − p_BC),          ẏ = J q̇,          J = ∂y/∂q = R_BCᵀ ∂p_B/∂q

The robots of many runs side by side are one model, whose arrays have leading axes (`servobench.plant.lanes.stack`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servobench.plant.checks import FloatArray, as_array
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.limits import JointLimits, narrowed
from servobench.plant.signals import Channel, PlantSpec

FEATURE_NAMES = ("x", "y", "z")
FEATURE = Channel(FEATURE_NAMES, "m", 1.0, np.full(3, -np.inf), np.full(3, np.inf))  # the ball centre, camera frame
ROTATION_TOLERANCE = 1e-9  # [1] of the entries of R Rᵀ


@dataclass(frozen=True, eq=False)
class HandEyeModel:
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
    def lead(self) -> tuple[int, ...]:
        """Sizes of the leading axes; () for a single robot."""
        return self.arm.tool.shape[:-1]

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
    """The Jacobian of a model as a function, of which `servobench.plant.lanes.take` can choose lanes.

    Attributes:
        model: arm and camera.
    """

    model: HandEyeModel

    def __call__(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return ∂feature/∂(joint position), (..., 3, n) m/rad, for joint positions (..., n) in rad."""
        return self.model.jacobian(joint_position)


def hand_eye_spec(
    model: HandEyeModel, period: float, max_joint_speed: float, joint_range: float, limits: JointLimits | None = None
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
    return PlantSpec.of_joints(model.arm.joint_names, FEATURE_NAMES, both.speed, both.lower, both.upper, period)
