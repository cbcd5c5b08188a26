"""Generates the C sources of a model: functions of CasADi, the layout header, and the kinematic core of an arm.

The kinematic core, from the symbolic arm model, has four functions in CasADi's calling convention, which need libm
only, of the states s = [q, q̇, δ, w], parameters p and the play c, by which joints are behind their gears:

    arm_feature   s, p, c -> y                 the ball in the camera frame, or features and which of them are seen
    arm_jacobian  s, p, c -> J                 of the features, row-major, m × n
    arm_motion    s, p, c -> (p_B, ṗ_B), (δ̇, ẇ)   the target of a rigid tool, and the rates of a flexible one
    arm_forward   s, p, c, ṡ, ṗ -> (ẏ, J̇), …   forward derivatives along (ṡ, ṗ), of the rates as well
"""

import tempfile
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import casadi
import numpy as np

from servobench.fmus.variables import FIXED, INPUT, PARAMETER, STATE, ArmLayout, Layout, View
from servobench.plant.cameras.optics import Optics
from servobench.plant.cameras.symbolic import (
    SX,
    ArmGeometry,
    SetupGeometry,
    arm_frames,
    features,
    points_in_cameras,
    symbolic_rotation,
    symbols,
    valid_features,
)
from servobench.plant.contract.checks import AnyArray, NamedArrays, Shape
from servobench.plant.robot.mechanics import FREQUENCIES, MAX_PART

