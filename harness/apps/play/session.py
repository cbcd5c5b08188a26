"""Runs without an end that are steered while they go on: one controller, or two on the same robot and noise.

A side has a plant and a controller of its own, and goes through the loop of every run. The same seed draws the same
true robot and noise for both. A target is a reading of the camera, so that one that is knocked takes it along.
"""

import sys
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, final

import numpy as np

from servobench.harness.config.registry import find_plant
from servobench.harness.config.settings import Settings
from servobench.harness.run.contract import held_to_contract
from servobench.harness.run.experiment import Experiment, build
from servobench.harness.run.feasibility import check_possible
from servobench.harness.run.log import Period
from servobench.harness.run.loop import begin, periods
from servobench.harness.run.references import FixedPoint
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.harness.run.result import Ending
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.seeds import named_seed
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.robot.catalogue import find_robot

KNOCK_AXIS = np.array([0.28, 0.0, 0.96])  # in the frame of the camera, nearly its optical axis
HISTORY = 20.0  # [s] time over which errors are kept


@final
class Side:
    """A run of one controller.

    Attributes:
        name: of the controller.
        experiment: its plant and its controller.
        period: the last one; None before the first.
        numbers: diagnostics of the controller in the last period, by name.
        reason: why it ended; empty while it goes on.
    """

    def __init__(self, name: str, experiment: Experiment, seed: int) -> None:
        """Begin a run.

        Raises:
            RunFault: it cannot begin.
        """
        self.name = name
        self.experiment = experiment
        self.period: Period | None = None
        self.numbers: Any = {}
        self.reason = ""
        plant, controller = held_to_contract(experiment.plant, experiment.controller)
        self._controller = controller
        endless = replace(experiment.loop, periods=sys.maxsize, lost_after_periods=sys.maxsize)
        seeds = (named_seed(seed, "plant"), named_seed(seed, "controller"))
        self._rollout = begin(plant, controller, experiment.desired(1), endless, seeds)
        self._periods = periods(self._rollout, controller)

    def advance(self, desired: FloatArray) -> float:
        """Go on by a period towards desired features, (1 + preview, m), unless the run has ended.

        Any error ends the run, as a plug-in may raise any, and the other side goes on.

        Returns:
            The error of the true feature [mm]; NaN after the end.
        """
        if self.reason:
            return np.nan
        self._rollout.redirect(desired)
        try:
            period = next(self._periods)
            self.numbers = self._controller.diagnostics()
        except Exception as error:  # noqa: BLE001
            self.reason = Ending.of(error).reason
            return np.nan
        self.period = period
        return 1e3 * float(np.linalg.norm(desired[0] - period.truth.feature))


@final
class Session:
    """The sides and their common reference.

    Attributes:
        request: what the sides share.
        sides: one or two.
        sensing: the settings of the sensor; the usual ones for a plant that has none.
        model: the true robot, a `RobotModel`, with the camera as it is now.
        held: whether a target is held that was given, in place of the reference of the task.
        period: between two control instants [s].
        errors: time [s] and error of each side [mm], of the last periods.
    """

    def __init__(self, request: RunRequest, controllers: Sequence[str], settings: Settings) -> None:
        """Begin a run of each controller; the settings are overrides of the defaults.

        Raises:
            ConfigurationError: a name or a setting that cannot be used.
            RunFault: a run cannot begin.
        """
        self.request = request
        self.sides: list[Side] = []
        if find_plant(request.plant).own_robot:
            raise ConfigurationError(f"plant {request.plant} brings a robot that cannot be drawn")
        with ExitStack() as stack:
            for name in controllers:
                resolved = resolve(replace(request, controller=name), settings)
                experiment = build(resolved)
                stack.callback(experiment.plant.close)
                check_possible(resolved, experiment.drawn, experiment.plant.spec)
                self.sides.append(Side(name, experiment, request.seed))
            self.close = stack.pop_all().close
        self.sensing = getattr(resolved.plant, "sensing", SensingConfig())
        self.model: Any = experiment.drawn.true
        self.period = experiment.run.period
        self.held = False
        self.errors: deque[list[float]] = deque(maxlen=experiment.run.periods(HISTORY))
        self._move = experiment.loop.camera_move
        self._reference = experiment.scenario.reference
        self._rows = np.arange(1 + experiment.run.preview_rows)
        self.advance()

    def advance(self) -> None:
        """Let all sides go on by a control period."""
        times = self.period * self._rows
        desired = self._reference.at(times)
        self.errors.append([times[0], *(side.advance(desired) for side in self.sides)])
        if self._move is not None and self._rows[0] == self._move.period:
            self.model = self.model.with_camera(self._move.X_BC)
        self._rows += 1

    def aim(self, place: FloatArray) -> None:
        """Hold a place of the camera's frame, (3,) m, as the target from now on."""
        self.held = True
        self._reference = FixedPoint(place)

    def knock(self, angle: float) -> None:
        """Turn the camera of all sides by an angle [rad] about nearly its optical axis.

        Raises:
            ValueError: a plant without a camera that could be moved.
        """
        centre = find_robot(self.request.robot).workspace.centre
        moved = self.model.turned(angle * KNOCK_AXIS, centre)
        for side in self.sides:
            side.experiment.plant.move_camera(moved.camera)
        self.model = moved
