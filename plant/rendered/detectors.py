"""Detectors of a rendered plant: the ball or coloured discs, found in the images of each camera.

The sensing `position` is the ball's centre in 3-D, fitted to noisy depths of an RGB-D camera. For other set-ups, a
point of the target that is found at (u, v) lies on the ray through it, and the features are those of the points at a
depth of 1 m on these rays. A set-up whose features change with that depth needs cameras with depth, and gets the ball's
centre as fitted to depths. A detector uses nothing of the true robot but its images.

Engines render pinholes with square pixels and the principal point in the middle. A `Lens` makes an image with another
focal length, principal point or distortion of such an ideal image, which is larger where the lens has a wider view, by
taking each pixel (u, v) from where the ray through it meets the ideal image.

The noise of a depth sensor is z_measured = quantise(z + factor σ(z) w), w of unit variance and alike over a patch.
Models: stereo, RMS(z) = z² · subpixel / (f_native · baseline) (Intel, "Tuning D435 and D415 for best performance");
structured light, σ(z) = 0.0012 + 0.0019 (z − 0.4)² m (Nguyen, Izadi and Lovell 2012). A match compares patches of
pixels, so that neighbouring depths share their error: the noise is white noise smoothed by a Gaussian of the patch's
second moment and scaled back to unit variance.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Generic, NamedTuple, Self, TypeVar, final

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import convolve1d

from servobench.plant.cameras.optics import Optics, ideal_optics, locate
from servobench.plant.cameras.setups import SensingSetup, SetupModel
from servobench.plant.contract.checks import FloatArray, Floats32
from servobench.plant.contract.lanes import take
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.signals import BoolArray, Truth
from servobench.plant.rendered.detection import (
    OUTLINE,
    ByteArray,
    Detection,
    Patch,
    Window,
    add_colour_noise,
    draw_detection,
    find_ball,
    find_patch,
    locate_ball,
    window_around,
    window_around_all,
)
from servobench.plant.rendered.engine import Scene
from servobench.plant.rendered.marks import (
    MARK_COLOURS,
    Mark,
    disc_centre,
    find_marks,
    sphere_centre,
)
from servobench.plant.rendered.room import mark_radius
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.robot.camera import CAMERA, PinholeCamera
from servobench.plant.robot.hand_eye import HandEyeModel, RobotModel
from servobench.plant.robot.robot import Robot

MAX_SIZE = (
    1024  # [px] largest side of an ideal image: a lens with a wider view is black at its edges
)
# Stands for a point that is not found, whose features are not valid.
NOWHERE = (0.0, 0.0, 1.0)
CROSS = 5  # [px] half size of the cross that marks a point in a picture
# Names of the random streams.
DEPTH = "depth_noise"
COLOUR = "colour_noise"

Model = TypeVar("Model", bound=RobotModel)


@dataclass(frozen=True)
class ImageNoise:
    """The random streams of a frame's noise, one for the depths and one for the colours of each camera.

    A stream gives numbers to all pixels of the window that is rendered, whatever is found in it. So a patch with one
    pixel more has the same noise at all others, and so have the next frames.
    """

    seed: int  # seed of the run
    frame: int = 0  # number of the frame since the reset

    def next(self) -> Self:
        """Return the streams of the next frame."""
        return replace(self, frame=self.frame + 1)

    def stream(self, name: str, camera: int) -> np.random.Generator:
        """Return the stream called `DEPTH` or `COLOUR` of a camera, from its beginning."""
        return named_generator(self.seed, name, self.frame, camera)


class View(NamedTuple):
    """The part of a camera's image in which a target appears."""

    ideal: Window  # part of the ideal image, which is rendered
    part: Window  # part of the camera's image, in which the lens shows it


