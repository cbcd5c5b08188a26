"""The camera model that a controller may know: nominal motions of points, and the interaction matrix.

    J = L(y, z) R G(q)          R the rotation of the true camera, z the depth of a point

G(q) (3, n) is the motion of a point with the joints in the frame of the nominal camera, L (k, 3) the change of the
features of the point with its place in the camera, for one block of a point; all of it in the units of the parts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from servobench.plant.contract.checks import FloatArray

PointKinematics: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
Interaction: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A model of c nominal cameras and p points, of which each has features of its own, m = c p k.

    Attributes:
        cameras: c.
        points: p.
        kinematics: q (..., n) [rad] -> points (..., c, p, 3) [m] in the nominal cameras and motions (..., c, p, 3, n).
        interaction: features (..., m) and depths (..., c, p) [m] -> L (..., c, p, k, 3).
    """

    cameras: int
    points: int
    kinematics: PointKinematics
    interaction: Interaction

    @property
    def rows(self) -> int:
        """3 c p, of the motions of all points."""
        return 3 * self.cameras * self.points

    def motions(self, joint_position: FloatArray) -> FloatArray:
        """Return G of all points, (..., 3 c p, n) m/rad."""
        return _flat(self.kinematics(joint_position)[1])

    def depths_and_motions(self, joint_position: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z of all points, (..., c p) m, and G of all points, (..., 3 c p, n) m/rad."""
        points, motions = self.kinematics(joint_position)
        return np.ascontiguousarray(points[..., 2]).reshape(*points.shape[:-3], -1), _flat(motions)

    def rates(self, feature: FloatArray, depth: FloatArray) -> FloatArray:
        """Return L by cameras, (..., c, p, k, 3), for features (..., m) and depths (..., c p) [m]."""
        return self.interaction(feature, depth.reshape(*depth.shape[:-1], self.cameras, self.points))

    def in_unit(self, scale: float) -> CameraModel:
        """Return the camera model with features divided by `scale`."""

        def natural(feature: FloatArray, depth: FloatArray) -> FloatArray:
            return np.asarray(self.interaction(scale * feature, depth) / scale)

        return replace(self, interaction=natural)


def feature_jacobian(rates: FloatArray, turn: FloatArray, motions: FloatArray) -> FloatArray:
    """Return L R G, (..., m, n), for L (..., c, p, k, 3), R (..., c, 3, 3) and G (..., 3 c p, n)."""
    c, p = rates.shape[-4:-2]
    blocks = motions.reshape(*motions.shape[:-2], c, p, 3, motions.shape[-1])
    return _flat((rates @ turn[..., None, :, :]) @ blocks)


def turned_interaction(rates: FloatArray, turn: FloatArray) -> FloatArray:
    """Return L R as one matrix, (..., m, 3 c p), for L (..., c, p, k, 3) and R (..., c, 3, 3)."""
    return block_diagonal(rates @ turn[..., None, :, :])


def block_diagonal(blocks: FloatArray) -> FloatArray:
    """Return blocks (..., c, p, i, j) of single points on the diagonal of one matrix, (..., c p i, c p j)."""
    *lead, c, p, i, j = blocks.shape
    whole, points = np.zeros((c * p, c * p, *lead, i, j)), np.arange(c * p)
    whole[points, points] = np.moveaxis(blocks.reshape(*lead, c * p, i, j), -3, 0)
    joined = np.moveaxis(whole, (0, 1), (-4, -2))
    return joined.reshape(*lead, c * p * i, c * p * j)


def _flat(blocks: FloatArray) -> FloatArray:
    """Return blocks (..., c, p, i, n) as one matrix, (..., c p i, n)."""
    return np.ascontiguousarray(blocks).reshape(*blocks.shape[:-4], -1, blocks.shape[-1])
