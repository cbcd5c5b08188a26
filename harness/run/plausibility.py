"""Settings that are valid one by one and make no run together: times longer than the run, targets out of reach.

A target that a task gives as a feature is held against the nominal arm, with room for what the mismatch may add to its
reach: a run is refused only where no true robot of that mismatch could do it.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np

from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.request import RunSettings
from servobench.harness.run.resolution import ResolvedRun
from servobench.harness.run.scenario import Scenario
from servobench.harness.run.tasks import TASKS, find_task
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.signals import PlantSpec
from servobench.plant.robot.hand_eye import HandEyeModel
from servobench.plant.robot.inverse import closest_distance
from servobench.plant.robot.mismatch import Mismatch
from servobench.plant.robot.robot import Robot

ROOM: Final = 0.1  # [m] beyond the nominal reach that a target may be whatever the mismatch
POINTS: Final = 12  # of a curve that are looked at


def check_times(resolved: ResolvedRun, duration: float) -> None:
    """Refuse times that are longer than the run of `duration` [s], so that what they delay never happens.

    Raises:
        ConfigurationError: names the setting, the length of the run and what came.
    """
    plant, sensing = resolved.request.plant, getattr(resolved.plant, "sensing", None)
    times = {f"{plant}.command_delay": getattr(resolved.plant, "command_delay", 0.0)}
    if isinstance(sensing, SensingConfig):
        times[f"{plant}.sensing.latency"] = sensing.latency
        times[f"{plant}.sensing.jitter"] = sensing.jitter
        times[f"{plant}.sensing.frame_period"] = sensing.frame_period
    for name, time in times.items():
        if isinstance(time, float) and time > 0.0 and time >= duration:
            raise ConfigurationError(f"{name} must be shorter than the run of {duration:g} s, got {time:g} s")
    preview = resolved.run.preview_time
    if preview > max(duration, RunSettings().preview_time):
        raise ConfigurationError(
            f"run.preview_time must be no longer than the run of {duration:g} s, got {preview:g} s"
        )


def check_reach(resolved: ResolvedRun, scenario: Scenario, robot: Robot, spec: PlantSpec) -> None:
    """Refuse a target or a curve that no true robot of the run's mismatch can reach.

    Args:
        resolved: the run.
        scenario: its task.
        robot: the nominal one, which the mismatch starts from.
        spec: joint limits of the plant.

    Raises:
        ConfigurationError: names the point that is farthest out of reach, and by how much.
    """
    task = resolved.request.task
    if find_task(task).out_of_reach or not resolved.task.any_robot:  # other targets are taught on the true robot
        return
    if resolved.request.sensing != DEFAULT_SENSING:  # the features are no places
        return
    nominal, times = robot.nominal, np.linspace(0.0, scenario.duration, POINTS)
    points = np.unique(scenario.reference.at(times), axis=0)
    limits = tuple(spec.joint_lower), tuple(spec.joint_upper)
    distances = np.array(_distances(nominal, tuple(map(tuple, points)), *limits))
    beyond = distances - _room(resolved.request.mismatch, robot, nominal.to_base(points))
    worst = int(beyond.argmax())
    if beyond[worst] > 0.0:
        where = ", ".join(f"{value:g}" for value in points[worst].round(3))
        on_purpose = [entry.name for entry in TASKS.values() if entry.out_of_reach]
        what = "its target" if len(points) == 1 else "a point of its curve,"
        raise ConfigurationError(
            f"task {task}: {what} ({where}) m in the camera frame, is {distances[worst]:.2g} m out of the arm's reach; "
            f"for a target out of reach on purpose there is the task {', '.join(on_purpose)}"
        )


def check_joints(resolved: ResolvedRun, scenario: Scenario, spec: PlantSpec) -> None:
    """Refuse a start, or a target taught at joint positions, outside the joints' limits.

    Raises:
        ConfigurationError: names the first joint that is outside.
    """
    for what, values in (("start", scenario.start), ("target", resolved.task.taught_at)):
        if values is None:
            continue
        for joint, value, lower, upper in zip(
            spec.joint_names, values, spec.joint_lower, spec.joint_upper, strict=True
        ):
            if not lower <= value <= upper:
                raise ConfigurationError(
                    f"task {resolved.request.task}: {what} must be within the joints' limits, {lower:.4g} to "
                    f"{upper:.4g} rad for {joint}, got {value:g}"
                )


@lru_cache(maxsize=64)
def _distances(
    nominal: HandEyeModel, points: tuple[tuple[float, ...], ...], lower: tuple[float, ...], upper: tuple[float, ...]
) -> tuple[float, ...]:
    """Return how near the nominal arm comes to each point [m]."""
    found = closest_distance(nominal.arm, nominal.to_base(np.array(points)), np.array(lower), np.array(upper))
    return tuple(found.tolist())


def _room(mismatch: Mismatch, robot: Robot, points: FloatArray) -> FloatArray:
    """Return how much nearer than the nominal arm a true one may come to each point (p, 3) of the base frame, (p,) m.

    Longer links and tools reach farther; a turned camera turns the point about the middle of the workspace.
    """
    length = float(np.linalg.norm(robot.arm.translation, axis=-1).sum())
    arm = ROOM + length * mismatch.size("links") + math.sqrt(3.0) * mismatch.size("tool")
    turn = min(math.pi, mismatch.size("camera_rotation") + mismatch.size("camera_move"))
    turned = 2.0 * math.sin(turn / 2.0) * np.linalg.norm(points - np.asarray(robot.workspace.centre), axis=-1)
    return np.asarray(arm + turned)