@final
class Lens:
    """One camera of a set-up."""

    def __init__(self, planned: PinholeCamera, optics: Optics, camera: int) -> None:
        """Prepare the map from the pixels to those of the ideal image.

        Args:
            planned: the camera as planned, whose picture needs no lens.
            optics: of all cameras of the set-up.
            camera: the number of this one.
        """
        own = take(optics, slice(camera, camera + 1))
        self._ideal = planned
        self._map: tuple[Floats32, Floats32] | None = None
        if as_planned(own, planned):
            return
        rays = _rays(planned, own)
        # The ideal image reaches as far as the widest ray, with two pixels to spare.
        half_width, half_height = (np.abs(rays[:, :2]).max(axis=0) * own.focal[0] + 2.0).tolist()
        largest = max(MAX_SIZE, 2 * planned.width, 2 * planned.height)
        width = min(largest, 2 * math.ceil(half_width))
        height = min(largest, 2 * math.ceil(half_height))
        fov = 2.0 * math.degrees(math.atan(0.5 * height / own.focal[0]))
        self._ideal = replace(planned, width=width, height=height, vertical_fov=fov)
        sources = self._ideal.project(rays).astype(np.float32)
        sources = sources.reshape(planned.height, planned.width, 2)
        self._map = (sources[..., 0], sources[..., 1])

    def view(self, points: FloatArray, radius: float) -> View | None:
        """Return the view of balls or discs; None where none appears.

        Args:
            points: (p, 3) [m], their centres in the camera frame.
            radius: [m].
        """
        ideal = window_around_all(points, radius, self._ideal)
        if ideal is None:
            return None
        if self._map is None:
            return View(ideal, ideal)
        columns, rows = self._map
        in_columns = (columns >= ideal.left) & (columns < ideal.right)
        in_rows = (rows >= ideal.top) & (rows < ideal.bottom)
        shown = in_columns & in_rows
        left, top, width, height = cv2.boundingRect(shown.astype(np.uint8))
        if width == 0:  # Only the ideal image is wide enough to show them.
            return None
        return View(ideal, Window(top, left, top + height, left + width))

    def render(self, scene: Scene, X_BC: FloatArray, view: View | None = None) -> ByteArray:
        """Return the image of the camera at X_BC (4, 4), or what a view shows of it, (h, w, 3 or 4)."""
        rgb, _ = scene.render(self._ideal, X_BC, view and view.ideal)
        if self._map is None:
            return rgb
        columns, rows = self._map
        if view is not None:
            columns = view.part.cut(columns) - view.ideal.left
            rows = view.part.cut(rows) - view.ideal.top
        return np.asarray(cv2.remap(rgb, columns, rows, cv2.INTER_LINEAR))


def as_planned(optics: Optics, planned: PinholeCamera) -> bool:
    """Return whether cameras have the intrinsics that are planned."""
    if optics.further is not None:
        return False
    plain = ideal_optics(planned, 1)
    for name in ("focal", "centre", "distortion"):
        if not np.allclose(getattr(optics, name), getattr(plain, name), rtol=1e-12, atol=0.0):
            return False
    return True


def _rays(planned: PinholeCamera, optics: Optics) -> FloatArray:
    """Return the ray (x/z, y/z, 1) through each pixel of an image, (h w, 3)."""
    columns, rows = np.meshgrid(np.arange(planned.width), np.arange(planned.height))
    half = np.array([planned.width, planned.height]) / 2.0
    # The planned camera says where a pixel is sampled, counted from the upper left corner.
    tangents = planned.rays(columns.ravel(), rows.ravel())[:, :2]
    pixels = half + planned.focal * tangents
    points = locate(pixels[None], np.ones((1, 1)), optics)
    return points[0]


