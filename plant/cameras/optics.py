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

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import matrix, norm, outer
from servobench.plant.contract.signals import BoolArray
from servobench.plant.robot.camera import PinholeCamera

# A nearer point is not valid, and its features are those of this least depth.
NEAR = 0.02  # [m]
NEWTON_STEPS = 12  # Convergence is quadratic from a start within the image.
BISECTIONS = 60  # They lead from r = 1000 down to rounding.
# It is added to r², so that a fisheye has a derivative on the optical axis.
AXIS_OFFSET = 1e-24  # [1]
# Columns of `Optics.further` by the model of the lens, under its name in ROS.
COLUMNS = {"plumb_bob": 6, "equidistant": 7, "rational_polynomial": 9}


@dataclass(frozen=True, eq=False)
class Optics:
    """The intrinsics of c cameras."""

    focal: FloatArray  # f or f_x, (..., c) [px].
    centre: FloatArray  # c, (..., c, 2) [px].
    distortion: FloatArray  # k or k₁, (..., c) [1].
    size: tuple[float, float]  # width and height of the images [px]
    # f_y/f_x, k₂, p₁, p₂, k₃ and the largest r² [1] of calibrated cameras, (..., c, 6); None for others. The rational
    # model has k₄, k₅, k₆ behind them, (..., c, 9), and the fisheye k₄, (..., c, 7), with p₁ = p₂ = 0.
    further: FloatArray | None = None

    @property
    def focal_lengths(self) -> FloatArray:
        """Focal lengths of both axes, (..., c, 2) [px]."""
        aspect = np.ones_like(self.focal)
        if self.further is not None:
            aspect = self.further[..., 0]
        return np.stack([self.focal, self.focal * aspect], axis=-1)


def ideal_optics(camera: PinholeCamera, count: int) -> Optics:
    """Return the intrinsics of `count` cameras that are as planned."""
    width = float(camera.width)
    height = float(camera.height)
    centre = np.tile([width / 2.0, height / 2.0], (count, 1))
    return Optics(np.full(count, camera.focal), centre, np.zeros(count), (width, height))


def project(points: FloatArray, optics: Optics) -> FloatArray:
    """Return the pixels at which points appear.

    Args:
        points: (..., c, p, 3), in the frame of each camera [m]; numbers, or expressions in an array of objects.
        optics: the intrinsics of the cameras.

    Returns:
        (..., c, p, 2) [px].
    """
    a = points[..., :2] / _depth(points)
    centre = optics.centre[..., None, :]
    if optics.further is not None:
        b = _distorted(a, optics.distortion, optics.further)
        return centre + optics.focal_lengths[..., None, :] * b
    # vecdot does not take an array of expressions.
    x = a[..., 0]
    y = a[..., 1]
    square = x * x + y * y
    stretch = 1.0 + optics.distortion[..., None] * square
    return centre + (optics.focal[..., None] * stretch)[..., None] * a


