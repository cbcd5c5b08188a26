"""A run made ready: from names, a mismatch and a seed to plant, controller and scenario."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from servobench.controllers.controller import Controller, RobotKnowledge
from servobench.controllers.networks.config import TrainingConfig
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.fit import Progress
from servobench.harness.config.defaults import default_config
from servobench.harness.config.registry import (
    controller_names,
    find_controller,
    find_plant,
    plant_names,
)
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.harness.run.loop import CameraMove, LoopSettings
from servobench.harness.run.network_cache import network_source
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.tasks import (
    Scenario,
    TaskSetting,
    find_task,
    task_names,
)
from servobench.plant.bench import vary_sensing
from servobench.plant.faults import RunFault
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.plant import (
    Plant,
    PlantEntry,
    PlantSetup,
    TrueModel,
)
from servobench.plant.robot.hand_eye import FEATURE_NAMES, HandEyeModel, hand_eye_spec
from servobench.plant.robot.mismatch import Mismatch, MismatchSample, sample_mismatch
from servobench.plant.robot.ur5 import TRAINING_LOWER, TRAINING_UPPER, nominal_ur5
from servobench.plant.seeds import named_seed
from servobench.plant.signals import PlantSpec


@dataclass(frozen=True)
class Experiment:
    """A run made ready: all configuration resolved, the true robot drawn, plant and controller built."""

    plant: Plant
    controller: Controller
    scenario: Scenario
    run: RunSettings
    sample: MismatchSample | None
    moved: HandEyeModel | None = None

    @property
    def loop(self) -> LoopSettings:
        """What the loop has to know."""
        move = None
        if self.moved is not None:
            move = CameraMove(int(self.run.camera_moves_at * self.periods), self.moved.X_BC)
        return LoopSettings(self.periods, self.run.preview, self.run.lost_after_periods, move)

    @property
    def periods(self) -> int:
        """Number of control periods."""
        return self.run.periods(self.scenario.duration)


def known_sections() -> list[str]:
    """Return every section that a configuration may have."""
    return ["run", *plant_names(), *controller_names(), *task_names()]


def build_experiment(
    request: RunRequest, settings: Settings, *, keep: Path | None = None, progress: Progress | None = None
) -> Experiment:
    """Make a run ready.

    Args:
        request: what to run.
        settings: overrides of the defaults.
        keep: results folder in which trained networks are kept beside the runs.
        progress: told how far a training of networks is.

    Raises:
        ConfigurationError: a name, setting, mismatch or seed that cannot be used.
    """
    run = settings.resolve("run", RunSettings())
    entry = find_plant(request.plant)
    if entry.own_robot:
        return _build_with_own_robot(request, settings, run, entry, keep, progress)
    nominal = nominal_ur5()
    try:
        true, sample = sample_mismatch(request.mismatch, nominal, named_seed(request.seed, "mismatch"))
    except ValueError as error:
        raise ConfigurationError(str(error)) from error
    moved = sample.moved(true)
    setting = TaskSetting(true, true.arm.n, FEATURE_NAMES, named_seed(request.seed, "task"), moved)
    scenario = _build_scenario(request, settings, setting)
    plant = _build_plant(request, settings, entry, PlantSetup(true, scenario.start, run.period))
    try:
        source = network_source(nominal.jacobian, plant.spec, keep, progress)
        knowledge = replace(_nominal_knowledge(plant.spec, run), train=source)
        controller = _build_controller(request, settings, knowledge, lambda: _equations(true))
    except BaseException:
        plant.close()
        raise
    return Experiment(plant, controller, scenario, run, sample, moved)


def train_networks(controller: str, settings: Settings, progress: Progress) -> TrainedNetworks:
    """Return the networks that a controller of this name starts from, trained where the cache has none.

    Raises:
        ConfigurationError: a name or setting that cannot be used, or a controller without networks.
    """
    trained: list[TrainedNetworks] = []
    run = settings.resolve("run", RunSettings())
    plant = KinematicConfig()
    nominal = nominal_ur5()
    knowledge = _nominal_knowledge(hand_eye_spec(nominal, run.period, plant.max_joint_speed, plant.joint_range), run)
    source = network_source(nominal.jacobian, knowledge.spec, progress=progress)

    def obtain(config: TrainingConfig) -> TrainedNetworks:
        trained.append(source(config))
        return trained[-1]

    request = RunRequest("", controller, "", Mismatch(), 0)
    _build_controller(request, settings, replace(knowledge, train=obtain), lambda: _equations(nominal))
    if not trained:
        raise ConfigurationError(f"controller {controller} has no networks to train")
    return trained[-1]


def _nominal_knowledge(spec: PlantSpec, run: RunSettings) -> RobotKnowledge:
    """Return what every controller may know."""
    return RobotKnowledge(
        spec=spec,
        preview=run.preview,
        nominal_jacobian=nominal_ur5().jacobian,
        region=(np.array(TRAINING_LOWER), np.array(TRAINING_UPPER)),
    )


def _build_with_own_robot(
    request: RunRequest,
    settings: Settings,
    run: RunSettings,
    entry: PlantEntry,
    keep: Path | None,
    progress: Progress | None,
) -> Experiment:
    """Make a run ready on a plant of whose robot only the plant itself knows anything."""
    if request.mismatch != Mismatch():
        raise ConfigurationError(
            f"plant {request.plant} brings a robot of its own, to which mismatches do not apply; use --mismatch none"
        )
    plant = _build_plant(request, settings, entry, PlantSetup(None, None, run.period))
    try:
        spec = plant.spec
        setting = TaskSetting(None, spec.n, spec.feature_names, named_seed(request.seed, "task"))
        scenario = _build_scenario(request, settings, setting)
        nominal = plant.nominal_jacobian()
        source = None if nominal is None else network_source(nominal, spec, keep, progress)
        knowledge = RobotKnowledge(spec, run.preview, nominal, train=source)
        controller = _build_controller(request, settings, knowledge, plant.true_model)
    except BaseException:
        plant.close()
        raise
    return Experiment(plant, controller, scenario, run, None)


def _equations(model: HandEyeModel) -> TrueModel:
    def symbolic(joint_position: Any) -> Any:  # noqa: ANN401 - expressions of CasADi
        from servobench.plant.robot.symbolic import symbolic_feature  # noqa: PLC0415 - only the extra mpc brings CasADi

        return symbolic_feature(model)(joint_position)

    return TrueModel(model.jacobian, symbolic)


def _build_scenario(request: RunRequest, settings: Settings, setting: TaskSetting) -> Scenario:
    task = find_task(request.task)
    config = settings.resolve(request.task, task.default)
    try:
        return task.build(config, setting)
    except ValueError as error:
        raise ConfigurationError(f"task {request.task}: {error}") from error


def _build_plant(request: RunRequest, settings: Settings, entry: PlantEntry, setup: PlantSetup) -> Plant:
    config = settings.resolve(request.plant, entry.config())
    try:
        if request.noise_factor != 1.0 or request.latency_periods is not None:
            config = vary_sensing(config, request.noise_factor, request.latency_periods)
        return entry.build(config, setup)
    except (ValueError, RunFault) as error:
        raise ConfigurationError(f"plant {request.plant}: {error}") from error


def _build_controller(
    request: RunRequest, settings: Settings, knowledge: RobotKnowledge, tell: Callable[[], TrueModel]
) -> Controller:
    """Build a controller; only one that asks for the truth has it told. Where no model is nominal, the truth is."""
    entry = find_controller(request.controller)
    config = settings.resolve(request.controller, default_config(entry))
    try:
        if entry.needs_truth:
            true = tell()
            nominal = knowledge.nominal_jacobian or true.jacobian
            knowledge = replace(
                knowledge, nominal_jacobian=nominal, true_jacobian=true.jacobian, true_symbolic=true.symbolic
            )
        return entry.build(config, knowledge)
    except ValueError as error:
        raise ConfigurationError(f"controller {request.controller}: {error}") from error
