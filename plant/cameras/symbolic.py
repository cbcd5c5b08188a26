"""The symbolic twin of an arm and its cameras in CasADi: kinematics and the set-up's own function over expressions.

    θ = g ⊙ q + o,     p_B = p_flange + R_flange t,     y = h(R_BCᵀ (p_B − p_BC))

The kinematics uses the same table as `servobench.plant.robot.arm`. All functions take symbols or numbers, so that one
expression serves both a model with fixed numbers and a function (or generated C code) whose geometry is a parameter. A
set-up whose function CasADi cannot evaluate has no symbolic twin.
"""

from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple, Self, TypeAlias

import casadi
import numpy as np
import numpy.typing as npt

from servobench.plant.cameras.optics import NEAR, Optics, ideal_optics, project
from servobench.plant.cameras.setups import MIN_INCIDENCE, POSITION, SensingSetup, SetupModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import configuration_errors
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.camera import CAMERA
from servobench.plant.robot.hand_eye import HandEyeModel, Mount, RobotModel

Expressions: TypeAlias = npt.NDArray[Any]
"""An array of CasADi expressions."""
SX: TypeAlias = Any  # casadi.SX; its own annotations do not cover element access


class ArmGeometry(NamedTuple):
    """Everything that describes an arm without its ball, as CasADi symbols or constants."""

    translation: SX  # (n+1, 3), m; see `servobench.plant.robot.arm.SerialArm`
    rpy: SX  # (n+1, 3), rad
    joint_offset: SX  # o, (n,), rad
    gear_ratio: SX  # g, (n,)

    @classmethod
    def of(cls, arm: SerialArm) -> Self:
        """Return the geometry of `arm` as constants."""
        return cls(
            casadi.SX(arm.translation),
            casadi.SX(arm.rpy),
            casadi.SX(arm.joint_offset),
            casadi.SX(arm.gear_ratio),
        )


def symbols(**sizes: int) -> list[SX]:
    """Return symbols of CasADi by name with their sizes."""
    return [casadi.SX.sym(name, size) for name, size in sizes.items()]


def arm_frames(joint_position: SX, geometry: ArmGeometry) -> tuple[list[SX], list[SX], SX, SX]:
    """Return the axes z_i and origins p_i of the joints, and rotation and position of the flange, as expressions.

    Args:
        joint_position: q, (n, 1), rad, as reported.
        geometry: symbols or constants for n joints.
    """
    rotation = symbolic_rotation(geometry.rpy[0, :])
    position = geometry.translation[0, :].T
    axes = []
    origins = []
    for i in range(joint_position.numel()):
        theta = geometry.gear_ratio[i] * joint_position[i] + geometry.joint_offset[i]
        axes.append(rotation[:, 2])
        origins.append(position)
        rotation = rotation @ _turn_z(theta)
        position = position + rotation @ geometry.translation[i + 1, :].T
        rotation = rotation @ symbolic_rotation(geometry.rpy[i + 1, :])
    return axes, origins, rotation, position


@dataclass(frozen=True, eq=False)
class SetupGeometry:
    """Everything that describes an arm, its cameras and its target, as CasADi symbols or constants."""

    arm: ArmGeometry  # the arm
    target: list[SX]  # p points, each (3,) [m]
    # Rotation (3, 3) and position (3,) [m] of c cameras in the frame of their mount
    cameras: list[tuple[SX, SX]]
    optics: Optics  # their intrinsics

    @classmethod
    def of(cls, arm: SerialArm, target: FloatArray, cameras: FloatArray, optics: Optics) -> Self:
        """Return the geometry of an arm, points (p, 3) m and camera poses (c, 4, 4) as constants."""
        poses = [(casadi.SX(pose[:3, :3]), casadi.SX(pose[:3, 3])) for pose in cameras]
        points = [casadi.SX(point) for point in target]
        return cls(ArmGeometry.of(arm), points, poses, optics)


def symbolic_feature(model: RobotModel) -> casadi.Function:
    """Return q -> feature, (n,) rad -> (m,), with the numbers of `model` bound.

    Raises:
        ValueError: the set-up's function cannot be carried out over expressions.
    """
    q = casadi.SX.sym("joint_position", model.arm.n)
    setup = POSITION
    mount: Mount = "fixed"
    if isinstance(model, HandEyeModel):
        ball = model.arm.tool[None]
        optics = ideal_optics(CAMERA, 1)
        geometry = SetupGeometry.of(model.arm, ball, model.X_BC[None], optics)
    elif isinstance(model, SetupModel):
        setup = model.setup
        mount = model.mount
        geometry = SetupGeometry.of(model.arm, model.target, model.cameras, model.optics)
    else:
        raise ValueError(f"model must be of an arm and its cameras, got {type(model).__name__}")  # noqa: TRY004
    feature = features(points_in_cameras(q, geometry, mount), geometry.optics, setup)
    return casadi.Function("feature", [q], [feature], ["joint_position"], ["feature"])