def project_rates(points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
    """Return the motions of points in the images, (..., c, p, 2, n) px.

    Args:
        points: (..., c, p, 3) [m].
        motions: (..., c, p, 3, n), n motions of each of them [m].
        optics: the intrinsics of the cameras.
    """
    depth = _depth(points)
    a = points[..., :2] / depth
    # ∂a: the motion of the point less that which leaves it on its ray
    across = motions[..., :2, :] - a[..., None] * motions[..., 2:, :]
    rate_a = across / depth[..., None]
    if optics.further is not None:
        xx, xy, yy = _distortion_slopes(a, optics.distortion, optics.further)
        slope = matrix([xx, xy], [xy, yy])
        return optics.focal_lengths[..., None, :, None] * (slope @ rate_a)
    # ∂((1 + k r²) a) = ∂a + k (r² ∂a + 2 a aᵀ ∂a)
    k = optics.distortion[..., None, None, None]
    square = np.vecdot(a, a)[..., None, None]
    rate_b = rate_a + k * (square * rate_a + 2.0 * (outer(a, a) @ rate_a))
    return optics.focal[..., None, None, None] * rate_b


def locate(pixels: FloatArray, depth: FloatArray, optics: Optics) -> FloatArray:
    """Return the points that appear at given pixels, (..., c, p, 3) m: the inverse of `project` for known depths.

    A pixel at which the distortion shows no point gets a point at the edge of the visible ones.

    Args:
        pixels: (..., c, p, 2) [px].
        depth: z, (..., c, p) [m].
        optics: the intrinsics of the cameras.
    """
    b = (pixels - optics.centre[..., None, :]) / optics.focal_lengths[..., None, :]
    a = _undistorted(b, optics)
    z = depth[..., None]
    across = a * z
    z = np.broadcast_to(z, (*across.shape[:-1], 1))
    return np.concatenate([across, z], axis=-1)


def _undistorted(b: FloatArray, optics: Optics) -> FloatArray:
    """Return a, (..., c, p, 2), whose distorted ones are `b`."""
    if optics.further is None:
        if not optics.distortion.any():
            return b
        return _undistorted_quadratic(b, optics.distortion[..., None])
    if optics.further.shape[-1] == COLUMNS["equidistant"]:
        return _undistorted_fisheye(b, optics.distortion, optics.further)
    return _undistorted_polynomial(b, optics.distortion, optics.further)


def _with_length(b: FloatArray, r: FloatArray, length: FloatArray) -> FloatArray:
    """Return vectors along `b` (..., 2), whose length is given, with the length r, (..., 2)."""
    return b * (r / np.maximum(length, 1e-12))[..., None]


def _undistorted_quadratic(b: FloatArray, k: FloatArray) -> FloatArray:
    """Return a, (..., c, p, 2), for which (1 + k r²) a = b; Newton's method on r."""
    wanted = norm(b)
    # r (1 + k r²) turns back at this r if k is negative.
    turning = 1.0 / np.sqrt(3.0 * np.maximum(-k, 1e-12))
    most = np.where(k < 0.0, turning, np.inf)
    r = np.minimum(wanted, 0.9 * most)
    for _ in range(NEWTON_STEPS):
        slope = np.maximum(1.0 + 3.0 * k * r**2, 1e-3)
        excess = r * (1.0 + k * r**2) - wanted
        r = np.maximum(r - excess / slope, 0.0)
        r = np.minimum(r, most)
    return _with_length(b, r, wanted)


def _radial(a: FloatArray, k1: FloatArray, further: FloatArray) -> tuple[FloatArray, ...]:
    """Return r², the radial factor of a, its derivative by r², (..., c, p) each, and p₁ and p₂, (..., c, 1)."""
    k1 = k1[..., None]
    k2, p1, p2, k3 = (further[..., i, None] for i in range(1, 5))
    x = a[..., 0]
    y = a[..., 1]
    s = x * x + y * y
    if further.shape[-1] == COLUMNS["equidistant"]:
        square = s + AXIS_OFFSET
        r = np.sqrt(square)
        angle, rate = _distorted_angle(np.arctan(r), k1, further)
        stretch = angle / r
        # ∂θ/∂r = 1 / (1 + r²) and ∂r/∂r² = 1 / (2 r)
        change = (rate / (1.0 + square) - stretch) / (2.0 * square)
        return s, stretch, change, p1, p2
    stretch = 1.0 + s * (k1 + s * (k2 + s * k3))
    change = k1 + s * (2.0 * k2 + 3.0 * s * k3)
    if further.shape[-1] == COLUMNS["rational_polynomial"]:
        k4, k5, k6 = (further[..., i, None] for i in range(6, 9))
        below = 1.0 + s * (k4 + s * (k5 + s * k6))
        below_change = k4 + s * (2.0 * k5 + 3.0 * s * k6)
        stretch = stretch / below
        change = (change - stretch * below_change) / below
    return s, stretch, change, p1, p2


def _distorted_angle(
    angle: FloatArray, k1: FloatArray, further: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return θ (1 + k₁ θ² + k₂ θ⁴ + k₃ θ⁶ + k₄ θ⁸) of a fisheye and its derivative by θ, (..., c, p) each."""
    k2, k3, k4 = (further[..., i, None] for i in (1, 4, 6))
    t = angle * angle
    distorted = angle * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
    rate = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + 9.0 * t * k4)))
    return distorted, rate


def _distorted(a: FloatArray, k1: FloatArray, further: FloatArray) -> FloatArray:
    """Return b, (..., c, p, 2), of calibrated cameras."""
    s, stretch, _, p1, p2 = _radial(a, k1, further)
    x = a[..., 0]
    y = a[..., 1]
    tangential_x = 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
    tangential_y = p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([stretch * x + tangential_x, stretch * y + tangential_y], axis=-1)


def _distortion_slopes(
    a: FloatArray, k1: FloatArray, further: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ∂b_x/∂a_x, ∂b_x/∂a_y = ∂b_y/∂a_x and ∂b_y/∂a_y, (..., c, p) each, of calibrated cameras."""
    _, stretch, change, p1, p2 = _radial(a, k1, further)
    x = a[..., 0]
    y = a[..., 1]
    xx = stretch + 2.0 * x * x * change + 2.0 * p1 * y + 6.0 * p2 * x
    xy = 2.0 * x * y * change + 2.0 * p1 * x + 2.0 * p2 * y
    yy = stretch + 2.0 * y * y * change + 6.0 * p1 * y + 2.0 * p2 * x
    return xx, xy, yy


def _undistorted_polynomial(b: FloatArray, k1: FloatArray, further: FloatArray) -> FloatArray:
    """Return a, (..., c, p, 2), whose distorted ones are b; Newton's method within the visible part."""
    edge = np.sqrt(further[..., 5, None])
    a = b
    most = 0.95 * edge
    if further.shape[-1] == COLUMNS["rational_polynomial"]:
        a = _undistorted_radially(b, k1, further)
        most = edge
    for _ in range(NEWTON_STEPS):
        xx, xy, yy = _distortion_slopes(a, k1, further)
        excess = _distorted(a, k1, further) - b
        ex = excess[..., 0]
        ey = excess[..., 1]
        # The step is (∂b/∂a)⁻¹ e, by the adjugate and the determinant.
        adjugate_e = np.stack([yy * ex - xy * ey, xx * ey - xy * ex], axis=-1)
        determinant = np.maximum(xx * yy - xy * xy, 1e-2)
        a = a - adjugate_e / determinant[..., None]
        shrink = np.minimum(1.0, most / np.maximum(norm(a), 1e-12))
        a = a * shrink[..., None]
    return a


def _undistorted_radially(b: FloatArray, k1: FloatArray, further: FloatArray) -> FloatArray:
    """Return a, (..., c, p, 2), whose distorted ones without tangential part are b; bisection of r."""
    wanted = norm(b)
    low = np.zeros_like(wanted)
    high = low + np.sqrt(further[..., 5, None])
    for _ in range(BISECTIONS):
        r = 0.5 * (low + high)
        on_axis = np.stack([r, np.zeros_like(r)], axis=-1)
        _, stretch, *_ = _radial(on_axis, k1, further)
        short = r * stretch < wanted
        low = np.where(short, r, low)
        high = np.where(short, high, r)
    return _with_length(b, low, wanted)


def _undistorted_fisheye(b: FloatArray, k1: FloatArray, further: FloatArray) -> FloatArray:
    """Return a, (..., c, p, 2), whose distorted ones by a fisheye are b; Newton's method on θ."""
    wanted = norm(b)
    most = np.arctan(np.sqrt(further[..., 5, None]))
    angle = np.minimum(wanted, most)
    for _ in range(NEWTON_STEPS):
        distorted, rate = _distorted_angle(angle, k1[..., None], further)
        step = (distorted - wanted) / np.maximum(rate, 1e-3)
        angle = np.clip(angle - step, 0.0, most)
    return _with_length(b, np.tan(angle), wanted)


def in_image(points: FloatArray, optics: Optics, share: float = 1.0) -> BoolArray:
    """Return which points, (..., c, p, 3) m, are in front of the camera and in the image, (..., c, p).

    Args:
        points: positions in the frame of each camera.
        optics: the intrinsics of the cameras.
        share: part of the image's half sides in which they have to be; below 1 it leaves a margin.
    """
    half = 0.5 * np.array(optics.size)
    from_middle = np.abs(project(points, optics) - half)
    inside = (from_middle <= share * half).all(axis=-1)
    turning = None
    if optics.further is not None:
        turning = optics.further[..., 5]
    elif (optics.distortion < 0.0).any():
        # r (1 + k r²) turns back at this r².
        turning = 1.0 / (3.0 * np.maximum(-optics.distortion, 1e-12))
    if turning is not None:
        a = points[..., :2] / _depth(points)
        inside &= np.vecdot(a, a) <= turning[..., None]
    return inside & (points[..., 2] > NEAR)


def _depth(points: FloatArray) -> FloatArray:
    """Return z, (..., 1) m, not below the least depth."""
    depth = points[..., 2:]
    if depth.dtype != object:
        return np.maximum(depth, NEAR)
    # Expressions have methods in place of numpy's functions.
    clip_expression = np.frompyfunc(lambda z: z.fmax(NEAR), 1, 1)
    return clip_expression(depth)
