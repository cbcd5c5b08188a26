"""One run: from names, a mismatch and a seed to a row of results and a table of steps."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from controllers.controller import Controller, RobotKnowledge
from controllers.network_file import TrainedNetworks
from controllers.training import Progress
from controllers.training_config import TrainingConfig
from harness.configuration import ConfigurationError, Settings
from harness.log import StepLog
from harness.loop import LoopSettings, run_loop
from harness.metrics import Judgement, judge_run
from harness.registry import controller_names, find_controller, find_plant, plant_names
from harness.tasks import Scenario, find_task, task_names
from harness.training import network_source
from plant.hand_eye import HandEyeModel, hand_eye_spec
from plant.kinematic import KinematicConfig
from plant.mismatch import MismatchSample, parse_mismatch, sample_mismatch
from plant.plant import ImageArray, Plant, PlantSetup
from plant.seeds import named_seed
from plant.signals import PlantSpec, RunFault, check_number
from plant.symbolic import symbolic_feature
from plant.ur5 import TRAINING_LOWER, TRAINING_UPPER, nominal_ur5

COMPLETED = "completed"


@dataclass(frozen=True)
class RunSettings:
    """The section `run`: what is common to all plants, controllers and tasks."""

    period: float = 0.05  # s, control period
    preview: int = 10  # future rows of the reference that every controller is offered
    lost_after_periods: int = 20  # so many periods in a row without a valid feature end a run
    full_jacobian: bool = False  # log every entry of the estimated and the true Jacobian

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_number("period", self.period, above=0.0)
        check_number("preview", self.preview, at_least=0)
        check_number("lost_after_periods", self.lost_after_periods, at_least=1)


@dataclass(frozen=True)
class RunRequest:
    """What is asked for: one cell of a comparison."""

    plant: str
    controller: str
    task: str
    mismatch: str
    seed: int

    @property
    def run_id(self) -> str:
        """Return a name for the run that is the same wherever it is made, and fit for a file."""
        mismatch = re.sub(r"[^A-Za-z0-9.=+_-]", "_", self.mismatch)
        plant = re.sub(r"[^A-Za-z0-9.=+_-]", "_", self.plant)
        return f"{plant}-{self.controller}-{self.task}-{mismatch}-{self.seed}"


@dataclass(frozen=True)
class RunResult:
    """What came of it.

    Attributes:
        row: one row for the table of runs.
        steps: one row a period.
        picture: what the camera saw last, or None.
    """

    row: dict[str, Any]
    steps: pd.DataFrame
    picture: ImageArray | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Experiment:
    """A run made ready: all configuration resolved, the true robot drawn, plant and controller built."""

    plant: Plant
    controller: Controller
    scenario: Scenario
    run: RunSettings
    sample: MismatchSample

    @property
    def periods(self) -> int:
        """Number of control periods."""
        return max(1, math.ceil(self.scenario.duration / self.run.period - 1e-9))


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
    try:
        run = settings.resolve("run", RunSettings())
        nominal = nominal_ur5()
        mismatch = parse_mismatch(request.mismatch)
        true, sample = sample_mismatch(mismatch, nominal, named_seed(request.seed, "mismatch"))
        task = find_task(request.task)
        scenario = task.build(settings.resolve(request.task, task.default), true, named_seed(request.seed, "task"))
        plant = _build_plant(request, settings, PlantSetup(true, scenario.start, run.period))
    except ConfigurationError:
        raise
    except ValueError as error:
        raise ConfigurationError(str(error)) from error
    try:
        source = network_source(nominal.jacobian, plant.spec, keep, progress)
        knowledge = replace(_nominal_knowledge(plant.spec, run), train=source)
        controller = _build_controller(request, settings, knowledge, true)
    except BaseException:
        plant.close()
        raise
    return Experiment(plant, controller, scenario, run, sample)


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

    _build_controller(RunRequest("", controller, "", "", 0), settings, replace(knowledge, train=obtain), nominal)
    if not trained:
        raise ConfigurationError(f"controller {controller} has no networks to train")
    return trained[-1]


def run_experiment(
    request: RunRequest, settings: Settings, *, picture: bool = False, keep: Path | None = None
) -> RunResult:
    """Carry one run out; a fault on the way is told in the row's `status` and `reason`.

    Args:
        request: what to run.
        settings: overrides of the defaults.
        picture: also return what the camera saw last, where there is one.
        keep: results folder in which trained networks are kept beside the runs.

    Raises:
        ConfigurationError: a name, setting, mismatch or seed that cannot be used.
    """
    experiment = build_experiment(request, settings, keep=keep)
    plant, spec, scenario = experiment.plant, experiment.plant.spec, experiment.scenario
    log = StepLog(spec, full_jacobian=experiment.run.full_jacobian)
    loop = LoopSettings(experiment.periods, experiment.run.preview, experiment.run.lost_after_periods)
    status, reason = COMPLETED, ""
    try:
        with threadpool_limits(1), np.errstate(divide="raise", over="raise", invalid="raise"):
            run_loop(plant, experiment.controller, scenario.reference, loop, request.seed, log)
    except RunFault as fault:
        status, reason = fault.status, _one_line(fault)
    except FloatingPointError as error:
        status, reason = "numerical_error", _one_line(error)
    except Exception as error:  # noqa: BLE001 - a plug-in may raise anything; the batch goes on and the row says what
        status, reason = "crashed", f"{type(error).__name__}: {_one_line(error)}"
    finally:
        image = plant.picture() if picture and len(log) else None
        plant.close()
    steps = log.table(request.run_id)
    judgement = Judgement(spec, scenario.point_to_point, scenario.evaluate_from)
    row: dict[str, Any] = {
        "run_id": request.run_id,
        "plant": request.plant,
        "controller": request.controller,
        "task": request.task,
        "seed": request.seed,
        "mismatch": request.mismatch,
        "status": status,
        **(judge_run(steps, judgement) if len(steps) else {}),
        "periods": len(steps),
        "reason": reason,
        "mismatch_values": json.dumps(experiment.sample.as_record()),
    }
    return RunResult(row, steps, image)


def _nominal_knowledge(spec: PlantSpec, run: RunSettings) -> RobotKnowledge:
    """Return what every controller may know."""
    return RobotKnowledge(
        spec=spec,
        preview=run.preview,
        nominal_jacobian=nominal_ur5().jacobian,
        region=(np.array(TRAINING_LOWER), np.array(TRAINING_UPPER)),
    )


def _build_plant(request: RunRequest, settings: Settings, setup: PlantSetup) -> Plant:
    entry = find_plant(request.plant)
    config = settings.resolve(request.plant, entry.config())
    try:
        return entry.build(config, setup)
    except ValueError as error:
        raise ConfigurationError(f"plant {request.plant}: {error}") from error


def _build_controller(
    request: RunRequest, settings: Settings, knowledge: RobotKnowledge, true: HandEyeModel
) -> Controller:
    entry = find_controller(request.controller)
    config = settings.resolve(request.controller, entry.config())
    if entry.needs_truth:
        knowledge = replace(knowledge, true_jacobian=true.jacobian, true_symbolic=symbolic_feature(true))
    try:
        return entry.build(config, knowledge)
    except ValueError as error:
        raise ConfigurationError(f"controller {request.controller}: {error}") from error


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())
