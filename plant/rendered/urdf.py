"""URDF of an arm with a ball on its flange, and of the table and floor on which it stands, with their meshes.

The body frame of link i is frame i of `SerialArm` (after the rotation of joint i); the next joint sits at the arm's
fixed transform. A mismatched arm therefore turns into a mismatched simulation. The rendered arm has visual and no
collision shapes, the simulated one the same cylinders and spheres as collision shapes only.

Numbers are written with `repr`, so that none loses a digit. Meshes are Wavefront OBJ text: PyBullet's own sphere is so
coarse that its front lies 6 % of the radius too deep, and its boxes draw six faces where one is enough.
"""

from functools import lru_cache
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray, IntArray
from servobench.plant.rendered.marks import RED, Colour
from servobench.plant.rendered.settings import Box
from servobench.plant.robot.arm import SerialArm, rotation_from_rpy, rpy_from_rotation
from servobench.plant.robot.robot import Robot

BASE_LINK = "base"
FLANGE_LINK = "flange"
BALL_LINK = "ball"
ALUMINIUM = (0.76, 0.78, 0.80, 1.0)
DARK_GREY = (0.26, 0.28, 0.31, 1.0)
LIGHT_BLUE = (0.42, 0.66, 0.86, 1.0)
TABLE_TOP = (0.86, 0.85, 0.82, 1.0)
TABLE_RIM = (0.48, 0.50, 0.53, 1.0)
FLOOR_A = (0.55, 0.59, 0.63, 1.0)
FLOOR_B = (0.51, 0.55, 0.59, 1.0)
TABLE = (-0.32, -0.75, 1.15, 0.75)  # [m] x and y of two opposite corners
TABLE_THICKNESS = 0.04  # [m] thickness of its top as an obstacle
FLOOR_DROP = 0.75  # [m] floor below the table's top
TILE = 0.4  # [m] side of a floor tile
RIM = 0.02  # [m] width of the table's rim
LIGHT_PART = (0.001, (1e-6, 1e-6))  # [kg], [kg m²] of flange and ball; PyBullet's default is 1 kg
BASE_PART = (4.0, (0.01, 0.01))  # [kg], [kg m²]; fixed to the world, so without effect
BALL_MESH = "ball.obj"  # file of the unit sphere in URDFs
# Halves of the sides of the golden rectangles whose corners are the vertices of an icosahedron.
EDGES = (0.5257311121191336, 0.85065080835204)
# Its triangles, each by its three vertices in hexadecimal digits.
TRIANGLES = "0b5 051 017 07a 0ab 159 5b4 ba2 a76 718 394 342 326 368 389 495 24b 62a 867 981"
BALL_SUBDIVISIONS = 4  # 5120 triangles: the front lies 0.05 % of the radius too deep


def text(robot: ET.Element) -> str:
    """Return the text of a URDF."""
    ET.indent(robot)
    return ET.tostring(robot, encoding="unicode")


def numbers(values: npt.ArrayLike) -> str:
    """Return numbers in the notation of URDF, separated by spaces."""
    return " ".join(repr(value) for value in np.asarray(values, dtype=np.float64).tolist())


def rpy_along(direction: npt.ArrayLike) -> FloatArray:
    """Return the roll, pitch, yaw, (3,) rad, that turn the z axis into `direction` (3,)."""
    x, y, z = np.asarray(direction, dtype=np.float64).tolist()
    return np.array([0.0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)])


