"""Cameras as optics: a pinhole with radial distortion, its derivative, and the limits of the image.

With p = (x, y, z) in the camera frame, z along the optical axis, x right and y down in the image,

    a = (x, y) / z,   r² = ‖a‖²,   (u, v) = c + f (1 + k r²) a

f [px] is the focal length, c [px] the principal point, counted from the image's upper left corner, and k [1] the first
coefficient of radial distortion, as in OpenCV. All functions take leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm, outer
from servobench.plant.contract.signals import BoolArray
from servobench.plant.robot.camera import PinholeCamera

CAMERA: Final = PinholeCamera()  # planned camera of every set-up in pixels
NEAR: Final = 0.02  # [m] least depth: a nearer point is not valid, and its features are those of this depth
NEWTON_STEPS: Final = 12  # quadratic convergence from a start within the image


@dataclass(frozen=True, eq=False)
class Optics:
    """The intrinsics of c cameras.

    Attributes:
        focal: f, (..., c) [px].
        centre: c, (..., c, 2) [px].
        distortion: k, (..., c) [1].
        size: width and height of the images [px].
    """

    focal: FloatArray
    centre: FloatArray
    distortion: FloatArray
    size: tuple[float, float]


def ideal_optics(camera: PinholeCamera, count: int) -> Optics:
    """Return the intrinsics of `count` cameras that are as planned."""
    width, height = float(camera.width), float(camera.height)
    centre = np.tile([width / 2.0, height / 2.0], (count, 1))
    return Optics(np.full(count, camera.focal), centre, np.zeros(count), (width, height))


def project(points: FloatArray, optics: Optics) -> FloatArray:
    """Return the pixels at which points appear.

    Args:
        points: (..., c, p, 3), in the frame of each camera [m]; numbers, or expressions in an array of objects.
        optics: of the cameras.

    Returns:
        (..., c, p, 2) [px].
    """
    a = points[..., :2] / _depth(points)
    stretch = 1.0 + optics.distortion[..., None] * (a[..., 0] * a[..., 0] + a[..., 1] * a[..., 1])
    return optics.centre[..., None, :] + (optics.focal[..., None] * stretch)[..., None] * a


def project_rates(points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
    """Return the motions of points in the images, (..., c, p, 2, n) px.

    Args:
        points: (..., c, p, 3) [m].
        motions: (..., c, p, 3, n), n motions of each of them [m].
        optics: of the cameras.
    """
    depth = _depth(points)
    a, k = points[..., :2] / depth, optics.distortion[..., None, None, None]
    flat = (motions[..., :2, :] - a[..., None] * motions[..., 2:, :]) / depth[..., None]
    square = np.vecdot(a, a)[..., None, None]
    bent = flat + k * (square * flat + 2.0 * (outer(a, a) @ flat))
    return np.asarray(optics.focal[..., None, None, None] * bent)


def locate(pixels: FloatArray, depth: FloatArray, optics: Optics) -> FloatArray:
    """Return the points that appear at given pixels, (..., c, p, 3) m: the inverse of `project` for known depths.

    A pixel at which the distortion shows no point gets a point at the edge of the visible ones.

    Args:
        pixels: (..., c, p, 2) [px].
        depth: z, (..., c, p) [m].
        optics: of the cameras.
    """
    bent = (pixels - optics.centre[..., None, :]) / optics.focal[..., None, None]
    a = _undistorted(bent, optics.distortion[..., None]) if optics.distortion.any() else bent
    z = depth[..., None]
    across = a * z
    return np.concatenate([across, np.broadcast_to(z, (*across.shape[:-1], 1))], axis=-1)


def _undistorted(bent: FloatArray, k: FloatArray) -> FloatArray:
    """Return a, (..., c, p, 2), of which (1 + k r²) a = `bent`; Newton's method on r."""
    wanted = norm(bent)
    most = np.where(k < 0.0, 1.0 / np.sqrt(3.0 * np.maximum(-k, 1e-12)), np.inf)  # where r (1 + k r²) turns back
    r = np.minimum(wanted, 0.9 * most)
    for _ in range(NEWTON_STEPS):
        slope = np.maximum(1.0 + 3.0 * k * r**2, 1e-3)
        r = np.minimum(np.maximum(r - (r * (1.0 + k * r**2) - wanted) / slope, 0.0), most)
    return np.asarray(bent * (r / np.maximum(wanted, 1e-12))[..., None])


def in_image(points: FloatArray, optics: Optics, share: float = 1.0) -> BoolArray:
    """Return which points, (..., c, p, 3) m, are in front of the camera and in the image, (..., c, p).

    Args:
        points: in the frame of each camera.
        optics: of the cameras.
        share: of the image's half sides in which they have to be; below 1 it leaves a margin.
    """
    half = 0.5 * np.array(optics.size)
    inside = (np.abs(project(points, optics) - half) <= share * half).all(axis=-1)
    return np.asarray(inside & (points[..., 2] > NEAR))


def _depth(points: FloatArray) -> FloatArray:
    """Return z, (..., 1) m, not below the least depth."""
    depth = points[..., 2:]
    if depth.dtype != object:
        return np.maximum(depth, NEAR)
    # Expressions have methods in place of numpy's functions.
    least: FloatArray = np.frompyfunc(lambda z: z.fmax(NEAR), 1, 1)(depth)
    return least
