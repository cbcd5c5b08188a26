"""A trained policy in an ONNX file as a controller, `onnx:FILE`: it sees and returns what it does in the environment.

    a, h′ = π(s, h),      u = clip(a, −1, 1) u_max

| | in the file | content |
|---|---|---|
| s | the first input | k numbers, what `Spaces.observe` returns |
| a | the first output | n shares of the joints' speed limits |
| h | each further input, such as `state` | memory, 0 at the beginning of a run |
| h′ | an output of the same name and `_next`, such as `state_next` | the memory of the next period |

All are floats of 32 bits; an axis whose length is not fixed has the length 1. A policy that takes two numbers more than
an observation has gets the stamps of frames, too.
"""

from pathlib import Path
from typing import Any, final

import numpy as np
from onnxruntime import InferenceSession, SessionOptions

from servobench.controllers.controller import Controller, RobotKnowledge
from servobench.harness.config.entries import NoSettings
from servobench.harness.gym.environment import Spaces
from servobench.plant.contract.checks import FloatArray, Floats32
from servobench.plant.contract.faults import configuration_errors
from servobench.plant.contract.signals import Command, Observation


@final
class Policy(Controller):
    """u = clip(a, −1, 1) u_max for the action a of an ONNX file."""

    @configuration_errors("", Exception)  # onnxruntime's errors have no other base
    def __init__(self, path: Path, _config: NoSettings, knowledge: RobotKnowledge) -> None:
        """Load a file and try it.

        Raises:
            ConfigurationError: it is no policy for this robot and task; the message is that of onnxruntime, where that
                refuses it.
        """
        options = SessionOptions()
        options.intra_op_num_threads = 1
        options.log_severity_level = 4  # fatal ones alone are printed; errors are raised
        self._session = InferenceSession(path, options, providers=["CPUExecutionProvider"])
        self._first = {port.name: _zeros(port.shape) for port in self._session.get_inputs()}
        self._seen, *memory = self._first
        action = self._session.get_outputs()[0].name
        self._outputs = [action, *(name + "_next" for name in memory)]
        came = self._first[self._seen].size
        size = Spaces(knowledge.spec, knowledge.preview).observations.shape[0]
        self._spaces = Spaces(knowledge.spec, knowledge.preview, stamps=came > size)
        if came != self._spaces.observations.shape[0]:
            raise ValueError(
                f"{self._seen} takes {came} numbers, an observation has {size}; run.preview_time changes it"
            )
        self._inputs = dict(self._first)
        for _ in range(2):  # the second time with the memory of the first
            self._act(np.ones(came, np.float32))

    def _shared(self) -> tuple[object]:
        """Return the session, which has no state."""
        return (self._session,)

    def _act(self, seen: Floats32) -> None:
        """Take the next action and memory.

        Raises:
            ValueError: the action is not n finite numbers.
        """
        self._inputs[self._seen] = seen.reshape(self._first[self._seen].shape)
        action, *memory = self._session.run(self._outputs, self._inputs)
        self._action = self._spaces.action(np.ravel(action))
        self._inputs = dict(zip(self._first, [seen, *memory], strict=True))

    def reset(self, observation: Observation, seed: int) -> None:
        """Forget the last run; nothing here is random."""
        self._spaces.begin(observation)
        self._action = np.zeros(self._spaces.spec.n)
        self._inputs = dict(self._first)

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the velocity of the policy's action.

        Raises:
            ValueError: the action is not finite.
        """
        self._act(self._spaces.observe(observation, reference, self._action))
        return Command(self._spaces.command(self._action))


def _zeros(shape: list[Any]) -> Floats32:
    """Return zeros, with an axis of length 1 where it has a name, or none, in place of a length."""
    lengths = [length if isinstance(length, int) else 1 for length in shape]
    return np.zeros(lengths, np.float32)
