"""Sensing set-ups of a rendered plant: the ball or coloured discs, found in the images of each camera.

A point of the target that is found at (u, v) lies on the ray through it, and the features are those of the points at a
depth of 1 m on these rays. A set-up whose features change with that depth needs cameras with depth, and gets the ball's
centre as fitted to depths. Nothing of what is found stems from the true robot but its image.
"""

from __future__ import annotations

from typing import Any, Final, final

import cv2
import numpy as np

from servobench.plant.cameras.eye import Eye
from servobench.plant.cameras.model import EyeModel
from servobench.plant.cameras.optics import Optics, ideal_optics, locate
from servobench.plant.cameras.placing import CAMERA
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.signals import BoolArray, Truth
from servobench.plant.rendered.ball_sight import BallSight, DepthCamera
from servobench.plant.rendered.detection import OUTLINE, ByteArray, add_colour_noise
from servobench.plant.rendered.engine import Scene
from servobench.plant.rendered.lens import Lens
from servobench.plant.rendered.marks import MARK_COLOURS, disc_centre, find_marks, sphere_centre
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.rendered.sight import Sight
from servobench.plant.robot.hand_eye import HandEyeModel, SensedArm
from servobench.plant.robot.robot import Robot

NOWHERE: Final = (0.0, 0.0, 1.0)  # stands for a point that is not found, whose features are not valid
CROSS: Final = 5  # [px] half size of what marks a point that is found


def open_sight(model: SensedArm, scene: Scene, config: RenderedConfig, robot: Robot) -> Sight[Any]:
    """Return what the cameras of a true robot measure.

    Raises:
        ValueError: cameras that cannot be rendered.
    """
    if isinstance(model, HandEyeModel):
        return BallSight(scene, config, robot.workspace.ball_radius)
    if not isinstance(model, EyeModel):
        raise ValueError(f"model must be of an arm and its cameras, got {type(model).__name__}")  # noqa: TRY004
    if config.camera() != CAMERA:
        raise ValueError(
            f"width, height and vertical_fov are those of sensing position; the images of {model.eye.name} have "
            f"{CAMERA.width} x {CAMERA.height} px and {CAMERA.vertical_fov:g} deg"
        )
    if needs_depth(model.eye, model.optics):
        return DepthSight(model, scene, config, robot.workspace.ball_radius)
    return MarkSight(model, scene, config)


def needs_depth(eye: Eye, optics: Optics) -> bool:
    """Return whether the features change when points move along the rays on which they are seen."""
    near = _some_points(eye)
    return not np.allclose(eye.measure(near, optics), eye.measure(2.0 * near, optics), rtol=1e-9, atol=1e-9)


def _some_points(eye: Eye) -> FloatArray:
    """Return points (c, p, 3) m that all cameras see, no two alike."""
    count = eye.cameras * len(eye.target)
    points = np.stack([0.1 * np.sin(np.arange(count)), 0.1 * np.cos(np.arange(count)), np.ones(count)], axis=-1)
    return points.reshape(eye.cameras, len(eye.target), 3)


class EyeSight(Sight[EyeModel]):
    """Features of points that are found."""

    _seen: BoolArray | None = None

    def visible(self) -> BoolArray | None:
        """See `Sight.visible`."""
        return self._seen

    def truth(self, model: EyeModel, q: FloatArray) -> Truth:
        """Return the features of the true model in closed form, and their Jacobian."""
        feature, jacobian, _ = model.look(q)
        return Truth(feature, jacobian)

    def why_unseen(self, model: EyeModel, q: FloatArray) -> str:
        """Return which features are not seen, and where they would be."""
        seen = np.zeros(model.eye.m, dtype=np.bool_) if self._seen is None else self._seen
        names, true = np.array(model.eye.features)[~seen], model.feature(q)[~seen]
        wide, high = model.optics.size
        return (
            f"{', '.join(names)} cannot be seen at the start {q.round(6).tolist()}: without anything in between they "
            f"would be {true.round(1).tolist()} {model.eye.unit} in images of {wide:g} x {high:g}; the target is "
            "hidden, out of sight, too small or cut by the border"
        )

    def _measured(self, points: FloatArray, found: BoolArray, model: EyeModel) -> FloatArray:
        """Return the features, (m,), of points (c, p, 3) of which some are found, (c, p)."""
        self._seen = model.eye.valid(found)
        feature = model.eye.measure(points, model.optics)
        feature.setflags(write=False)
        return feature


def camera_poses(model: EyeModel, q: FloatArray) -> FloatArray:
    """Return the cameras in the base frame, (c, 4, 4), with the arm at `q` (n,) rad."""
    if model.mount == "fixed":
        return model.cameras
    return np.asarray(model.arm.frames(q)[-1] @ model.cameras)


