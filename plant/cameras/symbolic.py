"""The symbolic twin of every arm and its cameras in CasADi: the set-up's own function over expressions.

The kinematics is written from the same table as `servobench.plant.robot.symbolic`; the features are those that the
set-up makes of an array of expressions. A set-up whose function CasADi cannot carry out has no symbolic twin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self, TypeAlias

import casadi
import numpy as np
import numpy.typing as npt

from servobench.plant.cameras.eye import Eye
from servobench.plant.cameras.model import MIN_FACING, EyeModel, Mount
from servobench.plant.cameras.optics import NEAR, Optics, project
from servobench.plant.robot.hand_eye import HandEyeModel
from servobench.plant.robot.sensed import SensedArm
from servobench.plant.robot.symbolic import SX, ArmGeometry, arm_frames
from servobench.plant.robot.symbolic import symbolic_feature as symbolic_ball

Expressions: TypeAlias = npt.NDArray[Any]
"""An array of CasADi expressions."""


@dataclass(frozen=True, eq=False)
class EyeGeometry:
    """Everything that describes an arm, its cameras and its target, as CasADi symbols or constants.

    Attributes:
        arm: the arm.
        target: p points, each (3,) [m].
        cameras: of c cameras rotation (3, 3) and position (3,) [m] in the frame that they are mounted on.
        optics: their intrinsics.
    """

    arm: ArmGeometry
    target: list[SX]
    cameras: list[tuple[SX, SX]]
    optics: Optics

    @classmethod
    def of(cls, model: EyeModel) -> Self:
        """Return the geometry of `model` as constants."""
        poses = [(casadi.SX(pose[:3, :3]), casadi.SX(pose[:3, 3])) for pose in model.cameras]
        return cls(ArmGeometry.of(model.arm), [casadi.SX(point) for point in model.target], poses, model.optics)


def symbolic_feature(model: SensedArm) -> casadi.Function:
    """Return q -> feature, (n,) rad -> (m,), with the numbers of `model` bound.

    Raises:
        ValueError: the set-up's function cannot be carried out over expressions.
    """
    if isinstance(model, HandEyeModel):
        return symbolic_ball(model)
    if not isinstance(model, EyeModel):
        raise ValueError(f"model must be of an arm and its cameras, got {type(model).__name__}")  # noqa: TRY004
    q = casadi.SX.sym("joint_position", model.arm.n)
    geometry = EyeGeometry.of(model)
    feature = features(points_in_cameras(q, geometry, model.mount), geometry.optics, model.eye)
    return casadi.Function("feature", [q], [feature], ["joint_position"], ["feature"])


def points_in_cameras(joint_position: SX, geometry: EyeGeometry, mount: Mount) -> Expressions:
    """Return the target in the frame of each camera, (1, c, p, 3) m, as expressions.

    Args:
        joint_position: q, (n, 1), rad, as reported.
        geometry: symbols or constants.
        mount: of the cameras.
    """
    # A leading axis keeps whatever the function takes apart an array, whose entries numpy asks for their own functions.
    points = np.empty((1, len(geometry.cameras), len(geometry.target), 3), dtype=object)
    *_, flange, place = arm_frames(joint_position, geometry.arm)
    for p, target in enumerate(geometry.target):
        mounted = place + flange @ target if mount == "fixed" else flange.T @ (target - place)
        for c, (rotation, position) in enumerate(geometry.cameras):
            seen = rotation.T @ (mounted - position)
            points[0, c, p] = [seen[0], seen[1], seen[2]]
    return points


def features(points: Expressions, optics: Optics, eye: Eye) -> SX:
    """Return what a set-up makes of points (1, c, p, 3), (m, 1).

    Raises:
        ValueError: the set-up's function cannot be carried out over expressions.
    """
    try:
        made: Any = eye.measure(points, optics)
    except (TypeError, AttributeError, RuntimeError, NotImplementedError) as error:
        raise ValueError(f"sensing {eye.name} has no symbolic twin: {error}") from error
    return casadi.vertcat(*made[0].tolist())


def seen_features(points: Expressions, optics: Optics, eye: Eye) -> SX:
    """Return which features are seen of points (1, c, p, 3), (m, 1) of ones and zeros; see `EyeModel.in_view`."""
    pixels, half = project(points, optics)[0], 0.5 * np.array(optics.size)
    seen = []
    for points_of_camera, pixels_of_camera in zip(points[0], pixels, strict=True):
        front = _facing(points_of_camera)
        for point, pixel in zip(points_of_camera, pixels_of_camera, strict=True):
            inside = [casadi.fabs(pixel[axis] - half[axis]) <= half[axis] for axis in (0, 1)]
            seen.append(casadi.logic_and(casadi.logic_and(*inside), casadi.logic_and(point[2] > NEAR, front)))
    if eye.single:
        return casadi.vertcat(*(each for each in seen for _ in range(eye.m // len(seen))))
    whole = seen[0]
    for each in seen[1:]:
        whole = casadi.logic_and(whole, each)
    return casadi.vertcat(*[whole] * eye.m)


def _facing(points: Expressions) -> SX:
    """Return whether points (p, 3) show their front; see `MIN_FACING`."""
    if len(points) < 3:
        return casadi.SX(1.0)
    at = [casadi.vertcat(*point) for point in points]
    normal, sight = casadi.cross(at[1] - at[0], at[2] - at[0]), sum(at[1:], at[0]) / len(at)
    lengths = casadi.fmax(casadi.norm_2(normal) * casadi.norm_2(sight), 1e-12)
    return casadi.dot(normal, sight) / lengths > MIN_FACING