IN_MACROS = {ord("("): "_", ord(")"): ""}  # DER(BALL) is DER_BALL there
# Generated functions do not use all of their parameters; none of them is exported by the library.
HEAD = """/* Generated with CasADi's code generator; not meant to be edited. */
#ifdef __GNUC__
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif
#define CASADI_SYMBOL_EXPORT
#include "{name}.h"
"""
LAYOUT = """/* Generated from the table of variables; not meant to be edited. */
#ifndef LAYOUT_H
#define LAYOUT_H
{}
#endif
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
    layout: Layout, start: NamedArrays, constants: Mapping[str, float], token: str
) -> str:
    """Return the C header with sizes, offsets, start values and minima.

    Args:
        layout: groups of the model.
        start: start values, flat arrays by group; zero where there are none.
        constants: further ones by name.
        token: GUID that the importer passes to `fmi2Instantiate` or `fmi3Instantiate…`.
    """
    groups = [f"{{{layout.offsets[group.name]}, {group.size}}}" for group in layout.groups]
    values = []
    for group in layout.groups:
        group_values = np.resize(start.get(group.name, np.zeros(1)), group.size)
        values += [float(value).hex() for value in group_values]
    minima = []
    for group in layout.of_role(PARAMETER, FIXED, INPUT, STATE):
        minimum = dict(group.attributes).get("min")
        bound = "-HUGE_VAL" if minimum is None else float(minimum).hex()
        minima += [bound] * group.size
    macros = {
        "TOKEN": f'"{token}"',
        "N_GROUPS": len(layout.groups),
        "N_VALUES": layout.size,
        "N_SETTABLE": len(minima),
    }
    for name, offset in layout.offsets.items():
        macros[f"OFFSET_{name.upper().translate(IN_MACROS)}"] = offset
    macros |= constants
    macros["GROUPS"] = _initialiser(groups)
    macros["START_VALUES"] = _initialiser(values)
    macros["MINIMA"] = _initialiser(minima)
    lines = [f"#define {name} {value}" for name, value in macros.items()]
    return LAYOUT.format("\n".join(lines))


def _initialiser(values: Iterable[str]) -> str:
    """Return the initialiser of an array in C, as the value of a macro with a line for each number."""
    return "{ \\\n    " + ", \\\n    ".join(values) + "}"


@cache
def kinematics_source(layout: ArmLayout) -> str:
    """Return the C source of the kinematic core for the arm that `layout` describes."""
    return generated_source("kinematics", core_functions(layout))


def arm_constants(layout: ArmLayout) -> dict[str, float]:
    """Return the sizes, offsets and limits that the model of an arm needs beside those of every layout."""
    first, *_ = layout.computed
    work = max(function.sz_w() for function in core_functions(layout))
    return {
        "N_JOINTS": layout.by_name["joint_position"].size,
        "N_WORK": max(work, 1),
        "OFFSET_FEATURE": layout.offsets[first.name],
        "MAX_PART": MAX_PART,
        "MIN_FREQUENCY": FREQUENCIES[0],
        "MAX_FREQUENCY": FREQUENCIES[1],
    }


def core_functions(layout: ArmLayout) -> list[Any]:
    """Return the four functions of the kinematic core of an arm."""
    n = layout.by_name["joint_position"].size
    n_states = 2 * n + 6
    n_parameters = sum(group.size for group in layout.kinematic)
    s, ds, p, dp, c = symbols(s=n_states, ds=n_states, p=n_parameters, dp=n_parameters, c=n)
    feature, jacobian, motion, rates = _equations(layout, s, p, c)
    row_major = casadi.vec(jacobian.T)
    variables = casadi.vertcat(s, p)
    direction = casadi.vertcat(ds, dp)
    outputs = (casadi.vertcat(feature, row_major), rates)
    along = [casadi.jtimes(each, variables, direction) for each in outputs]
    return [
        casadi.Function("arm_feature", [s, p, c], [feature], {"cse": True}),
        casadi.Function("arm_jacobian", [s, p, c], [row_major], {"cse": True}),
        casadi.Function("arm_forward", [s, p, c, ds, dp], along, {"cse": True}),
        casadi.Function("arm_motion", [s, p, c], [motion, rates], {"cse": True}),
    ]


def _equations(layout: ArmLayout, s: SX, p: SX, c: SX) -> tuple[SX, SX, SX, SX]:
    """Return the outputs before the Jacobian, the Jacobian, motion of a rigid tool and rates of a flexible one."""
    part = {}
    for group in layout.kinematic:
        first = layout.offsets[group.name]
        part[group.name] = p[first:][: group.size]
    arm = _arm(part)
    view = layout.view
    n = c.numel()
    q, v, deflection, w = casadi.vertsplit(s, [0, n, 2 * n, 2 * n + 3, 2 * n + 6])
    phase = part["ripple_order"] * q
    x = q + part["ripple"] * casadi.sin(phase) + c
    slope = 1.0 + part["ripple"] * part["ripple_order"] * casadi.cos(phase)
    if view is None:
        feature, jacobian, place = _ball(x, part, arm, slope, deflection)
    else:
        geometry = _view(part, arm, view)
        places = points_in_cameras(x, geometry, view.mount)
        seen = valid_features(places, geometry.optics, view.setup)
        measured = features(places, geometry.optics, view.setup)
        feature = casadi.vertcat(measured, seen)
        jacobian = casadi.jacobian(measured, q)
        place = casadi.SX.zeros(3)  # only the ball hangs on a flexible tool
    speed = slope * v
    # Within its play a joint is not carried along; its gear pushes it at one end of the play only.
    pushed = casadi.if_else(speed > 0.0, c <= -part["backlash"], c >= part["backlash"])
    carried = casadi.jtimes(place, q, v * pushed)
    motion = casadi.vertcat(place, carried)
    # Rates of the flexible tool: δ̇ = w − ṗ_B, ẇ = −ω² δ − 2 ζ ω δ̇.
    omega = part["tool_frequency"]
    zeta = part["tool_damping"]
    slip = w - carried
    acceleration = -(omega**2) * deflection - 2.0 * zeta * omega * slip
    flexible = casadi.vertcat(slip, acceleration)
    rates = casadi.if_else(omega > 0.0, flexible, 0.0)
    return feature, jacobian, motion, rates


def _ball(
    q: SX, part: Mapping[str, SX], arm: ArmGeometry, slope: SX, deflection: SX
) -> tuple[SX, SX, SX]:
    """Return the ball in the camera frame, always seen; ∂y/∂q_i = g_i R_BCᵀ (z_i × (p_B − p_i)) × slope; and p_B."""
    R_BC = symbolic_rotation(part["camera_rpy"])
    axes, origins, rotation, position = arm_frames(q, arm)
    ball = position + rotation @ part["tool"]
    columns = []
    for i, (axis, origin) in enumerate(zip(axes, origins, strict=True)):
        lever = casadi.cross(axis, ball - origin)
        columns.append(slope[i] * (arm.gear_ratio[i] * lever))
    position_in_camera = R_BC.T @ (ball + deflection - part["camera_position"])
    seen = casadi.SX.ones(position_in_camera.numel())
    feature = casadi.vertcat(position_in_camera, seen)
    jacobian = R_BC.T @ casadi.horzcat(*columns)
    return feature, jacobian, ball


def _arm(part: Mapping[str, SX]) -> ArmGeometry:
    """Return the geometry of the arm from its parameters by name."""
    columns = casadi.horzcat(part["a"], part["y"], part["d"])
    angles = casadi.horzcat(part["alpha"], part["pitch"], part["yaw"])
    return ArmGeometry(
        translation=casadi.vertcat(part["base_position"].T, columns),
        rpy=casadi.vertcat(part["base_rpy"].T, angles),
        joint_offset=part["joint_offset"],
        gear_ratio=part["gear_ratio"],
    )


def _view(part: Mapping[str, SX], arm: ArmGeometry, view: View) -> SetupGeometry:
    """Return the geometry of arm, target and cameras from their parameters by name."""
    c = view.setup.cameras
    further = None
    if view.calibration:
        further = _objects(part["calibration"], (c, view.calibration))
    optics = Optics(
        focal=_objects(part["focal_length"], (c,)),
        centre=_objects(part["principal_point"], (c, 2)),
        distortion=_objects(part["distortion"], (c,)),
        size=view.size,
        further=further,
    )
    positions = casadi.vertsplit(part["camera_position"], 3)
    angles = casadi.vertsplit(part["camera_rpy"], 3)
    poses = []
    for rpy, position in zip(angles, positions, strict=True):
        poses.append((symbolic_rotation(rpy), position))
    target = casadi.vertsplit(part["target"], 3)
    return SetupGeometry(arm, target, poses, optics)


def _objects(values: SX, shape: Shape) -> AnyArray:
    """Return expressions, (k, 1), as an array of them."""
    array = np.empty(values.numel(), dtype=object)
    for k in range(array.size):
        array[k] = values[k]
    return array.reshape(shape)
