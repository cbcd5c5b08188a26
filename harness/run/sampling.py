"""The sampling of a run: the true robot, its cameras and the task on it, drawn from a mismatch and a seed."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from servobench.harness.config.registry import is_foreign_plant
from servobench.harness.config.sensing import find_sensing
from servobench.harness.config.source import same_folder
from servobench.harness.run.plausibility import check_extents, check_times
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import ResolvedRun
from servobench.harness.run.scenario import Scenario, TaskSetting
from servobench.harness.run.tasks import TASKS
from servobench.plant.cameras.placement import CameraDraws
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.seeds import named_seed
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.mismatch import MismatchSample, sample_mismatch

POINTS = 12  # points of a curve that are checked
ROBOTS_KEPT = 1024  # true robots with their tasks, a few kilobytes each


@dataclass(frozen=True, eq=False)
class Drawn:
    """The values drawn for one run."""

    scenario: Scenario
    # The true robot and its cameras; None for a plant that brings its own.
    true: RobotModel | None = None
    sample: MismatchSample | None = None  # how it differs from the nominal one
    moved: RobotModel | None = None  # the true robot after its camera was moved; None if it is not
    # How cameras differ from those planned; None where they are part of `sample`.
    cameras: CameraDraws | None = None

    @property
    def final(self) -> RobotModel | None:
        """The true robot with the camera as it is at the end of the run."""
        return self.moved or self.true

    def as_record(self) -> dict[str, object]:
        """Return all values drawn for robot and cameras, for JSON."""
        record: dict[str, object] = {}
        for part in (self.sample, self.cameras):
            if part is not None:
                record |= part.as_record()
        return record


def draw(resolved: ResolvedRun) -> Drawn:
    """Draw the true robot and the task of a run.

    Raises:
        ConfigurationError: a mismatch or a task that cannot be used.
    """
    request = resolved.request
    robot = find_robot(request.robot)
    true, sample, cameras = draw_robot(request)
    moved = sample.moved(true, robot)
    setting = TaskSetting(
        true,
        true.arm.n,
        true.channel,
        named_seed(request.seed, "task"),
        moved,
        robot,
        nominal=find_sensing(request.sensing).nominal(robot),
    )
    return Drawn(build_scenario(resolved, setting), true, sample, moved, cameras)


_kept = lru_cache(ROBOTS_KEPT)(draw)


def draw_once(resolved: ResolvedRun) -> Drawn:
    """Return what `draw` does; methods that meet the same robot one after the other share it.

    What depends on code or files of a user's is drawn anew.
    """
    request = resolved.request
    foreign = is_foreign_plant(request.plant) or request.task not in TASKS
    if foreign or request.mismatch.calibration or "." in request.robot + request.sensing:
        return draw(resolved)
    return _kept(replace(resolved, request=replace(request, controller=""), controller=None))


@configuration_errors()
def draw_robot(request: RunRequest) -> tuple[RobotModel, MismatchSample, CameraDraws | None]:
    """Draw the true robot of a run with its cameras, and return the drawn values, too.

    Raises:
        ConfigurationError: a robot, sensing or mismatch that cannot be used.
    """
    robot = find_robot(request.robot)
    seed = named_seed(request.seed, "mismatch")
    arm, sample = sample_mismatch(request.mismatch, robot, seed)
    sensing = find_sensing(request.sensing)
    true, cameras = sensing.true(robot, arm, sample, request.mismatch, seed)
    if robot.twin is not None:
        exact = not request.mismatch.moves_robot
        true = robot.twin.model(sensing.nominal(robot), request.sensing, request.seed, exact=exact)
    return true, sample, cameras


def build_scenario(resolved: ResolvedRun, setting: TaskSetting) -> Scenario:
    """Return the task of a run as it is in a setting.

    Raises:
        ConfigurationError: a task that cannot be used there, or times that do not fit.
    """
    name = resolved.request.task
    task = resolved.task
    if setting.model is None and not task.any_robot:
        others = ", ".join(name for name, entry in TASKS.items() if entry.default.any_robot)
        raise ConfigurationError(
            f"task {name}: it is taught on a known robot, and this plant brings a robot of its own; use one of "
            f"{others}"
        )
    with configuration_errors(f"task {name}: "):
        with same_folder():
            scenario: object = task.scenario(setting)  # That of a user's task may be anything.
        if not isinstance(scenario, Scenario):
            raise ConfigurationError(
                f"its method scenario must return a servobench.Scenario, got {scenario!r}"
            )
        points = _points_of(scenario, len(setting.feature.names))
        last = (resolved.run.periods(scenario.duration) - 1) * resolved.run.period
        # A move is judged by its settling, whenever its judged part begins.
        if scenario.kind == "curve" and scenario.evaluate_from > last + 1e-9:
            raise ConfigurationError(
                f"its judged part begins at {scenario.evaluate_from:g} s, after the last control instant at "
                f"{last:g} s; let evaluate_from be earlier"
            )
        if name not in TASKS:
            with configuration_errors(
                "its scenario differs from one call to the next: ", Exception
            ):
                _check_repeated(scenario, points, task.scenario(setting))
    plant = resolved.request.plant
    check_times(resolved.run, plant, resolved.plant, scenario.duration)
    check_extents(plant, resolved.plant, setting.nominal)
    return scenario


def _points_of(scenario: Scenario, m: int) -> FloatArray:
    """Return the reference of a scenario at a few instants, (p, m), and refuse one of another shape."""
    points = np.asarray(scenario.reference.at(checked_instants(scenario)))
    if points.shape != (POINTS, m) or not np.isfinite(points).all():
        raise ConfigurationError(
            f"its reference must be {m} finite features at {POINTS} instants, got shape {points.shape} and "
            f"{points[:1].tolist()}"
        )
    return points


def checked_instants(scenario: Scenario) -> FloatArray:
    """Return the instants at which the reference of a scenario is checked, (POINTS,) [s]."""
    return np.linspace(0.0, scenario.duration, POINTS)


def _check_repeated(scenario: Scenario, points: FloatArray, again: Scenario) -> None:
    """Refuse a task whose second scenario is another one, given points of the first."""
    repeated = np.array_equal(points, again.reference.at(checked_instants(scenario)))
    starts: list[Any] = [scenario.start, again.start]
    if not repeated or not np.array_equal(*starts):
        raise ConfigurationError("draw from setting.seed alone")
