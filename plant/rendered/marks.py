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

from typing import Final, NamedTuple

import cv2
import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.detection import RED_RANGE, ByteArray, HueRange, Patch, largest_patch
from servobench.plant.robot.camera import IntArray, PinholeCamera

Colour = tuple[float, float, float, float]  # red, green, blue and opacity, each up to 1
RED: Final[Colour] = (0.90, 0.06, 0.05, 1.0)  # paint of the ball


class MarkColour(NamedTuple):
    """The colour of a mark."""

    paint: Colour  # red, green, blue and opacity
    hues: (
        HueRange  # in which its pixels are, if OpenCV is fed with red, green, blue; no two overlap
    )


MARK_COLOURS: Final = (
    MarkColour(RED, RED_RANGE),
    MarkColour((0.90, 0.80, 0.05, 1.0), ((84, 120, 40), (102, 255, 255))),  # yellow
    MarkColour((0.05, 0.75, 0.15, 1.0), ((46, 120, 40), (65, 255, 255))),  # green
    MarkColour((0.85, 0.05, 0.80, 1.0), ((139, 120, 40), (157, 255, 255))),  # magenta
)
EDGE = 1.0  # [px] how far the outline of a whole mark may be from its ellipse
MIN_HALF_AXIS = 1.5  # [px] of the ellipse of a mark
NEIGHBOURS = np.ones((3, 3), dtype=np.uint8)
ELLIPSE = 2.0  # standard deviations of a filled ellipse from its middle to its edge


class Mark(NamedTuple):
    """The pixels of a mark and their neighbours."""

    rows: IntArray  # (k,) [px]
    columns: IntArray  # (k,) [px]
    shares: FloatArray  # (k,), of each of them that the mark has


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
    found: list[Mark | None] = []
    for number, mask in enumerate(masks):
        patch, others = largest_patch(mask), grown[:number] + grown[number + 1 :]
        whole = patch if patch is None or others or fills_ellipse(patch) else _hull(patch)
        touched = patch is not None and any(
            other[patch.rows, patch.columns].any() for other in others
        )
        if patch is None or whole is None or touched or not fills_ellipse(whole):
            found.append(None)
        else:
            mark = _with_shares(patch, whole, rgb, colours[number].paint)
            found.append(
                mark._replace(rows=mark.rows + corner[0], columns=mark.columns + corner[1])
            )
    return found


def _hull(patch: Patch) -> Patch:
    """Return the pixels of the convex hull of a patch."""
    corner = np.array([patch.columns.min(), patch.rows.min()])
    points = (np.stack([patch.columns, patch.rows], axis=-1) - corner).astype(np.int32)
    box = np.zeros(points.max(axis=0)[::-1] + 1, dtype=np.uint8)
    rows, columns = np.nonzero(cv2.fillConvexPoly(box, cv2.convexHull(points), 1))
    return Patch(rows + corner[1], columns + corner[0])


def fills_ellipse(patch: Patch) -> bool:
    """Return whether pixels fill an ellipse and nothing else, to within `EDGE`."""
    x = np.stack([patch.columns, patch.rows], axis=-1).astype(np.float64)
    middle = x.mean(axis=0)
    sizes, axes = np.linalg.eigh(np.cov(x.T, bias=True))
    half = ELLIPSE * np.sqrt(np.maximum(sizes, 0.0))
    if half[0] < MIN_HALF_AXIS:
        return False
    lower = np.array([patch.columns.min(), patch.rows.min()])
    width, height = np.array([patch.columns.max(), patch.rows.max()]) - lower + 1
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + lower
    inner = (((grid - middle) @ axes / (half - EDGE).clip(0.1)) ** 2).sum(axis=-1) <= 1.0
    outer = (((grid - middle) @ axes / (half + EDGE)) ** 2).sum(axis=-1) <= 1.0
    filled = np.zeros((height, width), dtype=np.bool_)
    filled[patch.rows - lower[1], patch.columns - lower[0]] = True
    return bool((filled | ~inner).all() and (outer | ~filled).all())


def _with_shares(patch: Patch, whole: Patch, rgb: ByteArray, paint: Colour) -> Mark:
    """Return the mark of a patch, with its share of each pixel of the whole mark and of their neighbours."""
    top, left = patch.rows.min() - 1, patch.columns.min() - 1
    box = rgb[top : patch.rows.max() + 2, left : patch.columns.max() + 2, :3].astype(np.float64)
    towards = np.array(paint[:3]) - np.mean(paint[:3])
    amount = np.maximum((box - box.mean(axis=-1, keepdims=True)) @ towards, 0.0)
    near = np.zeros(amount.shape, dtype=np.uint8)
    near[whole.rows - top, whole.columns - left] = 1
    rows, columns = np.nonzero(cv2.dilate(near, NEIGHBOURS))
    shares = amount / np.maximum(np.asarray(cv2.dilate(amount, NEIGHBOURS)), 1e-9)
    inner = cv2.erode(near, NEIGHBOURS)
    inner[patch.rows - top, patch.columns - left] = 0
    shares[(cv2.dilate(inner, NEIGHBOURS) & near) > 0] = 1.0
    return Mark(rows + top, columns + left, shares[rows, columns])


def disc_centre(mark: Mark, camera: PinholeCamera) -> FloatArray:
    """Return where the middle of a disc appears, (2,) px from the image's upper left corner."""
    return _in_image(mark.shares @ camera.rays(mark.columns, mark.rows), camera)


def sphere_centre(mark: Mark, camera: PinholeCamera) -> FloatArray:
    """Return where the centre of a sphere appears, (2,) px from the image's upper left corner."""
    rays = camera.rays(mark.columns, mark.rows)
    length2 = np.vecdot(rays, rays)
    return _in_image((mark.shares / (length2 * length2)) @ rays, camera)


def _in_image(direction: FloatArray, camera: PinholeCamera) -> FloatArray:
    """Return where a direction (3,) appears, (2,) px."""
    half = np.array([camera.width, camera.height]) / 2.0
    return np.asarray(half + camera.focal * direction[:2] / direction[2])
