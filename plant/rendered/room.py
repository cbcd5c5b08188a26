"""The bodies in the world of a rendered plant: arm, table, floor, boxes, and target and cameras of a sensing set-up.

A target of one point is the red ball, one of three or four points a plate with a disc for each of them. The plate is a
cross of thin rods with a white pad behind each disc, so that it hides nothing and a disc stands out in every posture.
"""

from dataclasses import dataclass, replace
from typing import Self
from xml.etree import ElementTree as ET

import numpy as np

from servobench.plant.cameras.setups import HALF_SIDE, SetupModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered import urdf
from servobench.plant.rendered.marks import MARK_COLOURS, RED
from servobench.plant.rendered.settings import Box
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.camera import PinholeCamera
from servobench.plant.robot.robot import Robot

WHITE = (0.97, 0.97, 0.97, 1.0)
DISC_RADIUS = 0.02  # [m] for a UR5
PAD_RADIUS = 0.035  # [m] radius of the white pad behind a disc, for a UR5
LAYER = 0.001  # [m] thickness of discs and pads, for a UR5
ROD_RADIUS = 0.004  # [m] for a UR5
# [m] Radius and length of a camera on the hand, for a UR5; too near to be in its own image.
HOUSING = (0.02, 0.06)
OVERVIEW_POSITION = (1.75, -1.35, 1.35)  # [m] base frame of a UR5: from the front right
OVERVIEW_TARGET = (0.40, 0.0, 0.26)  # [m] the point on its optical axis
OVERVIEW_CAMERA = PinholeCamera(640, 480, 38.0, near=0.1, far=8.0)


@dataclass(frozen=True, eq=False)
class Room:
    """An arm and the bodies around it; the base frame is the world frame."""

    arm: SerialArm  # the true kinematics
    scenery: bool  # whether the table and the floor are there
    robot: Robot  # by its maker's description, for the visual shapes
    boxes: tuple[Box, ...] = ()  # obstacles
    # Target and cameras of a sensing set-up; None for the ball on the flange.
    model: SetupModel | None = None

    def files(self) -> dict[str, str]:
        """Return the files, text by name: a URDF for each body, that of the arm first, and the meshes they name.

        Raises:
            ValueError: the arm has another number of joints than the robot, or a target that cannot be drawn.
        """
        files = {**self._own_files(), urdf.BALL_MESH: urdf.sphere_obj()}
        if self.scenery:
            files |= urdf.bench_files(self.robot.workspace.scale)
        if self.boxes:
            files["boxes.urdf"] = urdf.boxes_urdf(self.boxes)
        return files

    def _own_files(self) -> dict[str, str]:
        """Return the files of the arm with its target or cameras, and of a target in the world."""
        tree = urdf.arm_tree(self.arm, self.robot)
        model = self.model
        fixed = model is None or model.mount == "fixed"
        if model is None or (fixed and len(model.target) == 1):  # the ball, which every arm carries
            return {"arm.urdf": urdf.text(tree)}
        # The flange carries the plate or the cameras in the place of the ball.
        (carried,) = (link for link in tree.iter("link") if link.get("name") == urdf.BALL_LINK)
        for visual in carried.findall("visual"):
            carried.remove(visual)
        if fixed:
            self._draw_target(carried, model, -self.arm.tool)
            return {"arm.urdf": urdf.text(tree)}
        radius, length = target_scale(model, self.robot) * np.array(HOUSING)
        for pose in model.cameras:
            lens = pose[:3, 3] - self.arm.tool
            back = lens - length * pose[:3, 2]
            urdf.draw_cylinder(carried, urdf.DARK_GREY, back, lens, radius)
        body = ET.Element("robot", name="target")
        urdf.add_link(body, "world", *urdf.BASE_PART)
        middle = model.target.mean(axis=0)
        target = urdf.add_link(body, "target", *urdf.BASE_PART)
        self._draw_target(target, model, -middle)
        origin = np.stack([middle, np.zeros(3)])
        urdf.add_joint(body, "place", ("world", "target"), origin, turns=False)
        return {"arm.urdf": urdf.text(tree), "target.urdf": urdf.text(body)}

    def _draw_target(self, link: ET.Element, model: SetupModel, shift: FloatArray) -> None:
        """Draw ball or plate, the points of which are shifted by (3,) [m] into a link's frame."""
        points = model.target + shift
        if len(points) == 1:
            urdf.draw_mesh(link, RED, urdf.BALL_MESH, self.robot.workspace.ball_radius)
            return
        normal = np.zeros(3)
        if len(points) > 2:
            normal = np.cross(points[1] - points[0], points[2] - points[0])
        length = np.linalg.norm(normal)
        if len(points) > len(MARK_COLOURS) or not length > 1e-9:
            raise ValueError(
                f"sensing {model.setup.name} has a target of {len(points)} points; only these can be drawn: a "
                "ball, of one point, or a plate with three or four discs that are not in line"
            )
        scale = target_scale(model, self.robot)
        # One layer away from the side of the discs: first discs, then pads, then the rods from the middle.
        back = LAYER * scale * (normal / length)
        hub = points.mean(axis=0) + 6.0 * back
        for point, colour in zip(points, MARK_COLOURS, strict=False):
            behind_disc = point + back
            behind_pad = point + 2.0 * back
            rod_end = point + 6.0 * back
            urdf.draw_cylinder(link, colour.paint, point, behind_disc, DISC_RADIUS * scale)
            urdf.draw_cylinder(link, WHITE, behind_disc, behind_pad, PAD_RADIUS * scale)
            urdf.draw_cylinder(link, urdf.DARK_GREY, hub, rod_end, ROD_RADIUS * scale)


