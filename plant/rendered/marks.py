"""Coloured marks, the ball or discs, found in an image by nothing but its pixels.

Each mark has a colour of its own, so none is taken for another. A mark is found if its pixels fill an ellipse. With
their mean μ and covariance Σ, the pixels x of a whole ellipse are those with

    (x − μ)ᵀ Σ⁻¹ (x − μ) ≤ 4

and a mark that something hides in part, that the border cuts or that touches another mark is not measured. A notch in a
ball, such as that of its stick, is filled up to the convex hull. A pixel at the edge counts by the share w that is the
mark's: how far its colour c is from grey towards the mark's paint e,

    a = max(0, (c − c̄) · (e − ē)),        w = a / (largest a among its neighbours)

The centre of a disc is the mean of its pixels. A sphere shows a little more of its outer side: its centre lies in the
direction of Σ w r / |r|⁴ over the rays r = (x/z, y/z, 1) through its pixels, the mean direction over the solid angle
that they cover, by the intrinsics that are planned.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from servobench.plant.contract.checks import FloatArray, IntArray
from servobench.plant.rendered.detection import RED_RANGE, ByteArray, HueRange, Patch, largest_patch
from servobench.plant.robot.camera import PinholeCamera

Colour = tuple[float, float, float, float]  # red, green, blue and opacity, each up to 1
RED = (0.90, 0.06, 0.05, 1.0)  # paint of the ball


class MarkColour(NamedTuple):
    """The colour of a mark."""

    paint: Colour  # red, green, blue and opacity
    hues: HueRange  # range of its pixels, if OpenCV is fed with red, green, blue; no two overlap


MARK_COLOURS = (
    MarkColour(RED, RED_RANGE),
    MarkColour((0.90, 0.80, 0.05, 1.0), ((84, 120, 40), (102, 255, 255))),  # yellow
    MarkColour((0.05, 0.75, 0.15, 1.0), ((46, 120, 40), (65, 255, 255))),  # green
    MarkColour((0.85, 0.05, 0.80, 1.0), ((139, 120, 40), (157, 255, 255))),  # magenta
)
EDGE = 1.0  # [px] how far the outline of a whole mark may be from its ellipse
MIN_HALF_AXIS = 1.5  # [px] least half axis of the ellipse of a mark
NEIGHBOURS = np.ones((3, 3), dtype=np.uint8)
ELLIPSE = 2.0  # standard deviations of a filled ellipse from its middle to its edge


class Mark(NamedTuple):
    """The pixels of a mark and their neighbours."""

    rows: IntArray  # (k,) [px]
    columns: IntArray  # (k,) [px]
    shares: FloatArray  # (k,) [1], the mark's share of each of these pixels


def find_marks(
    rgb: ByteArray, colours: tuple[MarkColour, ...], corner: tuple[int, int] = (0, 0)
) -> list[Mark | None]:
    """Return the mark of each colour, or None where it is not wholly visible.

    Args:
        rgb: (h, w, 3 or 4), an image or a window of it.
        colours: of the marks.
        corner: row and column of the window's first pixel in the image, from which the marks' pixels are counted.
    """
    hsv = cv2.cvtColor(rgb, cv2.COLOR_BGR2HSV)
    masks = [np.asarray(cv2.inRange(hsv, *colour.hues), dtype=np.uint8) for colour in colours]
    grown = [cv2.dilate(mask, NEIGHBOURS) for mask in masks]
    top, left = corner
    found: list[Mark | None] = []
    for number, colour in enumerate(colours):
        patch = largest_patch(masks[number])
        others = grown[:number] + grown[number + 1 :]
        whole = _whole_mark(patch, others)
        if patch is None or whole is None:
            found.append(None)
            continue
        mark = _with_shares(patch, whole, rgb, colour.paint)
        found.append(mark._replace(rows=mark.rows + top, columns=mark.columns + left))
    return found


def _whole_mark(patch: Patch | None, others: Sequence[cv2.typing.MatLike]) -> Patch | None:
    """Return all pixels of a mark, those of a ball's notch included; None where it is not wholly visible.

    Args:
        patch: the pixels of its colour, or None.
        others: masks (h, w) of the other marks and their neighbours. A mark without any is a ball.
    """
    if patch is None:
        return None
    if any(other[patch.rows, patch.columns].any() for other in others):
        return None
    if fills_ellipse(patch):
        return patch
    if others:
        return None
    hull = _hull(patch)
    return hull if fills_ellipse(hull) else None


def _hull(patch: Patch) -> Patch:
    """Return the pixels of the convex hull of a patch."""
    box, top, left = patch.mask()
    points = np.stack([patch.columns - left, patch.rows - top], axis=-1).astype(np.int32)
    filled = cv2.fillConvexPoly(box, cv2.convexHull(points), 1)
    rows, columns = np.nonzero(filled)
    return Patch(rows + top, columns + left)


def fills_ellipse(patch: Patch) -> bool:
    """Return whether pixels fill an ellipse and nothing else, to within `EDGE`."""
    x = np.stack([patch.columns, patch.rows], axis=-1).astype(np.float64)
    middle = x.mean(axis=0)
    variances, axes = np.linalg.eigh(np.cov(x.T, bias=True))
    half_axes = ELLIPSE * np.sqrt(np.maximum(variances, 0.0))
    if half_axes[0] < MIN_HALF_AXIS:
        return False
    mask, top, left = patch.mask()
    filled = mask > 0
    height, width = filled.shape
    # Pixels of the patch's box along the axes of its ellipse.
    box = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    along_axes = (box + np.array([left, top]) - middle) @ axes
    inner = ((along_axes / (half_axes - EDGE).clip(0.1)) ** 2).sum(axis=-1) <= 1.0
    outer = ((along_axes / (half_axes + EDGE)) ** 2).sum(axis=-1) <= 1.0
    covers_inner = (filled | ~inner).all()
    within_outer = (outer | ~filled).all()
    return bool(covers_inner and within_outer)


def _with_shares(patch: Patch, whole: Patch, rgb: ByteArray, paint: Colour) -> Mark:
    """Return the mark of a patch, with its share of each pixel of the whole mark and of their neighbours."""
    # The box has a border of one pixel for the neighbours; no patch touches the border of the image.
    in_mark, top, left = whole.mask(margin=1)
    height, width = in_mark.shape
    colour = rgb[top : top + height, left : left + width, :3].astype(np.float64)
    grey = colour.mean(axis=-1, keepdims=True)
    towards_paint = np.array(paint[:3]) - np.mean(paint[:3])
    amount = np.maximum((colour - grey) @ towards_paint, 0.0)
    largest = np.asarray(cv2.dilate(amount, NEIGHBOURS))
    shares = amount / np.maximum(largest, 1e-9)
    # Pixels of a notch, away from the edge, belong to the mark as a whole, and so do their neighbours within it.
    notch = cv2.erode(in_mark, NEIGHBOURS)
    notch[patch.rows - top, patch.columns - left] = 0
    about_notch = cv2.bitwise_and(cv2.dilate(notch, NEIGHBOURS), in_mark) > 0
    shares[about_notch] = 1.0
    rows, columns = np.nonzero(cv2.dilate(in_mark, NEIGHBOURS))
    return Mark(rows + top, columns + left, shares[rows, columns])


def disc_centre(mark: Mark, camera: PinholeCamera) -> FloatArray:
    """Return where the middle of a disc appears, (2,) px from the image's upper left corner."""
    rays = camera.rays(mark.columns, mark.rows)
    return _in_image(mark.shares @ rays, camera)


def sphere_centre(mark: Mark, camera: PinholeCamera) -> FloatArray:
    """Return where the centre of a sphere appears, (2,) px from the image's upper left corner."""
    rays = camera.rays(mark.columns, mark.rows)
    length2 = np.vecdot(rays, rays)
    weights = mark.shares / (length2 * length2)
    return _in_image(weights @ rays, camera)


def _in_image(direction: FloatArray, camera: PinholeCamera) -> FloatArray:
    """Return where a direction (3,) appears, (2,) px."""
    x, y, z = direction
    u = camera.width / 2.0 + camera.focal * x / z
    v = camera.height / 2.0 + camera.focal * y / z
    return np.array([u, v])
