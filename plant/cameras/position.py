"""`position`: the ball's centre in the camera frame, as a camera with depth gives it; m = 3, in metres."""

from __future__ import annotations

from servobench.plant.cameras.eye import Eye
from servobench.plant.cameras.optics import Optics
from servobench.plant.contract.checks import FloatArray


def measure(points: FloatArray, optics: Optics) -> FloatArray:
    """Return y = p, (..., 3) m."""
    del optics
    return points[..., 0, 0, :]


def rates(points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
    """Return ẏ = ṗ, (..., 3, n) m."""
    del points, optics
    return motions[..., 0, 0, :, :]


POSITION = Eye("position", "the ball in 3-D, by a camera with depth", ("x", "y", "z"), "m", measure, rates)
