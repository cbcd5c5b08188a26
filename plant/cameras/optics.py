"""Cameras as optics: a pinhole with distortion, its derivative, and the limits of the image.

With p = (x, y, z) in the camera frame, z along the optical axis, x right and y down in the image,

    a = (x, y) / z,   r² = ‖a‖²,   (u, v) = c + f (1 + k r²) a

f [px] is the focal length, c [px] the principal point, counted from the image's upper left corner, and k [1] the first
coefficient of radial distortion, as in OpenCV. A calibrated camera has all five coefficients of OpenCV's model and a
focal length for each axis:

    (u, v) = c + (f_x b_x, f_y b_y)
    b = (1 + k₁ r² + k₂ r⁴ + k₃ r⁶) a + (2 p₁ a_x a_y + p₂ (r² + 2 a_x²), p₁ (r² + 2 a_y²) + 2 p₂ a_x a_y)

Its rational model (`CALIB_RATIONAL_MODEL`, Azure Kinect) divides the radial factor:

    b = (1 + k₁ r² + k₂ r⁴ + k₃ r⁶) / (1 + k₄ r² + k₅ r⁴ + k₆ r⁶) a + (…)

and that of its fisheye module (Kannala and Brandt 2006; "equidistant" in ROS) is in the angle θ = arctan r of a ray:

    b = θ (1 + k₁ θ² + k₂ θ⁴ + k₃ θ⁶ + k₄ θ⁸) / r a

Beyond the r at which the length of b turns back, a point would appear a second time: it is not in the image. All
functions take leading axes.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm, outer
from servobench.plant.contract.signals import BoolArray
from servobench.plant.robot.camera import PinholeCamera

NEAR: Final = (
    0.02  # [m] least depth: a nearer point is not valid, and its features are those of this depth
)
NEWTON_STEPS: Final = 12  # quadratic convergence from a start within the image
BISECTIONS: Final = 60  # from r = 1000 down to rounding
AXIS: Final = 1e-24  # [1] added to r², so that a fisheye has a derivative on the optical axis
# Columns of `Optics.further` by the model of the lens, under its name in ROS.
COLUMNS: Final = {"plumb_bob": 6, "equidistant": 7, "rational_polynomial": 9}


@dataclass(frozen=True, eq=False)
class Optics:
    """The intrinsics of c cameras."""

    focal: FloatArray  # f or f_x, (..., c) [px].
    centre: FloatArray  # c, (..., c, 2) [px].
    distortion: FloatArray  # k or k₁, (..., c) [1].
    size: tuple[float, float]  # width and height of the images [px]
    # f_y/f_x, k₂, p₁, p₂, k₃ and the largest r² [1] of calibrated cameras, (..., c, 6); None of others. The rational
    # model has k₄, k₅, k₆ behind them, (..., c, 9), and the fisheye k₄, (..., c, 7), with p₁ = p₂ = 0.
    further: FloatArray | None = None

    @property
    def focal_lengths(self) -> FloatArray:
        """Focal lengths of both axes, (..., c, 2) [px]."""
        aspect = np.ones_like(self.focal) if self.further is None else self.further[..., 0]
        return np.stack([self.focal, self.focal * aspect], axis=-1)


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
    a, k, further = points[..., :2] / _depth(points), optics.distortion, optics.further
    if further is not None:
        return optics.centre[..., None, :] + optics.focal_lengths[..., None, :] * _bent(
            a, k, further
        )
    stretch = 1.0 + k[..., None] * (a[..., 0] * a[..., 0] + a[..., 1] * a[..., 1])
    return optics.centre[..., None, :] + (optics.focal[..., None] * stretch)[..., None] * a


def project_rates(points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
    """Return the motions of points in the images, (..., c, p, 2, n) px.

    Args:
        points: (..., c, p, 3) [m].
        motions: (..., c, p, 3, n), n motions of each of them [m].
        optics: of the cameras.
    """
    depth = _depth(points)
    a, k, further = points[..., :2] / depth, optics.distortion, optics.further
    flat = (motions[..., :2, :] - a[..., None] * motions[..., 2:, :]) / depth[..., None]
    if further is not None:
        return np.asarray(optics.focal_lengths[..., None, :, None] * (_slope(a, k, further) @ flat))
    square = np.vecdot(a, a)[..., None, None]
    bent = flat + k[..., None, None, None] * (square * flat + 2.0 * (outer(a, a) @ flat))
    return np.asarray(optics.focal[..., None, None, None] * bent)


def locate(pixels: FloatArray, depth: FloatArray, optics: Optics) -> FloatArray:
    """Return the points that appear at given pixels, (..., c, p, 3) m: the inverse of `project` for known depths.

    A pixel at which the distortion shows no point gets a point at the edge of the visible ones.

    Args:
        pixels: (..., c, p, 2) [px].
        depth: z, (..., c, p) [m].
        optics: of the cameras.
    """
    bent = (pixels - optics.centre[..., None, :]) / optics.focal_lengths[..., None, :]
    a = bent
    if optics.further is not None and optics.further.shape[-1] == COLUMNS["equidistant"]:
        a = _flattened(bent, optics.distortion, optics.further)
    elif optics.further is not None:
        a = _straightened(bent, optics.distortion, optics.further)
    elif optics.distortion.any():
        a = _undistorted(bent, optics.distortion[..., None])
    z = depth[..., None]
    across = a * z
    return np.concatenate([across, np.broadcast_to(z, (*across.shape[:-1], 1))], axis=-1)


def _undistorted(bent: FloatArray, k: FloatArray) -> FloatArray:
    """Return a, (..., c, p, 2), of which (1 + k r²) a = `bent`; Newton's method on r."""
    wanted = norm(bent)
    # Where r (1 + k r²) turns back
    most = np.where(k < 0.0, 1.0 / np.sqrt(3.0 * np.maximum(-k, 1e-12)), np.inf)
    r = np.minimum(wanted, 0.9 * most)
    for _ in range(NEWTON_STEPS):
        slope = np.maximum(1.0 + 3.0 * k * r**2, 1e-3)
        r = np.minimum(np.maximum(r - (r * (1.0 + k * r**2) - wanted) / slope, 0.0), most)
    return np.asarray(bent * (r / np.maximum(wanted, 1e-12))[..., None])