@final
class DepthCamera:
    """An RGB-D camera that finds the ball in its noisy images; noise is drawn only at pixels of the ball's colour."""

    def __init__(
        self, scene: Scene, config: RenderedConfig, camera: PinholeCamera, radius: float
    ) -> None:
        """Take a scene and the radius of its ball [m]."""
        self.camera = camera
        self.radius = radius
        self._scene = scene
        self._config = config
        self._deviation = config.colour_noise * config.sensing.noise_factor

    def find(
        self, X_BC: FloatArray, ball: FloatArray, noise: ImageNoise, number: int = 0
    ) -> Detection | None:
        """Return the ball as found in an image of the camera, or None.

        Args:
            X_BC: (4, 4), the camera.
            ball: (3,) [m], its true place in the base frame: only the part of the image around it is rendered.
            noise: of depths and colours.
            number: of the camera, each of which has noise of its own.
        """
        p_C = X_BC[:3, :3].T @ (ball - X_BC[:3, 3])
        window = window_around(p_C, self.radius, self.camera)
        if window is None:
            return None
        rgba, buffer = self._scene.render(self.camera, X_BC, window)
        if self._deviation > 0.0:
            rgba = add_colour_noise(rgba, self._deviation, noise.stream(COLOUR, number))
        patch = find_patch(rgba)
        if patch is None:
            return None
        depth = self.camera.metric_depth(buffer[patch.rows, patch.columns])
        measured = measure_depth(
            self._config, depth, patch, window.shape, self.camera, noise.stream(DEPTH, number)
        )
        # A patch touches the border of the window only where the image ends, too.
        in_image = Patch(patch.rows + window.top, patch.columns + window.left)
        return locate_ball(in_image, measured, self.camera, self.radius)

    def picture(self, X_BC: FloatArray) -> ByteArray:
        """Return the image from X_BC (4, 4) without noise, with the detected ball marked, (h, w, 3)."""
        rgba, buffer = self._scene.render(self.camera, X_BC)
        found = find_ball(rgba, buffer, self.camera, self.radius)
        return draw_detection(rgba[..., :3], found, self.camera, self.radius)


class Detector(ABC, Generic[Model]):
    """Measures features in rendered images.

    The methods take `model`, the true arm and cameras, and `q`, (n,) rad, the exact joint positions of the scene.
    """

    @abstractmethod
    def measure(
        self, model: Model, q: FloatArray, noise: ImageNoise
    ) -> tuple[FloatArray | None, BoolArray | None]:
        """Return the features as measured with the noise of images, (m,), and which are valid, (m,).

        No features mean that nothing was found, no mask that all features are valid.
        """

    @abstractmethod
    def truth(self, model: Model, q: FloatArray) -> Truth:
        """Return the true features and their Jacobian."""

    @abstractmethod
    def why_missing(self, model: Model, q: FloatArray, valid: BoolArray | None) -> str:
        """Return why features are missing at the start, with evidence, of a measurement with the mask `valid`."""

    @abstractmethod
    def picture(self, model: Model, q: FloatArray) -> ByteArray:
        """Return the images of the cameras with the detected points marked, (h, w, 3)."""


@final
class BallDetector(Detector[HandEyeModel]):
    """A fixed RGB-D camera; y = centre of the ball on the flange."""

    def __init__(self, scene: Scene, config: RenderedConfig, robot: Robot) -> None:
        """Take a scene with a ball on the flange of a robot."""
        camera = CAMERA.reaching(robot.workspace.camera_distance)
        self._scene = scene
        self._camera = DepthCamera(scene, config, camera, robot.workspace.ball_radius)

    def measure(
        self, model: HandEyeModel, q: FloatArray, noise: ImageNoise
    ) -> tuple[FloatArray | None, None]:
        """Return the ball's centre as fitted to the depths, (3,) m, or None."""
        found = self._camera.find(model.X_BC, self._scene.ball_position(), noise)
        if found is None:
            return None, None
        found.centre.setflags(write=False)
        return found.centre, None

    def truth(self, model: HandEyeModel, q: FloatArray) -> Truth:
        """Return the feature by the simulator's own ball, and the Jacobian of the true model."""
        feature = model.to_camera(self._scene.ball_position())
        return Truth(feature, model.jacobian(q))

    def why_missing(self, model: HandEyeModel, q: FloatArray, valid: BoolArray | None) -> str:
        """Return where the ball is and would appear."""
        camera = self._camera.camera
        radius = self._camera.radius
        true = model.to_camera(self._scene.ball_position())
        pixel = camera.project(true)
        clipped = camera.clipping([true[2] - radius, true[2] + radius])
        return (
            f"the ball is not visible at the start {q.round(6).tolist()}: it is at {true.round(3).tolist()} m in "
            f"the camera frame, column and row {pixel.round(1).tolist()} of an image of "
            f"{camera.width} x {camera.height}; it is {clipped}hidden, out of sight, too small or cut by the border"
        )

    def picture(self, model: HandEyeModel, q: FloatArray) -> ByteArray:
        """See `Detector.picture`."""
        return self._camera.picture(model.X_BC)


