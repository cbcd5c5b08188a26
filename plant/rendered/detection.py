"""The red ball in an RGB-D image: colour segmentation, depth deprojection and a fit of a sphere of known radius.

The ball's pixels are chosen by colour alone, so depth noise does not select them. Each gives a measured depth z_i along
its ray r_i = (x/z, y/z, 1). A sphere of radius R about c meets that ray first at the depth

    t_i(c) = (r_i·c − √D_i) / |r_i|²,          D_i = (r_i·c)² − |r_i|² (|c|² − R²)

and c minimises Σ (z_i − t_i(c))² by Gauss-Newton with ∂t_i/∂c = −(t_i r_i − c)/√D_i. The noise lies along the ray,
hence so do the residuals: a fit of distances to the centre would be biased by noise² / R. Pixels near the silhouette,
where that slope grows without bound, and pixels whose residual stands far off the others' take no part.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.camera import IntArray, PinholeCamera

ByteArray = npt.NDArray[np.uint8]
HueRange: TypeAlias = tuple[tuple[int, int, int], tuple[int, int, int]]
"""Lowest and highest hue, saturation and brightness of a colour, as OpenCV has them."""

# OpenCV reads the channels as blue, green, red. Fed with red, green, blue, red lands at hue 120 of 180 instead of at
# both ends 0 and 180, and one range covers purplish and orange reds.
RED_RANGE: HueRange = (111, 120, 40), (129, 255, 255)
FULL_BOX = 0.6  # share of red pixels above which a box holds one patch; a disc fills π/4
MIN_PIXELS = 16  # fewer pixels do not determine three coordinates under noise
MIN_VISIBLE = 0.4  # share of the ball's disc that must be visible
MAX_VISIBLE = 1.4  # a larger red patch is not the ball
INNER_COSINE = 0.4  # cosine of the angle between ray and surface normal below which a pixel counts as silhouette
OUTLIER_SCALE = 4.0  # robust standard deviations beyond which a depth is an outlier
OUTLIER_FLOOR = 0.002  # [m] a smaller deviation is no outlier
MAX_RESIDUAL = 0.75  # RMS as a share of the radius beyond which the fit is implausible
MAX_UNCERTAINTY = (
    0.2  # standard error as a share of the radius beyond which the fit is too uncertain
)
SELECTION_ITERATIONS = 3  # number of iterations that select the depths again
MAX_ITERATIONS = 10
STEP_TOLERANCE = 1e-5  # [m] the error after such a step is far smaller
RIDGE = 1e-9 * np.eye(3)  # keeps the normal matrix of a degenerate patch invertible
OUTLINE = (40, 255, 80)  # RGB of the drawn detection
# [px] of a window around the target: four in which colour noise can matter, and two for the shift of an edge by
# rounding and by the sampling point of a pixel.
MARGIN = 6


@dataclass(frozen=True, eq=False)
class Patch:
    """The largest red patch in an image."""

    rows: IntArray  # (k,), px
    columns: IntArray  # (k,), px


@dataclass(frozen=True, eq=False)
class Detection:
    """A ball as a sphere of known radius fitted to depths."""

    centre: FloatArray  # (3,), m, camera frame
    residual: float  # m, RMS of the depths that took part
    used: int  # number of those depths
    uncertainty: float  # m, standard error of the centre by the residual, all axes together


def find_patch(rgb: ByteArray) -> Patch | None:
    """Return the largest red patch of an image.

    Args:
        rgb: (h, w, 3 or 4), red, green, blue and, ignored, opacity.

    Returns:
        The patch, or None where there is none, it is too small, or the image's border cuts it.
    """
    return largest_patch(
        np.asarray(cv2.inRange(cv2.cvtColor(rgb, cv2.COLOR_BGR2HSV), *RED_RANGE), dtype=np.uint8)
    )


def largest_patch(mask: ByteArray) -> Patch | None:
    """Return the largest connected part of a mask.

    Args:
        mask: (h, w), above 0 where pixels have the wanted colour.

    Returns:
        The patch, or None where there is none, it is too small, or the image's border cuts it.
    """
    x, y, width, height = cv2.boundingRect(mask)
    if width * height < MIN_PIXELS:
        return None
    # Only the box around all of the colour is searched. A full box holds one patch, and the search for parts is slow.
    coloured = mask[y : y + height, x : x + width] > 0
    if np.count_nonzero(coloured) < FULL_BOX * width * height:
        _, labels, statistics, _ = cv2.connectedComponentsWithStats(
            coloured.astype(np.uint8), connectivity=8
        )
        coloured = labels == 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))
    rows, columns = np.nonzero(coloured)
    rows, columns = rows + y, columns + x
    image_height, image_width = mask.shape
    cut = (
        rows[0] == 0
        or rows[-1] == image_height - 1
        or columns.min() == 0
        or columns.max() == image_width - 1
    )
    return None if cut or len(rows) < MIN_PIXELS else Patch(rows, columns)


def add_colour_noise(rgb: ByteArray, deviation: float, generator: np.random.Generator) -> ByteArray:
    """Return an image with white noise on each channel of each pixel.

    Args:
        rgb: (h, w, 3 or 4), a window of an image; an opacity stays as it is.
        deviation: standard deviation of the noise, of 255.
        generator: of the noise; three numbers are drawn for each pixel, whatever its colour.
    """
    noisy = rgb.copy()
    channels = rgb[..., :3]
    values = channels + deviation * generator.standard_normal(channels.shape)
    noisy[..., :3] = np.clip(np.round(values), 0, 255).astype(np.uint8)
    return noisy


def locate_ball(
    patch: Patch, depth: FloatArray, camera: PinholeCamera, radius: float
) -> Detection | None:
    """Return the ball that makes a red patch.

    Args:
        patch: k pixels.
        depth: (k,), m, measured along the optical axis.
        camera: its intrinsics.
        radius: m, of the ball.

    Returns:
        The ball, or None where too little of it is visible or no ball of this radius explains the depths.
    """
    rays = camera.rays(patch.columns, patch.rows)
    middle = np.array([np.median(rays[:, 0]), np.median(rays[:, 1]), 1.0])
    # The median depth over a sphere's disc is R/√2 nearer than its centre.
    start = middle * (float(np.median(depth)) + radius / np.sqrt(2.0))
    fit = fit_sphere(rays, depth, start, radius)
    if fit is None or not fit.centre[2] > radius:
        return None
    visible = len(depth) / disc_area(fit.centre, camera, radius)
    plausible = (
        fit.residual <= MAX_RESIDUAL * radius and fit.uncertainty <= MAX_UNCERTAINTY * radius
    )
    complete = MIN_VISIBLE <= visible <= MAX_VISIBLE and fit.used >= 0.5 * len(depth)
    return fit if plausible and complete else None


def find_ball(
    rgb: ByteArray, buffer: FloatArray, camera: PinholeCamera, radius: float
) -> Detection | None:
    """Return the ball in a rendered image without noise, or None where none is found.

    Args:
        rgb: (h, w, 3 or 4).
        buffer: depth buffer, (h, w).
        camera: its intrinsics.
        radius: m, of the ball.
    """
    patch = find_patch(rgb)
    if patch is None:
        return None
    return locate_ball(
        patch, camera.metric_depth(buffer[patch.rows, patch.columns]), camera, radius
    )


def disc_area(centre: FloatArray, camera: PinholeCamera, radius: float) -> float:
    """Return the area, px², of the ellipse of a sphere at `centre` (3,) m, which is stretched off the optical axis."""
    nearest2 = centre[2] ** 2 - radius**2
    return float(
        np.pi * (camera.focal * radius) ** 2 * np.sqrt((centre @ centre - radius**2) / nearest2**3)
    )


def fit_sphere(
    rays: FloatArray, depth: FloatArray, start: FloatArray, radius: float
) -> Detection | None:
    """Fit the centre of a sphere of known radius to depths along rays.

    Args:
        rays: (k, 3), with third entry 1.
        depth: (k,), m.
        start: (3,), m, first guess of the centre.
        radius: m.

    Returns:
        The fit, or None where too few depths agree with a sphere.
    """
    centre = start
    for iteration in range(MAX_ITERATIONS):
        # Selection in every iteration could make a pixel at the gate, and so the centre, oscillate.
        if iteration < SELECTION_ITERATIONS:
            chosen = choose_depths(rays, depth, centre, radius)
            if len(chosen) < MIN_PIXELS:
                return None
            r, z = rays[chosen], depth[chosen]
        t, root = first_hit(r, centre, radius)
        e = z - t
        slope = (centre - t[:, None] * r) / root[:, None]
        normal = slope.T @ slope + RIDGE * len(e)
        step = np.linalg.solve(normal, slope.T @ e)
        length = math.sqrt(step @ step)
        # The linearisation does not hold beyond a step of one radius.
        centre = centre + step * min(1.0, radius / max(length, radius))
        if iteration >= SELECTION_ITERATIONS and length < STEP_TOLERANCE:
            break
    residual = math.sqrt(e @ e / len(e))
    # The inverse of Gauss-Newton's normal matrix is the centre's covariance for unit noise.
    return Detection(
        centre, residual, len(e), residual * math.sqrt(np.trace(np.linalg.inv(normal)))
    )


def first_hit(rays: FloatArray, centre: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
    """Return where rays (k, 3) first meet a sphere: the depths t (k,) m and the roots √D (k,); D is kept positive."""
    length2, along = np.einsum("ij,ij->i", rays, rays), rays @ centre
    D = along * along - length2 * (centre @ centre - radius**2)
    root = np.sqrt(np.maximum(D, (0.1 * INNER_COSINE * radius) ** 2))
    return (along - root) / length2, root


def choose_depths(
    rays: FloatArray, depth: FloatArray, centre: FloatArray, radius: float
) -> IntArray:
    """Return the indices of the rays that meet the sphere well inside its silhouette and whose depth is no outlier."""
    t, root = first_hit(rays, centre, radius)
    inner = np.flatnonzero(
        root >= INNER_COSINE * radius * np.sqrt(np.einsum("ij,ij->i", rays, rays))
    )
    if len(inner) == 0:
        return inner
    size = np.abs(depth[inner] - t[inner])
    middle = len(inner) // 2
    # 1.4826 times the median size estimates the standard deviation in spite of outliers.
    gate = max(OUTLIER_FLOOR, OUTLIER_SCALE * 1.4826 * float(np.partition(size, middle)[middle]))
    return inner[size <= gate]


def draw_detection(
    rgb: ByteArray, detection: Detection | None, camera: PinholeCamera, radius: float
) -> ByteArray:
    """Return a copy of an image with the detected ball's outline and centre drawn on it.

    Args:
        rgb: (h, w, 3).
        detection: the ball, or None: then the copy is plain.
        camera: the camera that took the image.
        radius: m, of the ball.
    """
    picture = np.ascontiguousarray(rgb).copy()
    if detection is None:
        return picture
    shift = 4  # OpenCV takes fractions of pixels as integers shifted by this many bits
    u, v = camera.project(detection.centre)
    centre = (round(u * 2**shift), round(v * 2**shift))
    size = camera.focal * radius / detection.centre[2]
    thickness = max(1, round(camera.height / 360))
    cv2.circle(
        picture,
        centre,
        round((size + 1.5 * thickness) * 2**shift),
        OUTLINE,
        thickness,
        cv2.LINE_AA,
        shift,
    )
    arm = round(0.45 * size * 2**shift)
    for dx, dy in ((arm, 0), (0, arm)):
        ends = ((centre[0] - dx, centre[1] - dy), (centre[0] + dx, centre[1] + dy))
        cv2.line(picture, *ends, OUTLINE, thickness, cv2.LINE_AA, shift)
    return picture


Scalar = TypeVar("Scalar", bound=np.generic)


class Window(NamedTuple):
    """Rows and columns of an image, counted from the upper left corner, both ends of which are whole pixels."""

    top: int  # first row
    left: int  # first column
    bottom: int  # row after the last one
    right: int  # column after the last one

    def cut(self, image: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
        """Return the part of an image (h, w, ...) in this window, without a copy."""
        return image[self.top : self.bottom, self.left : self.right]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width [px]."""
        return self.bottom - self.top, self.right - self.left


