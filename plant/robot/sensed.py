"""The contract of an arm and its cameras: what is measured, as a function of the joint positions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Final, Self

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import BoolArray, Channel
from servobench.plant.robot.arm import SerialArm

WAY_FROM_HOME: Final = np.linspace(1.0, 0.0, 21)  # shares of the way to a posture at which features are looked for


class SensedArm(ABC):
    """An arm and its cameras, y = h(q) and J = ∂h/∂q; pure, over leading axes.

    The robots of many runs side by side are one model, whose arrays have leading axes (`plant.contract.lanes.stack`).
    """

    arm: SerialArm
    """The arm."""

    @property
    def lead(self) -> tuple[int, ...]:
        """Sizes of the leading axes; () for a single robot."""
        return self.arm.tool.shape[:-1]

    @property
    @abstractmethod
    def channel(self) -> Channel:
        """Names, unit and natural size of the features."""

    @property
    def noise_unit(self) -> float:
        """What a metre of noise is in the unit of the features."""
        return 1.0

    @property
    @abstractmethod
    def camera(self) -> FloatArray:
        """The pose of the first camera, (..., 4, 4), in the frame of what it is mounted on: the base or the flange."""

    @abstractmethod
    def with_camera(self, pose: FloatArray) -> Self:
        """Return this model with its first camera at another pose, (..., 4, 4)."""

    @abstractmethod
    def pivot(self, centre: npt.ArrayLike) -> FloatArray:
        """Return the point about which the first camera is turned, (..., 3) m, in the frame that it is mounted on.

        Args:
            centre: (3,), middle of the workspace in the base frame [m].
        """

    @abstractmethod
    def feature_and_jacobian(self, joint_position: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `feature` and `jacobian`, both read-only, at the cost of one forward kinematics."""

    def feature(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return the true features, (..., m), for joint positions (..., n) in rad."""
        return self.feature_and_jacobian(joint_position)[0]

    def jacobian(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return ∂feature/∂(joint position), (..., m, n), for joint positions (..., n) in rad."""
        return self.feature_and_jacobian(joint_position)[1]

    def visible(self, joint_position: npt.ArrayLike) -> BoolArray | None:
        """Return which features a camera sees, (..., m); None where nothing can hide them."""
        del joint_position
        return None

    def look(self, joint_position: npt.ArrayLike) -> tuple[FloatArray, FloatArray, BoolArray | None]:
        """Return `feature`, `jacobian` and `visible` at the cost of one forward kinematics."""
        return (*self.feature_and_jacobian(joint_position), self.visible(joint_position))

    def jacobian_in_view(self, joint_position: npt.ArrayLike, home: FloatArray) -> FloatArray:
        """Return `jacobian`, or where a feature is out of view that of the last posture on the way there from home.

        Args:
            joint_position: (..., n) [rad].
            home: (n,), a posture at which all features are in view [rad].
        """
        q = np.asarray(joint_position, dtype=np.float64)
        if self.visible(home) is None:
            return self.jacobian(q)
        nearer, reached = q, np.zeros(q.shape[:-1], dtype=np.bool_)
        for share in WAY_FROM_HOME:
            tried = home + share * (q - home)
            seen = self.visible(tried)
            here = ~reached if seen is None else seen.all(axis=-1) & ~reached
            nearer, reached = np.where(here[..., None], tried, nearer), reached | here
        return self.jacobian(np.where(reached[..., None], nearer, home))

    def turned(self, rotation: FloatArray, centre: npt.ArrayLike) -> Self:
        """Return this model with its first camera turned by a rotation vector, (3,) rad, about its `pivot`."""
        return self.with_camera(turn_about(self.camera, rotation, self.pivot(centre)))


def turn_about(pose: FloatArray, rotation: FloatArray, point: FloatArray) -> FloatArray:
    """Return a pose, (4, 4), turned by a rotation vector of its own frame, (3,) rad, about a `point` (3,) m.

    The point has the same coordinates in the turned frame as before.
    """
    own = pose[:3, :3].T @ (point - pose[:3, 3])
    turned = np.eye(4)
    turned[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(rotation).as_matrix()
    turned[:3, 3] = point - turned[:3, :3] @ own
    return turned
