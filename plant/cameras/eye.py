"""The contract of a sensing set-up: which features are made of the points that cameras see.

A set-up is one `Eye`: names and unit of its features, how many cameras look at which points, and the function from the
points, in the frame of each camera, to the features. Everything else follows: arm, mount, mismatch, tasks and scale.

A set-up that is added is an `Eye` in a file of its own and a line in `plant.cameras.registry`, or a file that a
user names on the command line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from servobench.plant.cameras.optics import Optics, locate, project, project_rates
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import SETTLING_BAND, BoolArray, Channel

Measure: TypeAlias = Callable[[FloatArray, Optics], FloatArray]
"""Points (..., c, p, 3) [m] in the frame of each camera, and the optics -> features (..., m)."""
Rates: TypeAlias = Callable[[FloatArray, FloatArray, Optics], FloatArray]
"""Points, their motions (..., c, p, 3, n) [m] and the optics -> the change of the features, (..., m, n)."""
Locate: TypeAlias = Callable[[FloatArray, FloatArray, Optics], FloatArray]
"""Features (..., m), depths (..., c, p) [m] and the optics -> the points that have them, (..., c, p, 3) [m]."""
DIFFERENCE: Final = 1e-6  # share of the motions over which features are differentiated


def one(focal: float, distance: float) -> float:
    """Return the natural size of a feature in metres."""
    del focal, distance
    return 1.0


def pixels_per_metre(focal: float, distance: float) -> float:
    """Return how far a point moves in the image that moves by a metre across it [px]."""
    return focal / distance


@dataclass(frozen=True)
class Eye:
    """A sensing set-up.

    Attributes:
        name: the word on the command line.
        summary: one line for `servobench sensing`.
        features: m names, used in the columns of the log.
        unit: of all features, such as "px".
        measure: makes features of points; pure, over leading axes.
        rates: its derivative along motions of the points; None: by central differences.
        locate: its inverse for points of known depth; None where there is none. With it and `single`, controllers may
            know how features change with motions of what is seen, wherever the camera is.
        scale: natural size of a feature, in its unit, for a focal length [px] and a working distance [m]: what a metre
            of motion across the optical axis changes.
        tolerance: the settling band as a share of the scale, for the norm of the error.
        cameras: c, how many there are.
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
    locate: Locate | None = None
    scale: Callable[[float, float], float] = one
    tolerance: float = SETTLING_BAND
    cameras: int = 1
    target: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),)
    single: bool = False
    closeness: float = 1.0
    least_joints: int = 1
    judges_pose: bool = False

    @property
    def m(self) -> int:
        """Number of features."""
        return len(self.features)

    def channel(self, focal: float, distance: float) -> Channel:
        """Return names, unit and natural size of the features, seen at a focal length [px] from a `distance` [m]."""
        free = np.full(self.m, np.inf)
        return Channel(self.features, self.unit, self.scale(focal, distance), -free, free, self.tolerance)

    def change(self, points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
        """Return how features of points (..., c, p, 3) change, (..., m, n), with motions (..., c, p, 3, n) [m]."""
        if self.rates is not None:
            return self.rates(points, motions, optics)
        step = DIFFERENCE * np.moveaxis(motions, -1, 0)
        there, back = self.measure(points + step, optics), self.measure(points - step, optics)
        return np.ascontiguousarray(np.moveaxis((there - back) / (2.0 * DIFFERENCE), 0, -1))

    def valid(self, seen: BoolArray) -> BoolArray:
        """Return which features are measured, (..., m), where the points (..., c, p) are seen or not."""
        lead, count = seen.shape[:-2], seen.shape[-2] * seen.shape[-1]
        if self.single:
            return np.repeat(seen.reshape(*lead, count), self.m // count, axis=-1)
        whole = np.logical_and.reduce(seen, axis=(-2, -1), keepdims=True)[..., 0]
        return np.repeat(whole, self.m, axis=-1)


def pixels(points: FloatArray, optics: Optics) -> FloatArray:
    """Return (u, v) of each point in each camera, (..., 2 c p) px."""
    return _joined(project(points, optics), 3)


def pixel_rates(points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
    """Return the change of `pixels`, (..., 2 c p, n) px."""
    rates = project_rates(points, motions, optics)
    return rates.reshape(*rates.shape[:-4], -1, rates.shape[-1])


def located(features: FloatArray, depth: FloatArray, optics: Optics) -> FloatArray:
    """Return the points that have given `pixels`, (..., c, p, 3) m."""
    return locate(features.reshape(*features.shape[:-1], *depth.shape[-2:], 2), depth, optics)


def _joined(values: FloatArray, axes: int) -> FloatArray:
    return values.reshape(*values.shape[: values.ndim - axes], -1)
