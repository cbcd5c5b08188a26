"""What there is to see in the world of a rendered plant, and the files from which an engine loads it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

from servobench.plant.rendered.meshes import BALL_MESH, sphere_obj
from servobench.plant.rendered.rig import Rig, arm_files
from servobench.plant.rendered.urdf import Box, bench_files, boxes_urdf
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.catalogue import UR5, find_robot
from servobench.plant.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class Room:
    """An arm among the things around it; the base frame is the world frame.

    Attributes:
        arm: the true kinematics.
        scenery: whether the table and the floor are there.
        boxes: what else is in the room.
        robot: by its maker's description, for the looks.
        rig: what a sensing set-up has in place of the ball on the flange; None for the ball.
    """

    arm: SerialArm
    scenery: bool
    boxes: tuple[Box, ...] = ()
    robot: Robot = field(default_factory=partial(find_robot, UR5))
    rig: Rig | None = None

    def files(self) -> dict[str, str]:
        """Return the files, text by name: a URDF for each body, that of the arm first, and the meshes they name.

        Raises:
            ValueError: the arm has another number of joints than the robot.
        """
        files = {**arm_files(self.arm, self.robot, self.rig), BALL_MESH: sphere_obj()}
        if self.scenery:
            files |= bench_files(self.robot.workspace.scale)
        if self.boxes:
            files["boxes.urdf"] = boxes_urdf(self.boxes)
        return files
