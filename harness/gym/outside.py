"""The arm of a plant without a camera from outside: rendered at its joint positions, with the target marked."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from servobench.harness.config.registry import rendered_plant, scene_of
from servobench.harness.config.robots import find_robot
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.drawn import Drawn
from servobench.harness.run.request import RunRequest
from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.detection import ByteArray
from servobench.plant.rendered.overview import Overview
from servobench.plant.rendered.room import Room
from servobench.plant.robot.hand_eye import HandEyeModel

MARK: Final = (40, 40, 40)  # red, green, blue


class OutsideView:
    """A scene with the true arm of a run."""

    def __init__(self, drawn: Drawn, request: RunRequest) -> None:
        """Open the scene.

        Raises:
            ConfigurationError: the plant brings a robot of its own, or no engine that renders is installed.
        """
        if drawn.true is None:
            raise ConfigurationError(f"plant {request.plant} brings a robot of its own, which cannot be rendered")
        robot = find_robot(request.robot)
        self._arm, self._drawn, self._overview = drawn.true.arm, drawn, Overview.of(robot.workspace.scale)
        self._scene = scene_of(rendered_plant())(Room(self._arm, scenery=True, robot=robot))

    def picture(self, joint_position: FloatArray, target: FloatArray, *, moved: bool) -> ByteArray:
        """Return the arm, (480, 640, 3), with a cross where features are places and the ball is to be.

        Args:
            joint_position: (n,) [rad].
            target: (m,), the reference.
            moved: whether the camera was moved before, in whose frame the target is given.
        """
        self._scene.place(self._arm.joint_angle(joint_position))
        colours, _ = self._scene.render(self._overview.camera, self._overview.X_BC)
        picture = np.ascontiguousarray(colours[..., :3])
        model = self._drawn.final if moved else self._drawn.true
        if isinstance(model, HandEyeModel):
            (pixel,), (far,) = self._overview.pixels(model.to_base(target)[None])
            if far > self._overview.camera.near:
                x, y = np.round(pixel).astype(int).tolist()
                cv2.drawMarker(picture, (x, y), MARK, cv2.MARKER_TILTED_CROSS, 14, 2, cv2.LINE_AA)
        return picture

    def close(self) -> None:
        """Leave the scene."""
        self._scene.close()
