"""An arm and its cameras, and the plainest of them: a ball on the flange under one fixed RGB-D camera (eye to hand).

The features y are a function h of the joint positions q, with the Jacobian J = ∂h/∂q. For the ball under the fixed
camera the feature is the ball's centre in the camera frame (eqs. 1, 8 and 27 of the paper):

    y = R_BCᵀ (p_B(q) − p_BC),          ẏ = J q̇,          J = ∂y/∂q = R_BCᵀ ∂p_B/∂q

The robots of many runs side by side are one model, whose arrays have leading axes (`plant.contract.lanes.stack`).
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray, Shape, as_array
from servobench.plant.contract.lanes import matrix
from servobench.plant.contract.settings import JointSpeed, Positive, Usual, settings
from servobench.plant.contract.signals import BoolArray, Channel, PlantSpec
from servobench.plant.robot.arm import (
    JointLimits,
    SerialArm,
    from_frame,
    into_frame,
    narrow_limits,
)

# The ball centre, camera frame
FEATURE = Channel(("x", "y", "z"), "m", 1.0, np.full(3, -np.inf), np.full(3, np.inf))
SERIES_ANGLE = 1e-3  # [rad] below it, sin(α/2)/α is a series
# Largest deviation of the entries of R Rᵀ from those of the identity
ROTATION_TOLERANCE = 1e-9  # [1]
# Shares of the way to a posture at which features are sought
WAY_FROM_HOME = np.linspace(1.0, 0.0, 21)


Mount: TypeAlias = Literal["fixed", "hand"]
"""Where cameras are mounted."""


class RobotModel(ABC):
    """An arm and its cameras, y = h(q) and J = ∂h/∂q; pure, over leading axes."""

    arm: SerialArm
    """The arm."""
    mount: Mount
    """Whether the cameras are beside the arm and the target on it, or the reverse."""

    @property
    def lead(self) -> Shape:
        """Sizes of the leading axes; () for a single robot."""
        return self.arm.tool.shape[:-1]

    @property
    @abstractmethod
    def channel(self) -> Channel:
        """Names, unit and natural size of the features."""

    @property
    def noise_unit(self) -> float:
        """A metre of noise in the unit of the features."""
        return 1.0

    @property
    @abstractmethod
    def camera(self) -> FloatArray:
        """The pose of the first camera, (..., 4, 4), in the frame of its mount, the base or the flange."""

    @abstractmethod
    def with_camera(self, pose: FloatArray) -> Self:
        """Return this model with its first camera at another pose, (..., 4, 4)."""

    @abstractmethod
    def with_arm(self, arm: SerialArm) -> Self:
        """Return this model with another arm, and the target on its flange where that arm's tool is."""

    @property
    @abstractmethod
    def poses(self) -> FloatArray:
        """The poses of all cameras, (..., c, 4, 4), in the frame of their mount."""

    @property
    @abstractmethod
    def marks(self) -> FloatArray:
        """The points of the target, (..., p, 3) m, in the flange frame; with cameras on the hand in the base frame."""

    @abstractmethod
    def measure(self, points: FloatArray) -> FloatArray:
        """Return the features, (..., m), of the target's points in the frame of each camera, (..., c, p, 3) m."""

    @abstractmethod
    def change(self, points: FloatArray, motions: FloatArray) -> FloatArray:
        """Return how the features change, (..., m, k), with k motions of these points, (..., c, p, 3, k) m."""

    def points(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return the target in the frame that the cameras are mounted on, (..., p, 3) m."""
        flange = self.arm.frames(joint_position)[..., -1, :, :]
        return self.mounted(flange, self.in_base(flange))

    def in_base(self, flange: FloatArray) -> FloatArray:
        """Return the target in the base frame, (..., p, 3) m, for poses of the flange, (..., 4, 4)."""
        if self.mount == "hand":
            return self.marks
        return from_frame(flange[..., None, :, :], self.marks)

    def mounted(self, flange: FloatArray, points: FloatArray) -> FloatArray:
        """Return points of the base frame, (..., p, 3) m, in the frame that the cameras are mounted on."""
        if self.mount == "fixed":
            return points
        return into_frame(flange[..., None, :, :], points)

    def in_cameras(self, points: FloatArray) -> FloatArray:
        """Return points of the frame of the mount, (..., p, 3), in each camera, (..., c, p, 3) m."""
        return into_frame(self.poses[..., None, :, :], points[..., None, :, :])

    def with_lens(self, deviation: FloatArray) -> Self:
        """Return this model with deviating intrinsics, 1 + focal, centre [px] and distortion, (4,), if it has any."""
        del deviation
        return self

    @abstractmethod
    def pivot(self, centre: npt.ArrayLike) -> FloatArray:
        """Return the point about which the first camera is turned, (..., 3) m, in the frame that it is mounted on.

        Args:
            centre: (3,), middle of the workspace in the base frame [m].
        """

    @abstractmethod
    def observe(
        self, joint_position: npt.ArrayLike
    ) -> tuple[FloatArray, FloatArray, BoolArray | None]:
        """Return `feature`, `jacobian` and `valid`, all read-only, at the cost of one forward kinematics."""

    def feature(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return the true features, (..., m), for joint positions (..., n) in rad."""
        return self.observe(joint_position)[0]

    def jacobian(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return ∂feature/∂(joint position), (..., m, n), for joint positions (..., n) in rad."""
        return self.observe(joint_position)[1]

    def valid(self, joint_position: npt.ArrayLike) -> BoolArray | None:
        """Return which features can be measured, (..., m); None where nothing can hide them."""
        del joint_position
        return None

    def valid_jacobian(self, joint_position: npt.ArrayLike, home: FloatArray) -> FloatArray:
        """Return `jacobian`, or where a feature is not valid that of the last posture on the way there from home.

        Args:
            joint_position: (..., n) [rad].
            home: (n,), a posture at which all features are valid [rad].
        """
        q = np.asarray(joint_position, dtype=np.float64)
        if self.valid(home) is None:
            return self.jacobian(q)
        nearer = q
        reached = np.zeros(q.shape[:-1], dtype=np.bool_)
        for share in WAY_FROM_HOME:
            tried = home + share * (q - home)
            first_valid = ~reached
            valid = self.valid(tried)
            if valid is not None:
                first_valid = valid.all(axis=-1) & ~reached
            nearer = np.where(first_valid[..., None], tried, nearer)
            reached = reached | first_valid
        return self.jacobian(np.where(reached[..., None], nearer, home))

    def turned(self, rotation: FloatArray, centre: npt.ArrayLike) -> Self:
        """Return this model with its first camera turned by a rotation vector, (3,) rad, about its `pivot`."""
        return self.with_camera(turn_about(self.camera, rotation, self.pivot(centre)))


def rotation_matrix(vector: npt.ArrayLike) -> FloatArray:
    """Return the matrices, (..., 3, 3), of rotation vectors v, (..., 3) rad, by unit quaternions.

    (x, y, z) = v sin(α/2)/α, w = cos(α/2), α = |v|; the quotient is a series near 0. It has the bits of scipy's
    `Rotation`, which takes a quarter of a second to load.
    """
    v = np.asarray(vector, dtype=np.float64)
    v1 = v[..., :1]
    v2 = v[..., 1:2]
    v3 = v[..., 2:]
    angle = np.sqrt((v1 * v1 + v2 * v2) + v3 * v3)
    near = angle <= SERIES_ANGLE
    # scipy takes the square of the rounded angle.
    square = angle**2
    series = 0.5 - square / 48 + square**2 / 3840
    # The angle of near ones is raised by 1, which avoids a division by zero and is not used.
    exact = np.sin(angle / 2) / (angle + near)
    quotient = np.where(near, series, exact)
    x, y, z = np.moveaxis(v * quotient, -1, 0)
    w = np.cos(angle / 2)[..., 0]
    xx = x * x
    yy = y * y
    zz = z * z
    ww = w * w
    x_row = [xx - yy - zz + ww, 2 * (x * y - z * w), 2 * (x * z + y * w)]
    y_row = [2 * (x * y + z * w), -xx + yy - zz + ww, 2 * (y * z - x * w)]
    z_row = [2 * (x * z - y * w), 2 * (y * z + x * w), -xx - yy + zz + ww]
    return matrix(x_row, y_row, z_row)


def turn_about(pose: FloatArray, rotation: FloatArray, point: FloatArray) -> FloatArray:
    """Return a pose, (4, 4), turned by a rotation vector of its own frame, (3,) rad, about a `point` (3,) m.

    The point has the same coordinates in the turned frame as before.
    """
    R = pose[:3, :3]
    p = pose[:3, 3]
    own_point = R.T @ (point - p)
    turned = np.eye(4)
    turned[:3, :3] = R @ rotation_matrix(rotation)
    turned[:3, 3] = point - turned[:3, :3] @ own_point
    return turned


@dataclass(frozen=True, eq=False)
class HandEyeModel(RobotModel):
    """A serial arm under a fixed camera, eye to hand."""

    arm: SerialArm  # the arm with the ball on its flange
    X_BC: FloatArray  # (..., 4, 4), camera in the base frame; z along the optical axis, x right and y down in the image
    channel: ClassVar[Channel] = FEATURE  # names, unit and natural size of the ball's coordinates
    mount: Literal["fixed"] = field(default="fixed", init=False)  # the ball is on the arm

    def __post_init__(self) -> None:
        """Check that the camera pose is a rigid transform and freeze it."""
        # One arm may stand for many: its camera may have longer axes than it has itself.
        lead = np.broadcast_shapes(self.lead, np.shape(self.X_BC)[:-2])
        pose = as_array("X_BC", self.X_BC, (*lead, 4, 4))
        R = pose[..., :3, :3]
        product = R @ R.mT
        deviation = np.abs(product - np.eye(3)).max(initial=0.0)
        is_mirrored = np.linalg.det(R) < 0.0
        if deviation > ROTATION_TOLERANCE or is_mirrored.any():
            raise ValueError("X_BC must hold a rotation matrix")
        object.__setattr__(self, "X_BC", pose)

    @property
    def camera(self) -> FloatArray:
        """The pose of the camera in the base frame, X_BC."""
        return self.X_BC

    def with_camera(self, pose: FloatArray) -> Self:
        """Return this model with the camera at another pose, (..., 4, 4)."""
        return replace(self, X_BC=pose)

    @property
    def poses(self) -> FloatArray:
        """The pose of the camera alone, (..., 1, 4, 4)."""
        return self.X_BC[..., None, :, :]

    @property
    def marks(self) -> FloatArray:
        """The ball alone, (..., 1, 3) m."""
        return self.arm.tool[..., None, :]

    def measure(self, points: FloatArray) -> FloatArray:
        """Return the ball in the camera frame, (..., 3) m."""
        return points[..., 0, 0, :]

    def change(self, points: FloatArray, motions: FloatArray) -> FloatArray:
        """Return its motions, (..., 3, k) m."""
        del points
        return motions[..., 0, 0, :, :]

    def with_arm(self, arm: SerialArm) -> Self:
        """Return this model with another arm."""
        return replace(self, arm=arm)

    def pivot(self, centre: npt.ArrayLike) -> FloatArray:
        """Return the middle of the workspace, about which the camera is turned."""
        return np.asarray(centre, dtype=np.float64)

    def observe(self, joint_position: npt.ArrayLike) -> tuple[FloatArray, FloatArray, None]:
        """Return the ball centre in the camera frame, (..., 3) m, and its Jacobian, (..., 3, n) m/rad."""
        p_B, J_B = self.arm.ball_and_jacobian(joint_position)
        R_CB = self.X_BC[..., :3, :3].mT
        y = self.to_camera(p_B)
        J = R_CB @ J_B
        y.setflags(write=False)
        J.setflags(write=False)
        return y, J, None

    def to_camera(self, p_B: npt.ArrayLike) -> FloatArray:
        """Return points of the base frame in the camera frame, (..., 3) m."""
        return into_frame(self.X_BC, np.asarray(p_B, dtype=np.float64))

    def to_base(self, p_C: npt.ArrayLike) -> FloatArray:
        """Return points of the camera frame in the base frame, (..., 3) m."""
        return from_frame(self.X_BC, np.asarray(p_C, dtype=np.float64))


@dataclass(frozen=True, eq=False)
class TrueJacobian:
    """The Jacobian of a model as a function, of which `servobench.plant.contract.lanes.take` can choose lanes."""

    model: RobotModel  # arm and camera

    def __call__(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return ∂feature/∂(joint position), (..., m, n), for joint positions (..., n) in rad."""
        return self.model.jacobian(joint_position)


@settings
class JointsConfig:
    """Settings of every plant that moves an arm itself: how fast and how far."""

    max_joint_speed: JointSpeed = 1.0
    """[rad/s] limit of every joint, besides its maker's (UR5: π)."""
    joint_range: Annotated[Positive, Usual(4 * math.pi)] = 2 * math.pi
    """[rad] largest joint position each way, besides its maker's limits."""


def hand_eye_spec(
    model: RobotModel,
    period: float,
    max_joint_speed: float,
    joint_range: float,
    limits: JointLimits | None = None,
) -> PlantSpec:
    """Return the spec of a plant built on `model`.

    Args:
        model: arm and camera.
        period: control period, s.
        max_joint_speed: rad/s, the same for all joints.
        joint_range: rad, each way, the same for all joints.
        limits: the maker's, which hold as well; None for none.

    Raises:
        ValueError: a period, speed or range that is not positive.
    """
    narrowed = narrow_limits(limits, model.arm.n, max_joint_speed, joint_range)
    command = Channel(model.arm.joint_names, "rad/s", 1.0, -narrowed.speed, narrowed.speed)
    return PlantSpec(model.channel, command, narrowed.lower, narrowed.upper, period)
