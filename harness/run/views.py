"""References under sensing set-ups whose features are no places: true, noise-free images of where the target should be.

A place of the target is given as its points in the frame M that the cameras are mounted on. A taught target is where
the arm was when it was recorded. A curve in space moves the target as the ball of `position` would move in the first
camera's frame C, with the orientation that the target has at home, and nearer by as much as the camera is nearer:

    p_j(t) = X_MC (ρ y(t)) + p_j(home) − p̄(home)       p̄ mean of the points, ρ ratio of the distances, y(t) the curve
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from servobench.harness.run.references import Reference
from servobench.plant.cameras.model import EyeModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.robot import Robot


class View(Reference):
    """A desired place of the target over time, and its image."""

    model: EyeModel
    """The true arm and its cameras."""

    @abstractmethod
    def points(self, time: npt.ArrayLike) -> FloatArray:
        """Return the target in the frame M, (..., p, 3) m, at `time` (...), s."""

    def at(self, time: npt.ArrayLike) -> FloatArray:
        """Return its image, (..., m)."""
        return self.model.seen(self.points(time))


@final
@dataclass(frozen=True, eq=False)
class TaughtView(View):
    """The target where it is with the arm at given joint positions."""

    model: EyeModel
    joint_position: FloatArray  # (n,) [rad]

    def points(self, time: npt.ArrayLike) -> FloatArray:
        """Return the same place at all times."""
        points = self.model.points(self.joint_position)
        return np.broadcast_to(points, (*np.shape(time), *points.shape)).copy()


@final
@dataclass(frozen=True, eq=False)
class FollowedCurve(View):
    """The target on a curve in space, as above."""

    model: EyeModel
    curve: Reference  # of a ball in the frame of a fixed camera, (3,) [m]
    robot: Robot  # whose home gives the orientation, and whose workspace the curve is in

    def points(self, time: npt.ArrayLike) -> FloatArray:
        """Return the place at each time."""
        home = self.model.points(self.robot.workspace.home)
        ratio, pose = self.model.distance / self.robot.workspace.camera_distance, self.model.camera
        place = np.matvec(pose[:3, :3], ratio * self.curve.at(time)) + pose[:3, 3]
        return np.asarray(place[..., None, :] + (home - home.mean(axis=-2)))


def in_space(curve: Reference, model: object, robot: Robot | None) -> Reference:
    """Return what the features should be for a ball on a curve: the curve itself where they are places."""
    return FollowedCurve(model, curve, robot) if isinstance(model, EyeModel) and robot is not None else curve
