"""The part of an image in which a ball must be, so that no more than that need be rendered and searched.

A sphere of radius R about (x, y, z) in the camera frame appears between the columns and rows at which the planes
through the lens that contain one axis of the image touch it:

    (x z ± R √(x² + z² − R²)) / (z² − R²)        of x/z, and likewise of y/z

Nothing else in a rendered room has the ball's colour. An image that is cut to this window with a margin, in which the
colour noise of the ball can matter, therefore gives the same detection as all of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.detection import COLOUR_MARGIN
from servobench.plant.robot.camera import PinholeCamera

Scalar = TypeVar("Scalar", bound=np.generic)
MARGIN = COLOUR_MARGIN + 2  # [px] and two for what rounding and the sampling point of a pixel make of an edge


class Window(NamedTuple):
    """Rows and columns of an image, counted from the upper left corner, both ends of which are whole pixels.

    Attributes:
        top: first row.
        left: first column.
        bottom: row after the last one.
        right: column after the last one.
    """

    top: int
    left: int
    bottom: int
    right: int

    def cut(self, image: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
        """Return the part of an image (h, w, ...) in this window, without a copy."""
        return image[self.top : self.bottom, self.left : self.right]


def whole(camera: PinholeCamera) -> Window:
    """Return the window of all pixels."""
    return Window(0, 0, camera.height, camera.width)


def window_around(centre: FloatArray, radius: float, camera: PinholeCamera) -> Window | None:
    """Return the window outside of which no pixel shows a ball, with a margin for noise; None where none does.

    Args:
        centre: (3,) [m], of the ball in the camera frame.
        radius: [m].
        camera: its intrinsics.
    """
    x, y, z = centre.tolist()
    if z <= radius + camera.near:
        return None if z < -radius else whole(camera)
    depth2 = z * z - radius * radius
    ends = [
        [(at * z + side * radius * math.sqrt(at * at + depth2)) / depth2 for at in (x, y)] + [1.0] for side in (-1, 1)
    ]
    (left, top), (right, bottom) = camera.project(ends).tolist()
    window = Window(
        max(0, math.floor(top) - MARGIN),
        max(0, math.floor(left) - MARGIN),
        min(camera.height, math.ceil(bottom) + 1 + MARGIN),
        min(camera.width, math.ceil(right) + 1 + MARGIN),
    )
    return window if window.top < window.bottom and window.left < window.right else None
