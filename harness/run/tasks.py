"""The tasks: where a run starts, what the feature should do, and for how long.

Targets are taught as a user would teach them: the ball is put somewhere and the camera's reading becomes the desired
feature. A target given as joint positions is therefore seen through the true robot, and is always in reach. Curves are
given in the camera frame; the middle of the workspace is at (0, 0, 1.3) m there, whatever the mismatch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.references import FixedPoint, Laps, Reference, TaskKind, line, read_waypoints
from servobench.plant.checks import FloatArray, as_vector, check_number
from servobench.plant.lanes import norm
from servobench.plant.robot.hand_eye import HandEyeModel
from servobench.plant.robot.ur5 import HOME, TRAINING_LOWER, TRAINING_UPPER, nominal_ur5
from servobench.plant.seeds import named_generator
from servobench.plant.settings import Count, NonNegative, Number, Positive, settings, suggest
from servobench.plant.signals import Channel

Vector: TypeAlias = tuple[float, ...]

SHOULDER = (0.0, 0.0, 0.09)  # [m] base frame
MAX_DRAWS, DRAWN_AT_ONCE = 1000, 4  # pairs of start and target; one in two fits
REACH = (0.35, 0.75)  # [m] from the shoulder to the ball: away from the arm's own column and from the stretched arm


@dataclass(frozen=True)
class Scenario:
    """A task made concrete for one true robot."""

    start: FloatArray | None  # (n,), joint positions at time 0; None for a plant that brings its own [rad]
    reference: Reference  # the desired feature over time
    duration: float  # [s]
    evaluate_from: float  # where the evaluated part begins [s]
    kind: TaskKind = "curve"  # whether the reference is a fixed target or moves
    lap_time: float = math.nan  # of a curve that is repeated [s]; NaN of any other


@settings
class PointTask:
    """A move from rest to a fixed target that was taught at given joint positions."""

    start: Vector = HOME
    """[rad] joint positions at time 0"""
    target: Vector = HOME
    """[rad] joint positions at which the target was taught"""
    duration: Positive = 10.0
    """[s] length of the run"""


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


@dataclass(frozen=True)
class TaskSetting:
    """Where a task is to be done."""

    model: HandEyeModel | None  # the true robot, or None for a plant that brings its own
    n: int  # number of joints
    feature: Channel  # names and unit of the m features
    seed: int  # for tasks that draw random numbers
    moved: HandEyeModel | None = None  # the true robot once its camera was moved; None if it is not

    @property
    def m(self) -> int:
        """Number of features."""
        return len(self.feature.names)

    def taught_on(self) -> HandEyeModel:
        """Return the true robot, for a target that is taught on it.

        Raises:
            ValueError: the plant brings a robot of its own.
        """
        if self.model is None:
            raise ValueError("it is taught on the UR5, and this plant brings a robot of its own; use one of "
                             f"{', '.join(name for name in TASKS if TASKS[name].any_robot)}")  # fmt: skip
        return self.model

    def start(self, joint_position: Vector | FloatArray) -> FloatArray | None:
        """Return the start of a run, (n,) rad, or None for a plant that brings its own."""
        return None if self.model is None else as_vector("start", joint_position, self.n)


@dataclass(frozen=True)
class TaskEntry:
    """A task as the command line knows it."""

    name: str  # the word on the command line
    summary: str  # one line for `servobench tasks`
    default: Any  # its settings
    build: Callable[[Any, TaskSetting], Scenario]  # makes a scenario from settings and the setting of the run
    any_robot: bool = False  # it needs no UR5: start and target are not given as its joint positions


def _build_point(config: PointTask, setting: TaskSetting) -> Scenario:
    target = as_vector("target", config.target, setting.n)
    return _move(config.start, FixedPoint(setting.taught_on().feature(target)), config.duration, setting)


def _build_target(config: TargetTask, setting: TaskSetting) -> Scenario:
    target = as_vector("target", config.target, setting.m)
    return _move(config.start, FixedPoint(target), config.duration, setting)


def _move(start: Vector | FloatArray, reference: FixedPoint, duration: float, setting: TaskSetting) -> Scenario:
    return Scenario(setting.start(start), reference, duration, 0.75 * duration, "point_to_point")


def _build_random(config: RandomTask, setting: TaskSetting) -> Scenario:
    n, nominal = setting.taught_on().arm.n, nominal_ur5()
    lower, upper = as_vector("lower", config.lower, n), as_vector("upper", config.upper, n)
    if not (lower < upper).all():
        raise ValueError("lower must be below upper for every joint")
    generator = named_generator(setting.seed, "start_and_target")
    for _ in range(MAX_DRAWS // DRAWN_AT_ONCE):
        pairs = generator.uniform(lower, upper, (DRAWN_AT_ONCE, 2, n))
        balls = nominal.arm.ball_position(pairs)
        apart = norm(balls[:, 1] - balls[:, 0]) >= config.shortest
        for start, target in pairs[apart & (balls[:, :, 2] >= config.lowest).all(axis=-1)]:
            if _stays_in_reach(target, config.lowest, setting):
                return _move(start, FixedPoint(setting.taught_on().feature(target)), config.duration, setting)
    raise ValueError("no start and target in the box are far enough apart and above the table")


def _stays_in_reach(target: FloatArray, lowest: float, setting: TaskSetting) -> bool:
    """Return whether a target (n,), rad, that was taught before the camera's move is in easy reach after it."""
    if setting.moved is None:
        return True
    point = setting.moved.to_base(setting.taught_on().feature(target))
    return bool(point[2] >= lowest and REACH[0] <= np.linalg.norm(point - SHOULDER) <= REACH[1])


