"""A camera with intrinsics of its own, of the ideal pictures that an engine renders.

Engines render pinholes with square pixels and the principal point in the middle. Another focal length, principal point
or distortion is made of such a picture, which is larger where the lens sees more, by taking each pixel (u, v) from
where the ray through it meets the ideal picture.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import final

import cv2
import numpy as np
import numpy.typing as npt

from servobench.plant.cameras.optics import Optics, ideal_optics, locate
from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.detection import ByteArray
from servobench.plant.rendered.engine import Scene
from servobench.plant.robot.camera import PinholeCamera

MAX_SIZE = 1024  # [px] of an ideal picture's side: a lens that sees more is black at its edges


@final
class Lens:
    """One camera of a set-up."""

    def __init__(self, planned: PinholeCamera, optics: Optics, camera: int) -> None:
        """Prepare where pixels are taken from.

        Args:
            planned: the camera as planned, whose picture needs no lens.
            optics: of all cameras of the set-up.
            camera: the number of this one.
        """
        own = Optics(
            optics.focal[camera : camera + 1],
            optics.centre[camera : camera + 1],
            optics.distortion[camera : camera + 1],
            optics.size,
        )
        self._ideal = planned
        self._map: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]] | None = None
        if as_planned(own, planned):
            return
        rays = _rays(planned, own)
        half = np.abs(rays[:, :2]).max(axis=0) * own.focal[0] + 2.0
        width, height = (min(MAX_SIZE, 2 * math.ceil(size)) for size in half.tolist())
        fov = 2.0 * math.degrees(math.atan(0.5 * height / own.focal[0]))
        self._ideal = replace(planned, width=width, height=height, vertical_fov=fov)
        at = self._ideal.project(rays).astype(np.float32).reshape(planned.height, planned.width, 2)
        self._map = at[..., 0], at[..., 1]

    def render(self, scene: Scene, X_BC: FloatArray) -> ByteArray:
        """Return what the camera sees from X_BC (4, 4), (h, w, 3 or 4)."""
        rgb, _ = scene.render(self._ideal, X_BC)
        return rgb if self._map is None else np.asarray(cv2.remap(rgb, *self._map, cv2.INTER_LINEAR))


def as_planned(optics: Optics, planned: PinholeCamera) -> bool:
    """Return whether cameras have the intrinsics that are planned."""
    plain = ideal_optics(planned, 1)
    return all(np.all(getattr(optics, part) == getattr(plain, part)) for part in ("focal", "centre", "distortion"))


def _rays(planned: PinholeCamera, optics: Optics) -> FloatArray:
    """Return the ray (x/z, y/z, 1) through each pixel of an image, (h w, 3)."""
    columns, rows = np.meshgrid(np.arange(planned.width), np.arange(planned.height))
    half = np.array([planned.width, planned.height]) / 2.0
    # Where a pixel is sampled, counted from the upper left corner, is what the planned camera says.
    pixels = half + planned.focal * planned.rays(columns.ravel(), rows.ravel())[:, :2]
    rays: FloatArray = locate(pixels[None], np.ones((1, 1)), optics)[0]
    return rays