def add_link(
    robot: ET.Element,
    name: str,
    mass: float,
    inertia: npt.ArrayLike,
    *,
    centre: npt.ArrayLike = (0.0, 0.0, 0.0),
    along: npt.ArrayLike = (0.0, 0.0, 1.0),
) -> ET.Element:
    """Add a link and return it.

    Args:
        robot: the URDF.
        name: of the link.
        mass: kg.
        inertia: kg m², about the centre of mass: (2,) across `along` and about it, or (3, 3) in the body frame.
        centre: (3,), m, centre of mass in the body frame.
        along: (3,), the direction about which the link is symmetric, in the body frame.
    """
    link = ET.SubElement(robot, "link", name=name)
    inertial = ET.SubElement(link, "inertial")
    rpy, (xx, yy, zz) = _principal(np.asarray(inertia, dtype=np.float64), along)
    ET.SubElement(inertial, "origin", xyz=numbers(centre), rpy=numbers(rpy))
    ET.SubElement(inertial, "mass", value=repr(float(mass)))
    ET.SubElement(
        inertial, "inertia", ixx=repr(xx), iyy=repr(yy), izz=repr(zz), ixy="0", ixz="0", iyz="0"
    )
    return link


def _principal(inertia: FloatArray, along: npt.ArrayLike) -> tuple[FloatArray, list[float]]:
    """Return roll, pitch, yaw [rad] of the principal axes of an inertia, and the moments about them [kg m²]."""
    if inertia.ndim == 1:
        across, about = inertia.tolist()
        return rpy_along(along), [across, across, about]
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return rpy_from_rotation(axes), moments.tolist()


def add_joint(
    robot: ET.Element, name: str, ends: tuple[str, str], origin: FloatArray, *, turns: bool
) -> None:
    """Add a joint about z, or a fixed one.

    Args:
        robot: the URDF.
        name: of the joint.
        ends: names of the parent link and of the child link.
        origin: (2, 3), the joint in the parent's frame: translation, m, and roll, pitch, yaw, rad.
        turns: whether it turns; a turning joint has no limits, as the plant holds them.
    """
    joint = ET.SubElement(robot, "joint", name=name, type="continuous" if turns else "fixed")
    ET.SubElement(joint, "parent", link=ends[0])
    ET.SubElement(joint, "child", link=ends[1])
    ET.SubElement(joint, "origin", xyz=numbers(origin[0]), rpy=numbers(origin[1]))
    if turns:
        ET.SubElement(joint, "axis", xyz="0 0 1")


def add_visual(
    link: ET.Element, colour: Colour, xyz: npt.ArrayLike, rpy: npt.ArrayLike
) -> ET.Element:
    """Add a drawn part at `xyz` (3,) m, `rpy` (3,) rad of the body frame and return its empty geometry."""
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=numbers(xyz), rpy=numbers(rpy))
    # PyBullet keeps materials by name, so every colour needs a name of its own.
    name = "rgba_" + "_".join(f"{255 * part:.0f}" for part in colour)
    material = ET.SubElement(visual, "material", name=name)
    ET.SubElement(material, "color", rgba=numbers(colour))
    return ET.SubElement(visual, "geometry")


def draw_cylinder(
    link: ET.Element, colour: Colour, start: npt.ArrayLike, end: npt.ArrayLike, radius: float
) -> None:
    """Draw a cylinder between two points (3,) m of the body frame; nothing where they coincide."""
    a = np.asarray(start, dtype=np.float64)
    b = np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(b - a))
    if length <= 1e-6:
        return
    middle = (a + b) / 2
    geometry = add_visual(link, colour, middle, rpy_along(b - a))
    ET.SubElement(geometry, "cylinder", radius=repr(float(radius)), length=repr(length))


def draw_sphere(link: ET.Element, colour: Colour, centre: npt.ArrayLike, radius: float) -> None:
    """Draw a sphere at a point (3,) m of the body frame."""
    geometry = add_visual(link, colour, centre, np.zeros(3))
    ET.SubElement(geometry, "sphere", radius=repr(float(radius)))


def draw_mesh(link: ET.Element, colour: Colour, file_name: str, scale: float) -> None:
    """Draw a mesh at the body frame's origin, `scale` times as large as in its file."""
    geometry = add_visual(link, colour, np.zeros(3), np.zeros(3))
    ET.SubElement(geometry, "mesh", filename=file_name, scale=numbers([scale] * 3))