def _build_laps(config: CircleTask, setting: TaskSetting) -> Scenario:
    centre, eight = as_vector("centre", config.centre, setting.m), isinstance(config, LemniscateTask)
    reference = Laps(centre, config.radius, config.lap_time, eight)
    laps, lap_time = config.laps, config.lap_time
    start, judged_from = setting.start(config.start), (laps - 1) * lap_time
    return Scenario(start, reference, laps * lap_time, judged_from, lap_time=lap_time)


def _build_endurance(config: EnduranceTask, setting: TaskSetting) -> Scenario:
    shape = LemniscateTask if config.curve == "lemniscate" else CircleTask
    return _build_laps(shape(start=config.start, lap_time=config.lap_time, laps=config.laps), setting)


def _build_line(config: LineTask, setting: TaskSetting) -> Scenario:
    m = setting.m
    reference = line(as_vector("begin", config.begin, m), as_vector("end", config.end, m), config.moving)
    return Scenario(setting.start(config.start), reference, config.duration, 0.5 * config.duration)


def _build_waypoints(config: WaypointTask, setting: TaskSetting) -> Scenario:
    if not config.file:
        raise ValueError("a CSV file is needed: --set waypoints.file=PATH")
    reference = read_waypoints(Path(config.file).expanduser(), setting.feature)
    duration = float(reference.times[-1]) + config.settle
    check_number("last waypoint's time plus settle", duration, above=0.0)
    return Scenario(setting.start(config.start), reference, duration, 0.5 * duration)


# Start and target as joint positions, and beside them the ball on the nominal robot in the base frame.
EXP1 = PointTask(
    start=(0.169, -1.669, -2.250, 0.893, 1.156, 0.0),  # (0.50, -0.10, 0.35) m
    target=(1.484, -1.897, -2.052, 0.793, 1.624, 0.0),  # (0.15, 0.58, 0.30) m; the shoulder is 0.63 rad outside
)
EXP2 = PointTask(
    start=(0.097, -1.434, -2.282, 0.990, 1.124, 0.0),  # (0.40, -0.15, 0.45) m
    target=(0.441, -2.006, -2.124, 0.760, 1.255, 0.0),  # (0.60, 0.10, 0.20) m
)
EXP3 = PointTask(
    start=(0.583, -2.093, -1.976, 0.720, 1.301, 0.0),  # (0.62, 0.22, 0.20) m
    target=(-0.114, -1.648, -2.157, 0.894, 1.067, 0.0),  # (0.45, -0.25, 0.40) m
)
EXP4 = PointTask(
    start=(-0.938, -1.724, -1.814, 0.812, 0.855, 0.0),  # (0.12, -0.55, 0.50) m; the shoulder is 0.69 rad outside
    target=(0.403, -1.847, -2.248, 0.826, 1.231, 0.0),  # (0.55, 0.05, 0.25) m
)
# The arm stretched level over the table, the ball at (1.03, 0, 0.09) m: its Jacobian has lost the way out and back.
SINGULAR = PointTask(start=(0.132772, -3.141593, 0.0, -0.483504, 1.421076, -0.000417))
UNREACHABLE = TargetTask(target=(0.0, -1.5, 1.25), duration=30.0)  # 1.5 m straight on from where the ball starts

_ENTRIES = (
    TaskEntry("exp1", "a move whose target lies outside the training region", EXP1, _build_point),
    TaskEntry("exp2", "a move inside the training region, forward and down", EXP2, _build_point),
    TaskEntry("exp3", "a move inside the training region, across and up", EXP3, _build_point),
    TaskEntry("exp4", "a move that starts outside the training region", EXP4, _build_point),
    TaskEntry("circle", "two laps on a horizontal circle of 0.3 m radius", CircleTask(), _build_laps, any_robot=True),
    TaskEntry("line", "a straight line at constant speed", LineTask(), _build_line, any_robot=True),
    TaskEntry("lemniscate", "two laps on a figure of eight", LemniscateTask(), _build_laps, any_robot=True),
    TaskEntry("random", "start and target drawn by the seed from the training region", RandomTask(), _build_random),
    TaskEntry("target", "a move to a given feature (target.target)", TargetTask(), _build_target, any_robot=True),
    TaskEntry(
        "endurance", "half an hour on the circle or the lemniscate", EnduranceTask(), _build_endurance, any_robot=True
    ),
    TaskEntry("unreachable", "a target 1.5 m away, out of the arm's reach", UNREACHABLE, _build_target, any_robot=True),
    TaskEntry("singular_start", "a move that starts with the arm stretched", SINGULAR, _build_point),
    TaskEntry("waypoints", "points of a CSV file (waypoints.file)", WaypointTask(), _build_waypoints, any_robot=True),
)
TASKS = {entry.name: entry for entry in _ENTRIES}


def find_task(name: str) -> TaskEntry:
    """Return the task called `name`.

    Raises:
        ConfigurationError: no such task.
    """
    if name not in TASKS:
        raise ConfigurationError(f"unknown task {name!r}: {suggest(name, TASKS)}")
    return TASKS[name]
