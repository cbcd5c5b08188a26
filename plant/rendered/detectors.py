"""Sensing set-ups of a rendered plant: the ball or coloured discs, found in the images of each camera.

A point of the target that is found at (u, v) lies on the ray through it, and the features are those of the points at a
depth of 1 m on these rays. A set-up whose features change with that depth needs cameras with depth, and gets the ball's
centre as fitted to depths. Nothing of what is found stems from the true robot but its image.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, Final, Generic, TypeAlias, TypeVar, final

import cv2
import numpy as np
import numpy.typing as npt

from servobench.plant.cameras.eye import Eye
from servobench.plant.cameras.model import EyeModel
from servobench.plant.cameras.optics import CAMERA, Optics, ideal_optics, locate
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.signals import BoolArray, Truth
from servobench.plant.rendered.detection import (
    OUTLINE,
    ByteArray,
    Detection,
    Patch,
    add_colour_noise,
    draw_detection,
    find_ball,
    window_around,
)
from servobench.plant.rendered.engine import Scene
from servobench.plant.rendered.marks import MARK_COLOURS, disc_centre, find_marks, sphere_centre
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.robot.camera import PinholeCamera
from servobench.plant.robot.hand_eye import HandEyeModel, SensedArm
from servobench.plant.robot.robot import Robot

NOWHERE: Final = (0.0, 0.0, 1.0)  # stands for a point that is not found, whose features are not valid
CROSS: Final = 5  # [px] half size of what marks a point that is found


Model = TypeVar("Model", bound=SensedArm)


Generators: TypeAlias = tuple[np.random.Generator, np.random.Generator]


MAX_SIZE = 1024  # [px] of an ideal picture's side: a lens that sees more is black at its edges


class Sight(ABC, Generic[Model]):
    """Cameras whose images are rendered and searched; arm and cameras are given as they are now.

    All methods take `model`, the true arm and cameras, and `q`, (n,) rad, exact joint positions at which the scene is.
    """

    @abstractmethod
    def reset(self, seed: int) -> None:
        """Draw all randomness from `seed`."""

    @abstractmethod
    def see(self, model: Model, q: FloatArray) -> FloatArray | None:
        """Return the features as seen now, (m,); None if nothing is found."""

    def visible(self) -> BoolArray | None:
        """Return which features of what was seen last are measured, (m,); None for all of them."""
        return None

    @abstractmethod
    def truth(self, model: Model, q: FloatArray) -> Truth:
        """Return the true features and their Jacobian."""

    @abstractmethod
    def why_unseen(self, model: Model, q: FloatArray) -> str:
        """Return why a feature is not seen at the start, with evidence."""

    @abstractmethod
    def picture(self, model: Model, q: FloatArray) -> ByteArray:
        """Return what the cameras see with what is found marked, (h, w, 3)."""

    @abstractmethod
    def save(self) -> Any:  # noqa: ANN401 - each sight has a state of its own
        """Return the state of what is random, as a value."""

    @abstractmethod
    def restore(self, state: Any) -> None:  # noqa: ANN401 - what `save` returned
        """Return to a state."""


@final
class Lens:
    """One camera of a set-up."""

    def __init__(self, planned: PinholeCamera, optics: Optics, camera: int) -> None:
        """Prepare where pixels are taken from.

        Args:
            planned: the camera as planned, whose picture needs no lens.
            optics: of all cameras of the set-up.
            camera: the number of this one.
        """
        own = Optics(
            optics.focal[camera : camera + 1],
            optics.centre[camera : camera + 1],
            optics.distortion[camera : camera + 1],
            optics.size,
        )
        self._ideal = planned
        self._map: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]] | None = None
        if as_planned(own, planned):
            return
        rays = _rays(planned, own)
        half = np.abs(rays[:, :2]).max(axis=0) * own.focal[0] + 2.0
        width, height = (min(MAX_SIZE, 2 * math.ceil(size)) for size in half.tolist())
        fov = 2.0 * math.degrees(math.atan(0.5 * height / own.focal[0]))
        self._ideal = replace(planned, width=width, height=height, vertical_fov=fov)
        at = self._ideal.project(rays).astype(np.float32).reshape(planned.height, planned.width, 2)
        self._map = at[..., 0], at[..., 1]

    def render(self, scene: Scene, X_BC: FloatArray) -> ByteArray:
        """Return what the camera sees from X_BC (4, 4), (h, w, 3 or 4)."""
        rgb, _ = scene.render(self._ideal, X_BC)
        return rgb if self._map is None else np.asarray(cv2.remap(rgb, *self._map, cv2.INTER_LINEAR))


def as_planned(optics: Optics, planned: PinholeCamera) -> bool:
    """Return whether cameras have the intrinsics that are planned."""
    plain = ideal_optics(planned, 1)
    return all(np.all(getattr(optics, part) == getattr(plain, part)) for part in ("focal", "centre", "distortion"))


def _rays(planned: PinholeCamera, optics: Optics) -> FloatArray:
    """Return the ray (x/z, y/z, 1) through each pixel of an image, (h w, 3)."""
    columns, rows = np.meshgrid(np.arange(planned.width), np.arange(planned.height))
    half = np.array([planned.width, planned.height]) / 2.0
    # Where a pixel is sampled, counted from the upper left corner, is what the planned camera says.
    pixels = half + planned.focal * planned.rays(columns.ravel(), rows.ravel())[:, :2]
    rays: FloatArray = locate(pixels[None], np.ones((1, 1)), optics)[0]
    return rays


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


"""Of the depth and of the colour noise."""