def _radial(a: FloatArray, k1: FloatArray, further: FloatArray) -> tuple[FloatArray, ...]:
    """Return r², the radial factor of a, its derivative by r², (..., c, p) each, and p₁ and p₂, (..., c, 1)."""
    k1, (k2, p1, p2, k3) = k1[..., None], (further[..., i, None] for i in range(1, 5))
    s = a[..., 0] * a[..., 0] + a[..., 1] * a[..., 1]
    if further.shape[-1] == COLUMNS["equidistant"]:
        square = s + AXIS
        r = np.sqrt(square)
        angle, rate = _bent_angle(np.arctan(r), k1, further)
        stretch = angle / r
        return s, stretch, (rate / (1.0 + square) - stretch) / (2.0 * square), p1, p2
    stretch = 1.0 + s * (k1 + s * (k2 + s * k3))
    change = k1 + s * (2.0 * k2 + 3.0 * s * k3)
    if further.shape[-1] == COLUMNS["rational_polynomial"]:
        k4, k5, k6 = (further[..., i, None] for i in range(6, 9))
        below = 1.0 + s * (k4 + s * (k5 + s * k6))
        stretch = stretch / below
        change = (change - stretch * (k4 + s * (2.0 * k5 + 3.0 * s * k6))) / below
    return s, stretch, change, p1, p2


