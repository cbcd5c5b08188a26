"""Generates the C sources of a model: functions of CasADi, the layout header, and the kinematic core of an arm.

The kinematic core, from the symbolic arm model, has three functions in CasADi's calling convention, which need libm
only:

    arm_feature   q, p -> y                    the ball in the camera frame, or features and which of them are seen
    arm_jacobian  q, p -> J                    of the features, row-major, m × n
    arm_forward   q, p, q̇, ṗ -> ẏ, J̇          forward derivatives along (q̇, ṗ)
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import numpy.typing as npt

from servobench.fmus.variables import FIXED, INPUT, PARAMETER, STATE, ArmLayout, Layout, View
from servobench.plant.cameras.optics import Optics
from servobench.plant.cameras.symbolic import (
    SX,
    ArmGeometry,
    SetupGeometry,
    arm_frames,
    features,
    points_in_cameras,
    valid_features,
)
from servobench.plant.contract.checks import FloatArray

# Generated functions do not use all of their parameters; none of them is exported by the library.
HEAD = """/* Generated with CasADi's code generator; not meant to be edited. */
#ifdef __GNUC__
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif
#define CASADI_SYMBOL_EXPORT
#include "{name}.h"
"""


def generated_source(name: str, functions: Iterable[Any]) -> str:
    """Return the file `name`.c with functions of CasADi, which `name`.h declares."""
    generator = casadi.CodeGenerator(f"{name}.c", {"with_header": False, "casadi_int": "int"})
    for function in functions:
        generator.add(function)
    with tempfile.TemporaryDirectory() as folder:
        generator.generate(f"{folder}/")
        return HEAD.format(name=name) + (Path(folder) / f"{name}.c").read_text(encoding="utf-8")


def layout_header(
    layout: Layout,
    start: Mapping[str, FloatArray],
    constants: Mapping[str, float],
    model_name: str,
    token: str,
) -> str:
    """Return the C header with sizes, offsets, start values and minima.

    Args:
        layout: groups of the model.
        start: start values, flat arrays by group; zero where there are none.
        constants: further ones by name.
        model_name: for log messages.
        token: GUID that the importer passes to `fmi2Instantiate` or `fmi3Instantiate…`.
    """
    settable = layout.of_role(PARAMETER, FIXED, INPUT, STATE)
    lines = [
        "/* Generated from the table of variables; not meant to be edited. */",
        "#ifndef LAYOUT_H",
        "#define LAYOUT_H",
    ]
    lines += [f'#define MODEL_NAME "{model_name}"', f'#define TOKEN "{token}"']
    lines += [f"#define N_GROUPS {len(layout.groups)}", f"#define N_VALUES {layout.size}"]
    lines += [f"#define N_SETTABLE {sum(group.size for group in settable)}"]
    lines += [f"#define OFFSET_{_macro(group.name)} {layout.offsets[group.name]}" for group in layout.groups]
    lines += [f"#define {name} {value!r}" for name, value in constants.items()]
    sizes = ", ".join(f"{{{layout.offsets[group.name]}, {group.size}}}" for group in layout.groups)
    zero = np.zeros(1)
    values = np.concatenate([np.resize(start.get(group.name, zero), group.size) for group in layout.groups])
    minima = [
        "-HUGE_VAL" if group.minimum is None else float(group.minimum).hex()
        for group in settable
        for _ in range(group.size)
    ]
    lines += [f"#define GROUPS {{{sizes}}}"]
    lines += [_initialiser("START_VALUES", [float(value).hex() for value in values])]
    lines += [_initialiser("MINIMA", minima), "#endif", ""]
    return "\n".join(lines)


def _macro(name: str) -> str:
    return name.upper().replace("DER(", "DER_").replace(")", "")


def _initialiser(name: str, values: list[str]) -> str:
    return f"#define {name} {{ \\\n    " + ", \\\n    ".join(values) + "}"


@cache
def kinematics_source(layout: ArmLayout) -> str:
    """Return the C source of the kinematic core for the arm that `layout` describes."""
    return generated_source("kinematics", core_functions(layout))


def arm_constants(layout: ArmLayout) -> dict[str, int]:
    """Return the sizes and offsets that the model of an arm needs beside those of every layout."""
    first, *_ = layout.computed
    work = max(function.sz_w() for function in core_functions(layout))
    return {
        "N_JOINTS": _size(layout, "joint_position"),
        "N_KINEMATIC": kinematic_size(layout),
        "N_WORK": max(work, 1),
        "OFFSET_FEATURE": layout.offsets[first.name],
    }


def kinematic_size(layout: ArmLayout) -> int:
    """Return the number of kinematic parameters."""
    return sum(group.size for group in layout.kinematic)


def core_functions(layout: ArmLayout) -> list[Any]:
    """Return the three functions of the kinematic core of an arm."""
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
        return _ball(q, part, arm)
    geometry = _view(part, arm, view)
    points = points_in_cameras(q, geometry, view.mount)
    feature = features(points, geometry.optics, view.setup)
    seen = valid_features(points, geometry.optics, view.setup)
    return casadi.vertcat(feature, seen), casadi.jacobian(feature, q)


def _ball(q: SX, part: Mapping[str, SX], arm: ArmGeometry) -> tuple[SX, SX]:
    """Return the ball in the camera frame, always seen, and ∂y/∂q_i = g_i R_BCᵀ (z_i × (p_B − p_i))."""
    R_BC = _rotation(part["camera_rpy"])
    axes, origins, rotation, position = arm_frames(q, arm)
    ball = position + rotation @ part["tool"]
    columns = [
        arm.gear_ratio[i] * casadi.cross(axis, ball - origin)
        for i, (axis, origin) in enumerate(zip(axes, origins, strict=True))
    ]
    feature = R_BC.T @ (ball - part["camera_position"])
    return casadi.vertcat(feature, casadi.SX.ones(feature.numel())), R_BC.T @ casadi.horzcat(*columns)


def _arm(part: Mapping[str, SX]) -> ArmGeometry:
    columns = casadi.horzcat(part["a"], part["y"], part["d"])
    angles = casadi.horzcat(part["alpha"], part["pitch"], part["yaw"])
    return ArmGeometry(
        translation=casadi.vertcat(part["base_position"].T, columns),
        rpy=casadi.vertcat(part["base_rpy"].T, angles),
        joint_offset=part["joint_offset"],
        gear_ratio=part["gear_ratio"],
    )


def _view(part: Mapping[str, SX], arm: ArmGeometry, view: View) -> SetupGeometry:
    c = view.setup.cameras
    optics = Optics(
        _objects(part["focal_length"], (c,)),
        _objects(part["principal_point"], (c, 2)),
        _objects(part["distortion"], (c,)),
        view.size,
    )
    positions, angles = (casadi.vertsplit(part[name], 3) for name in ("camera_position", "camera_rpy"))
    poses = [(_rotation(rpy), position) for rpy, position in zip(angles, positions, strict=True)]
    return SetupGeometry(arm, casadi.vertsplit(part["target"], 3), poses, optics)


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