@final
class MarkSight(EyeSight):
    """Cameras without depth, in whose images marks are found."""

    def __init__(self, model: EyeModel, scene: Scene, config: RenderedConfig) -> None:
        """Take a scene with the target of a set-up."""
        self._scene = scene
        self._lenses = [Lens(CAMERA, model.optics, camera) for camera in range(model.eye.cameras)]
        self._colours = MARK_COLOURS[: len(model.target)]
        self._centre = sphere_centre if len(model.target) == 1 else disc_centre
        self._deviation = config.colour_noise * config.sensing.noise_factor

    def reset(self, seed: int) -> None:
        """See `Sight.reset`."""
        self._noise = named_generator(seed, "colour_noise")

    def see(self, model: EyeModel, q: FloatArray) -> FloatArray:
        """Return the features as seen now, (m,); `visible` says which are measured."""
        found, pixels = self._find([self._noisy(image) for image in self._images(model, q)])
        points = locate(pixels, np.ones(found.shape), model.optics)
        points[~found] = NOWHERE
        return self._measured(points, found, model)

    def picture(self, model: EyeModel, q: FloatArray) -> ByteArray:
        """Return the images of all cameras side by side, with a cross at each mark that is found, (h, w, 3)."""
        images = [np.ascontiguousarray(image[..., :3]) for image in self._images(model, q)]
        for image, found, pixels in zip(images, *self._find(images), strict=True):
            for u, v in pixels[found].round().astype(int).tolist():
                cv2.drawMarker(image, (u, v), OUTLINE, cv2.MARKER_CROSS, 2 * CROSS)
        return np.concatenate(images, axis=1)

    def save(self) -> dict[str, Any]:
        """See `Sight.save`."""
        return dict(self._noise.bit_generator.state)

    def restore(self, state: dict[str, Any]) -> None:
        """See `Sight.restore`."""
        self._noise = named_generator(0, "colour_noise")
        self._noise.bit_generator.state = state

    def _images(self, model: EyeModel, q: FloatArray) -> list[ByteArray]:
        poses = camera_poses(model, q)
        return [lens.render(self._scene, pose) for lens, pose in zip(self._lenses, poses, strict=True)]

    def _noisy(self, image: ByteArray) -> ByteArray:
        """Return an image with colour noise around each mark."""
        for colour in self._colours if self._deviation > 0.0 else ():
            image = add_colour_noise(image, self._deviation, self._noise, colour.hues)
        return image

    def _find(self, images: list[ByteArray]) -> tuple[BoolArray, FloatArray]:
        """Return which marks are found, (c, p), and where, (c, p, 2) px; the middle of the image for the others."""
        marks = [find_marks(image, self._colours) for image in images]
        middle = np.array([CAMERA.width, CAMERA.height]) / 2.0
        pixels = [[middle if mark is None else self._centre(mark, CAMERA) for mark in row] for row in marks]
        return np.array([[mark is not None for mark in row] for row in marks]), np.array(pixels)


@final
class DepthSight(EyeSight):
    """Cameras with depth, which fit a sphere to the ball."""

    def __init__(self, model: EyeModel, scene: Scene, config: RenderedConfig, ball_radius: float) -> None:
        """Take a scene with a ball.

        Raises:
            ValueError: another target than a ball, or features that depend on intrinsics that are not as planned.
        """
        name = model.eye.name
        if len(model.target) > 1:
            raise ValueError(f"sensing {name} needs the depth of {len(model.target)} points; only a ball's is measured")
        points, planned = _some_points(model.eye), ideal_optics(CAMERA, model.eye.cameras)
        if (model.eye.measure(points, model.optics) != model.eye.measure(points, planned)).any():
            raise ValueError(f"sensing {name} needs depth, and the intrinsics of cameras with depth are as planned")
        self._eye = DepthCamera(scene, config, CAMERA, ball_radius)

    def reset(self, seed: int) -> None:
        """See `Sight.reset`."""
        self._eye.reset(seed)

    def see(self, model: EyeModel, q: FloatArray) -> FloatArray:
        """Return the features as seen now, (m,); `visible` says which are measured."""
        ball = model.target[0] if model.mount == "hand" else model.points(q)[0]
        balls = [self._eye.find(pose, ball) for pose in camera_poses(model, q)]
        found = np.array([[ball is not None] for ball in balls])
        points = np.array([[NOWHERE if ball is None else ball.centre] for ball in balls])
        return self._measured(points, found, model)

    def picture(self, model: EyeModel, q: FloatArray) -> ByteArray:
        """See `Sight.picture`."""
        return np.concatenate([self._eye.picture(pose) for pose in camera_poses(model, q)], axis=1)

    def save(self) -> Any:  # noqa: ANN401
        """See `Sight.save`."""
        return self._eye.save()

    def restore(self, state: Any) -> None:  # noqa: ANN401
        """See `Sight.restore`."""
        self._eye.restore(state)
