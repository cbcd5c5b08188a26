"""The red ball in an RGB-D image: colour segmentation, depth deprojection and a fit of a sphere of known radius.

The ball's pixels are chosen by colour alone, so depth noise does not select them. Each gives a measured depth z_i along
its ray r_i = (x/z, y/z, 1). A sphere of radius R about c meets that ray first at the depth

    t_i(c) = (r_i·c − √D_i) / |r_i|²,          D_i = (r_i·c)² − |r_i|² (|c|² − R²)

and c minimises Σ (z_i − t_i(c))² by Gauss-Newton with ∂t_i/∂c = −(t_i r_i − c)/√D_i. The noise lies along the ray, hence so
do the residuals: a fit of distances to the centre would be biased by noise² / R. Pixels near the silhouette, where
that slope grows without bound, and pixels whose residual stands far off the others' take no part.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from plant.camera import PinholeCamera
from plant.signals import FloatArray

ByteArray = npt.NDArray[np.uint8]
IntArray = npt.NDArray[np.intp]

# OpenCV reads the channels as blue, green, red. Fed with red, green, blue, red lands at hue 120 of 180 instead of at
# both ends 0 and 180, and one range covers purplish and orange reds.
RED_LOWER, RED_UPPER = (111, 120, 40), (129, 255, 255)
MIN_PIXELS = 16  # fewer do not fix three coordinates under noise
MIN_VISIBLE = 0.4  # share of the ball's disc that must be seen
MAX_VISIBLE = 1.4  # a larger red patch is not the ball
INNER_COSINE = 0.4  # of the angle between ray and surface normal, below which a pixel counts as silhouette
OUTLIER_SCALE = 4.0  # robust standard deviations beyond which a depth is an outlier
OUTLIER_FLOOR = 0.002  # m, what is never an outlier
MAX_RESIDUAL = 0.4  # of the radius, RMS beyond which the fit is implausible
MAX_ITERATIONS = 10
STEP_TOLERANCE = 1e-6  # m
OUTLINE = (40, 255, 80)  # RGB of the drawn detection


@dataclass(frozen=True, eq=False)
class Patch:
    """The largest red patch in an image.

    Attributes:
        rows: (k,), px.
        columns: (k,), px.
    """

    rows: IntArray
    columns: IntArray


@dataclass(frozen=True, eq=False)
class Detection:
    """A ball that was found.

    Attributes:
        centre: (3,), m, camera frame.
        residual: m, RMS of the depths that took part in the fit.
        used: number of those depths.
        visible: share of the ball's disc that is seen, about 1 where nothing hides it.
    """

    centre: FloatArray
    residual: float
    used: int
    visible: float


def find_patch(rgb: ByteArray) -> Patch | None:
    """Return the largest red patch of an image.

    Args:
        rgb: (h, w, 3 or 4), red, green, blue and, ignored, opacity.

    Returns:
        The patch, or None where there is none, it is too small, or the image's border cuts it.
    """
    mask = cv2.inRange(cv2.cvtColor(rgb, cv2.COLOR_BGR2HSV), RED_LOWER, RED_UPPER)
    x, y, width, height = cv2.boundingRect(mask)
    if width * height < MIN_PIXELS:
        return None
    # Only the box around all red is looked at, as the search for connected parts would be slow on the whole image.
    box = np.ascontiguousarray(mask[y : y + height, x : x + width])
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(box, connectivity=8)
    largest = 1 + int(np.argmax(statistics[1:count, cv2.CC_STAT_AREA]))
    rows, columns = np.nonzero(labels == largest)
    rows, columns = rows + y, columns + x
    image_height, image_width = mask.shape
    cut = rows[0] == 0 or rows[-1] == image_height - 1 or columns.min() == 0 or columns.max() == image_width - 1
    return None if cut or len(rows) < MIN_PIXELS else Patch(rows, columns)


def locate_ball(patch: Patch, depth: FloatArray, camera: PinholeCamera, radius: float) -> Detection | None:
    """Return the ball that makes a red patch.

    Args:
        patch: k pixels.
        depth: (k,), m, measured along the optical axis.
        camera: its intrinsics.
        radius: m, of the ball.

    Returns:
        The ball, or None where too little of it is seen or no ball of this radius explains the depths.
    """
    rays = camera.rays(patch.columns, patch.rows)
    middle = np.array([np.median(rays[:, 0]), np.median(rays[:, 1]), 1.0])
    # The median depth over a sphere's disc is R/√2 nearer than its centre.
    start = middle * (float(np.median(depth)) + radius / np.sqrt(2.0))
    fit = fit_sphere(rays, depth, start, radius)
    if fit is None:
        return None
    centre, used, residual = fit
    disc = np.pi * (camera.focal * radius / centre[2]) ** 2
    visible = len(depth) / disc
    if used < max(MIN_PIXELS, 0.5 * MIN_VISIBLE * disc) or not MIN_VISIBLE <= visible <= MAX_VISIBLE:
        return None
    return Detection(centre, residual, used, visible) if residual <= MAX_RESIDUAL * radius else None


def fit_sphere(
    rays: FloatArray, depth: FloatArray, start: FloatArray, radius: float
) -> tuple[FloatArray, int, float] | None:
    """Fit the centre of a sphere of known radius to depths along rays.

    Args:
        rays: (k, 3), with third entry 1.
        depth: (k,), m.
        start: (3,), m, first guess of the centre.
        radius: m.

    Returns:
        The centre, (3,) m, how many depths took part, and the RMS of their residuals, m; None where the fit fails.
    """
    length2 = np.einsum("ij,ij->i", rays, rays)
    centre = start
    for _ in range(MAX_ITERATIONS):
        along = rays @ centre
        D = along**2 - length2 * (centre @ centre - radius**2)
        inner = np.flatnonzero(D >= length2 * (INNER_COSINE * radius) ** 2)
        if len(inner) < MIN_PIXELS:
            return None
        r, root = rays[inner], np.sqrt(D[inner])
        t = (along[inner] - root) / length2[inner]
        residual = depth[inner] - t
        size = np.abs(residual)
        keep = size <= max(OUTLIER_FLOOR, OUTLIER_SCALE * 1.4826 * float(np.median(size)))
        used = int(np.count_nonzero(keep))
        if used < MIN_PIXELS:
            return None
        slope = ((centre - t[:, None] * r) / root[:, None])[keep]
        kept = residual[keep]
        normal = slope.T @ slope
        step = np.linalg.solve(normal + 1e-9 * used * np.eye(3), slope.T @ kept)
        # A step beyond the radius leaves the region in which the linearisation says anything.
        step *= min(1.0, radius / max(float(np.linalg.norm(step)), 1e-12))
        centre = centre + step
        if float(np.abs(step).max()) < STEP_TOLERANCE:
            return centre, used, float(np.sqrt(kept @ kept / used))
    return centre, used, float(np.sqrt(kept @ kept / used))


def draw_detection(rgb: ByteArray, detection: Detection | None, camera: PinholeCamera, radius: float) -> ByteArray:
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
    cv2.circle(picture, centre, round((size + 1.5 * thickness) * 2**shift), OUTLINE, thickness, cv2.LINE_AA, shift)
    arm = round(0.45 * size * 2**shift)
    for dx, dy in ((arm, 0), (0, arm)):
        ends = ((centre[0] - dx, centre[1] - dy), (centre[0] + dx, centre[1] + dy))
        cv2.line(picture, *ends, OUTLINE, thickness, cv2.LINE_AA, shift)
    return picture
