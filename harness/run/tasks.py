"""The tasks by name, as rows of a few classes that make the start, the desired feature and the duration of a run.

Targets are taught as a user would teach them: the ball is put somewhere and the camera's reading becomes the desired
feature. A target given as joint positions is therefore observed on the true robot, and is always in reach. Curves are
given in the camera frame; the middle of the workspace is at (0, 0, 1.3) m there under any mismatch; where cameras
see pixels, the desired feature is the true image of a ball on the curve (`servobench.harness.run.references`).

A user brings a task as a file with a dataclass below `Task`, or publishes it, or a `TaskEntry`, under the entry-point
group `servobench.tasks`.
"""

from dataclasses import is_dataclass, replace
from typing import Any, Literal, Self

from servobench.harness.config.entries import Kind, check_settings, summary_of
from servobench.harness.config.registry import Registry
from servobench.harness.run.references import FixedPoint, Laps, line, read_waypoints
from servobench.harness.run.scenario import Scenario, Task, TaskEntry, TaskSetting, Vector, numbers
from servobench.harness.run.sequences import AgainTask, TourTask
from servobench.harness.run.starts import PLACES, BoxTask, PoseTask, drawn_moves, drawn_together
from servobench.plant.contract.checks import as_array, check_number
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import user_path
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.settings import (
    Count,
    Duration,
    NonNegative,
    Positive,
    remark,
    settings,
)
from servobench.plant.robot.catalogue import DEFAULT_ROBOT
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.ur5 import HOME, MOVES, STRETCHED
from servobench.plant.robot.workspace import Workspace

LONG_RUN = 600.0  # [s]
RADII = {"circle": 0.3, "lemniscate": 0.25}  # [m] radii of the curves on a UR5
STRETCHED_START = "singular_start"


@settings
class PointTask(Task):
    """A move from rest to a fixed target that was taught at given joint positions."""

    start: Vector = HOME
    """[rad] joint positions at time 0"""
    target: Vector = HOME
    """[rad] joint positions at which the target was taught"""
    duration: Duration = 10.0
    """[s] length of the run"""
    into_view: bool = True
    """where cameras see pixels, draw start and target together towards the arm's home until both are in view"""

    @property
    def taught_at(self) -> Vector:
        """See `Task.taught_at`."""
        return self.target

    def scenario(self, setting: TaskSetting) -> Scenario:
        """See `Task.scenario`."""
        start, target = (
            as_array(f"its setting {name}", getattr(self, name), (setting.n,))
            for name in ("start", "target")
        )
        robot, _ = setting.taught_on()
        cameras = setting.cameras()
        if self.into_view and cameras is not None:
            start, target = drawn_together(start, target, robot, cameras)
        return setting.move(start, setting.taught(target), self.duration)

    def scaled(self, name: str, work: Workspace) -> Self:
        """Return the move of this name that was found for the arm; see `Task.scaled`."""
        moves = {**work.moves, STRETCHED_START: (work.stretched, work.home)}
        if name not in moves:
            return self
        start, target = moves[name]
        return replace(self, start=numbers(start), target=numbers(target))


@settings
class TargetTask(Task):
    """A move from rest to a fixed target that is given as a feature."""

    start: Vector = HOME
    """[rad] joint positions at time 0"""
    target: Vector = (0.1, -0.1, 1.2)
    """[m] camera frame"""
    duration: Duration = 10.0
    """[s] length of the run"""

    any_robot = True
    places = ("start", "target")

    def scenario(self, setting: TaskSetting) -> Scenario:
        """See `Task.scenario`."""
        target = as_array("its setting target", self.target, (setting.m,))
        return setting.move(self.start, setting.followed(FixedPoint(target)), self.duration)


