"""What can be set of each task; the defaults are those of the UR5's bench."""

from __future__ import annotations

from typing import Literal, TypeAlias

from servobench.plant.contract.settings import Count, NonNegative, Number, Positive, settings
from servobench.plant.robot.ur5 import HOME, TRAINING_LOWER, TRAINING_UPPER

Vector: TypeAlias = tuple[float, ...]


@settings
class PointTask:
    """A move from rest to a fixed target that was taught at given joint positions."""

    start: Vector = HOME
    """[rad] joint positions at time 0"""
    target: Vector = HOME
    """[rad] joint positions at which the target was taught"""
    duration: Positive = 10.0
    """[s] length of the run"""
    into_view: bool = True
    """where cameras see pixels, draw start and target together towards the arm's home until both are in view"""


@settings
class RandomTask:
    """A move whose start and target are drawn by the run's seed from a box of joint positions.

    Where the camera is moved during the run, the target is drawn such that the arm reaches it afterwards, too.
    """

    lower: Vector = TRAINING_LOWER
    """[rad] lower corner of the box"""
    upper: Vector = TRAINING_UPPER
    """[rad] upper corner of the box"""
    shortest: Number = 0.1
    """[m] least distance between start and target on the nominal model"""
    lowest: Number = 0.08
    """[m] least height of the ball above the table on the nominal model"""
    duration: Positive = 10.0
    """[s] length of the run"""


@settings
class CircleTask:
    """A horizontal circle in the camera frame, entered from its centre: a large initial error."""

    start: Vector = HOME
    """[rad] joint positions at time 0"""
    centre: Vector = (0.0, 0.0, 1.25)
    """[m] camera frame; (0.5, 0, 0.3) m in the base frame of the nominal robot"""
    radius: Positive = 0.3
    """[m] of the circle"""
    lap_time: Positive = 10.0
    """[s] 200 points a lap at the default period"""
    laps: Count = 2
    """laps in the run; the last one is judged"""


@settings
class LemniscateTask(CircleTask):
    """A figure of eight in the plane of the camera's image."""

    radius: Positive = 0.25
    """[m] half of its length"""


@settings
class EnduranceTask:
    """Many laps on the curve of the task `circle` or `lemniscate`: whether a method stays as good as it was."""

    curve: Literal["circle", "lemniscate"] = "circle"
    """the task whose centre and radius the curve has"""
    start: Vector = HOME
    """[rad] joint positions at time 0"""
    lap_time: Positive = 10.0
    """[s] 200 points a lap at the default period"""
    laps: Count = 180
    """laps in the run, half an hour; the first one is the entry, the last one is judged"""


@settings
class LineTask:
    """A straight line at constant speed, then rest at its end."""

    start: Vector = HOME
    """[rad] joint positions at time 0"""
    begin: Vector = (-0.2, 0.0, 1.25)
    """[m] camera frame"""
    end: Vector = (0.2, 0.1, 1.2)
    """[m] camera frame"""
    moving: Positive = 8.0
    """[s] from the beginning to the end of the line"""
    duration: Positive = 10.0
    """[s] length of the run"""


@settings
class WaypointTask:
    """Waypoints from a CSV file, in the camera frame; its columns are time_s, x_m, y_m, z_m on a UR5."""

    start: Vector = HOME
    """[rad] joint positions at time 0"""
    file: str = ""
    """path of the CSV file"""
    settle: NonNegative = 2.0
    """[s] rest after the last waypoint"""


@settings
class TargetTask:
    """A move from rest to a fixed target that is given as a feature."""

    start: Vector = HOME
    """[rad] joint positions at time 0"""
    target: Vector = (0.1, -0.1, 1.2)
    """[m] camera frame"""
    duration: Positive = 10.0
    """[s] length of the run"""
