"""The contract of a sensing set-up, the built-in ones, and an arm in front of cameras, or with cameras on its hand.

A set-up is one `SensingSetup`: names and unit of its features, the number of cameras, the points of the target, and the
function from the points, in the frame of each camera, to the features. Arm, mount, mismatch, tasks and scale follow.

    position   the ball's centre in the camera frame, by a camera with depth                        m = 3, in metres
    pixel      the ball in the image of one camera, without depth                                   m = 2, in pixels
    stereo     the ball in the images of two cameras, without depth and epipolar calibration        m = 4, in pixels
    plate      four discs on a plate in the image of one camera, for six degrees of freedom         m = 8, in pixels

A further set-up is a `SensingSetup` in this file and its name in `plant.cameras.registry`, or one in a file that a user
names on the command line.

A camera is mounted on the base B (`fixed`) or on the flange F (`hand`); the target is on the flange or in the world:

    fixed   p = p_B(q) = p_F + R_F t           ∂p/∂q_i = g_i z_i × (p_B − o_i)
    hand    p = R_Fᵀ (t − p_F)                 ∂p/∂q_i = −R_Fᵀ (g_i z_i × (t − o_i))
    in camera c, p_c = R_cᵀ (p − p_0c);        y = h(p_c),   J = ∂h/∂p_c R_cᵀ ∂p/∂q

with points t of the target in the flange frame or in the base frame, and the joints' axes z_i, origins o_i and gear
ratios g_i.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Self, TypeAlias, final

import numpy as np
import numpy.typing as npt

from servobench.plant.cameras.optics import Optics, ideal_optics, in_image, project, project_rates
from servobench.plant.contract.checks import FloatArray, Shape, Triple
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.lanes import norm
from servobench.plant.contract.sensing import EXTENTS, LENGTH
from servobench.plant.contract.signals import SETTLING_BAND, BoolArray, Channel
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.camera import CAMERA, PinholeCamera
from servobench.plant.robot.hand_eye import Mount, RobotModel

Measure: TypeAlias = Callable[[FloatArray, Optics], FloatArray]
"""Points (..., c, p, 3) [m] in the frame of each camera, and the optics -> features (..., m)."""
Rates: TypeAlias = Callable[[FloatArray, FloatArray, Optics], FloatArray]
"""Points, their motions (..., c, p, 3, n) [m] and the optics -> the change of the features, (..., m, n)."""
FINE_STEP = 1e-6  # [1] share of the motions over which features are differentiated
# The same for a `measure` in single precision, and where `rates` are checked
COARSE_STEP = 1e-3  # [1]
FLOAT_TYPES = (np.float64, np.float32)  # types that `measure` and `rates` may return
CHECK_POSES = 5  # poses of the target at which the functions of a user's set-up are checked
# Share of the fastest rate by which `rates` may differ from the derivative
RATE_TOLERANCE = 1e-3  # [1]


@dataclass(frozen=True)
class SensingSetup:
    """A sensing set-up.

    Attributes:
        name: the word on the command line.
        summary: one line for `servobench sensing`.
        features: m names, used in the columns of the log.
        unit: of all features, such as "px".
        measure: makes features of points; pure, over leading axes.
        rates: its derivative along motions of the points; None: by central differences.
        scale: natural size of a feature, in its unit, for a focal length [px] and a working distance [m]: its change
            with a metre of motion across the optical axis; None: a metre in its unit of length, or for "px" f over
            the distance.
        tolerance: the settling band as a share of the scale, for the norm of the error.
        cameras: c, their number.
        target: p points of the target in a frame whose z axis leads away from the first camera; lengths of a UR5's
            bench [m].
        single: each point in each camera has features of its own, m = c p k, and only they are lost with it.
        closeness: of a fixed camera, as a share of the distance that is planned for the ball.
        least_joints: of an arm for which the features can be reached.
        judges_pose: the pose of the target is judged as well.
    """

    name: str
    summary: str
    features: tuple[str, ...]
    unit: str
    measure: Measure
    rates: Rates | None = None
    scale: Callable[[float, float], float] | None = None
    tolerance: float = SETTLING_BAND
    cameras: int = 1
    target: tuple[Triple, ...] = ((0.0, 0.0, 0.0),)
    single: bool = False
    closeness: float = 1.0
    least_joints: int = 1
    judges_pose: bool = False

    def __post_init__(self) -> None:
        """Check names and scale."""
        if not self.features:
            raise ValueError(f"sensing {self.name}: features must be one name or more, got none")
        if self.scale is None and self.unit not in EXTENTS:
            raise ValueError(
                f"sensing {self.name}: features in {self.unit} need their natural size; give scale=lambda "
                "focal, distance: NUMBER, by how much they change with a metre of motion"
            )
        count = self.cameras * len(self.target)
        if self.single and self.m % count:
            raise ValueError(
                f"sensing {self.name}: single needs as many features for each of {count} points, got {self.m}"
            )
        # The channel checks names, scale and tolerance, for any focal length and distance.
        self.channel(500.0, 1.0)

    @property
    def m(self) -> int:
        """Number of features."""
        return len(self.features)

    def channel(self, focal: float, distance: float) -> Channel:
        """Return names, unit and natural size of the features, for a focal length [px] and a `distance` [m]."""
        free = np.full(self.m, np.inf)
        return Channel(
            self.features, self.unit, self.size(focal, distance), -free, free, self.tolerance
        )

    def size(self, focal: float, distance: float) -> float:
        """Return the natural size of a feature, in its unit, for a focal length [px] and a `distance` [m]."""
        if self.scale is not None:
            return self.scale(focal, distance)
        if self.unit == "px":
            return focal / distance
        return 1.0 / LENGTH[self.unit]

    def change(self, points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
        """Return how features of points (..., c, p, 3) change, (..., m, n), with motions (..., c, p, 3, n) [m]."""
        if self.rates is not None:
            return self.rates(points, motions, optics)
        return self._differences(points, motions, optics, self._step)

    def _differences(
        self, points: FloatArray, motions: FloatArray, optics: Optics, h: float
    ) -> FloatArray:
        """Return `change` by central differences over a share h of the motions."""
        step = h * np.moveaxis(motions, -1, 0)
        ahead = self.measure(points + step, optics)
        behind = self.measure(points - step, optics)
        rates = (ahead - behind) / (2.0 * h)
        return np.ascontiguousarray(np.moveaxis(rates, 0, -1))

    @cached_property
    def _step(self) -> float:
        """Share of the motions for `_differences`, by whether `measure` tells apart motions that are far smaller."""
        fine = self._differences(*self._check_poses(), RATE_TOLERANCE * FINE_STEP)
        coarse = self._differences(*self._check_poses(), COARSE_STEP)
        rates = np.abs(coarse)
        lost = rates[fine == 0.0] > RATE_TOLERANCE * np.median(rates)
        return COARSE_STEP if lost.any() else FINE_STEP

    def _check_poses(self) -> tuple[FloatArray, FloatArray, Optics]:
        """Return a few poses of the target in front of the cameras, two motions of it, and the optics; see `rates`."""
        draw = np.random.default_rng(0).uniform
        target = np.array(self.target)
        # A metre ahead of the cameras, which are 0.1 m apart
        side = np.arange(self.cameras)[:, None, None] * [0.1, 0.0, 0.0]
        ahead = np.array([0.0, 0.0, 1.0]) - side
        points = target + ahead + draw(-0.05, 0.05, (CHECK_POSES, 1, 1, 3))
        # The motions of a rigid target: v + ω × t
        velocity, turn = draw(-1.0, 1.0, (2, CHECK_POSES, 1, 1, 3, 2))
        rigid = velocity + np.cross(turn, target[..., None], axis=-2)
        motions = np.zeros((*points.shape, 2)) + rigid
        return points, motions, ideal_optics(CAMERA, self.cameras)

    @np.errstate(divide="raise", over="raise", invalid="raise")
    def check(self) -> None:
        """Refuse functions that break their contract, at a few places of the target in front of the cameras.

        Raises:
            ConfigurationError: they change their arguments, `measure` does not return m features for each place, or
                `rates` is not its derivative.
            FloatingPointError: they divide by zero, or the like.
        """
        points, motions, optics = self._check_poses()
        given_points = points.copy()
        given_motions = motions.copy()
        single = self.measure(points[0].copy(), optics)
        self._check_array("measure", single, (self.m,), points[0])
        several = self.measure(given_points, optics)
        self._check_array("measure", several, (CHECK_POSES, self.m), points)
        rates = self.change(given_points, given_motions, optics)
        self._check_array("rates", rates, (CHECK_POSES, self.m, 2), points)
        same_points = np.array_equal(given_points, points)
        if not (same_points and np.array_equal(given_motions, motions)):
            raise ConfigurationError(
                f"sensing {self.name}: measure and rates must not change their arguments; work on a copy, such as "
                "points.copy()"
            )
        differences = self._differences(points, motions, optics, COARSE_STEP)
        wrong = np.abs(rates - differences).max(axis=(0, 2))
        bound = RATE_TOLERANCE * np.abs(differences).max()
        if self.rates is not None and not (wrong <= bound).all():
            raise ConfigurationError(
                f"sensing {self.name}: rates is not the derivative of measure, by up to {wrong.max():.3g} "
                f"{self.unit}/m for {self.features[wrong.argmax()]}; correct it, or leave it out for differences"
            )

    def _check_array(self, name: str, made: object, shape: Shape, points: FloatArray) -> None:
        """Refuse what a function called `name` made of points (..., c, p, 3), unless it is finite floats of a shape."""
        expected = (
            f"sensing {self.name}: {name} must return float64 or float32 of shape {shape} for points "
            f"{points.shape}, as points[..., 0, 0, :]"
        )
        if type(made) is not np.ndarray:
            raise ConfigurationError(f"{expected}, got {type(made).__name__}")
        if made.shape != shape or made.dtype not in FLOAT_TYPES:
            raise ConfigurationError(f"{expected}, got {made.dtype} of shape {made.shape}")
        if not np.isfinite(made).all():
            raise ConfigurationError(
                f"sensing {self.name}: {name} must return finite numbers, got {made.tolist()}"
            )

    def valid(self, found: BoolArray) -> BoolArray:
        """Return which features are measured, (..., m), where the points (..., c, p) are found or not."""
        if self.single:
            *lead, cameras, points = found.shape
            count = cameras * points
            each = found.reshape(*lead, count)
            return np.repeat(each, self.m // count, axis=-1)
        all_found = np.logical_and.reduce(found, axis=(-2, -1), keepdims=True)[..., 0]
        return np.repeat(all_found, self.m, axis=-1)


def pixels(points: FloatArray, optics: Optics) -> FloatArray:
    """Return (u, v) of each point in each camera, (..., 2 c p) px."""
    appeared = project(points, optics)
    return appeared.reshape(*appeared.shape[:-3], -1)


def pixel_rates(points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
    """Return the change of `pixels`, (..., 2 c p, n) px."""
    rates = project_rates(points, motions, optics)
    return rates.reshape(*rates.shape[:-4], -1, rates.shape[-1])


def position(points: FloatArray, optics: Optics) -> FloatArray:
    """Return the first point in the first camera, (..., 3) m."""
    del optics
    return points[..., 0, 0, :]


def position_rates(points: FloatArray, motions: FloatArray, optics: Optics) -> FloatArray:
    """Return the change of `position`, (..., 3, n) m."""
    del points, optics
    return motions[..., 0, 0, :, :]


in_pixels = partial(SensingSetup, unit="px", measure=pixels, rates=pixel_rates, single=True)
"""Make a set-up of points in images, the features of which are `pixels`."""

# Half side of the plate's square, at the corners of which the discs are
HALF_SIDE = 0.12  # [m]

POSITION = SensingSetup(
    "position",
    "the ball in 3-D, by a camera with depth",
    ("x", "y", "z"),
    "m",
    position,
    position_rates,
)
PIXEL = in_pixels("pixel", "the ball in the image of one camera", ("u", "v"))
STEREO = in_pixels(
    "stereo",
    "the ball in the images of two cameras",
    ("u1", "v1", "u2", "v2"),
    # Both cameras measure a motion across both.
    tolerance=math.sqrt(2.0) * SETTLING_BAND,
    cameras=2,
)
PLATE = in_pixels(
    "plate",
    "four discs on a plate, for position and orientation",
    ("u1", "v1", "u2", "v2", "u3", "v3", "u4", "v4"),
    # Four discs measure a motion of the plate, as long as it does not turn.
    tolerance=2.0 * SETTLING_BAND,
    target=(
        (-HALF_SIDE, -HALF_SIDE, 0.0),
        (HALF_SIDE, -HALF_SIDE, 0.0),
        (HALF_SIDE, HALF_SIDE, 0.0),
        (-HALF_SIDE, HALF_SIDE, 0.0),
    ),
    # The orientation of a plate that is small in the image is measured badly.
    closeness=0.5,
    least_joints=6,
    judges_pose=True,
)


MIN_INCIDENCE = 0.2  # cosine of the angle beyond which discs on a plate are not valid


@final
@dataclass(frozen=True, eq=False)
class SetupModel(RobotModel):
    """An arm and its cameras under a sensing set-up; arrays have the leading axes of the arm's."""

    arm: SerialArm  # the arm
    setup: SensingSetup  # the set-up
    mount: Mount  # where the cameras are mounted
    cameras: FloatArray  # (..., c, 4, 4), their poses in the frame that they are mounted on
    optics: Optics  # their intrinsics
    target: FloatArray  # (..., p, 3) [m], points in the flange frame, or with cameras on the hand in the base frame
    distance: float  # distance from the cameras to the target in the middle of the workspace, as planned [m]
    planned: PinholeCamera  # image of a camera as planned, whose focal length decides the natural size of a feature
    far: float  # distance of the ball's fixed camera as planned, at which the noise of pixels is that of the ball [m]

    @cached_property
    def channel(self) -> Channel:
        """Names, unit and natural size of the features."""
        return self.setup.channel(self.planned.focal, self.distance)

    @property
    def noise_unit(self) -> float:
        """A metre of noise in the unit of the features; pixels have the same noise at every distance."""
        return self.setup.size(self.planned.focal, self.far)

    @property
    def camera(self) -> FloatArray:
        """The pose of the first camera, (..., 4, 4)."""
        return self.cameras[..., 0, :, :]

    def with_camera(self, pose: FloatArray) -> Self:
        """Return this model with its first camera at another pose, (..., 4, 4)."""
        cameras = self.cameras.copy()
        cameras[..., 0, :, :] = pose
        return replace(self, cameras=cameras)

    def with_arm(self, arm: SerialArm) -> Self:
        """Return this model with another arm; see `RobotModel.with_arm`."""
        moved: FloatArray | float = 0.0
        if self.mount == "fixed":
            # The target is on the flange, in place of the ball.
            moved = (arm.tool - self.arm.tool)[..., None, :]
        return replace(self, arm=arm, target=self.target + moved)

    def with_lens(self, deviation: FloatArray) -> Self:
        """Return this model with deviating intrinsics; see `RobotModel.with_lens`."""
        focal, *centre_shift, distortion = deviation
        planned = self.optics
        optics = replace(
            planned,
            focal=planned.focal * (1.0 + focal),
            centre=planned.centre + np.array(centre_shift),
            distortion=planned.distortion + distortion,
        )
        return replace(self, optics=optics)

    def pivot(self, centre: npt.ArrayLike) -> FloatArray:
        """Return the point about which the first camera turns: for a fixed one `centre`, else on its optical axis."""
        if self.mount == "fixed":
            return np.asarray(centre, dtype=np.float64)
        position = self.camera[..., :3, 3]
        optical_axis = self.camera[..., :3, 2]
        return position + self.distance * optical_axis

    @property
    def poses(self) -> FloatArray:
        """The poses of the cameras, (..., c, 4, 4)."""
        return self.cameras

    @property
    def marks(self) -> FloatArray:
        """The points of the target, (..., p, 3) m."""
        return self.target

    def measure(self, points: FloatArray) -> FloatArray:
        """Return the features, (..., m), of points in the frame of each camera, (..., c, p, 3) m."""
        return self.setup.measure(points, self.optics)

    def change(self, points: FloatArray, motions: FloatArray) -> FloatArray:
        """Return how the features change, (..., m, k), with motions of these points, (..., c, p, 3, k) m."""
        return self.setup.change(points, motions, self.optics)

    def feature_at(self, points: FloatArray) -> FloatArray:
        """Return the features, (..., m), of a target at `points` (..., p, 3) m in the frame of the cameras' mount."""
        return self.setup.measure(self.in_cameras(points), self.optics)

    def valid_at(self, points: FloatArray, share: float = 1.0) -> BoolArray:
        """Return which features of such a target are valid, (..., m), within a share of the images' half sides."""
        return self._valid(self.in_cameras(points), share)

    def incidence(self, points: FloatArray) -> FloatArray:
        """Return the cosine of the angle between a plate's normal and the first camera's ray, (...); 1 for a point."""
        return _incidence(self.in_cameras(points)[..., 0, :, :])

    def valid(self, joint_position: npt.ArrayLike) -> BoolArray | None:
        """Return which features can be measured, (..., m)."""
        return self.valid_at(self.points(joint_position))

    def feature(self, joint_position: npt.ArrayLike) -> FloatArray:
        """Return the true features, (..., m), for joint positions (..., n) in rad."""
        return self.feature_at(self.points(joint_position))

    def observe(self, joint_position: npt.ArrayLike) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return features (..., m), Jacobian (..., m, n) and which features are valid (..., m), all read-only."""
        points, motions = self.point_motions(joint_position)
        y = self.setup.measure(points, self.optics)
        J = self.setup.change(points, motions, self.optics)
        valid = self._valid(points)
        for array in (y, J, valid):
            array.setflags(write=False)
        return y, J, valid

    def point_motions(self, joint_position: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the target in each camera, (..., c, p, 3) m, and its motion with the joints, (..., c, p, 3, n)."""
        frames = self.arm.frames(joint_position)
        flange = frames[..., -1, :, :]
        target = self.in_base(flange)
        motions = self.arm.motions(frames, target)
        if self.mount == "hand":
            # Seen from the hand, the target moves by −R_Fᵀ (g_i z_i × (t − o_i)).
            R_BF = flange[..., None, None, :3, :3]
            motions = -np.vecmat(motions, R_BF)
        points = self.in_cameras(self.mounted(flange, target))
        # (..., p, n, 3) to (..., c, p, 3, n), turned into each camera
        rotations = self.cameras[..., None, None, :3, :3]
        turned = np.vecmat(motions[..., None, :, :, :], rotations)
        return points, turned.mT

    def _valid(self, points: FloatArray, share: float = 1.0) -> BoolArray:
        """Return which features are valid, (..., m), for points in the frame of each camera, (..., c, p, 3) m."""
        front = _incidence(points) > MIN_INCIDENCE
        inside = in_image(points, self.optics, share)
        return self.setup.valid(np.logical_and(inside, front[..., None]))


def _incidence(points: FloatArray) -> FloatArray:
    """Return the cosine of the angle between a target's normal and the ray to its middle, (...), for (..., p, 3) m."""
    if points.shape[-2] < 3:
        return np.ones(points.shape[:-2])
    corner = points[..., 0, :]
    first_side = points[..., 1, :] - corner
    second_side = points[..., 2, :] - corner
    normal = np.cross(first_side, second_side)
    ray = points.mean(axis=-2)
    lengths = np.maximum(norm(normal) * norm(ray), 1e-12)
    return np.asarray(np.vecdot(normal, ray) / lengths)
