"""A bound on learning: it knows nothing of the true robot until a moment, and then all that `calibrated` knows."""

from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, cast, final

from servobench.controllers.controller import (
    Controller,
    ControllerEntry,
    Diagnostics,
    RobotKnowledge,
)
from servobench.controllers.methods import METHODS
from servobench.controllers.servo import ServoController
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.files import read_toml
from servobench.plant.contract.settings import NonNegative, override, settings
from servobench.plant.contract.signals import Command, Observation

UNKNOWING = "regression_mfac"
KNOWING = "calibrated"


@settings
class RevealedConfig:
    """Settings of `revealed`."""

    reveal_time: NonNegative = 0.2
    """[s] of the run at which the true robot becomes known."""


@final
class Revealed(Controller):
    """The method `regression_mfac` until the reveal time, and `calibrated` from then on.

    It does as well as a learner that knows nothing until then and everything afterwards, with the law of `calibrated`.
    A method that learns earlier, moves better meanwhile, or has another law may be better.
    `calibrated` follows the run from its start, so that it knows which commands are still under way.
    """

    def __init__(self, config: RevealedConfig, knowledge: RobotKnowledge) -> None:
        """Build both methods; the first one does not get the truth."""
        unknowing = replace(
            knowledge,
            true_jacobian=None,
            true_symbolic=None,
            true_delays=None,
            true_camera_turn=0.0,
            true_tool=(0.0, 0.0),
        )
        self._reveal_time = config.reveal_time
        self._period = knowledge.spec.period
        self._unknowing = _method(UNKNOWING, unknowing)
        self._knowing = _method(KNOWING, knowledge)
        self._active = self._unknowing

    def reset(self, observation: Observation, seed: int) -> None:
        """Begin a run, in which the true robot is unknown."""
        self._active = self._unknowing
        for method in (self._unknowing, self._knowing):
            method.reset(observation, seed)

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the command of the method of this time."""
        command = self._knowing.step(observation, reference)
        if observation.time >= self._reveal_time - 1e-9:
            self._active = self._knowing
            return command
        command = self._unknowing.step(observation, reference)
        self._note(command)
        return command

    def diagnostics(self) -> Diagnostics:
        """Return the diagnostics of the method of this time."""
        return self._active.diagnostics()

    def estimated_jacobian(self) -> FloatArray | None:
        """Return the Jacobian (m, n) of the method of this time."""
        return self._active.estimated_jacobian()

    def _shared(self) -> tuple[object, ...]:
        return self._unknowing.servo, self._knowing.servo

    def _note(self, command: Command) -> None:
        """Let the method that waits know that another command than its own was sent."""
        state = cast(Any, self._knowing.state)
        response = state.predictor.response
        sent = response.commands.copy()
        sent[0] = self._period * command.joint_velocity
        predictor = state.predictor._replace(response=response._replace(commands=sent))
        self._knowing.restore(state._replace(predictor=predictor))


def _method(name: str, knowledge: RobotKnowledge) -> ServoController:
    """Return a method with its tuned values."""
    entry = METHODS[name]
    file = Path(str(files("servobench.controllers") / "tuned" / f"{name}.toml"))
    tuned = read_toml("tuned values", file)["settings"]
    config = override(name, entry.config(), tuned)
    return cast(ServoController, entry.build(config, knowledge))


ENTRY = ControllerEntry(
    "revealed",
    "regression_mfac until 0.2 s, then calibrated: a bound of what learning within a run can reach",
    RevealedConfig,
    Revealed,
    needs_truth=True,
)