@settings
class RandomTask(BoxTask):
    """A move whose start and target are drawn by the run's seed from a box of joint positions.

    Where the camera is moved during the run, the target is drawn such that the arm reaches it afterwards, too.
    """

    duration: Duration = 10.0
    """[s] length of the run"""

    def scenario(self, setting: TaskSetting) -> Scenario:
        """See `Task.scenario`."""
        box = self.box(setting)
        generator = named_generator(setting.seed, PLACES)
        start, target = next(drawn_moves(box, setting, generator))
        return setting.move(start, setting.taught(target), self.duration)


@settings
class CurveTask(Task):
    """Laps on a curve in the plane of the camera's image, entered from its centre: a large initial error."""

    curve: Literal["circle", "lemniscate"] = "circle"
    """a circle, or a figure of eight"""
    start: Vector = HOME
    """[rad] joint positions at time 0"""
    centre: Vector = (0.0, 0.0, 1.25)
    """[m] camera frame; (0.5, 0, 0.3) m in the base frame of the nominal robot"""
    radius: Positive | None = None
    """[m] of the circle, or half the length of the lemniscate; by default 0.3 m and 0.25 m on a UR5"""
    lap_time: Duration = 10.0
    """[s] 200 points a lap at the default period"""
    laps: Count = 2
    """laps in the run; the last one is judged"""

    any_robot = True
    places = ("start", "centre")
    judged_part = "the last lap"

    def scenario(self, setting: TaskSetting) -> Scenario:
        """See `Task.scenario`."""
        centre = as_array("its setting centre", self.centre, (setting.m,))
        scale = 1.0
        if setting.robot is not None:
            scale = setting.robot.workspace.scale
        radius = scale * RADII[self.curve] if self.radius is None else self.radius
        laps = setting.followed(Laps(centre, radius, self.lap_time, self.curve == "lemniscate"))
        judged_from = (self.laps - 1) * self.lap_time
        start = setting.start(self.start)
        return Scenario(start, laps, self.laps * self.lap_time, judged_from, lap_time=self.lap_time)

    def scaled(self, name: str, work: Workspace) -> Self:
        """See `Task.scaled`."""
        radius = None if self.radius is None else work.scale * self.radius
        return replace(super().scaled(name, work), radius=radius)


@settings
class LineTask(Task):
    """A straight line at constant speed, then rest at its end."""

    start: Vector = HOME
    """[rad] joint positions at time 0"""
    begin: Vector = (-0.2, 0.0, 1.25)
    """[m] camera frame"""
    end: Vector = (0.2, 0.1, 1.2)
    """[m] camera frame"""
    moving: Positive = 8.0
    """[s] from the beginning to the end of the line"""
    duration: Duration = 10.0
    """[s] length of the run"""

    any_robot = True
    places = ("start", "begin", "end")
    judged_part = "the second half"

    def scenario(self, setting: TaskSetting) -> Scenario:
        """See `Task.scenario`."""
        begin, end = (
            as_array(f"its setting {name}", getattr(self, name), (setting.m,))
            for name in ("begin", "end")
        )
        reference = setting.followed(line(begin, end, self.moving))
        return Scenario(setting.start(self.start), reference, self.duration, 0.5 * self.duration)


@settings
class WaypointTask(Task):
    """Waypoints from a CSV file, in the camera frame; its columns are time_s, x_m, y_m, z_m on a UR5."""

    start: Vector = HOME
    """[rad] joint positions at time 0"""
    file: str = ""
    """path of the CSV file"""
    settle: NonNegative = 2.0
    """[s] rest after the last waypoint"""

    any_robot = True
    places = ("start",)
    judged_part = "the second half"

    def scenario(self, setting: TaskSetting) -> Scenario:
        """See `Task.scenario`."""
        if not self.file:
            raise ValueError("it needs a CSV file, the setting waypoints.file")
        reference = read_waypoints(user_path(self.file), setting.feature)
        duration = float(reference.times[-1]) + self.settle
        check_number("last waypoint's time plus settle", duration, above=0.0)
        if duration > LONG_RUN:
            remark(f"the waypoints of {self.file} take {duration:g} s; time_s is in s, not in ms")
        return Scenario(setting.start(self.start), reference, duration, 0.5 * duration)


