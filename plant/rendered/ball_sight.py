"""The sensing `position` of a rendered plant: the ball's centre in 3-D, fitted to noisy depths of an RGB-D camera."""

from __future__ import annotations

import copy
from typing import TypeAlias, final

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.signals import Truth
from servobench.plant.rendered.detection import ByteArray, Detection, Patch, add_colour_noise, draw_detection, find_ball
from servobench.plant.rendered.engine import Scene
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.rendered.sight import Sight
from servobench.plant.rendered.window import window_around
from servobench.plant.robot.camera import PinholeCamera
from servobench.plant.robot.hand_eye import HandEyeModel

Generators: TypeAlias = tuple[np.random.Generator, np.random.Generator]
"""Of the depth and of the colour noise."""


@final
class DepthCamera:
    """The noise of an RGB-D camera and the ball in its images; depth and colour noise have random streams of their own.

    Noise is drawn only where the ball's colour is.
    """

    def __init__(self, scene: Scene, config: RenderedConfig, camera: PinholeCamera, radius: float) -> None:
        """Take a scene and the radius of its ball [m]."""
        self.camera, self.radius = camera, radius
        self._scene, self._depth_noise = scene, config.noise()
        self._deviation = config.colour_noise * config.sensing.noise_factor

    def reset(self, seed: int) -> None:
        """Draw all noise from `seed`."""
        self._noise, self._colour_noise = named_generator(seed, "depth_noise"), named_generator(seed, "colour_noise")

    def save(self) -> Generators:
        """Return the state of the noise."""
        return copy.deepcopy((self._noise, self._colour_noise))

    def restore(self, state: Generators) -> None:
        """Return to a state of the noise."""
        self._noise, self._colour_noise = copy.deepcopy(state)

    def find(self, X_BC: FloatArray, ball: FloatArray) -> Detection | None:
        """Return the ball as a camera sees it, or None.

        Args:
            X_BC: (4, 4), the camera.
            ball: (3,) [m], where it is in the base frame: no more of the image is rendered than what can show it.
        """
        window = window_around(X_BC[:3, :3].T @ (ball - X_BC[:3, 3]), self.radius, self.camera)
        if window is None:
            return None
        rgba, buffer = self._scene.render(self.camera, X_BC, window)
        if self._deviation > 0.0:
            rgba = add_colour_noise(rgba, self._deviation, self._colour_noise)
        return find_ball(rgba, buffer, self.camera, self.radius, self._sense, (window.top, window.left))

    def picture(self, X_BC: FloatArray) -> ByteArray:
        """Return what a camera at X_BC (4, 4) sees without noise, with the detected ball marked, (h, w, 3)."""
        rgba, buffer = self._scene.render(self.camera, X_BC)
        found = find_ball(rgba, buffer, self.camera, self.radius)
        return draw_detection(rgba[..., :3], found, self.camera, self.radius)

    def _sense(self, depth: FloatArray, patch: Patch) -> FloatArray:
        return self._depth_noise.apply(depth, (patch.rows, patch.columns), self.camera, self._noise)


@final
class BallSight(Sight[HandEyeModel]):
    """A fixed RGB-D camera; y = centre of the ball on the flange."""

    def __init__(self, scene: Scene, config: RenderedConfig, ball_radius: float) -> None:
        """Take a scene with a ball on the flange."""
        self._scene, self._eye = scene, DepthCamera(scene, config, config.camera(), ball_radius)

    def reset(self, seed: int) -> None:
        """See `Sight.reset`."""
        self._eye.reset(seed)

    def see(self, model: HandEyeModel, q: FloatArray) -> FloatArray | None:
        """Return the ball's centre as the sensor sees it, (3,) m, or None."""
        found = self._eye.find(model.X_BC, self._scene.ball_position())
        if found is None:
            return None
        found.centre.setflags(write=False)
        return found.centre

    def truth(self, model: HandEyeModel, q: FloatArray) -> Truth:
        """Return the feature by the simulator's own ball, and the Jacobian of the true model."""
        return Truth(model.to_camera(self._scene.ball_position()), model.jacobian(q))

    def why_unseen(self, model: HandEyeModel, q: FloatArray) -> str:
        """Return where the ball is and would appear."""
        true, camera = model.to_camera(self._scene.ball_position()), self._eye.camera
        return (
            f"the ball is not visible at the start {q.round(6).tolist()}: it is at {true.round(3).tolist()} m in "
            f"the camera frame, column and row {camera.project(true).round(1).tolist()} of an image of "
            f"{camera.width} x {camera.height}; it is hidden, out of sight, too small or cut "
            "by the border"
        )

    def picture(self, model: HandEyeModel, q: FloatArray) -> ByteArray:
        """See `Sight.picture`."""
        return self._eye.picture(model.X_BC)

    def save(self) -> Generators:
        """See `Sight.save`."""
        return self._eye.save()

    def restore(self, state: Generators) -> None:
        """See `Sight.restore`."""
        self._eye.restore(state)
