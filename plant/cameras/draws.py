"""How the cameras of a run differ from those that are planned, drawn by name and seed as the arm is.

Focal lengths are scaled, principal points shifted and radial distortions set, each drawn uniformly from plus or minus
the magnitude. A camera on the hand is turned about its own centre as well, by an angle drawn below `mount` about an
axis drawn among all. Every further camera of a set-up turns as the first one does (`camera_rotation`), by draws of its
own. Every axis has a random stream of its own; a camera has the same draws in every set-up.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.seeds import named_generator
from servobench.plant.robot.mismatch import MAX_TILT, Mismatch, draw_camera_axis

OPTICAL = ("focal", "centre", "distortion")  # axes of a mismatch that a camera in pixels has
ON_HAND = "mount"  # the axis that a camera on the hand has


@dataclass(frozen=True, eq=False)
class CameraDraws:
    """The values drawn for c cameras.

    Attributes:
        focal: (c,), factors on the focal lengths.
        centre: (c, 2), shifts of the principal points [px].
        distortion: (c,), k of the radial distortion [1].
        turn: (c, 3), rotation vectors [rad] of the cameras after the first one, whose turn is that of the robot.
        mount: (c, 3), rotation vectors [rad] about the cameras' own centres.
    """

    focal: FloatArray
    centre: FloatArray
    distortion: FloatArray
    turn: FloatArray
    mount: FloatArray

    def as_record(self) -> dict[str, object]:
        """Return the values as plain lists, for JSON."""
        return {f"camera_{field.name}": getattr(self, field.name).tolist() for field in fields(self)}


def planned(count: int) -> CameraDraws:
    """Return the draws of `count` cameras that are as planned."""
    zero = np.zeros(count)
    return CameraDraws(np.ones(count), np.zeros((count, 2)), zero, np.zeros((count, 3)), np.zeros((count, 3)))


def draw_cameras(mismatch: Mismatch, count: int, seed: int) -> CameraDraws:
    """Draw how `count` cameras differ from those that are planned; `seed` is that of the robot's mismatch."""
    size = mismatch.size

    def draw(name: str, *shape: int) -> FloatArray:
        """Return numbers of ±1, (count, ...), the first ones alike for any count."""
        return named_generator(seed, f"mismatch.{name}").uniform(-1.0, 1.0, (count, *shape))

    mount = named_generator(seed, "mismatch.mount_axis").standard_normal((count, 3))
    mount *= size(ON_HAND) * draw(ON_HAND, 1) / np.linalg.norm(mount, axis=-1, keepdims=True)
    return CameraDraws(
        focal=1.0 + size("focal") * draw("focal"),
        centre=size("centre") * draw("centre", 2),
        distortion=size("distortion") * draw("distortion"),
        turn=np.array([np.zeros(3), *(_draw_turn(mismatch, i, seed) for i in range(1, count))]),
        mount=mount,
    )


def _draw_turn(mismatch: Mismatch, camera: int, seed: int) -> FloatArray:
    """Return the rotation vector, (3,) rad, of a further camera, drawn as that of the first one is."""
    angle = mismatch.size("camera_rotation")
    axis = draw_camera_axis(angle, MAX_TILT, named_generator(seed, f"mismatch.camera_axis_{camera}"))
    share = 1.0 if mismatch.camera_exact else named_generator(seed, f"mismatch.camera_angle_{camera}").uniform(-1, 1)
    return np.asarray(share * angle * axis)
