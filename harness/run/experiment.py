"""A run made ready: from the settings of a run, or of runs that advance together, to plant and controller."""

import contextlib
import copy
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from servobench.controllers.controller import Controller, Delays, RobotKnowledge
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.fit import Progress
from servobench.harness.config.registry import find_controller, find_plant
from servobench.harness.config.sensing import find_sensing
from servobench.harness.config.source import same_folder
from servobench.harness.run.knowledge import network_source, nominal_knowledge
from servobench.harness.run.loop import CameraMove, LoopSettings
from servobench.harness.run.request import RunSettings
from servobench.harness.run.resolution import ResolvedRun
from servobench.harness.run.sampling import Drawn, build_scenario, draw, draw_once
from servobench.harness.run.scenario import Scenario, TaskSetting
from servobench.plant.bench.plant import Plant, PlantSetup, TrueModel
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, RunFault, configuration_errors
from servobench.plant.contract.lanes import stack
from servobench.plant.contract.seeds import named_seed
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import RobotModel, TrueJacobian
from servobench.plant.robot.mismatch import Mismatch


@dataclass(frozen=True, eq=False)
class Experiment:
    """A run made ready, or runs that advance together: true robots drawn, plant and controller built."""

    plant: Plant  # for runs that advance together a bench with a lane for each
    controller: Controller  # likewise
    runs: tuple[Drawn, ...]  # the true robot and the task of each run
    run: RunSettings  # the settings that all of them share
    networks: Sequence[TrainedNetworks] = ()  # networks that the controller started from, if any
    together: bool = False  # whether there are lanes, also for a single run

    @property
    def drawn(self) -> Drawn:
        """The true robot and the task of the run, or of the first run."""
        return self.runs[0]

    @property
    def scenario(self) -> Scenario:
        """Start, reference and length of the run, or of the first run."""
        return self.drawn.scenario

    @property
    def periods(self) -> int:
        """Number of control periods."""
        return self.run.periods(self.scenario.duration)

    @property
    def loop(self) -> LoopSettings:
        """The settings of the loop, with the camera's pose (..., 4, 4) after a move."""
        run = self.run
        moved = [each.moved.camera for each in self.runs if each.moved is not None]
        move = None
        if moved:
            instant = int(run.camera_moves_at * self.periods)
            move = CameraMove(instant, self._in_lanes(moved))
        jumps = self.scenario.jump_periods(run.period)
        lost_after = run.periods(run.lost_after)
        return LoopSettings(self.periods, run.preview_rows, lost_after, move, jumps)

    def desired(self, periods: int | None = None) -> FloatArray:
        """Return the desired features of the run, or of this number of periods, and of the previewed rows beyond.

        Returns:
            (..., periods + preview, m) [unit of the feature].
        """
        rows = (periods or self.periods) + self.run.preview_rows
        period = self.plant.spec.period
        return self._in_lanes([each.scenario.reference.sampled(period, rows) for each in self.runs])

    def _in_lanes(self, arrays: list[FloatArray]) -> FloatArray:
        if self.together:
            return np.stack(arrays)
        return arrays[0]


@same_folder()
def build(resolved: ResolvedRun, *, progress: Progress | None = None) -> Experiment:
    """Make a run ready.

    Args:
        resolved: the run.
        progress: called with the share of a training of networks that is done.

    Raises:
        ConfigurationError: a name, setting, mismatch or seed that cannot be used.
    """
    request = resolved.request
    if not find_plant(request.plant).own_robot:
        drawn = draw(resolved)
        start = drawn.scenario.start
        plant, controller, networks = _assemble(resolved, drawn.true, start, progress)
        return Experiment(plant, controller, (drawn,), resolved.run, networks)
    brings = f"plant {request.plant} brings a"
    if request.mismatch != Mismatch():
        raise ConfigurationError(
            f"{brings} robot of its own, to which mismatches do not apply; use the mismatch none"
        )
    if request.sensing != DEFAULT_SENSING:
        raise ConfigurationError(
            f"{brings} sensor of its own, so the sensing {request.sensing} does not apply"
        )
    plant, controller, networks = _assemble(resolved, None, None, progress)
    try:
        seed = named_seed(request.seed, "task")
        setting = TaskSetting(None, plant.spec.n, plant.spec.feature, seed)
        drawn = Drawn(build_scenario(resolved, setting))
    except BaseException:
        plant.close()
        raise
    return Experiment(plant, controller, (drawn,), resolved.run, networks)


@same_folder()
def build_together(runs: Sequence[ResolvedRun]) -> Experiment:
    """Make runs of one `lanes.side_by_side_key` ready, with a lane for each.

    Raises:
        Exception: any error of a run alone, or runs that cannot advance together.
    """
    first = runs[0]
    drawn = tuple(map(draw_once, runs))
    robots = stack([each.true for each in drawn])
    starts = np.array([each.scenario.start for each in drawn])
    plant, controller, networks = _assemble(first, robots, starts)
    return Experiment(plant, controller, drawn, first.run, networks, together=True)