@final
class MarkCameras:
    """Cameras without depth, in whose images marks are found."""

    def __init__(
        self, model: SetupModel, scene: Scene, config: RenderedConfig, radius: float
    ) -> None:
        """Take a scene with the target of a set-up, whose ball or discs have a radius [m]."""
        self._scene = scene
        self._planned = model.planned.reaching(model.distance)
        cameras = range(model.setup.cameras)
        self._lenses = [Lens(self._planned, model.optics, camera) for camera in cameras]
        self._radius = radius
        points = len(model.target)
        self._colours = MARK_COLOURS[:points]
        self._centre = sphere_centre if points == 1 else disc_centre
        self._deviation = config.colour_noise * config.sensing.noise_factor

    def find(
        self, model: SetupModel, q: FloatArray, noise: ImageNoise
    ) -> tuple[FloatArray, BoolArray]:
        """Return the points in the frame of each camera, (c, p, 3) m at a depth of 1 m, and which are found, (c, p)."""
        marks: list[Sequence[Mark | None]] = []
        poses = camera_poses(model, q)
        for number, target in enumerate(model.in_cameras(model.points(q))):
            lens = self._lenses[number]
            view = lens.view(target, self._radius)
            if view is None:
                marks.append([None] * len(self._colours))
                continue
            image = lens.render(self._scene, poses[number], view)
            if self._deviation > 0.0:
                image = add_colour_noise(image, self._deviation, noise.stream(COLOUR, number))
            corner = (view.part.top, view.part.left)
            marks.append(find_marks(image, self._colours, corner))
        found, pixels = self._measure(marks)
        points = locate(pixels, np.ones(found.shape), model.optics)
        points[~found] = NOWHERE
        return points, found

    def picture(self, model: SetupModel, q: FloatArray) -> ByteArray:
        """Return the images of all cameras side by side, with a cross at each mark that is found, (h, w, 3)."""
        images = []
        for lens, pose in zip(self._lenses, camera_poses(model, q), strict=True):
            image = lens.render(self._scene, pose)
            images.append(np.ascontiguousarray(image[..., :3]))
        marks = [find_marks(image, self._colours) for image in images]
        found, pixels = self._measure(marks)
        for image, own_found, own_pixels in zip(images, found, pixels, strict=True):
            for u, v in own_pixels[own_found].round().astype(int).tolist():
                cv2.drawMarker(image, (u, v), OUTLINE, cv2.MARKER_CROSS, 2 * CROSS)
        return np.concatenate(images, axis=1)

    def _measure(self, marks: Sequence[Sequence[Mark | None]]) -> tuple[BoolArray, FloatArray]:
        """Return which marks are found, (c, p), and where, (c, p, 2) px; the middle of the image for the others."""
        middle = np.array([self._planned.width, self._planned.height]) / 2.0
        found = np.array([[mark is not None for mark in row] for row in marks])
        pixels = np.full((*found.shape, 2), middle)
        for camera, row in enumerate(marks):
            for point, mark in enumerate(row):
                if mark is not None:
                    pixels[camera, point] = self._centre(mark, self._planned)
        return found, pixels