def _bent_angle(
    angle: FloatArray, k1: FloatArray, further: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return θ (1 + k₁ θ² + k₂ θ⁴ + k₃ θ⁶ + k₄ θ⁸) of a fisheye and its derivative by θ, (..., c, p) each."""
    k2, k3, k4 = (further[..., i, None] for i in (1, 4, 6))
    t = angle * angle
    bent = angle * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
    rate = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + 9.0 * t * k4)))
    return bent, rate


def _bent(a: FloatArray, k1: FloatArray, further: FloatArray) -> FloatArray:
    """Return b, (..., c, p, 2), of calibrated cameras."""
    s, stretch, _, p1, p2 = _radial(a, k1, further)
    x, y = a[..., 0], a[..., 1]
    across = 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x), p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([stretch * x + across[0], stretch * y + across[1]], axis=-1)


def _slope(a: FloatArray, k1: FloatArray, further: FloatArray) -> FloatArray:
    """Return ∂b/∂a, (..., c, p, 2, 2), of calibrated cameras."""
    _, stretch, change, p1, p2 = _radial(a, k1, further)
    x, y = a[..., 0], a[..., 1]
    xx = stretch + 2.0 * x * x * change + 2.0 * p1 * y + 6.0 * p2 * x
    xy = 2.0 * x * y * change + 2.0 * p1 * x + 2.0 * p2 * y
    yy = stretch + 2.0 * y * y * change + 6.0 * p1 * y + 2.0 * p2 * x
    return np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)


def _straightened(b: FloatArray, k1: FloatArray, further: FloatArray) -> FloatArray:
    """Return a, (..., c, p, 2), of which b are the bent ones; Newton's method within the part that is visible."""
    edge = np.sqrt(further[..., 5, None])
    a, most = b, 0.95 * edge
    if further.shape[-1] == COLUMNS["rational_polynomial"]:
        a = _radially_straightened(b, k1, further)
        most = edge
    for _ in range(NEWTON_STEPS):
        (xx, xy), (_, yy) = np.moveaxis(_slope(a, k1, further), (-2, -1), (0, 1))
        e = _bent(a, k1, further) - b
        step = np.stack([yy * e[..., 0] - xy * e[..., 1], xx * e[..., 1] - xy * e[..., 0]], axis=-1)
        a = a - step / np.maximum(xx * yy - xy * xy, 1e-2)[..., None]
        a = a * np.minimum(1.0, most / np.maximum(norm(a), 1e-12))[..., None]
    return np.asarray(a)


def _radially_straightened(b: FloatArray, k1: FloatArray, further: FloatArray) -> FloatArray:
    """Return a, (..., c, p, 2), of which b are the bent ones without tangential distortion; bisection of r."""
    wanted = norm(b)
    low = np.zeros_like(wanted)
    high = low + np.sqrt(further[..., 5, None])
    for _ in range(BISECTIONS):
        r = 0.5 * (low + high)
        _, factor, *_ = _radial(np.stack([r, np.zeros_like(r)], axis=-1), k1, further)
        short = r * factor < wanted
        low = np.where(short, r, low)
        high = np.where(short, high, r)
    return np.asarray(b * (low / np.maximum(wanted, 1e-12))[..., None])


def _flattened(b: FloatArray, k1: FloatArray, further: FloatArray) -> FloatArray:
    """Return a, (..., c, p, 2), of which b are the bent ones of a fisheye; Newton's method on θ."""
    wanted = norm(b)
    most = np.arctan(np.sqrt(further[..., 5, None]))
    angle = np.minimum(wanted, most)
    for _ in range(NEWTON_STEPS):
        bent, rate = _bent_angle(angle, k1[..., None], further)
        angle = np.clip(angle - (bent - wanted) / np.maximum(rate, 1e-3), 0.0, most)
    return np.asarray(b * (np.tan(angle) / np.maximum(wanted, 1e-12))[..., None])


def in_image(points: FloatArray, optics: Optics, share: float = 1.0) -> BoolArray:
    """Return which points, (..., c, p, 3) m, are in front of the camera and in the image, (..., c, p).

    Args:
        points: in the frame of each camera.
        optics: of the cameras.
        share: of the image's half sides in which they have to be; below 1 it leaves a margin.
    """
    half = 0.5 * np.array(optics.size)
    inside = (np.abs(project(points, optics) - half) <= share * half).all(axis=-1)
    turning = None
    if optics.further is not None:
        turning = optics.further[..., 5]
    elif (optics.distortion < 0.0).any():
        # R² at which r (1 + k r²) turns back
        turning = 1.0 / (3.0 * np.maximum(-optics.distortion, 1e-12))
    if turning is not None:
        a = points[..., :2] / _depth(points)
        inside &= np.vecdot(a, a) <= turning[..., None]
    return np.asarray(inside & (points[..., 2] > NEAR))


def _depth(points: FloatArray) -> FloatArray:
    """Return z, (..., 1) m, not below the least depth."""
    depth = points[..., 2:]
    if depth.dtype != object:
        return np.maximum(depth, NEAR)
    # Expressions have methods in place of numpy's functions.
    least: FloatArray = np.frompyfunc(lambda z: z.fmax(NEAR), 1, 1)(depth)
    return least
