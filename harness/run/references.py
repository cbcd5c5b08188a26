"""The desired feature as a function of time, evaluated once for all control instants of a run.

Where features are no places, the reference is the true, noise-free image of the target. The target is given by its
points in the frame M that the cameras are mounted on. A taught target is where the arm was when it was recorded. A
curve in space moves the target as the ball of `position` would move in the first camera's frame C, with the orientation
that the target has at home, and nearer by as much as the camera is nearer:

    p_j(t) = X_MC (ρ y(t)) + p_j(home) − p̄(home)       p̄ mean of the points, ρ ratio of the distances, y(t) the curve

For a user's camera the curve is about the middle of the workspace as that camera sees it, or before a camera on the
hand about the target at home; ρ is at most 1, and smaller by as much as less of the workspace is in the image.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias, final

import numpy as np
import numpy.typing as npt

from servobench.plant.cameras.setups import SetupModel
from servobench.plant.contract.checks import FloatArray, check_number
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import numbers_of, read_table
from servobench.plant.contract.signals import Channel, column_unit
from servobench.plant.robot.arm import from_frame
from servobench.plant.robot.camera import CAMERA
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.robot import Robot

MAX_BEGIN = 1e6  # [s] after which the first waypoint is one of a clock that counts from 1970 or from a start-up
TaskKind: TypeAlias = Literal["point_to_point", "curve", "sequence"]
"""Whether a task's reference is a fixed target, moves, or jumps from one target to the next."""


class Reference(ABC):
    """A desired feature over time."""

    @abstractmethod
    def at(self, time: npt.ArrayLike) -> FloatArray:
        """Return the desired feature, (..., m) m, at `time` (...), s."""

    def sampled(self, period: float, count: int) -> FloatArray:
        """Return the desired features of the first `count` control instants, (count, m), read-only.

        Args:
            period: control period [s].
            count: periods of the run and the rows that are previewed beyond its end.

        Raises:
            ConfigurationError: one of them is missing or not finite.
        """
        rows = np.array(self.at(np.arange(count) * period), dtype=np.float64)
        if rows.shape[:-1] != (count,):
            raise ConfigurationError(
                f"the task's reference needs a row for each of {count} times, got {rows.shape}"
            )
        finite = np.isfinite(rows).all(axis=-1)
        if not finite.all():
            first = int(finite.argmin())
            raise ConfigurationError(
                "the reference of the task must be finite over the run and beyond it, as far as it is "
                f"previewed; got {rows[first].tolist()} at {first * period:g} s"
            )
        rows.flags.writeable = False
        return rows


@dataclass(frozen=True, eq=False)
class FixedPoint(Reference):
    """y_ref(t) = target, (m,) m."""

    target: FloatArray

    def at(self, time: npt.ArrayLike) -> FloatArray:
        """Return the target, the same at all times."""
        return np.broadcast_to(self.target, (*np.shape(time), len(self.target))).copy()


@dataclass(frozen=True, eq=False)
class Waypoints(Reference):
    """Straight lines between points passed at given times; before the first and after the last it rests there."""

    times: FloatArray  # (p,), ascending [s]
    points: FloatArray  # (p, m) [m]

    def __post_init__(self) -> None:
        """Check sizes and order."""
        if (
            self.points.ndim != 2
            or self.times.shape != (len(self.points),)
            or len(self.points) == 0
        ):
            raise ValueError(
                f"waypoints need times (p,) and points (p, m), got {self.times.shape}, {self.points.shape}"
            )
        if not (np.diff(self.times) > 0.0).all() or self.times[0] < 0.0:
            raise ValueError("waypoint times must ascend, the first one from 0 s on")

    def at(self, time: npt.ArrayLike) -> FloatArray:
        """Return the interpolated points."""
        times = np.asarray(time, dtype=np.float64)
        return np.stack([np.interp(times, self.times, column) for column in self.points.T], axis=-1)


@dataclass(frozen=True, eq=False)
class Laps(Reference):
    """y_ref(t) = c + r (cos ωt · a + s(t) · b), ω = 2π / lap time, a and b the first two feature axes.

    s(t) = sin ωt on a circle, and sin ωt cos ωt on a figure of eight (Gerono's lemniscate).
    """

    centre: FloatArray  # c, (m,) [m]
    radius: float  # r [m]
    lap_time: float  # [s]
    eight: bool = False

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_number("radius", self.radius, above=0.0)
        check_number("lap_time", self.lap_time, above=0.0)

    def at(self, time: npt.ArrayLike) -> FloatArray:
        """Return points on the curve."""
        phase = 2 * np.pi * np.asarray(time, dtype=np.float64) / self.lap_time
        points = np.broadcast_to(self.centre, (*phase.shape, len(self.centre))).copy()
        points[..., 0] += self.radius * np.cos(phase)
        points[..., 1] += self.radius * np.sin(phase) * (np.cos(phase) if self.eight else 1.0)
        return points


def line(start: FloatArray, end: FloatArray, duration: float) -> Waypoints:
    """Return a straight line from `start` to `end`, (m,) m, at constant speed within `duration`, s; it rests there."""
    check_number("duration", duration, above=0.0)
    return Waypoints(np.array([0.0, duration]), np.stack([start, end]))