@lru_cache(maxsize=4)
def sphere_obj(subdivisions: int = BALL_SUBDIVISIONS) -> str:
    """Return the unit sphere as a Wavefront OBJ file with normals, so that it is shaded smoothly.

    Args:
        subdivisions: how often the triangles of an icosahedron are split in four, as by trimesh, whose import takes
            half a second; 4 give 2562 vertices and a mean depth error of 0.05 % of the radius.
    """
    short, long = EDGES
    rectangle = np.array([[x * short, y * long, 0.0] for y in (1, -1) for x in (-1, 1)])
    vertices = np.concatenate([np.roll(rectangle, turn, axis=1) for turn in range(3)])
    corners = [[int(corner, 16) for corner in triangle] for triangle in TRIANGLES.split()]
    triangles = np.array(corners)
    for _ in range(subdivisions):
        vertices, triangles = _subdivided(vertices, triangles)
    points = [f"{x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines = [f"v {point}" for point in points]
    lines += [f"vn {point}" for point in points]
    # Wavefront counts from 1; on the unit sphere a vertex is its own normal.
    for a, b, c in (triangles + 1).tolist():
        lines.append(f"f {a}//{a} {b}//{b} {c}//{c}")
    return "\n".join(lines) + "\n"


def _subdivided(vertices: FloatArray, triangles: IntArray) -> tuple[FloatArray, IntArray]:
    """Return vertices (4 f, 3)/2 + 2 and triangles (4 f, 3) of a sphere whose f triangles are split in four."""
    followers = np.roll(triangles, -1, axis=1)
    edges = np.stack([triangles, followers], axis=-1).reshape(-1, 2)
    # Two triangles share each edge, and its middle: one new vertex for each pair of ends.
    descending = -np.sort(-edges, axis=1)
    pairs, place = np.unique(descending, axis=0, return_inverse=True)
    a, b, c = triangles.T
    ab, bc, ca = len(vertices) + place.reshape(-1, 3).T
    split = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1)
    middles = vertices[pairs].mean(axis=1)
    refined = np.concatenate([vertices, middles])
    length = np.sqrt(np.dot(refined**2, np.ones(3)))[:, None]
    on_sphere = refined + refined / length * (1.0 - length)
    return on_sphere, split.reshape(-1, 3)


def rectangles_obj(rectangles: list[tuple[float, float, float, float]], height: float) -> str:
    """Return horizontal rectangles that face up as a Wavefront OBJ file.

    Args:
        rectangles: x_lower, y_lower, x_upper, y_upper of each, m.
        height: z of all, m.

    Returns:
        The file's text: four vertices and two triangles a rectangle.
    """
    lines = ["vn 0 0 1"]
    for x0, y0, x1, y1 in rectangles:
        corners = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
        lines += [f"v {x!r} {y!r} {height!r}" for x, y in corners]
    for first in range(1, 4 * len(rectangles), 4):
        a, b, c, d = (f"{first + k}//1" for k in range(4))
        lines.append(f"f {a} {b} {c}")
        lines.append(f"f {a} {c} {d}")
    return "\n".join(lines) + "\n"


def arm_mechanics(arm: SerialArm, payload: float, *, robot: Robot, shapes: bool) -> str:
    """Return the URDF of an arm without visual shapes, with a point load at the ball.

    Args:
        arm: the kinematics, mismatch included.
        payload: kg.
        shapes: whether the parts that `arm_tree` draws are collision shapes.
        robot: by its maker's description, for masses and shapes.

    Raises:
        ValueError: the arm has another number of joints than the robot.
    """
    tree = arm_tree(arm, robot, payload)
    for link in tree.iter("link"):
        for visual in link.findall("visual"):
            if not shapes:
                link.remove(visual)
                continue
            visual.tag = "collision"
            for material in visual.findall("material"):
                visual.remove(material)
            for mesh in visual.findall("geometry/mesh"):
                mesh.tag = "sphere"
                mesh.attrib = {"radius": repr(robot.workspace.ball_radius)}
    return text(tree)