def points_in_cameras(joint_position: SX, geometry: SetupGeometry, mount: Mount) -> Expressions:
    """Return the target in the frame of each camera, (1, c, p, 3) m, as expressions.

    Args:
        joint_position: q, (n, 1), rad, as reported.
        geometry: symbols or constants.
        mount: where the cameras are mounted.
    """
    # With a leading axis every part that the function takes is an array, and numpy calls the functions of its entries.
    points = np.empty((1, len(geometry.cameras), len(geometry.target), 3), dtype=object)
    *_, R_BF, p_BF = arm_frames(joint_position, geometry.arm)
    for p, target in enumerate(geometry.target):
        mounted = R_BF.T @ (target - p_BF)
        if mount == "fixed":
            mounted = p_BF + R_BF @ target
        for c, (rotation, position) in enumerate(geometry.cameras):
            p_C = rotation.T @ (mounted - position)
            points[0, c, p] = [p_C[0], p_C[1], p_C[2]]
    return points


def features(points: Expressions, optics: Optics, setup: SensingSetup) -> SX:
    """Return the features of a set-up, (m, 1), for points (1, c, p, 3).

    Raises:
        ValueError: the set-up's function cannot be carried out over expressions.
    """
    with configuration_errors(
        f"sensing {setup.name} has no symbolic twin: ", TypeError, AttributeError, RuntimeError
    ):
        made = setup.measure(points, optics)
    return casadi.vertcat(*made[0].tolist())


def valid_features(points: Expressions, optics: Optics, setup: SensingSetup) -> SX:
    """Return which features of points (1, c, p, 3) are valid, (m, 1) of ones and zeros; see `SetupModel.valid_at`."""
    pixels = project(points, optics)[0]
    half = 0.5 * np.array(optics.size)
    found = []
    for camera, points_C in enumerate(points[0]):
        front = _shows_front(points_C)
        for point, pixel in zip(points_C, pixels[camera], strict=True):
            inside_u, inside_v = (
                casadi.fabs(pixel[axis] - half[axis]) <= half[axis] for axis in (0, 1)
            )
            if optics.further is not None:
                # Beyond the largest r² the distortion turns back: x² + y² ≤ r² z².
                most = optics.further[camera, 5] * casadi.fmax(point[2], NEAR) ** 2
                turns_not_back = point[0] ** 2 + point[1] ** 2 <= most
                inside_u = casadi.logic_and(inside_u, turns_not_back)
            inside = casadi.logic_and(inside_u, inside_v)
            ahead = casadi.logic_and(point[2] > NEAR, front)
            found.append(casadi.logic_and(inside, ahead))
    if setup.single:
        repeats = setup.m // len(found)
        return casadi.vertcat(*(each for each in found for _ in range(repeats)))
    all_found = reduce(casadi.logic_and, found)
    return casadi.vertcat(*[all_found] * setup.m)


def _shows_front(points: Expressions) -> SX:
    """Return whether points (p, 3) show their front; see `MIN_INCIDENCE`."""
    if len(points) < 3:
        return casadi.SX(1.0)
    corner, *others = (casadi.vertcat(*point) for point in points)
    normal = casadi.cross(others[0] - corner, others[1] - corner)
    ray = sum(others, corner) / len(points)
    lengths = casadi.fmax(casadi.norm_2(normal) * casadi.norm_2(ray), 1e-12)
    return casadi.dot(normal, ray) / lengths > MIN_INCIDENCE


def symbolic_rotation(rpy: SX) -> SX:
    """Return Rz(yaw) Ry(pitch) Rx(roll), (3, 3), as `servobench.plant.robot.arm.rotation_from_rpy`."""
    cosines: SX = casadi.cos(rpy)
    sines: SX = casadi.sin(rpy)
    c = cosines[0]
    s = sines[0]
    turn_x = casadi.blockcat([[1, 0, 0], [0, c, -s], [0, s, c]])
    c = cosines[1]
    s = sines[1]
    turn_y = casadi.blockcat([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return _turn_z(rpy[2]) @ turn_y @ turn_x


def _turn_z(angle: SX) -> SX:
    """Return Rz(angle), (3, 3)."""
    c = casadi.cos(angle)
    s = casadi.sin(angle)
    return casadi.blockcat([[c, -s, 0], [s, c, 0], [0, 0, 1]])
