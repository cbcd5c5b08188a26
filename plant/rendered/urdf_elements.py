"""The elements of a URDF: links with their inertia, joints, and parts that are drawn.

Numbers are written with `repr`, so that none loses a digit.
"""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.arm import rpy_from_rotation

Colour = tuple[float, float, float, float]


def text(robot: ET.Element) -> str:
    """Return a URDF as text."""
    ET.indent(robot)
    return ET.tostring(robot, encoding="unicode")


def numbers(values: npt.ArrayLike) -> str:
    """Return numbers as URDF writes them, with spaces between."""
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
    ET.SubElement(inertial, "inertia", ixx=repr(xx), iyy=repr(yy), izz=repr(zz), ixy="0", ixz="0", iyz="0")
    return link


def _principal(inertia: FloatArray, along: npt.ArrayLike) -> tuple[FloatArray, list[float]]:
    """Return roll, pitch, yaw [rad] of the principal axes of an inertia, and the moments about them [kg m²]."""
    if inertia.ndim == 1:
        across, about = inertia.tolist()
        return rpy_along(along), [across, across, about]
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return rpy_from_rotation(axes), moments.tolist()


def add_joint(robot: ET.Element, name: str, ends: tuple[str, str], origin: FloatArray, *, turns: bool) -> None:
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


def add_visual(link: ET.Element, colour: Colour, xyz: npt.ArrayLike, rpy: npt.ArrayLike) -> ET.Element:
    """Add a drawn part at `xyz` (3,) m, `rpy` (3,) rad of the body frame and return its empty geometry."""
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=numbers(xyz), rpy=numbers(rpy))
    # PyBullet keeps materials by name, so every colour needs a name of its own.
    material = ET.SubElement(visual, "material", name="rgba_" + "_".join(f"{255 * part:.0f}" for part in colour))
    ET.SubElement(material, "color", rgba=numbers(colour))
    return ET.SubElement(visual, "geometry")


def draw_cylinder(link: ET.Element, colour: Colour, start: npt.ArrayLike, end: npt.ArrayLike, radius: float) -> None:
    """Draw a cylinder between two points (3,) m of the body frame; nothing where they coincide."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.linalg.norm(b - a))
    if length > 1e-6:
        geometry = add_visual(link, colour, (a + b) / 2, rpy_along(b - a))
        ET.SubElement(geometry, "cylinder", radius=repr(float(radius)), length=repr(length))


def draw_sphere(link: ET.Element, colour: Colour, centre: npt.ArrayLike, radius: float) -> None:
    """Draw a sphere at a point (3,) m of the body frame."""
    geometry = add_visual(link, colour, centre, np.zeros(3))
    ET.SubElement(geometry, "sphere", radius=repr(float(radius)))


def draw_mesh(link: ET.Element, colour: Colour, file_name: str, scale: float) -> None:
    """Draw a mesh at the body frame's origin, `scale` times as large as in its file."""
    geometry = add_visual(link, colour, np.zeros(3), np.zeros(3))
    ET.SubElement(geometry, "mesh", filename=file_name, scale=numbers([scale] * 3))
