"""Generates the C code that depends on the arm: its kinematics, from the symbolic arm model.

The kinematic core has three functions in CasADi's calling convention. They need libm only:

    arm_feature   q, p -> y                    the ball in the camera frame, or features and which of them are seen
    arm_jacobian  q, p -> J                    of the features, row-major, m × n
    arm_forward   q, p, q̇, ṗ -> ẏ, J̇          forward derivatives along (q̇, ṗ)
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi
import numpy as np
import numpy.typing as npt

from servobench.fmus.eye_variables import View
from servobench.fmus.source import generated_source
from servobench.fmus.variables import ArmLayout
from servobench.plant.cameras.optics import Optics
from servobench.plant.cameras.symbolic import (
    SX,
    ArmGeometry,
    EyeGeometry,
    HandEyeGeometry,
    feature_and_jacobian,
    features,
    points_in_cameras,
    seen_features,
)


def kinematics_source(layout: ArmLayout) -> str:
    """Return the C source of the kinematic core for the arm that `layout` describes."""
    return generated_source("kinematics", _core_functions(layout))


def arm_constants(layout: ArmLayout) -> dict[str, int]:
    """Return the sizes and offsets that the model of an arm needs beside those of every layout."""
    first, *_ = layout.computed
    work = max(function.sz_w() for function in _core_functions(layout))
    return {
        "N_JOINTS": _size(layout, "joint_position"),
        "N_KINEMATIC": kinematic_size(layout),
        "N_WORK": max(work, 1),
        "OFFSET_FEATURE": layout.offsets[first.name],
    }


def kinematic_size(layout: ArmLayout) -> int:
    """Return the number of kinematic parameters."""
    return sum(group.size for group in layout.kinematic)


def _core_functions(layout: ArmLayout) -> list[Any]:
    n = _size(layout, "joint_position")
    q, p = casadi.SX.sym("q", n), casadi.SX.sym("p", kinematic_size(layout))
    dq, dp = casadi.SX.sym("dq", n), casadi.SX.sym("dp", kinematic_size(layout))
    feature, jacobian = _equations(layout, q, p)
    row_major = casadi.vec(jacobian.T)
    along = casadi.jtimes(casadi.vertcat(feature, row_major), casadi.vertcat(q, p), casadi.vertcat(dq, dp))
    return [
        casadi.Function("arm_feature", [q, p], [feature], {"cse": True}),
        casadi.Function("arm_jacobian", [q, p], [row_major], {"cse": True}),
        casadi.Function("arm_forward", [q, p, dq, dp], [along], {"cse": True}),
    ]


def _equations(layout: ArmLayout, q: SX, p: SX) -> tuple[SX, SX]:
    """Return the outputs before the Jacobian and the Jacobian, for joint positions and kinematic parameters."""
    part = {group.name: p[layout.offsets[group.name] :][: group.size] for group in layout.kinematic}
    arm, view = _arm(part), layout.view
    if view is None:
        ball = HandEyeGeometry(*arm, part["tool"], _rotation(part["camera_rpy"]), part["camera_position"])
        feature, jacobian = feature_and_jacobian(q, ball)
        return casadi.vertcat(feature, casadi.SX.ones(feature.numel())), jacobian
    geometry = _view(part, arm, view)
    points = points_in_cameras(q, geometry, view.mount)
    feature = features(points, geometry.optics, view.eye)
    seen = seen_features(points, geometry.optics, view.eye)
    return casadi.vertcat(feature, seen), casadi.jacobian(feature, q)


def _arm(part: Mapping[str, SX]) -> ArmGeometry:
    columns = casadi.horzcat(part["a"], part["y"], part["d"])
    angles = casadi.horzcat(part["alpha"], part["pitch"], part["yaw"])
    return ArmGeometry(
        translation=casadi.vertcat(part["base_position"].T, columns),
        rpy=casadi.vertcat(part["base_rpy"].T, angles),
        joint_offset=part["joint_offset"],
        gear_ratio=part["gear_ratio"],
    )


def _view(part: Mapping[str, SX], arm: ArmGeometry, view: View) -> EyeGeometry:
    c = view.eye.cameras
    optics = Optics(
        _objects(part["focal_length"], (c,)),
        _objects(part["principal_point"], (c, 2)),
        _objects(part["distortion"], (c,)),
        view.size,
    )
    positions, angles = (casadi.vertsplit(part[name], 3) for name in ("camera_position", "camera_rpy"))
    poses = [(_rotation(rpy), position) for rpy, position in zip(angles, positions, strict=True)]
    return EyeGeometry(arm, casadi.vertsplit(part["target"], 3), poses, optics)


def _objects(values: SX, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """Return expressions, (k, 1), as an array of them."""
    array = np.empty(values.numel(), dtype=object)
    for k in range(array.size):
        array[k] = values[k]
    return array.reshape(shape)


def _rotation(rpy: SX) -> SX:
    """Rz(yaw) Ry(pitch) Rx(roll), as `servobench.plant.robot.arm.rotation_from_rpy`."""
    (cr, cp, cy), (sr, sp, sy) = (casadi.vertsplit(f(rpy)) for f in (casadi.cos, casadi.sin))
    return casadi.vertcat(
        casadi.horzcat(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        casadi.horzcat(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        casadi.horzcat(-sp, cp * sr, cp * cr),
    )


def _size(layout: ArmLayout, name: str) -> int:
    return next(group.size for group in layout.groups if group.name == name)
