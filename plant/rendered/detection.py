"""The red ball in an RGB-D image: colour segmentation, depth deprojection and a fit of a sphere of known radius.

The ball's pixels are chosen by colour alone, so depth noise does not select them. Each gives a measured depth z_i along
its ray r_i = (x/z, y/z, 1). A sphere of radius R about c meets that ray first at the depth

    t_i(c) = (r_i·c − √D_i) / |r_i|²,          D_i = (r_i·c)² − |r_i|² (|c|² − R²)

and c minimises Σ (z_i − t_i(c))² by Gauss-Newton with ∂t_i/∂c = −(t_i r_i − c)/√D_i. The noise lies along the ray,
hence so do the residuals: a fit of distances to the centre would be biased by noise² / R. Pixels near the silhouette,
where that slope grows without bound, and pixels whose residual stands far off the others' take no part.
"""

import math
from typing import NamedTuple, TypeAlias, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray, IntArray
from servobench.plant.robot.camera import PinholeCamera

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
MIN_USED = 0.5  # share of the patch's depths that must agree with the sphere
INNER_COSINE = 0.4  # cosine of the angle between ray and surface normal below which a pixel counts as silhouette
OUTLIER_SCALE = 4.0  # robust standard deviations beyond which a depth is an outlier
OUTLIER_FLOOR = 0.002  # [m] a smaller deviation is no outlier
DEVIATION_OF_MEDIAN = 1.4826  # [1] standard deviation of a normal error over the median of its size
MAX_RESIDUAL = 0.75  # RMS as a share of the radius beyond which the fit is implausible
# Standard error as a share of the radius beyond which the fit is too uncertain
MAX_UNCERTAINTY = 0.2
SELECTION_ITERATIONS = 3  # number of iterations that select the depths again
MAX_ITERATIONS = 10
STEP_TOLERANCE = 1e-5  # [m] the error after such a step is far smaller
RIDGE = 1e-9 * np.eye(3)  # keeps the normal matrix of a degenerate patch invertible
OUTLINE = (40, 255, 80)  # RGB of the drawn detection
# [px] Margin of a window around the target: four in which colour noise can matter, and two for the shift of an edge
# by rounding and by the sampling point of a pixel.
MARGIN = 6


class Patch(NamedTuple):
    """The largest red patch in an image."""

    rows: IntArray  # (k,), px
    columns: IntArray  # (k,), px

    def mask(self, margin: int = 0) -> tuple[ByteArray, int, int]:
        """Return a mask of the box around the pixels with a margin [px], and the box's first row and column."""
        top = int(self.rows.min()) - margin
        left = int(self.columns.min()) - margin
        bottom = int(self.rows.max()) + 1 + margin
        right = int(self.columns.max()) + 1 + margin
        mask = np.zeros((bottom - top, right - left), dtype=np.uint8)
        mask[self.rows - top, self.columns - left] = 1
        return mask, top, left


class Detection(NamedTuple):
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
    hsv = cv2.cvtColor(rgb, cv2.COLOR_BGR2HSV)
    mask = cv2.inRange(hsv, *RED_RANGE)
    return largest_patch(np.asarray(mask, dtype=np.uint8))


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
        areas = statistics[1:, cv2.CC_STAT_AREA]
        # Label 0 is the background.
        coloured = labels == 1 + int(np.argmax(areas))
    rows, columns = np.nonzero(coloured)
    if len(rows) < MIN_PIXELS:
        return None
    rows = rows + y
    columns = columns + x
    last_row = mask.shape[0] - 1
    last_column = mask.shape[1] - 1
    cut_vertically = rows[0] == 0 or rows[-1] == last_row
    cut_horizontally = columns.min() == 0 or columns.max() == last_column
    if cut_vertically or cut_horizontally:
        return None
    return Patch(rows, columns)


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
    centre_depth = float(np.median(depth)) + radius / np.sqrt(2.0)
    fit = fit_sphere(rays, depth, middle * centre_depth, radius)
    if fit is None or not fit.centre[2] > radius:
        return None
    plausible = fit.residual <= MAX_RESIDUAL * radius
    certain = fit.uncertainty <= MAX_UNCERTAINTY * radius
    visible_share = len(depth) / disc_area(fit.centre, camera, radius)
    complete = MIN_VISIBLE <= visible_share <= MAX_VISIBLE
    mostly_used = fit.used >= MIN_USED * len(depth)
    if plausible and certain and complete and mostly_used:
        return fit
    return None


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
    depth = camera.metric_depth(buffer[patch.rows, patch.columns])
    return locate_ball(patch, depth, camera, radius)