def room_boxes(scale: float = 1.0) -> tuple[Box, Box]:
    """Return the table's top, `scale` times that of a UR5, and the floor as obstacles."""
    x0, y0, x1, y1 = (scale * side for side in TABLE)
    centre = ((x0 + x1) / 2, (y0 + y1) / 2, -TABLE_THICKNESS / 2)
    size = (x1 - x0, y1 - y0, TABLE_THICKNESS)
    table = Box("table", centre, size)
    floor = Box("floor", (0.0, 0.0, -FLOOR_DROP - 0.5), (10.0, 10.0, 1.0))
    return table, floor


def boxes_urdf(boxes: tuple[Box, ...]) -> str:
    """Return the URDF of a body that consists of boxes, each of which is both drawn and a collision shape."""
    robot = ET.Element("robot", name="boxes")
    body = add_link(robot, "boxes", *BASE_PART)
    for box in boxes:
        drawn = add_visual(body, DARK_GREY, box.centre, np.zeros(3))
        collision = ET.SubElement(body, "collision")
        ET.SubElement(collision, "origin", xyz=numbers(box.centre), rpy=numbers(np.zeros(3)))
        solid = ET.SubElement(collision, "geometry")
        for geometry in (drawn, solid):
            ET.SubElement(geometry, "box", size=numbers(box.size))
    return text(robot)


def arm_tree(arm: SerialArm, described: Robot, payload: float = 0.0) -> ET.Element:
    """Return the URDF of an arm with masses and visual shapes of a robot; its joint angles are the true ones, θ.

    It has the base, a link a joint, the flange and the ball, which is drawn by the mesh `BALL_MESH`.

    Args:
        arm: the kinematics, mismatch included.
        described: by its maker's description, for masses and shapes.
        payload: kg, a point load at the ball.

    Raises:
        ValueError: the arm has another number of joints than the robot.
    """
    own = described.links
    ball_radius = described.workspace.ball_radius
    if arm.n != described.n:
        raise ValueError(
            f"arm must have {described.n} joints like the {described.title}, got {arm.n}"
        )
    mass = own.mass.tolist()
    radius = own.radius.tolist()
    aside = own.aside.tolist()
    robot = ET.Element("robot", name="arm")
    links = [BASE_LINK, *(f"{name}_link" for name in arm.joint_names)]
    origins = np.stack([arm.translation, arm.rpy], axis=1)
    # The base has a foot on the table and a stem up to the first joint.
    base = add_link(robot, BASE_LINK, *BASE_PART)
    draw_cylinder(base, DARK_GREY, (0.0, 0.0, 0.0), (0.0, 0.0, 0.02), 1.45 * radius[0])
    draw_cylinder(base, ALUMINIUM, (0.0, 0.0, 0.02), (0.0, 0.0, 0.035), 1.2 * radius[0])
    draw_cylinder(base, ALUMINIUM, (0.0, 0.0, 0.0), arm.translation[0], radius[0])
    for i, name in enumerate(arm.joint_names):
        step = arm.translation[i + 1]
        R = rotation_from_rpy(arm.rpy[i + 1])
        centre = R @ own.centre[i] + step
        # A link without length, like a UR's shoulder in its calibration file, is long along its joint's axis.
        along = step if np.linalg.norm(step) > 1e-3 else (0.0, 0.0, 1.0)
        inertia = own.inertia[i]
        if own.inertia.ndim == 3:  # full tensors (n, 3, 3), which turn with the link
            inertia = R @ inertia @ R.T
        link = add_link(robot, links[i + 1], mass[i], inertia, centre=centre, along=along)
        _draw_link(link, step, radius[i], aside[i])
        add_joint(robot, name or "unnamed", (links[i], links[i + 1]), origins[i], turns=True)
    add_joint(robot, "flange_mount", (links[-1], FLANGE_LINK), origins[-1], turns=False)
    # The flange has a plate and the stick that carries the ball.
    flange = add_link(robot, FLANGE_LINK, *LIGHT_PART)
    draw_cylinder(flange, DARK_GREY, (0.0, 0.0, -0.012), (0.0, 0.0, 0.004), 0.9 * radius[-1])
    draw_cylinder(flange, DARK_GREY, (0.0, 0.0, 0.0), arm.tool, 0.25 * ball_radius)
    tool = np.stack([arm.tool, np.zeros(3)])
    add_joint(robot, "ball_mount", (FLANGE_LINK, BALL_LINK), tool, turns=False)
    ball_mass, ball_inertia = LIGHT_PART
    ball = add_link(robot, BALL_LINK, ball_mass + payload, ball_inertia)
    draw_mesh(ball, RED, BALL_MESH, ball_radius)
    return robot


