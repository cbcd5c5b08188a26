"""What a run's seed draws: the true robot with its cameras, and the task on it."""

from __future__ import annotations

from dataclasses import dataclass

from servobench.harness.config.robots import find_robot, find_sensing
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.plausible import check_times
from servobench.harness.run.resolved import ResolvedRun
from servobench.harness.run.tasks import Scenario, TaskSetting, find_task
from servobench.plant.cameras.draws import CameraDraws
from servobench.plant.contract.seeds import named_seed
from servobench.plant.robot.mismatch import MismatchSample, sample_mismatch
from servobench.plant.robot.sensed import SensedArm


@dataclass(frozen=True, eq=False)
class Drawn:
    """What is drawn for one run."""

    scenario: Scenario
    true: SensedArm | None = None  # the true robot and its cameras; None for a plant that brings its own
    sample: MismatchSample | None = None  # how it differs from the nominal one
    moved: SensedArm | None = None  # the true robot after its camera was moved; None if it is not
    cameras: CameraDraws | None = None  # how cameras differ from those planned; None where they are part of `sample`

    @property
    def final(self) -> SensedArm | None:
        """The true robot with the camera as it is at the end of the run."""
        return self.moved or self.true

    def as_record(self) -> dict[str, object]:
        """Return all values drawn for robot and cameras, for JSON."""
        parts = (self.sample, self.cameras)
        return {name: value for part in parts if part is not None for name, value in part.as_record().items()}


def draw(resolved: ResolvedRun) -> Drawn:
    """Draw the true robot and the task of a run.

    Raises:
        ConfigurationError: a mismatch or a task that cannot be used.
    """
    request, robot = resolved.request, find_robot(resolved.request.robot)
    sensing, seed = find_sensing(request.sensing), named_seed(request.seed, "mismatch")
    try:
        arm, sample = sample_mismatch(request.mismatch, robot, seed)
        true, cameras = sensing.true(robot, arm, sample, request.mismatch, seed)
    except ValueError as error:
        raise ConfigurationError(str(error)) from error
    moved = sample.moved(true, robot)
    task_seed = named_seed(request.seed, "task")
    setting = TaskSetting(true, true.arm.n, true.channel, task_seed, moved, robot, sensing.nominal(robot))
    return Drawn(build_scenario(resolved, setting), true, sample, moved, cameras)


def build_scenario(resolved: ResolvedRun, setting: TaskSetting) -> Scenario:
    """Return the task of a run as it is in a setting.

    Raises:
        ConfigurationError: a task that cannot be used there, or times that do not fit.
    """
    name = resolved.request.task
    try:
        scenario = find_task(name).build(resolved.task, setting)
    except ValueError as error:
        raise ConfigurationError(f"task {name}: {error}") from error
    check_times(resolved, scenario.duration)
    return scenario