EXP1, EXP2, EXP3, EXP4 = (PointTask(start=start, target=target) for start, target in MOVES.values())
# 1.5 m straight on from the ball's start
UNREACHABLE = TargetTask(target=(0.0, -1.5, 1.25), duration=30.0)

_ENTRIES = (
    TaskEntry("exp1", "a move whose target lies outside the training region", EXP1),
    TaskEntry("exp2", "a move inside the training region, forward and down", EXP2),
    TaskEntry("exp3", "a move inside the training region, across and up", EXP3),
    TaskEntry("exp4", "a move that starts outside the training region", EXP4),
    TaskEntry(
        "circle",
        "two laps on a horizontal circle of 0.3 m radius",
        CurveTask(radius=RADII["circle"]),
    ),
    TaskEntry("line", "a straight line at constant speed", LineTask()),
    TaskEntry(
        "lemniscate",
        "two laps on a figure of eight",
        CurveTask("lemniscate", radius=RADII["lemniscate"]),
    ),
    TaskEntry(
        "random", "start and target drawn by the seed from the training region", RandomTask()
    ),
    TaskEntry("tour", "moves to six targets in a row, drawn by the seed", TourTask()),
    TaskEntry("again", "a move, a curve, the way back and the same move again", AgainTask()),
    TaskEntry("target", "a move to a given feature (target.target)", TargetTask()),
    TaskEntry("endurance", "half an hour on the circle or the lemniscate", CurveTask(laps=180)),
    TaskEntry(
        "unreachable", "a target 1.5 m away, out of the arm's reach", UNREACHABLE, out_of_reach=True
    ),
    TaskEntry(
        STRETCHED_START, "a move that starts with the arm stretched", PointTask(start=STRETCHED)
    ),
    TaskEntry(
        "axis_turn", "of a plate: a turn about the optical axis by 45°", PoseTask("axis_turn")
    ),
    TaskEntry("retreat", "of a plate: away along the optical axis", PoseTask("retreat")),
    TaskEntry(
        "camera_turn",
        "of a plate: a turn about the camera's y axis by 15°",
        PoseTask("camera_turn", 15.0),
    ),
    TaskEntry(
        "plane_turn",
        "of a plate: a turn about an axis in its plane by 30°",
        PoseTask("plane_turn", 30.0),
    ),
    TaskEntry("waypoints", "points of a CSV file (waypoints.file)", WaypointTask()),
)
TASKS = {entry.name: entry for entry in _ENTRIES}


def _of_class(given: type[Any]) -> TaskEntry:
    check_settings(given, given.__name__)
    return TaskEntry(given.__name__, summary_of(given), given())


def _checked(entry: TaskEntry, place: str) -> TaskEntry:
    default: object = entry.default
    if not (isinstance(default, Task) and is_dataclass(type(default))):
        came = type(default).__name__
        raise ConfigurationError(
            f"{place}: the settings of a task must be a dataclass below Task, got {came}"
        )
    return entry


_WANTED = "wanted a dataclass below servobench.Task or a servobench.TaskEntry"
_KIND = Kind("task", TaskEntry, (Task,), _WANTED, _of_class, _checked)
TASK_REGISTRY = Registry(_KIND, "servobench.tasks", TASKS)
find_task, choose_task, task_names = TASK_REGISTRY.find, TASK_REGISTRY.choose, TASK_REGISTRY.names


def fitted(name: str, robot: Robot) -> Task:
    """Return the settings of a task for a robot: on a UR5 those of the entry itself.

    Raises:
        ConfigurationError: no such task.
    """
    default = find_task(name).default
    if robot.name == DEFAULT_ROBOT:
        return default
    return default.scaled(name, robot.workspace)
