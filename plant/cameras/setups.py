"""The contract of a sensing set-up, the features that are computed from points in camera frames, and the built-in ones.

A set-up is one `SensingSetup`: names and unit of its features, the number of cameras, the points of the target, and the
function from the points, in the frame of each camera, to the features. Arm, mount, mismatch, tasks and scale follow.

    position   the ball's centre in the camera frame, by a camera with depth                        m = 3, in metres
    pixel      the ball in the image of one camera, without depth                                   m = 2, in pixels
    stereo     the ball in the images of two cameras, without depth and epipolar calibration        m = 4, in pixels
    plate      four discs on a plate in the image of one camera, for six degrees of freedom         m = 8, in pixels

A further set-up is a `SensingSetup` in this file and its name in `plant.cameras.registry`, or one in a file that a user
names on the command line.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeAlias

import numpy as np

from servobench.plant.cameras.optics import Optics, project, project_rates
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import SETTLING_BAND, BoolArray, Channel

Measure: TypeAlias = Callable[[FloatArray, Optics], FloatArray]
"""Points (..., c, p, 3) [m] in the frame of each camera, and the optics -> features (..., m)."""
Rates: TypeAlias = Callable[[FloatArray, FloatArray, Optics], FloatArray]
"""Points, their motions (..., c, p, 3, n) [m] and the optics -> the change of the features, (..., m, n)."""
DIFFERENCE: Final = 1e-6  # share of the motions over which features are differentiated


def one(focal: float, distance: float) -> float:
    """Return the natural size of a feature in metres."""
    del focal, distance
    return 1.0


def pixels_per_metre(focal: float, distance: float) -> float:
    """Return the motion in the image of a point that moves by a metre parallel to the image plane [px]."""
    return focal / distance


@dataclass(frozen=True)
class SensingSetup:
    """A sensing set-up.

    Attributes:
        name: the word on the command line.
        summary: one line for `servobench sensing`.
        features: m names, used in the columns of the log.
        unit: of all features, such as "px".
        measure: makes features of points; pure, over leading axes.
        rates: its derivative along motions of the points; None: by central differences.
        scale: natural size of a feature, in its unit, for a focal length [px] and a working distance [m]: its change
            with a metre of motion across the optical axis.
        tolerance: the settling band as a share of the scale, for the norm of the error.
        cameras: c, their number.
        target: p points of the target in a frame whose z axis leads away from the first camera; lengths of a UR5's
            bench [m].
        single: each point in each camera has features of its own, m = c p k, and only they are lost with it.
        closeness: of a fixed camera, as a share of the distance that is planned for the ball.
        least_joints: of an arm for which the features can be reached.
        judges_pose: the pose of the target is judged as well.
    """

    name: str
    summary: str
    features: tuple[str, ...]
    unit: str
    measure: Measure
    rates: Rates | None = None
    scale: Callable[[float, float], float] = one
    tolerance: float = SETTLING_BAND
    cameras: int = 1
    target: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),)
    single: bool = False
    closeness: float = 1.0
    least_joints: int = 1
    judges_pose: bool = False

    def __post_init__(self) -> None:
        """Check names and scale."""
        self.channel(500.0, 1.0)

    @property
    def m(self) -> int:
        """Number of features."""
        return len(self.features)

    def channel(self, focal: float, distance: float) -> Channel:
        """Return names, unit and natural size of the features, for a focal length [px] and a `distance` [m]."""
        free = np.full(self.m, np.inf)
        return Channel(self.features, self.unit, self.scale(focal, distance), -free, free, self.tolerance)

    def change(self, points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
        """Return how features of points (..., c, p, 3) change, (..., m, n), with motions (..., c, p, 3, n) [m]."""
        if self.rates is not None:
            return self.rates(points, motions, optics)
        step = DIFFERENCE * np.moveaxis(motions, -1, 0)
        there, back = self.measure(points + step, optics), self.measure(points - step, optics)
        return np.ascontiguousarray(np.moveaxis((there - back) / (2.0 * DIFFERENCE), 0, -1))

    def valid(self, found: BoolArray) -> BoolArray:
        """Return which features are measured, (..., m), where the points (..., c, p) are found or not."""
        lead, count = found.shape[:-2], found.shape[-2] * found.shape[-1]
        if self.single:
            return np.repeat(found.reshape(*lead, count), self.m // count, axis=-1)
        whole = np.logical_and.reduce(found, axis=(-2, -1), keepdims=True)[..., 0]
        return np.repeat(whole, self.m, axis=-1)


def pixels(points: FloatArray, optics: Optics) -> FloatArray:
    """Return (u, v) of each point in each camera, (..., 2 c p) px."""
    appeared = project(points, optics)
    return appeared.reshape(*appeared.shape[:-3], -1)


def pixel_rates(points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
    """Return the change of `pixels`, (..., 2 c p, n) px."""
    rates = project_rates(points, motions, optics)
    return rates.reshape(*rates.shape[:-4], -1, rates.shape[-1])


def position(points: FloatArray, optics: Optics) -> FloatArray:
    """Return the first point in the first camera, (..., 3) m."""
    del optics
    return points[..., 0, 0, :]


def position_rates(points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
    """Return the change of `position`, (..., 3, n) m."""
    del points, optics
    return motions[..., 0, 0, :, :]


in_pixels = partial(SensingSetup, unit="px", measure=pixels, rates=pixel_rates, scale=pixels_per_metre, single=True)
"""Make a set-up of points in images, the features of which are `pixels`."""

HALF: Final = 0.12  # [m] half side of the plate's square, at the corners of which the discs are

POSITION = SensingSetup(
    "position", "the ball in 3-D, by a camera with depth", ("x", "y", "z"), "m", position, position_rates
)
PIXEL = in_pixels("pixel", "the ball in the image of one camera", ("u", "v"))
STEREO = in_pixels(
    "stereo",
    "the ball in the images of two cameras",
    ("u1", "v1", "u2", "v2"),
    tolerance=math.sqrt(2.0) * SETTLING_BAND,  # both cameras measure a motion across both
    cameras=2,
)
PLATE = in_pixels(
    "plate",
    "four discs on a plate, for position and orientation",
    ("u1", "v1", "u2", "v2", "u3", "v3", "u4", "v4"),
    tolerance=2.0 * SETTLING_BAND,  # four discs measure a motion of the plate, as long as it does not turn
    target=((-HALF, -HALF, 0.0), (HALF, -HALF, 0.0), (HALF, HALF, 0.0), (-HALF, HALF, 0.0)),
    closeness=0.5,  # the orientation of a plate that is small in the image is measured badly
    least_joints=6,
    judges_pose=True,
)
