"""URDF of an arm with a ball on its flange, and of the table and floor on which it stands.

The body frame of link i is frame i of `SerialArm` (after the rotation of joint i); the next joint sits at the arm's
fixed transform. A mismatched arm therefore turns into a mismatched simulation.

The rendered arm has looks and no collision shapes, the simulated one the same cylinders and spheres as collision shapes
and no looks.
"""

from __future__ import annotations

from typing import NamedTuple
from xml.etree import ElementTree as ET

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.meshes import BALL_MESH, rectangles_obj
from servobench.plant.rendered.urdf_elements import (
    add_joint,
    add_link,
    add_visual,
    draw_cylinder,
    draw_mesh,
    draw_sphere,
    numbers,
    text,
)
from servobench.plant.robot.arm import SerialArm, rotation_from_rpy
from servobench.plant.robot.catalogue import UR5, find_robot
from servobench.plant.robot.robot import Robot

BASE_LINK, FLANGE_LINK, BALL_LINK = "base", "flange", "ball"
ALUMINIUM = (0.76, 0.78, 0.80, 1.0)
DARK_GREY = (0.26, 0.28, 0.31, 1.0)
LIGHT_BLUE = (0.42, 0.66, 0.86, 1.0)
RED = (0.90, 0.06, 0.05, 1.0)
TABLE_TOP = (0.86, 0.85, 0.82, 1.0)
TABLE_RIM = (0.48, 0.50, 0.53, 1.0)
FLOOR_A, FLOOR_B = (0.55, 0.59, 0.63, 1.0), (0.51, 0.55, 0.59, 1.0)
TABLE = (-0.32, -0.75, 1.15, 0.75)  # [m] x and y of two opposite corners
TABLE_THICKNESS = 0.04  # [m] of its top as an obstacle
FLOOR_DROP, TILE = 0.75, 0.4  # [m] floor below the table's top; side of a floor tile
LIGHT_PART = (0.001, (1e-6, 1e-6))  # [kg], [kg m²] of flange and ball; PyBullet's default is 1 kg
BASE_PART = (4.0, (0.01, 0.01))  # [kg], [kg m²]; fixed to the world, so without effect


class Box(NamedTuple):
    """A box in the room, parallel to the axes of the base frame.

    Attributes:
        name: in error messages.
        centre: (3,) [m], base frame.
        size: (3,) [m], its three sides.
    """

    name: str
    centre: tuple[float, float, float]
    size: tuple[float, float, float]


def arm_urdf(arm: SerialArm, robot: Robot | None = None) -> str:
    """Return the URDF of an arm with masses and looks of a robot; its joint angles are the true ones, θ.

    Args:
        arm: the kinematics, mismatch included.
        robot: by its maker's description; None for the UR5.

    Returns:
        The URDF as text: the base, a link a joint in the arm's order, the flange and the ball, which is drawn by a
        mesh in `BALL_MESH`.

    Raises:
        ValueError: the arm has another number of joints than the robot.
    """
    return text(arm_tree(arm, robot or find_robot(UR5)))


def arm_mechanics(arm: SerialArm, payload: float, *, shapes: bool, robot: Robot | None = None) -> str:
    """Return the URDF of an arm without looks, with a point load at the ball.

    Args:
        arm: the kinematics, mismatch included.
        payload: kg.
        shapes: whether the parts that `arm_urdf` draws are collision shapes.
        robot: by its maker's description; None for the UR5.

    Raises:
        ValueError: the arm has another number of joints than the robot.
    """
    described = robot or find_robot(UR5)
    tree = arm_tree(arm, described)
    for link in tree.iter("link"):
        for visual in link.findall("visual"):
            if not shapes:
                link.remove(visual)
                continue
            visual.tag = "collision"
            for material in visual.findall("material"):
                visual.remove(material)
            for mesh in visual.findall("geometry/mesh"):
                mesh.tag, mesh.attrib = "sphere", {"radius": repr(described.workspace.ball_radius)}
        mass = link.find("inertial/mass")
        if link.get("name") == BALL_LINK and mass is not None:
            mass.set("value", repr(LIGHT_PART[0] + payload))
    return text(tree)


def _table(scale: float) -> tuple[float, float, float, float]:
    """Return x and y of two opposite corners of the table [m], which is as large as the workspace needs."""
    x0, y0, x1, y1 = TABLE
    return scale * x0, scale * y0, scale * x1, scale * y1


