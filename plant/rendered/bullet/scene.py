"""What a camera sees of the arm on its table: a PyBullet world that is only looked at.

The world frame W is the arm's base frame B. Masses and contact are in `servobench.plant.rendered.bullet.mechanics`.
"""

from __future__ import annotations

import os
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servobench.plant.rendered.bullet.engine import pybullet
from servobench.plant.rendered.engine import Scene
from servobench.plant.robot.camera import PinholeCamera, view_matrix

if TYPE_CHECKING:
    from servobench.plant.contract.checks import FloatArray
    from servobench.plant.rendered.detection import ByteArray
    from servobench.plant.rendered.room import Room
    from servobench.plant.rendered.window import Window


def describe_renderer() -> str:
    """Return which engine renders images, its version, and how they arrive from it."""
    images = "" if pybullet.isNumpyEnabled() else ", built without numpy: images arrive as tuples, which is slower"
    return f"PyBullet {version('pybullet')}, software renderer TinyRenderer{images}"


class BulletScene(Scene):
    """An arm with a ball on its flange in a PyBullet world of its own; joint angles here are the true ones, θ."""

    def __init__(self, room: Room, *, window: bool = False) -> None:
        """Open a world and load the room; see `OpenScene`.

        Raises:
            ValueError: a robot with another number of joints, or a window is wanted where there is no display.
            ConnectionError: PyBullet opens no world, as too many are open.
        """
        if window and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
            raise ValueError("view needs a display, but the environment variable DISPLAY is not set")
        self._client: int = pybullet.connect(pybullet.GUI if window else pybullet.DIRECT)
        if self._client < 0:
            raise ConnectionError("PyBullet could not open a physics world")
        try:
            self._load(room)
            if window:
                self._aim_window()
        except BaseException:
            self.close()
            raise
        n = room.arm.n
        self._joints = list(range(n))
        self._ball_link = n + 1

    def _load(self, room: Room) -> None:
        client = self._client
        # With file caching PyBullet keeps every mesh that it loaded, so memory would grow with each plant.
        pybullet.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=client)
        files = room.files()
        with tempfile.TemporaryDirectory(prefix="servobench-") as folder:
            for name, text in files.items():
                (Path(folder) / name).write_text(text, encoding="utf-8")
            bodies = [
                pybullet.loadURDF(
                    str(Path(folder) / name),
                    useFixedBase=True,
                    flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
                    physicsClientId=client,
                )
                for name in files
                if name.endswith(".urdf")
            ]
        self._arm = bodies[0]

    def _aim_window(self) -> None:
        """Show the arm from the front right, without PyBullet's side panels."""
        client = self._client
        pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=client)
        pybullet.resetDebugVisualizerCamera(1.9, 50.0, -30.0, (0.3, 0.0, 0.15), physicsClientId=client)

    def place(self, theta: FloatArray) -> None:
        """See `Scene.place`."""
        for joint, angle in zip(self._joints, theta.tolist(), strict=True):
            pybullet.resetJointState(self._arm, joint, angle, physicsClientId=self._client)

    def ball_position(self) -> FloatArray:
        """See `Scene.ball_position`; from the simulator's own link state."""
        state = pybullet.getLinkState(
            self._arm, self._ball_link, computeForwardKinematics=1, physicsClientId=self._client
        )
        return np.array(state[4])

    def render(
        self, camera: PinholeCamera, X_BC: FloatArray, window: Window | None = None
    ) -> tuple[ByteArray, FloatArray]:
        """See `Scene.render`; TinyRenderer knows no window, so that all is rendered."""
        _, _, rgba, depth, _ = pybullet.getCameraImage(
            camera.width,
            camera.height,
            *(matrix.T.ravel().tolist() for matrix in (view_matrix(X_BC), camera.projection_matrix())),
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._client,
        )
        # A PyBullet built without numpy returns tuples.
        shape = (camera.height, camera.width)
        rgba, depth = np.asarray(rgba, dtype=np.uint8).reshape(*shape, 4), np.asarray(depth).reshape(shape)
        return (rgba, depth) if window is None else (window.cut(rgba), window.cut(depth))

    def close(self) -> None:
        """See `Scene.close`."""
        if self._client >= 0:
            client, self._client = self._client, -1
            if pybullet.isConnected(client):
                pybullet.disconnect(client)
