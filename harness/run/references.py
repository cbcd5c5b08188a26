"""What the feature should do: a function of time, evaluated once for all control instants of a run."""

from __future__ import annotations

import csv
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from servobench.harness.run.log import column_unit
from servobench.plant.contract.checks import FloatArray, check_number
from servobench.plant.contract.files import reason
from servobench.plant.contract.signals import Channel

TaskKind: TypeAlias = Literal["point_to_point", "curve"]
"""Whether a task's reference is a fixed target or moves."""


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
        """
        rows = self.at(np.arange(count) * period)
        rows.flags.writeable = False
        return rows


@dataclass(frozen=True, eq=False)
class FixedPoint(Reference):
    """y_ref(t) = target, (m,) m."""

    target: FloatArray

    def at(self, time: npt.ArrayLike) -> FloatArray:
        """Return the target, whatever the time."""
        times = np.asarray(time, dtype=np.float64)
        return np.broadcast_to(self.target, (*times.shape, len(self.target))).copy()


@dataclass(frozen=True, eq=False)
class Waypoints(Reference):
    """Straight lines between points passed at given times; before the first and after the last it rests there."""

    times: FloatArray  # (p,), ascending [s]
    points: FloatArray  # (p, m) [m]

    def __post_init__(self) -> None:
        """Check sizes and order."""
        if self.points.ndim != 2 or self.times.shape != (len(self.points),) or len(self.points) == 0:
            raise ValueError(
                f"waypoints need times (p,) and points (p, m), got {self.times.shape}, {self.points.shape}"
            )
        if not (np.diff(self.times) > 0.0).all():
            raise ValueError("waypoint times must ascend")

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
    wanted = ("time_s", *(f"{name}_{column_unit(feature.unit)}" for name in feature.names))
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"waypoint file {path} cannot be read: {reason(error)}") from error
    if not rows or any(name not in rows[0] for name in wanted):
        raise ValueError(f"waypoint file {path} must have a header and rows with the columns {', '.join(wanted)}")
    values = np.empty((len(rows), len(wanted)))
    for i, row in enumerate(rows):
        for j, name in enumerate(wanted):
            try:
                values[i, j] = float(row[name])
            except (TypeError, ValueError) as error:
                raise ValueError(f"waypoint file {path}, row {i + 1}: {name} is not a number: {row[name]!r}") from error
    if not np.isfinite(values).all():
        raise ValueError(f"waypoint file {path} holds a number that is not finite")
    try:
        return Waypoints(values[:, 0], values[:, 1:])
    except ValueError as error:
        raise ValueError(f"waypoint file {path}: {error}") from error