def target_scale(model: SetupModel, robot: Robot) -> float:
    """Return the scale of all lengths of a target and its cameras, over those of a UR5's bench."""
    if robot.camera is None or len(model.target) == 1:
        return robot.workspace.scale
    side = robot.camera.keys.target.side
    if side is None:
        return robot.workspace.scale
    return side / (2.0 * HALF_SIDE)


def mark_radius(model: SetupModel, robot: Robot) -> float:
    """Return the radius [m] of a target's ball, or of its discs."""
    if len(model.target) == 1:
        return robot.workspace.ball_radius
    return DISC_RADIUS * target_scale(model, robot)


@dataclass(frozen=True, eq=False)
class Overview:
    """A camera with the whole arm in its image, for films and environments."""

    camera: PinholeCamera  # its optics
    X_BC: FloatArray  # (4, 4), its pose in the base frame

    @classmethod
    def of(cls, scale: float, fineness: float = 1.0) -> Self:
        """Return the overview of an arm.

        Args:
            scale: size of its workspace, over that of a UR5's.
            fineness: pixels for one pixel of `OVERVIEW_CAMERA`, along each side; above 1 edges become smooth once
                scaled down.
        """
        position = np.array(OVERVIEW_POSITION)
        target = np.array(OVERVIEW_TARGET)
        towards = scale * target - scale * position
        z = towards / np.linalg.norm(towards)
        x = np.cross(z, [0.0, 0.0, 1.0])  # The horizon is level.
        x /= np.linalg.norm(x)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
        pose[:3, 3] = scale * position
        distance = scale * float(np.linalg.norm(position - target))
        width = round(fineness * OVERVIEW_CAMERA.width)
        height = round(fineness * OVERVIEW_CAMERA.height)
        camera = replace(OVERVIEW_CAMERA.reaching(distance), width=width, height=height)
        return cls(camera, pose)

    def pixels(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where points (k, 3) m of the base frame appear, (k, 2) px, and their depths, (k,) m."""
        R_BC = self.X_BC[:3, :3]
        p_C = (points - self.X_BC[:3, 3]) @ R_BC
        return self.camera.project(p_C), p_C[:, 2]