def read_waypoints(path: Path, feature: Channel) -> Waypoints:
    """Read waypoints from a CSV file with the columns time_s and <feature>_<unit>, named as in the log.

    Args:
        path: the file.
        feature: names and unit of the m features, as in the plant's spec.

    Raises:
        ValueError: the file is missing, lacks a column, or holds something that is not a finite number.
    """
    file = f"waypoint file {path}"
    names = [f"{name}_{column_unit(feature.unit)}" for name in feature.names]
    values = numbers_of(file, read_table("waypoint file", path), ["time_s", *names])
    if values[0, 0] > MAX_BEGIN:
        raise ConfigurationError(
            f"{file} begins at {values[0, 0]:.0f} s; write time_s from the run's begin on"
        )
    with configuration_errors(f"{file}: "):
        return Waypoints(values[:, 0], values[:, 1:])


class Segment(NamedTuple):
    """A part of a path through which an arm is led: a rest, or a lap on an ellipse in the space of the joints."""

    duration: float  # T [s]
    middle: FloatArray  # c, (n,) [rad]
    swings: FloatArray | None = None  # a and b, (2, n) [rad]; None where the arm rests


@final
@dataclass(frozen=True, eq=False)
class JointPath:
    """Joint positions through which an arm is led, one segment after the other; the last one goes on.

    q(t) = c_i + cos φ a_i + sin φ b_i,   φ = 2π (t − t_i) / T_i,   t_i the sum of the durations before
    """

    segments: tuple[Segment, ...]

    @property
    def ends(self) -> FloatArray:
        """Times at which the segments end, (s,) [s]."""
        return np.cumsum([each.duration for each in self.segments])

    def at(self, time: npt.ArrayLike) -> FloatArray:
        """Return the joint positions, (..., n) rad, at `time` (...), s."""
        times = np.asarray(time, dtype=np.float64)
        n = len(self.segments[0].middle)
        postures = np.empty((*times.shape, n))
        begin = 0.0
        for segment, end in zip(self.segments, self.ends, strict=True):
            since = times - begin
            # A period's time is a product, and may be a rounding error before the sum of the durations.
            under_way = since >= -1e-9
            postures[under_way] = segment.middle
            if segment.swings is not None:
                phase = 2.0 * np.pi * since[under_way] / segment.duration
                a, b = segment.swings
                postures[under_way] += np.multiply.outer(np.cos(phase), a)
                postures[under_way] += np.multiply.outer(np.sin(phase), b)
            begin = end
        return postures


@final
@dataclass(frozen=True, eq=False)
class LedPlaces(Reference):
    """The features, (m,), of an arm that is led along a path."""

    model: RobotModel  # the true arm and its camera
    path: JointPath

    def at(self, time: npt.ArrayLike) -> FloatArray:
        """Return the features at each time."""
        return self.model.feature(self.path.at(time))


@dataclass(frozen=True, eq=False)
class ImageReference(Reference):
    """A desired place of the target over time, and its image."""

    model: SetupModel  # the true arm and its cameras

    @abstractmethod
    def points(self, time: npt.ArrayLike) -> FloatArray:
        """Return the target in the frame M, (..., p, 3) m, at `time` (...), s."""

    def at(self, time: npt.ArrayLike) -> FloatArray:
        """Return its image, (..., m)."""
        return self.model.feature_at(self.points(time))


@final
@dataclass(frozen=True, eq=False)
class LedImage(ImageReference):
    """The target where it is while the arm is led along a path, or rests where it was taught."""

    path: JointPath

    def points(self, time: npt.ArrayLike) -> FloatArray:
        """Return the place at each time."""
        return self.model.points(self.path.at(time))


@final
@dataclass(frozen=True, eq=False)
class FollowedCurve(ImageReference):
    """The target on a curve in space, as above."""

    curve: Reference  # path of a ball in the frame of a fixed camera, (3,) [m]
    robot: Robot  # whose home gives the orientation, and whose workspace the curve is in

    def points(self, time: npt.ArrayLike) -> FloatArray:
        """Return the place at each time."""
        home = self.model.points(self.robot.workspace.home)
        place = from_frame(self.model.camera, self._in_camera(time))
        about_middle = home - home.mean(axis=-2)
        return place[..., None, :] + about_middle

    def _in_camera(self, time: npt.ArrayLike) -> FloatArray:
        """Return the curve in the frame of the camera, (..., 3) m, no larger than it fits into a user's image."""
        work = self.robot.workspace
        ratio = self.model.distance / work.camera_distance
        if self.robot.camera is None:
            return ratio * self.curve.at(time)
        image = self.robot.pinhole
        middle = work.centre
        pose = self.robot.camera_pose
        if self.model.mount == "hand":
            middle = self.model.points(work.home).mean(axis=-2)
            pose = self.model.camera
        # The half angle of view over that of the bench's camera.
        seen = min(image.width, image.height) / image.focal * CAMERA.focal / CAMERA.height
        about = self.curve.at(time) - (0.0, 0.0, work.camera_distance)
        shrunk = min(1.0, ratio * seen) * about
        return shrunk + (middle - pose[:3, 3]) @ pose[:3, :3]
