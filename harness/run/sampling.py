"""Starts and targets under sensing set-ups: drawn until the target is in view, faces the camera, and the arm is fit.

A posture is fit if the nominal cameras see all features away from the edges of their images and the true ones see them
at all, the target faces the first camera, what is on the flange is above the table, and the arm is free of contact as
far as its workspace tells that. The box of joint positions from which postures are drawn keeps away from the limits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from servobench.plant.cameras.model import EyeModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm
from servobench.plant.robot.robot import Robot

DRAWN_AT_ONCE: Final = 256
MAX_DRAWS: Final = 25_600
PLANNED_SHARE: Final = 0.8  # of the images' half sides in which the planned cameras see the features
TRUE_SHARE: Final = 0.95  # the same of the true ones
FACING: Final = 0.7  # cosine of the angle at which the target's front is seen: 45°


@dataclass(frozen=True, eq=False)
class Box:
    """Where to draw.

    Attributes:
        lower: (n,) [rad].
        upper: (n,) [rad].
        shortest: motion from start to target that the ball of the planned fixed camera would need [m].
        lowest: height of the ball, or of the camera on the hand, above the table [m].
    """

    lower: FloatArray
    upper: FloatArray
    shortest: float
    lowest: float


def draw_in_view(
    box: Box, robot: Robot, nominal: EyeModel, true: EyeModel, generator: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return joint positions of start and target, (n,) and (n,) rad.

    Args:
        box: where to draw.
        robot: the nominal one.
        nominal: the same with its cameras as planned.
        true: the true arm and cameras.
        generator: of the draws.

    Raises:
        ValueError: too few postures are fit.
    """
    least = box.shortest * nominal.noise_unit  # the same way in the image, however near the camera is
    found: list[FloatArray] = []
    for _ in range(MAX_DRAWS // DRAWN_AT_ONCE):
        drawn = generator.uniform(box.lower, box.upper, (DRAWN_AT_ONCE, robot.n))
        for posture in drawn[_fit(drawn, box, robot, nominal, true)]:
            for other in found:
                if norm(nominal.feature(posture) - nominal.feature(other)) >= least:
                    return other, posture
            found.append(posture)
    raise ValueError(
        f"{len(found)} of {MAX_DRAWS} postures in the box keep the target in view, and no two of them are far enough "
        "apart"
    )


def drawn_together(
    start: FloatArray, target: FloatArray, robot: Robot, nominal: EyeModel, true: EyeModel
) -> tuple[FloatArray, FloatArray]:
    """Return start and target of a move, (n,) and (n,) rad, drawn together in tenths until both are in view.

    They are drawn towards the arm's home, where the target is in the middle of the images.

    Raises:
        ValueError: not even near the home both are in view.
    """
    home = robot.workspace.home
    for tenths in range(10, 0, -1):
        both = home + 0.1 * tenths * (np.stack([start, target]) - home)
        if _seen(both, nominal, true).all():
            return (start, target) if tenths == 10 else (both[0], both[1])
    raise ValueError("start and target must be in view, and near the arm's home they are not; use another mismatch")


def _fit(drawn: FloatArray, box: Box, robot: Robot, nominal: EyeModel, true: EyeModel) -> npt.NDArray[np.bool_]:
    """Return which of the postures (k, n) rad are fit, (k,)."""
    fit = robot.arm.ball_position(drawn)[:, 2] >= box.lowest
    if robot.workspace.clear is not None:
        fit &= robot.workspace.clear(drawn)
    fit[fit] = _seen(drawn[fit], nominal, true)
    return np.asarray(fit)


def _seen(postures: FloatArray, nominal: EyeModel, true: EyeModel) -> npt.NDArray[np.bool_]:
    """Return in which postures (k, n) rad the cameras see all features as they should, (k,)."""
    points = nominal.points(postures)
    planned = nominal.in_view(points, PLANNED_SHARE).all(axis=-1) & (nominal.facing(points) >= FACING)
    return np.asarray(planned & true.in_view(true.points(postures), TRUE_SHARE).all(axis=-1))