def whole(camera: PinholeCamera) -> Window:
    """Return the window of all pixels."""
    return Window(0, 0, camera.height, camera.width)


def window_around(centre: FloatArray, radius: float, camera: PinholeCamera) -> Window | None:
    """Return the window outside of which no pixel shows a ball, with a margin for noise; None where none does.

    A sphere of radius R about (x, y, z) in the camera frame appears between the columns and rows at which the planes
    through the lens that contain one axis of the image touch it:

        (x z ± R √(x² + z² − R²)) / (z² − R²)        of x/z, and likewise of y/z

    Nothing else in a rendered room has the ball's colour, so an image that is cut to this window gives the same
    detection as all of it.

    Args:
        centre: (3,) [m], of the ball in the camera frame.
        radius: [m].
        camera: its intrinsics.
    """
    x, y, z = centre.tolist()
    if z <= radius + camera.near:
        return None if z < -radius else whole(camera)
    depth2 = z * z - radius * radius
    sides = -radius, radius
    ends = [
        [(at * z + side * math.sqrt(at * at + depth2)) / depth2 for at in (x, y)] + [1.0]
        for side in sides
    ]
    (left, top), (right, bottom) = camera.project(ends).tolist()
    window = Window(
        max(0, math.floor(top) - MARGIN),
        max(0, math.floor(left) - MARGIN),
        min(camera.height, math.ceil(bottom) + 1 + MARGIN),
        min(camera.width, math.ceil(right) + 1 + MARGIN),
    )
    return window if window.top < window.bottom and window.left < window.right else None


def window_around_all(centres: FloatArray, radius: float, camera: PinholeCamera) -> Window | None:
    """Return the window outside of which no pixel shows any of the balls or discs, (p, 3) m; see `window_around`."""
    windows = [window_around(centre, radius, camera) for centre in centres]
    shown = np.array([window for window in windows if window is not None])
    if len(shown) == 0:
        return None
    top, left = shown[:, :2].min(axis=0).tolist()
    bottom, right = shown[:, 2:].max(axis=0).tolist()
    return Window(top, left, bottom, right)
