"""URDF of a serial arm with a ball on its flange, and of the table and floor on which it stands.

The body frame of link i is frame i of `SerialArm` (after the rotation of joint i); the next joint sits at the arm's
fixed transform. A mismatched arm therefore turns into a mismatched simulation.

No link has a collision shape: a mismatched arm's parts may overlap at rest, and the contact solver would throw it
apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np

from servobench.plant.bullet.meshes import rectangles_obj
from servobench.plant.bullet.urdf_elements import (
    add_joint,
    add_link,
    draw_cylinder,
    draw_mesh,
    draw_sphere,
)
from servobench.plant.checks import FloatArray, as_vector, check_number
from servobench.plant.robot.arm import SerialArm, rotation_from_rpy

BASE_LINK, FLANGE_LINK, BALL_LINK = "base", "flange", "ball"
ALUMINIUM = (0.76, 0.78, 0.80, 1.0)
DARK_GREY = (0.26, 0.28, 0.31, 1.0)
LIGHT_BLUE = (0.42, 0.66, 0.86, 1.0)
RED = (0.90, 0.06, 0.05, 1.0)
TABLE_TOP = (0.86, 0.85, 0.82, 1.0)
TABLE_RIM = (0.48, 0.50, 0.53, 1.0)
FLOOR_A, FLOOR_B = (0.55, 0.59, 0.63, 1.0), (0.51, 0.55, 0.59, 1.0)
TABLE = (-0.32, -0.75, 1.15, 0.75)  # m, x and y from, x and y to
FLOOR_DROP, TILE = 0.75, 0.4  # m, floor below the table's top; side of a floor tile
LIGHT_PART = (0.001, (1e-6, 1e-6))  # kg, kg m², flange and ball: PyBullet takes 1 kg where nothing is given
BASE_PART = (4.0, (0.01, 0.01))  # kg, kg m², held fast, so without effect


@dataclass(frozen=True, eq=False)
class ArmBody:
    """Masses, torques and looks of a serial arm with n joints.

    Attributes:
        mass: (n,), kg.
        centre_of_mass: (n, 3), m, of link i in its DH frame, which is where joint i+1 sits.
        inertia: (n, 2), kg m², about the centre of mass: across the link and along it.
        max_torque: (n,), Nm.
        tube_radius: (n,), m; looks only.
        side_step: (n,), m, how far a link's tube runs beside its joints, along the joint's axis; looks only.
        ball_radius: m.
    """

    mass: FloatArray
    centre_of_mass: FloatArray
    inertia: FloatArray
    max_torque: FloatArray
    tube_radius: FloatArray
    side_step: FloatArray
    ball_radius: float

    def __post_init__(self) -> None:
        """Check shapes and signs and freeze the arrays."""
        n = len(self.mass)
        shapes = {"centre_of_mass": (n, 3), "inertia": (n, 2)}
        for name in ("mass", "centre_of_mass", "inertia", "max_torque", "tube_radius", "side_step"):
            value, shape = np.asarray(getattr(self, name), dtype=np.float64), shapes.get(name, (n,))
            if value.shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {value.shape}")
            object.__setattr__(self, name, as_vector(name, value.ravel(), value.size).reshape(shape))
        for name in ("mass", "inertia", "max_torque", "tube_radius"):
            if not (getattr(self, name) > 0.0).all():
                raise ValueError(f"{name} must be positive, got {getattr(self, name).tolist()}")
        check_number("ball_radius", self.ball_radius, above=0.0)


def arm_urdf(arm: SerialArm, body: ArmBody, ball_mesh: str) -> str:
    """Return the URDF of an arm; its joint angles are the true ones, θ.

    Args:
        arm: the kinematics, mismatch included.
        body: masses, torques and looks for the same number of joints.
        ball_mesh: name of a file beside the URDF that holds a mesh of the unit sphere.

    Returns:
        The URDF as text: the base, a link a joint in the arm's order, the flange and the ball.

    Raises:
        ValueError: `body` is for another number of joints.
    """
    if len(body.mass) != arm.n:
        raise ValueError(f"body must be for {arm.n} joints, got one for {len(body.mass)}")
    robot = ET.Element("robot", name="arm")
    links = [BASE_LINK, *(f"{name}_link" for name in arm.joint_names)]
    origins = np.stack([arm.translation, arm.rpy], axis=1)
    _draw_base(add_link(robot, BASE_LINK, *BASE_PART), arm.translation[0], body.tube_radius[0])
    for i, name in enumerate(arm.joint_names):
        step = arm.translation[i + 1]
        centre = rotation_from_rpy(arm.rpy[i + 1]) @ body.centre_of_mass[i] + step
        # A link without length, like a UR's shoulder in its calibration file, is long along its joint's axis.
        along = step if np.linalg.norm(step) > 1e-3 else (0.0, 0.0, 1.0)
        link = add_link(robot, links[i + 1], body.mass[i], body.inertia[i], centre=centre, along=along)
        _draw_link(link, step, body.tube_radius[i], body.side_step[i])
        add_joint(robot, name, (links[i], links[i + 1]), origins[i], turns=True)
    add_joint(robot, FLANGE_LINK, (links[-1], FLANGE_LINK), origins[-1], turns=False)
    _draw_tool(add_link(robot, FLANGE_LINK, *LIGHT_PART), arm.tool, body)
    add_joint(robot, BALL_LINK, (FLANGE_LINK, BALL_LINK), np.stack([arm.tool, np.zeros(3)]), turns=False)
    draw_mesh(add_link(robot, BALL_LINK, *LIGHT_PART), RED, ball_mesh, body.ball_radius)
    return _text(robot)


def bench_files() -> dict[str, str]:
    """Return the files, text by name, of the table, whose top is at z = 0 around the arm's base, and the floor below.

    `bench.urdf` is the one to load; it names the others.
    """
    robot = ET.Element("robot", name="bench")
    bench = add_link(robot, "bench", *BASE_PART)
    x0, y0, x1, y1 = TABLE
    for x in (x0 + 0.04, x1 - 0.04):
        for y in (y0 + 0.04, y1 - 0.04):
            draw_cylinder(bench, DARK_GREY, (x, y, -FLOOR_DROP), (x, y, -0.04), 0.035)
    rim = [(x0, y0, x0 + 0.02, y1), (x1 - 0.02, y0, x1, y1)]
    rim += [(x0 + 0.02, y0, x1 - 0.02, y0 + 0.02), (x0 + 0.02, y1 - 0.02, x1 - 0.02, y1)]
    top = [(x0 + 0.02, y0 + 0.02, x1 - 0.02, y1 - 0.02)]
    tiles: tuple[list[tuple[float, float, float, float]], ...] = ([], [])
    for i in range(-6, 9):
        for j in range(-7, 7):
            tiles[(i + j) % 2].append((i * TILE, j * TILE, (i + 1) * TILE, (j + 1) * TILE))
    files = {}
    for name, colour, rectangles, height in (
        ("top", TABLE_TOP, top, 0.0),
        ("rim", TABLE_RIM, rim, 0.0),
        ("floor_a", FLOOR_A, tiles[0], -FLOOR_DROP),
        ("floor_b", FLOOR_B, tiles[1], -FLOOR_DROP),
    ):
        files[f"{name}.obj"] = rectangles_obj(rectangles, height)
        draw_mesh(bench, colour, f"{name}.obj", 1.0)
    return files | {"bench.urdf": _text(robot)}


def _text(robot: ET.Element) -> str:
    ET.indent(robot)
    return ET.tostring(robot, encoding="unicode")


def _draw_base(link: ET.Element, step: FloatArray, radius: float) -> None:
    """Draw the foot on the table and the stem up to the first joint."""
    draw_cylinder(link, DARK_GREY, (0.0, 0.0, 0.0), (0.0, 0.0, 0.02), 1.45 * radius)
    draw_cylinder(link, ALUMINIUM, (0.0, 0.0, 0.02), (0.0, 0.0, 0.035), 1.2 * radius)
    draw_cylinder(link, ALUMINIUM, (0.0, 0.0, 0.0), step, radius)


def _draw_link(link: ET.Element, step: FloatArray, radius: float, side: float) -> None:
    """Draw a link: a capped housing about its joint, a tube beside it, and the way over to the next joint."""
    top, corner, end = np.array([0.0, 0.0, side]), np.array([step[0], step[1], side]), step
    far_aside = abs(side) > radius
    # The cap closes the housing's free end: beyond the tube, or opposite to where the link before comes in.
    outwards = np.array([0.0, 0.0, np.copysign(1.12 * radius, side if far_aside else -1.0)])
    draw_cylinder(link, ALUMINIUM, np.zeros(3) if far_aside else -outwards, top + outwards, 1.06 * radius)
    draw_cylinder(link, LIGHT_BLUE, top + outwards, top + 1.25 * outwards, radius)
    draw_cylinder(link, ALUMINIUM, top, corner, 0.8 * radius)
    draw_cylinder(link, DARK_GREY, corner, end, 0.95 * radius)
    if far_aside:
        draw_cylinder(link, ALUMINIUM, corner - 0.8 * outwards, corner + 0.9 * outwards, 1.02 * radius)
        draw_cylinder(link, LIGHT_BLUE, corner + 0.9 * outwards, corner + 1.1 * outwards, 0.95 * radius)
    else:
        draw_sphere(link, ALUMINIUM, corner, 0.85 * radius)


def _draw_tool(link: ET.Element, tool: FloatArray, body: ArmBody) -> None:
    """Draw the flange's plate and the stick that carries the ball."""
    draw_cylinder(link, DARK_GREY, (0.0, 0.0, -0.012), (0.0, 0.0, 0.004), 0.9 * body.tube_radius[-1])
    draw_cylinder(link, DARK_GREY, (0.0, 0.0, 0.0), tool, 0.25 * body.ball_radius)