def room_boxes(scale: float = 1.0) -> tuple[Box, Box]:
    """Return the table's top, `scale` times that of a UR5, and the floor as obstacles."""
    x0, y0, x1, y1 = _table(scale)
    table = (x0 + x1) / 2, (y0 + y1) / 2, -TABLE_THICKNESS / 2
    return (
        Box("table", table, (x1 - x0, y1 - y0, TABLE_THICKNESS)),
        Box("floor", (0.0, 0.0, -FLOOR_DROP - 0.5), (10.0, 10.0, 1.0)),
    )


def boxes_urdf(boxes: tuple[Box, ...]) -> str:
    """Return the URDF of a body that consists of boxes, each of which is both drawn and a collision shape."""
    robot = ET.Element("robot", name="boxes")
    body = add_link(robot, "boxes", *BASE_PART)
    for box in boxes:
        shapes = [add_visual(body, DARK_GREY, box.centre, np.zeros(3))]
        collision = ET.SubElement(body, "collision")
        ET.SubElement(collision, "origin", xyz=numbers(box.centre), rpy=numbers(np.zeros(3)))
        for geometry in (*shapes, ET.SubElement(collision, "geometry")):
            ET.SubElement(geometry, "box", size=numbers(box.size))
    return text(robot)


def arm_tree(arm: SerialArm, described: Robot) -> ET.Element:
    """Return the tree of `arm_urdf`; arguments and errors are its own."""
    own, ball_radius = described.links, described.workspace.ball_radius
    if arm.n != described.n:
        raise ValueError(f"arm must have {described.n} joints like the {described.title}, got {arm.n}")
    mass, radius, aside = own.mass.tolist(), own.radius.tolist(), own.aside.tolist()
    robot = ET.Element("robot", name="arm")
    links = [BASE_LINK, *(f"{name}_link" for name in arm.joint_names)]
    origins = np.stack([arm.translation, arm.rpy], axis=1)
    _draw_base(add_link(robot, BASE_LINK, *BASE_PART), arm.translation[0], radius[0])
    for i, name in enumerate(arm.joint_names):
        step = arm.translation[i + 1]
        R = rotation_from_rpy(arm.rpy[i + 1])
        centre = R @ own.centre[i] + step
        # A link without length, like a UR's shoulder in its calibration file, is long along its joint's axis.
        along = step if np.linalg.norm(step) > 1e-3 else (0.0, 0.0, 1.0)
        inertia = own.inertia[i] if own.inertia.ndim == 2 else R @ own.inertia[i] @ R.T
        link = add_link(robot, links[i + 1], mass[i], inertia, centre=centre, along=along)
        _draw_link(link, step, radius[i], aside[i])
        add_joint(robot, name, (links[i], links[i + 1]), origins[i], turns=True)
    add_joint(robot, FLANGE_LINK, (links[-1], FLANGE_LINK), origins[-1], turns=False)
    _draw_tool(add_link(robot, FLANGE_LINK, *LIGHT_PART), arm.tool, radius[-1], ball_radius)
    add_joint(robot, BALL_LINK, (FLANGE_LINK, BALL_LINK), np.stack([arm.tool, np.zeros(3)]), turns=False)
    draw_mesh(add_link(robot, BALL_LINK, *LIGHT_PART), RED, BALL_MESH, ball_radius)
    return robot


def bench_files(scale: float = 1.0) -> dict[str, str]:
    """Return the files, text by name, of the table, whose top is at z = 0 around the arm's base, and the floor below.

    The table is `scale` times as large as that of a UR5.

    `bench.urdf` is the one to load; it names the others.
    """
    robot = ET.Element("robot", name="bench")
    bench = add_link(robot, "bench", *BASE_PART)
    x0, y0, x1, y1 = _table(scale)
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
    return files | {"bench.urdf": text(robot)}


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


def _draw_tool(link: ET.Element, tool: FloatArray, radius: float, ball_radius: float) -> None:
    """Draw the flange's plate and the stick that carries the ball."""
    draw_cylinder(link, DARK_GREY, (0.0, 0.0, -0.012), (0.0, 0.0, 0.004), 0.9 * radius)
    draw_cylinder(link, DARK_GREY, (0.0, 0.0, 0.0), tool, 0.25 * ball_radius)