def bench_files(scale: float = 1.0) -> dict[str, str]:
    """Return the files, text by name, of the table, whose top is at z = 0 around the arm's base, and the floor below.

    The table is `scale` times as large as that of a UR5.

    `bench.urdf` is the one to load; it names the others.
    """
    robot = ET.Element("robot", name="bench")
    bench = add_link(robot, "bench", *BASE_PART)
    x0, y0, x1, y1 = (scale * side for side in TABLE)
    for x in (x0 + 0.04, x1 - 0.04):
        for y in (y0 + 0.04, y1 - 0.04):
            draw_cylinder(bench, DARK_GREY, (x, y, -FLOOR_DROP), (x, y, -0.04), 0.035)
    # The rim lies around the top: two strips of full length along y, two between them.
    left = x0 + RIM
    right = x1 - RIM
    front = y0 + RIM
    back = y1 - RIM
    rim = [
        (x0, y0, left, y1),
        (right, y0, x1, y1),
        (left, y0, right, front),
        (left, back, right, y1),
    ]
    top = [(left, front, right, back)]
    # Tiles of two colours like those of a chessboard.
    tiles: tuple[list[tuple[float, float, float, float]], ...] = ([], [])
    for i in range(-6, 9):
        for j in range(-7, 7):
            tile = (i * TILE, j * TILE, (i + 1) * TILE, (j + 1) * TILE)
            tiles[(i + j) % 2].append(tile)
    surfaces = (
        ("top", TABLE_TOP, top, 0.0),
        ("rim", TABLE_RIM, rim, 0.0),
        ("floor_a", FLOOR_A, tiles[0], -FLOOR_DROP),
        ("floor_b", FLOOR_B, tiles[1], -FLOOR_DROP),
    )
    files = {}
    for name, colour, rectangles, height in surfaces:
        files[f"{name}.obj"] = rectangles_obj(rectangles, height)
        draw_mesh(bench, colour, f"{name}.obj", 1.0)
    return files | {"bench.urdf": text(robot)}


def _draw_link(link: ET.Element, step: FloatArray, radius: float, side: float) -> None:
    """Draw a link: a capped housing about its joint, a tube beside it, and the connection to the next joint."""
    top = np.array([0.0, 0.0, side])
    corner = np.array([step[0], step[1], side])
    far_aside = abs(side) > radius
    # The cap closes the housing's free end: beyond the tube, or opposite to where the link before comes in.
    direction = side if far_aside else -1.0
    outwards = np.array([0.0, 0.0, np.copysign(1.12 * radius, direction)])
    inner_end = np.zeros(3) if far_aside else -outwards
    outer_end = top + outwards
    draw_cylinder(link, ALUMINIUM, inner_end, outer_end, 1.06 * radius)
    draw_cylinder(link, LIGHT_BLUE, outer_end, top + 1.25 * outwards, radius)
    draw_cylinder(link, ALUMINIUM, top, corner, 0.8 * radius)
    draw_cylinder(link, DARK_GREY, corner, step, 0.95 * radius)
    if not far_aside:
        draw_sphere(link, ALUMINIUM, corner, 0.85 * radius)
        return
    far_end = corner + 0.9 * outwards
    draw_cylinder(link, ALUMINIUM, corner - 0.8 * outwards, far_end, 1.02 * radius)
    draw_cylinder(link, LIGHT_BLUE, far_end, corner + 1.1 * outwards, 0.95 * radius)
