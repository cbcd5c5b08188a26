"""The tasks: the start of a run, the desired feature over time, and the duration.

Targets are taught as a user would teach them: the ball is put somewhere and the camera's reading becomes the desired
feature. A target given as joint positions is therefore observed on the true robot, and is always in reach. Curves are
given in the camera frame; the middle of the workspace is at (0, 0, 1.3) m there, whatever the mismatch; where cameras
see pixels, the desired feature is the true image of a ball on the curve (`servobench.harness.run.references`). The
defaults are those of the UR5's bench; `taught` moves them to the same places in another arm's workspace.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np

from servobench.harness.config.robots import DEFAULT_ROBOT
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.references import (
    FixedPoint,
    Laps,
    Reference,
    TaskKind,
    TaughtView,
    in_space,
    line,
    read_waypoints,
)
from servobench.harness.run.starts import Box, PoseTask, draw_in_view, drawn_together, pose_start
from servobench.plant.cameras.model import EyeModel
from servobench.plant.contract.checks import FloatArray, as_vector, check_number
from servobench.plant.contract.files import user_path
from servobench.plant.contract.lanes import norm
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.settings import Count, NonNegative, Number, Positive, settings, suggest
from servobench.plant.contract.signals import Channel
from servobench.plant.robot.hand_eye import HandEyeModel, SensedArm
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.ur5 import HOME, MOVES, STRETCHED, TRAINING_LOWER, TRAINING_UPPER
from servobench.plant.robot.workspace import Workspace

MAX_DRAWS, DRAWN_AT_ONCE = 1000, 4  # pairs of start and target; one in two fits

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


@dataclass(frozen=True)
class Scenario:
    """A task made concrete for one true robot."""

    start: FloatArray | None  # (n,), joint positions at time 0; None for a plant that brings its own [rad]
    reference: Reference  # the desired feature over time
    duration: float  # [s]
    evaluate_from: float  # where the evaluated part begins [s]
    kind: TaskKind = "curve"  # whether the reference is a fixed target or moves
    lap_time: float = math.nan  # of a curve that is repeated [s]; NaN of any other


@dataclass(frozen=True)
class TaskSetting:
    """Where a task is to be done."""

    model: SensedArm | None  # the true robot, or None for a plant that brings its own
    n: int  # number of joints
    feature: Channel  # names and unit of the m features
    seed: int  # for tasks that draw random numbers
    moved: SensedArm | None = None  # the true robot once its camera was moved; None if it is not
    robot: Robot | None = None  # by its maker's description; None for a plant that brings its own
    nominal: SensedArm | None = None  # the same with its cameras as planned

    @property
    def m(self) -> int:
        """How many numbers a place has, in which tasks give targets and curves."""
        return len(self.feature.names) if self.model is None else 3

    def followed(self, curve: Reference) -> Reference:
        """Return what the features should be for a ball on a curve of places."""
        return in_space(curve, self.model, self.robot)

    def taught(self, joint_position: FloatArray) -> Reference:
        """Return the target that is taught with the arm at a joint position, (n,) rad.

        Raises:
            ValueError: the plant brings a robot of its own.
        """
        model = self.taught_on()[1]
        return (
            TaughtView(model, joint_position)
            if isinstance(model, EyeModel)
            else FixedPoint(model.feature(joint_position))
        )

    def taught_on(self) -> tuple[Robot, SensedArm]:
        """Return the robot and the true one, for a target that is taught on it.

        Raises:
            ValueError: the plant brings a robot of its own.
        """
        if self.model is None or self.robot is None:
            raise ValueError("it is taught on a known robot, and this plant brings a robot of its own; use one of "
                             f"{', '.join(name for name in TASKS if TASKS[name].any_robot)}")  # fmt: skip
        return self.robot, self.model

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
    any_robot: bool = False  # it needs no known robot: no target is given as its joint positions
    out_of_reach: bool = False  # its target is out of the arm's reach on purpose


def _build_point(config: PointTask, setting: TaskSetting) -> Scenario:
    start, target = (as_vector(name, getattr(config, name), setting.n) for name in ("start", "target"))
    robot, true = setting.taught_on()
    if config.into_view and isinstance(true, EyeModel) and isinstance(setting.nominal, EyeModel):
        start, target = drawn_together(start, target, robot, setting.nominal, true)
    return _move(start, setting.taught(target), config.duration, setting)


def _build_target(config: TargetTask, setting: TaskSetting) -> Scenario:
    target = as_vector("target", config.target, setting.m)
    return _move(config.start, setting.followed(FixedPoint(target)), config.duration, setting)


def _move(start: Vector | FloatArray, reference: Reference, duration: float, setting: TaskSetting) -> Scenario:
    return Scenario(setting.start(start), reference, duration, 0.75 * duration, "point_to_point")


def _build_random(config: RandomTask, setting: TaskSetting) -> Scenario:
    robot, true = setting.taught_on()
    n, clear = robot.n, robot.workspace.clear
    lower, upper = as_vector("lower", config.lower, n), as_vector("upper", config.upper, n)
    if not (lower < upper).all():
        raise ValueError("lower must be below upper for every joint")
    generator = named_generator(setting.seed, "start_and_target")
    if isinstance(true, EyeModel) and isinstance(setting.nominal, EyeModel):
        box = Box(lower, upper, config.shortest, config.lowest)
        start, target = draw_in_view(box, robot, setting.nominal, true, generator)
        return _move(start, setting.taught(target), config.duration, setting)
    for _ in range(MAX_DRAWS // DRAWN_AT_ONCE):
        pairs = generator.uniform(lower, upper, (DRAWN_AT_ONCE, 2, n))
        balls = robot.arm.ball_position(pairs)
        apart = norm(balls[:, 1] - balls[:, 0]) >= config.shortest
        fit = apart & (balls[:, :, 2] >= config.lowest).all(axis=-1)
        if clear is not None:
            fit &= clear(pairs).all(axis=-1)
        for start, target in pairs[fit]:
            point = true.feature(target)
            if _stays_in_reach(point, config.lowest, setting, robot):
                return _move(start, FixedPoint(point), config.duration, setting)
    raise ValueError("no start and target in the box are far enough apart and above the table")


def _stays_in_reach(target: FloatArray, lowest: float, setting: TaskSetting, robot: Robot) -> bool:
    """Return whether a target (m,) that was taught before the camera's move is in easy reach after it."""
    if not isinstance(setting.moved, HandEyeModel):
        return True
    point, (nearest, farthest) = setting.moved.to_base(target), robot.workspace.reach
    return bool(point[2] >= lowest and nearest <= np.linalg.norm(point - robot.workspace.shoulder) <= farthest)