def _assemble(
    resolved: ResolvedRun,
    true: RobotModel | None,
    start: FloatArray | None,
    progress: Progress | None = None,
) -> tuple[Plant, Controller, Sequence[TrainedNetworks]]:
    """Return plant, controller and its networks for a true robot and a start (..., n) [rad].

    For None the plant brings its own. Of runs side by side the arrays of the robot have a leading axis, and `resolved`
    is one of them.
    """
    request = resolved.request
    run = resolved.run
    entry = find_plant(request.plant)
    if request.sensing != DEFAULT_SENSING and not entry.any_sensing:
        raise ConfigurationError(
            f"plant {entry.name} has the sensing position only, got {request.sensing}"
        )
    robot = None if entry.own_robot else find_robot(request.robot)
    setup = PlantSetup(true, start, run.period, robot)
    with same_folder(), configuration_errors(f"plant {request.plant}: ", RunFault):
        plant = entry.build(resolved.plant, setup)
    if not math.isclose(plant.spec.period, run.period):
        plant.close()
        raise ConfigurationError(
            f"plant {request.plant}: spec.period must be that of its setup, {run.period:g} s"
        )
    try:
        if true is not None and request.mismatch.size("camera_move") > 0.0:
            # Refused where it cannot be moved; a user's camera may lack something before its reset.
            with (
                contextlib.suppress(AttributeError, TypeError),
                configuration_errors(f"plant {request.plant}: "),
            ):
                plant.move_camera(true.camera)
        if robot is None:
            jacobian = plant.nominal_jacobian()
            knowledge = RobotKnowledge(plant.spec, run.preview_rows, jacobian)
            trained = knowledge
        else:
            nominal = find_sensing(request.sensing).nominal(robot)
            knowledge, trained = nominal_knowledge(robot, nominal, plant.spec, run)
        source = network_source(trained, progress)
        true_model = partial(_true_model, plant, true)
        with naming_the_lack(plant, own_robot=robot is None):
            controller = _build_controller(resolved, replace(knowledge, train=source), true_model)
    except BaseException:
        plant.close()
        raise
    return plant, controller, () if source is None else source.given


@contextlib.contextmanager
def naming_the_lack(plant: Plant, *, own_robot: bool) -> Iterator[None]:
    """Add to an error of a controller that calls the nominal model where there is none that this is so."""
    try:
        yield
    except (AttributeError, ConfigurationError, TypeError) as error:
        calls_none = re.search("NoneType|callable", str(error))
        if own_robot and plant.nominal_jacobian() is None and calls_none:
            lack = "knowledge.nominal_jacobian is None here: this plant has no model"
            if isinstance(error, ConfigurationError):
                raise ConfigurationError(f"{error}; {lack}") from error
            error.add_note(lack)
        raise


def _true_model(plant: Plant, true: RobotModel | None) -> TrueModel:
    """Return the model of a true robot with the delays of its plant; for None that of the plant's own robot."""
    if true is None:
        return plant.true_model()
    return plant.with_delays(_equations(true))


def _equations(model: RobotModel) -> TrueModel:
    def symbolic(joint_position: Any) -> Any:  # noqa: ANN401 - expressions of CasADi
        from servobench.plant.cameras.symbolic import symbolic_feature  # noqa: PLC0415 - only the extra mpc brings CasADi

        return symbolic_feature(model)(joint_position)

    return TrueModel(TrueJacobian(model), symbolic)


def _build_controller(
    run: ResolvedRun, knowledge: RobotKnowledge, true_model: Callable[[], TrueModel]
) -> Controller:
    """Build a controller; the truth goes only to one that asks for it, as the nominal model where there is none."""
    entry = find_controller(run.request.controller)
    with configuration_errors(f"controller {run.request.controller}: "):
        if entry.needs_truth:
            true = true_model()
            delays = Delays(true.latency, true.command_delay, true.lag or 0.0, true.latency_spread)
            knowledge = replace(
                knowledge,
                nominal_jacobian=knowledge.nominal_jacobian or true.jacobian,
                true_jacobian=true.jacobian,
                true_symbolic=true.symbolic,
                true_delays=delays,
                true_camera_turn=true.camera_turn,
                true_tool=true.tool,
            )
        # Runs share the settings, which a class of a user's may change.
        config = run.controller
        parameters = getattr(type(config), "__dataclass_params__", None)
        if parameters is None or not parameters.frozen:
            config = copy.deepcopy(config)
        return entry.build(config, knowledge)
