"""The arm and its surroundings from outside, as films and environments show them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.camera import PinholeCamera

EYE: Final = (1.75, -1.35, 1.35)  # [m] base frame of a UR5: from the front right
TARGET: Final = (0.40, 0.0, 0.26)  # [m] what it looks at
CAMERA: Final = PinholeCamera(640, 480, 38.0, near=0.1, far=8.0)


@dataclass(frozen=True, eq=False)
class Overview:
    """A camera that sees the whole arm.

    Attributes:
        camera: its optics.
        X_BC: (4, 4), its pose in the base frame.
    """

    camera: PinholeCamera
    X_BC: FloatArray

    @classmethod
    def of(cls, scale: float, fineness: float = 1.0) -> Self:
        """Return the view of an arm.

        Args:
            scale: of its workspace, over that of a UR5.
            fineness: pixels for one pixel of `CAMERA`, along each side; above 1 edges become smooth once scaled down.
        """
        size = {"width": round(fineness * CAMERA.width), "height": round(fineness * CAMERA.height)}
        return cls(replace(CAMERA, **size), _look_at(scale * np.array(EYE), scale * np.array(TARGET)))

    def pixels(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where points (k, 3) m of the base frame appear, (k, 2) px, and their depths, (k,) m."""
        p_C = (points - self.X_BC[:3, 3]) @ self.X_BC[:3, :3]
        return self.camera.project(p_C), p_C[:, 2]


def _look_at(eye: FloatArray, target: FloatArray) -> FloatArray:
    """Return X_BC, (4, 4), of a camera at `eye` that looks at `target`, both (3,) m, with the horizon level."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
    pose[:3, 3] = eye
    return pose
