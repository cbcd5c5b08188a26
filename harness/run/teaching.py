"""Tasks on other arms than the UR5: the same places relative to the arm's own workspace."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from servobench.harness.config.robots import DEFAULT_ROBOT
from servobench.harness.run.pose_tasks import PoseTask
from servobench.harness.run.task_settings import CircleTask, LineTask, PointTask, RandomTask, TargetTask, Vector
from servobench.harness.run.tasks import TaskEntry
from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.workspace import Workspace


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