@final
class BallCameras:
    """Cameras with depth, which fit a sphere to the ball."""

    def __init__(
        self, model: SetupModel, scene: Scene, config: RenderedConfig, ball_radius: float
    ) -> None:
        """Take a scene with a ball.

        Raises:
            ValueError: another target than a ball, or features that depend on intrinsics that are not as planned.
        """
        name = model.setup.name
        if len(model.target) > 1:
            raise ValueError(
                f"sensing {name} needs the depth of {len(model.target)} points; only a ball's is measured"
            )
        points = _some_points(model.setup)
        planned = ideal_optics(model.planned, model.setup.cameras)
        true_features = model.setup.measure(points, model.optics)
        planned_features = model.setup.measure(points, planned)
        if (true_features != planned_features).any():
            raise ValueError(
                f"sensing {name} needs depth, and the intrinsics of cameras with depth are as planned"
            )
        camera = model.planned.reaching(model.distance)
        self._camera = DepthCamera(scene, config, camera, ball_radius)

    def find(
        self, model: SetupModel, q: FloatArray, noise: ImageNoise
    ) -> tuple[FloatArray, BoolArray]:
        """Return the ball in the frame of each camera, (c, 1, 3) m, and which cameras found it, (c, 1)."""
        # Cameras on the hand look at a target in the world, others at the ball on the flange.
        true_ball = model.target[0] if model.mount == "hand" else model.points(q)[0]
        points = []
        found = []
        for number, pose in enumerate(camera_poses(model, q)):
            ball = self._camera.find(pose, true_ball, noise, number)
            found.append([ball is not None])
            points.append([NOWHERE if ball is None else ball.centre])
        return np.array(points), np.array(found)

    def picture(self, model: SetupModel, q: FloatArray) -> ByteArray:
        """Return the images of all cameras side by side, with the detected ball marked, (h, w, 3)."""
        images = [self._camera.picture(pose) for pose in camera_poses(model, q)]
        return np.concatenate(images, axis=1)


@final
class SetupDetector(Detector[SetupModel]):
    """The features of a sensing set-up, from the points that its cameras find."""

    def __init__(self, cameras: MarkCameras | BallCameras) -> None:
        """Take the cameras."""
        self._cameras = cameras

    def measure(
        self, model: SetupModel, q: FloatArray, noise: ImageNoise
    ) -> tuple[FloatArray, BoolArray]:
        """See `Detector.measure`."""
        points, found = self._cameras.find(model, q, noise)
        feature = model.setup.measure(points, model.optics)
        feature.setflags(write=False)
        return feature, model.setup.valid(found)

    def truth(self, model: SetupModel, q: FloatArray) -> Truth:
        """Return the features of the true model in closed form, and their Jacobian."""
        feature, jacobian, _ = model.observe(q)
        return Truth(feature, jacobian)

    def why_missing(self, model: SetupModel, q: FloatArray, valid: BoolArray | None) -> str:
        """Return which features are missing, and where they would be."""
        setup = model.setup
        if valid is None:
            valid = np.zeros(setup.m, dtype=np.bool_)
        names = np.array(setup.features)[~valid]
        true = model.feature(q)[~valid]
        wide, high = model.optics.size
        camera = model.planned.reaching(model.distance)
        points, *_ = model.point_motions(q)
        clipped = camera.clipping(points[..., 2])
        return (
            f"{', '.join(names)} cannot be seen at the start {q.round(6).tolist()}: without anything in between they "
            f"would be {true.round(1).tolist()} {setup.unit} in images of {wide:g} x {high:g}; the target is "
            f"{clipped}hidden, out of sight, too small or cut by the border"
        )

    def picture(self, model: SetupModel, q: FloatArray) -> ByteArray:
        """See `Detector.picture`."""
        return self._cameras.picture(model, q)


def open_detector(
    model: RobotModel, scene: Scene, config: RenderedConfig, robot: Robot
) -> Detector[Any]:
    """Return the detector for the cameras of a true robot.

    Raises:
        ValueError: cameras that cannot be rendered.
    """
    if isinstance(model, HandEyeModel):
        return BallDetector(scene, config, robot)
    if not isinstance(model, SetupModel):
        raise ValueError(f"model must be of an arm and its cameras, got {type(model).__name__}")  # noqa: TRY004
    if needs_depth(model.setup, model.optics):
        return SetupDetector(BallCameras(model, scene, config, robot.workspace.ball_radius))
    return SetupDetector(MarkCameras(model, scene, config, mark_radius(model, robot)))


