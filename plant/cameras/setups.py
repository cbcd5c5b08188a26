"""The sensing set-ups of this package.

position   the ball's centre in the camera frame, by a camera with depth                        m = 3, in metres
pixel      the ball in the image of one camera, without depth                                   m = 2, in pixels
stereo     the ball in the images of two cameras, without depth and epipolar calibration        m = 4, in pixels
plate      four discs on a plate in the image of one camera, for six degrees of freedom         m = 8, in pixels
"""

from __future__ import annotations

import math
from typing import Final

from servobench.plant.cameras.eye import Eye, located, pixel_rates, pixels, pixels_per_metre
from servobench.plant.cameras.optics import Optics
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import SETTLING_BAND


def measure(points: FloatArray, optics: Optics) -> FloatArray:
    """Return y = p, (..., 3) m."""
    del optics
    return points[..., 0, 0, :]


def rates(points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
    """Return ẏ = ṗ, (..., 3, n) m."""
    del points, optics
    return motions[..., 0, 0, :, :]


POSITION = Eye("position", "the ball in 3-D, by a camera with depth", ("x", "y", "z"), "m", measure, rates)
PIXEL = Eye(
    name="pixel",
    summary="the ball in the image of one camera",
    features=("u", "v"),
    unit="px",
    measure=pixels,
    rates=pixel_rates,
    locate=located,
    scale=pixels_per_metre,
    single=True,
)


STEREO = Eye(
    name="stereo",
    summary="the ball in the images of two cameras",
    features=("u1", "v1", "u2", "v2"),
    unit="px",
    measure=pixels,
    rates=pixel_rates,
    locate=located,
    scale=pixels_per_metre,
    tolerance=math.sqrt(2.0) * SETTLING_BAND,  # both cameras see a motion across both
    cameras=2,
    single=True,
)


HALF: Final = 0.12  # [m] half side of the square at whose corners the discs are

PLATE = Eye(
    name="plate",
    summary="four discs on a plate, for position and orientation",
    features=("u1", "v1", "u2", "v2", "u3", "v3", "u4", "v4"),
    unit="px",
    measure=pixels,
    rates=pixel_rates,
    locate=located,
    scale=pixels_per_metre,
    tolerance=2.0 * SETTLING_BAND,  # four discs see a motion of the plate, as long as it does not turn
    target=((-HALF, -HALF, 0.0), (HALF, -HALF, 0.0), (HALF, HALF, 0.0), (-HALF, HALF, 0.0)),
    single=True,
    closeness=0.5,  # a plate that is small in the image tells little about its orientation
    least_joints=6,
    judges_pose=True,
)