def _build_pose(config: PoseTask, setting: TaskSetting) -> Scenario:
    robot, true = setting.taught_on()
    if not (isinstance(true, EyeModel) and isinstance(setting.nominal, EyeModel) and true.eye.judges_pose):
        raise ValueError("it needs a target with a pose; use --sensing plate or plate:hand")
    start = pose_start(config, robot, setting.nominal)
    return _move(start, setting.taught(robot.workspace.home), config.duration, setting)


def _build_laps(config: CircleTask, setting: TaskSetting) -> Scenario:
    centre, eight = as_vector("centre", config.centre, setting.m), isinstance(config, LemniscateTask)
    reference = setting.followed(Laps(centre, config.radius, config.lap_time, eight))
    laps, lap_time = config.laps, config.lap_time
    start, judged_from = setting.start(config.start), (laps - 1) * lap_time
    return Scenario(start, reference, laps * lap_time, judged_from, lap_time=lap_time)


def _build_endurance(config: EnduranceTask, setting: TaskSetting) -> Scenario:
    shape = LemniscateTask() if config.curve == "lemniscate" else CircleTask()
    scale = 1.0 if setting.robot is None else setting.robot.workspace.scale
    centre = tuple(scale * value for value in shape.centre)
    laps = replace(shape, start=config.start, centre=centre, radius=scale * shape.radius, lap_time=config.lap_time,
                   laps=config.laps)  # fmt: skip
    return _build_laps(laps, setting)


def _build_line(config: LineTask, setting: TaskSetting) -> Scenario:
    m = setting.m
    straight = line(as_vector("begin", config.begin, m), as_vector("end", config.end, m), config.moving)
    reference = setting.followed(straight)
    return Scenario(setting.start(config.start), reference, config.duration, 0.5 * config.duration)


def _build_waypoints(config: WaypointTask, setting: TaskSetting) -> Scenario:
    if not config.file:
        raise ValueError("a CSV file is needed: --set waypoints.file=PATH")
    reference = read_waypoints(user_path(config.file), setting.feature)
    duration = float(reference.times[-1]) + config.settle
    check_number("last waypoint's time plus settle", duration, above=0.0)
    return Scenario(setting.start(config.start), reference, duration, 0.5 * duration)


EXP1, EXP2, EXP3, EXP4 = (PointTask(start=start, target=target) for start, target in MOVES.values())
SINGULAR = PointTask(start=STRETCHED)
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
    TaskEntry(
        "unreachable",
        "a target 1.5 m away, out of the arm's reach",
        UNREACHABLE,
        _build_target,
        any_robot=True,
        out_of_reach=True,
    ),
    TaskEntry("singular_start", "a move that starts with the arm stretched", SINGULAR, _build_point),
    TaskEntry("axis_turn", "of a plate: a turn about the optical axis by 45°", PoseTask("axis_turn"), _build_pose),
    TaskEntry("retreat", "of a plate: away along the optical axis", PoseTask("retreat"), _build_pose),
    TaskEntry(
        "camera_turn", "of a plate: a turn about the camera's y axis by 15°", PoseTask("camera_turn", 15.0), _build_pose
    ),
    TaskEntry(
        "plane_turn", "of a plate: a turn about an axis in its plane by 30°", PoseTask("plane_turn", 30.0), _build_pose
    ),
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


def taught(entry: TaskEntry, robot: Robot) -> Any:  # noqa: ANN401 - the settings of any task
    """Return the settings of a task for a robot: on a UR5 those of the entry itself.

    Joint positions are those that were found for the robot, lengths grow with its workspace, times stay.
    """
    if robot.name == DEFAULT_ROBOT:
        return entry.default
    work, default = robot.workspace, entry.default
    home = _numbers(work.home)
    match default:
        case PoseTask():  # its start and its goal are the arm's own
            return default
        case PointTask():
            start, target = work.moves.get(entry.name, (work.stretched, work.home))
            return replace(default, start=_numbers(start), target=_numbers(target))
        case RandomTask():
            return RandomTask(
                _numbers(work.lower),
                _numbers(work.upper),
                work.scale * default.shortest,
                work.scale * default.lowest,
                default.duration,
            )
        case CircleTask():
            return replace(
                default, start=home, centre=_scaled(work, default.centre), radius=work.scale * default.radius
            )
        case LineTask():
            return replace(default, start=home, begin=_scaled(work, default.begin), end=_scaled(work, default.end))
        case TargetTask():
            return replace(default, start=home, target=_scaled(work, default.target))
        case _:
            return replace(default, start=home)


def _scaled(work: Workspace, point: Vector) -> Vector:
    return tuple(work.scale * value for value in point)


def _numbers(values: FloatArray | Iterable[float]) -> Vector:
    return tuple(np.asarray(values, dtype=np.float64).tolist())