def needs_depth(setup: SensingSetup, optics: Optics) -> bool:
    """Return whether the features change when points move along the rays on which they are found."""
    points = _some_points(setup)
    near = setup.measure(points, optics)
    far = setup.measure(2.0 * points, optics)
    return not np.allclose(near, far, rtol=1e-9, atol=1e-9)


def _some_points(setup: SensingSetup) -> FloatArray:
    """Return points (c, p, 3) m in front of all cameras, no two alike."""
    count = setup.cameras * len(setup.target)
    angle = np.arange(count)
    x = 0.1 * np.sin(angle)
    y = 0.1 * np.cos(angle)
    points = np.stack([x, y, np.ones(count)], axis=-1)
    return points.reshape(setup.cameras, len(setup.target), 3)


def camera_poses(model: SetupModel, q: FloatArray) -> FloatArray:
    """Return the cameras in the base frame, (c, 4, 4), with the arm at `q` (n,) rad."""
    if model.mount == "fixed":
        return model.cameras
    flange = model.arm.frames(q)[-1]
    return flange @ model.cameras


def depth_deviation(
    config: RenderedConfig, depth: npt.ArrayLike, camera: PinholeCamera
) -> FloatArray:
    """Return the standard deviation σ, m, at true depths of any shape, m."""
    z = np.asarray(depth, dtype=np.float64)
    if config.depth_noise == "stereo":
        native_focal = camera.focal * config.native_width / camera.width
        slope = config.depth_subpixel / (native_focal * config.depth_baseline)  # [1/m]
        return z**2 * slope
    if config.depth_noise == "structured_light":
        return 0.0012 + 0.0019 * (z - 0.4) ** 2
    return np.zeros_like(z)


def measure_depth(
    config: RenderedConfig,
    depth: FloatArray,
    patch: Patch,
    shape: tuple[int, int],
    camera: PinholeCamera,
    generator: np.random.Generator,
) -> FloatArray:
    """Return measured depths, (k,) m, of the k pixels of a patch; without noise nothing is drawn.

    Args:
        config: model of the noise, its factor and the depth unit.
        depth: (k,) [m], true.
        patch: the pixels.
        shape: height and width [px] of the window that the pixels are in, for all of which noise is drawn.
        camera: its intrinsics.
        generator: of the noise.
    """
    z = depth
    if config.depth_noise != "none":
        side = config.depth_patch * camera.width / config.native_width
        noise = _unit_noise(side, shape, generator)
        deviation = config.sensing.noise_factor * depth_deviation(config, z, camera)
        z = z + deviation * noise[patch.rows, patch.columns]
    if config.depth_quantisation > 0.0:
        z = np.round(z / config.depth_quantisation) * config.depth_quantisation
    return z


def _unit_noise(side: float, shape: tuple[int, int], generator: np.random.Generator) -> FloatArray:
    """Return noise of unit variance at all pixels of a window, (h, w), that match by patches of `side` px."""
    kernel = _patch_kernel(side)
    # Noise beyond the window's border, too, so that pixels at the border have unit variance as well.
    margin = len(kernel) // 2
    height, width = shape
    white = generator.standard_normal((height + 2 * margin, width + 2 * margin))
    by_rows = convolve1d(white, kernel, axis=0)
    smooth = convolve1d(by_rows, kernel, axis=1)
    return smooth[margin : margin + height, margin : margin + width]


@cache
def _patch_kernel(side: float) -> FloatArray:
    """Return Gaussian weights, (odd,), of the second moment of a patch of `side` [px] whose squares sum to 1."""
    deviation = side / np.sqrt(12.0)
    reach = int(np.ceil(3.0 * deviation))
    pixels = np.arange(-reach, reach + 1)
    standardised = pixels / max(deviation, 1e-9)
    weights = np.exp(-0.5 * standardised**2)
    return weights / np.sqrt(weights @ weights)