def disc_area(centre: FloatArray, camera: PinholeCamera, radius: float) -> float:
    """Return the area, px², of the ellipse of a sphere at `centre` (3,) m, which is stretched off the optical axis."""
    tangent2 = centre @ centre - radius**2  # squared length of the tangents from the lens
    depth2 = centre[2] ** 2 - radius**2
    return float(np.pi * (camera.focal * radius) ** 2 * np.sqrt(tangent2 / depth2**3))


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
            r = rays[chosen]
            z = depth[chosen]
        t, root = first_hit(r, centre, radius)
        e = z - t
        # ∂t/∂c = −(t r − c)/√D, a row for each depth.
        slope = (centre - t[:, None] * r) / root[:, None]
        normal = slope.T @ slope + RIDGE * len(e)
        step = np.linalg.solve(normal, slope.T @ e)
        length = math.sqrt(step @ step)
        # The linearisation does not hold beyond a step of one radius.
        shortening = min(1.0, radius / max(length, radius))
        centre = centre + step * shortening
        if iteration >= SELECTION_ITERATIONS and length < STEP_TOLERANCE:
            break
    residual = math.sqrt(e @ e / len(e))
    # The inverse of Gauss-Newton's normal matrix is the centre's covariance for unit noise.
    covariance = np.linalg.inv(normal)
    uncertainty = residual * math.sqrt(np.trace(covariance))
    return Detection(centre, residual, len(e), uncertainty)


def first_hit(rays: FloatArray, centre: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
    """Return where rays (k, 3) first meet a sphere: the depths t (k,) m and the roots √D (k,); D is kept positive."""
    length2 = np.einsum("ij,ij->i", rays, rays)
    along = rays @ centre
    D = along * along - length2 * (centre @ centre - radius**2)
    # Rays that miss the sphere, or nearly, have a root far below that of the silhouette's pixels.
    least = (0.1 * INNER_COSINE * radius) ** 2
    root = np.sqrt(np.maximum(D, least))
    return (along - root) / length2, root


def choose_depths(
    rays: FloatArray, depth: FloatArray, centre: FloatArray, radius: float
) -> IntArray:
    """Return the indices of the rays that meet the sphere well inside its silhouette and whose depth is no outlier."""
    t, root = first_hit(rays, centre, radius)
    # √D is R |r| times the cosine of the angle between ray and surface normal.
    length = np.sqrt(np.einsum("ij,ij->i", rays, rays))
    inner = np.flatnonzero(root >= INNER_COSINE * radius * length)
    if len(inner) == 0:
        return inner
    size = np.abs(depth[inner] - t[inner])
    middle = len(inner) // 2
    median = float(np.partition(size, middle)[middle])
    # The median estimates the standard deviation in spite of outliers.
    gate = max(OUTLIER_FLOOR, OUTLIER_SCALE * DEVIATION_OF_MEDIAN * median)
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
    x = round(u * 2**shift)
    y = round(v * 2**shift)
    size = camera.focal * radius / detection.centre[2]
    thickness = max(1, round(camera.height / 360))
    outline = round((size + 1.5 * thickness) * 2**shift)
    cv2.circle(picture, (x, y), outline, OUTLINE, thickness, cv2.LINE_AA, shift)
    arm = round(0.45 * size * 2**shift)
    for dx, dy in ((arm, 0), (0, arm)):
        start = (x - dx, y - dy)
        end = (x + dx, y + dy)
        cv2.line(picture, start, end, OUTLINE, thickness, cv2.LINE_AA, shift)
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
    across = centre[:2]
    z = float(centre[2])
    if z < -radius:
        return None
    if z <= radius + camera.near:
        return whole(camera)
    depth2 = z * z - radius * radius
    half = radius * np.sqrt(across * across + depth2)
    ends = np.ones((2, 3))
    ends[0, :2] = (across * z - half) / depth2
    ends[1, :2] = (across * z + half) / depth2
    lower, upper = camera.project(ends)
    first = np.floor(lower) - MARGIN
    beyond = np.ceil(upper) + 1 + MARGIN
    left, top = np.maximum(first, 0).astype(int).tolist()
    right, bottom = np.minimum(beyond, (camera.width, camera.height)).astype(int).tolist()
    if top >= bottom or left >= right:
        return None
    return Window(top, left, bottom, right)


def window_around_all(centres: FloatArray, radius: float, camera: PinholeCamera) -> Window | None:
    """Return the window outside of which no pixel shows any of the balls or discs, (p, 3) m; see `window_around`."""
    windows = [window_around(centre, radius, camera) for centre in centres]
    shown = [window for window in windows if window is not None]
    if not shown:
        return None
    tops, lefts, bottoms, rights = zip(*shown, strict=True)
    return Window(min(tops), min(lefts), max(bottoms), max(rights))
