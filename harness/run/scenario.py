"""The contract of a task: settings that make the scenario of a run from the robot and the cameras.

A task is a frozen dataclass below `Task` with a default for every field. The defaults are those of the UR5's bench;
`scaled` moves them to the same places in another arm's workspace.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, Self, TypeAlias, get_args

import numpy as np

from servobench.harness.run.references import (
    FixedPoint,
    FollowedCurve,
    JointPath,
    LedImage,
    LedPlaces,
    Reference,
    Segment,
    TaskKind,
)
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.contract.checks import FloatArray, as_array, check_number, real_numbers
from servobench.plant.contract.signals import Channel
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.workspace import Workspace

Vector: TypeAlias = tuple[float, ...]


class Span(NamedTuple):
    """A part of a run."""

    begin: float  # [s]
    end: float  # [s]


@dataclass(frozen=True)
class Scenario:
    """A task made concrete for one true robot."""

    start: (
        FloatArray | None
    )  # (n,), joint positions at time 0; None for a plant that brings its own [rad]
    reference: Reference  # the desired feature over time
    duration: float  # [s]
    evaluate_from: float  # where the evaluated part begins [s]
    kind: TaskKind = "curve"  # whether the reference is a fixed target, moves, or jumps
    lap_time: float = math.nan  # time of a lap of a curve that is repeated [s]; NaN of any other
    moves: tuple[Span, ...] = ()  # parts of a sequence in which a target is held
    # instants at which the reference jumps, which no preview shows [s]
    jumps: Vector = ()

    def __post_init__(self) -> None:
        """Check that the evaluated part is one of the run, and the kind."""
        if self.kind not in get_args(TaskKind):
            raise ValueError(
                f"kind must be one of {', '.join(get_args(TaskKind))}, got {self.kind!r}"
            )
        check_number("duration", self.duration, above=0.0)
        if not 0.0 <= real_numbers("evaluate_from", self.evaluate_from) < self.duration:
            raise ValueError(
                f"evaluate_from must be in the run of {self.duration:g} s, got {self.evaluate_from:g} s"
            )
        if (self.kind == "sequence") != bool(self.moves):
            raise ValueError("a sequence, and no other kind, has moves")

    def jump_periods(self, period: float) -> tuple[int, ...]:
        """Return the control periods, each of `period` s, in which the reference jumps."""
        return tuple(math.ceil(each / period - 1e-9) for each in self.jumps)


class Cameras(NamedTuple):
    """A robot with cameras that see pixels."""

    planned: SetupModel  # the nominal robot with its cameras as planned
    true: SetupModel


@dataclass(frozen=True)
class TaskSetting:
    """Where a task is to be done."""

    model: RobotModel | None  # the true robot, or None for a plant that brings its own
    n: int  # number of joints
    feature: Channel  # names and unit of the m features
    seed: int  # for tasks that draw random numbers
    moved: RobotModel | None = None  # the true robot once its camera was moved; None if it is not
    robot: Robot | None = None  # by its maker's description; None for a plant that brings its own
    nominal: RobotModel | None = None  # the same with its cameras as planned

    @property
    def m(self) -> int:
        """Size of a place, in which tasks give targets and curves."""
        if self.model is None:
            return len(self.feature.names)
        return 3

    def followed(self, curve: Reference) -> Reference:
        """Return the desired features of a ball on a curve of places: the curve itself where features are places."""
        if isinstance(self.model, SetupModel) and self.robot is not None:
            return FollowedCurve(self.model, curve, self.robot)
        return curve

    def taught(self, joint_position: FloatArray) -> Reference:
        """Return the target that is taught with the arm at a joint position, (n,) rad.

        Raises:
            ValueError: the plant brings a robot of its own.
        """
        model = self.taught_on()[1]
        if isinstance(model, SetupModel):
            return LedImage(model, JointPath((Segment(math.inf, joint_position),)))
        return FixedPoint(model.feature(joint_position))

    def taught_on(self) -> tuple[Robot, RobotModel]:
        """Return the robot and the true one, for a target that is taught on it.

        Raises:
            ValueError: the plant brings a robot of its own.
        """
        if self.model is None or self.robot is None:
            raise ValueError(
                "it is taught on a known robot, and this plant brings a robot of its own"
            )
        return self.robot, self.model

    def cameras(self) -> Cameras | None:
        """Return the cameras as planned and the true ones; None where features are places."""
        if isinstance(self.model, SetupModel) and isinstance(self.nominal, SetupModel):
            return Cameras(self.nominal, self.model)
        return None

    def led(self, path: JointPath) -> Reference:
        """Return the desired features while the arm is led along a path, as a user would teach them one by one.

        Raises:
            ValueError: the plant brings a robot of its own.
        """
        model = self.taught_on()[1]
        if isinstance(model, SetupModel):
            return LedImage(model, path)
        return LedPlaces(model, path)

    def start(self, joint_position: Vector | FloatArray) -> FloatArray | None:
        """Return the start of a run, (n,) rad, or None for a plant that brings its own."""
        if self.model is None:
            return None
        return as_array("start", joint_position, (self.n,))

    def move(self, start: Vector | FloatArray, target: Reference, duration: float) -> Scenario:
        """Return a move to a fixed target, of which the last quarter is judged."""
        return Scenario(self.start(start), target, duration, 0.75 * duration, "point_to_point")


class Task(ABC):
    """The settings of a task, which make the scenario of a run."""

    any_robot: ClassVar[bool] = False
    """Whether it also runs on a plant with a robot of its own: no target is given as joint positions."""
    places: ClassVar[tuple[str, ...]] = ()
    """Settings that are moved for another arm: points of the camera frame, and `start`, which is its home."""
    judged_part: ClassVar[str] = "from the time that its code sets as evaluate_from"
    """Words for the judged part of a curve."""

    @property
    def taught_at(self) -> Vector | None:
        """Joint positions [rad] at which the target was taught; None for other targets."""
        return None

    @abstractmethod
    def scenario(self, setting: TaskSetting) -> Scenario:
        """Return start, reference and duration of a run.

        Raises:
            ValueError: the task cannot be done there; says why.
        """

    def scaled(self, name: str, work: Workspace) -> Self:
        """Return the settings for another arm than the UR5's; by default the same but for `places`.

        Joint positions are those found for the robot, lengths grow with its workspace, times stay.

        Args:
            name: of the task.
            work: the workspace of the robot.
        """
        given = {each: getattr(self, each) for each in self.places if each != "start"}
        points = {
            each: tuple(work.scale * value for value in point) for each, point in given.items()
        }
        home = {"start": numbers(work.home)} if "start" in self.places else {}
        return replace(self, **points, **home)  # type: ignore[type-var]


@dataclass(frozen=True)
class TaskEntry:
    """A task as the command line knows it: a row of a class of tasks."""

    name: str  # the word on the command line
    summary: str  # one line for `servobench tasks`
    default: Task  # its settings
    out_of_reach: bool = False  # its target is out of the arm's reach on purpose


def numbers(values: FloatArray) -> Vector:
    """Return joint positions as a setting."""
    return tuple(np.asarray(values, dtype=np.float64).tolist())
