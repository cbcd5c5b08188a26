"""What learning for longer gains: `calibrating_mfac`, of which regression and arm learn nothing from a moment on.

    servobench suite --challenges zeros180,gears50,unknown_arm --plants kinematic --seeds 202020:202060 \
        --controllers ./benchmarks/frozen.py --set Frozen.until=0.2 --out results/frozen

Its Jacobian still follows the joints by what was learned until then, and its filter the frames.
"""

from typing import Any, cast, final

import numpy as np

from servobench.controllers.controller import Controller, Diagnostics, RobotKnowledge
from servobench.controllers.methods import METHODS
from servobench.controllers.servo import ServoController
from servobench.controllers.stages.calibration import CalibrationState, Regressed
from servobench.controllers.stages.regression import RegressionState
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.settings import NonNegative, settings
from servobench.plant.contract.signals import BoolArray, Command, Observation

METHOD = "calibrating_mfac"


@settings
class FrozenConfig:
    """Settings of `Frozen`."""

    until: NonNegative = 0.2
    """[s] of the run until which it learns."""


@final
class Frozen(Controller):
    """The method, which learns until a moment."""

    def __init__(self, config: FrozenConfig, knowledge: RobotKnowledge) -> None:
        """Build the method."""
        entry = METHODS[METHOD]
        self._method = cast(ServoController, entry.build(entry.config(), knowledge))
        self._until = config.until
        self._learns = True
        self._stand_between(self._method.servo)

    def _stand_between(self, servo: Any) -> None:  # noqa: ANN401 - whose methods are replaced
        """Let the stages of a servo ask this controller what they learn."""
        self._calibration_update = servo.calibration.update
        servo.calibration.update = self._calibrated
        regression = servo.estimation.pairing.regression
        self._regression_update = regression.update
        regression.update = self._regressed

    def _calibrated(
        self,
        state: CalibrationState,
        observation: Observation,
        due: BoolArray,
        regression: Regressed,
        late: FloatArray | None,
    ) -> CalibrationState:
        """Return the state of the calibrating stage after an observation, which counts while it learns."""
        if self._learns:
            learned: CalibrationState = self._calibration_update(
                state, observation, due, regression, late
            )
            return learned
        # Members that were never fitted are not searched any more, either.
        idle = state._replace(begun=np.full_like(state.begun, -1))
        never = np.zeros_like(due)
        moved: CalibrationState = self._calibration_update(
            idle, observation, never, regression, late
        )
        return moved._replace(begun=state.begun, used=state.used)

    def _regressed(
        self,
        before: RegressionState,
        h: FloatArray,
        feature_step: FloatArray,
        duration: FloatArray,
        frame: FloatArray,
    ) -> RegressionState:
        """Return the regression after a frame; of one that learns no more, the noise of the frame alone is new."""
        after: RegressionState = self._regression_update(before, h, feature_step, duration, frame)
        if self._learns:
            return after
        m = before.mean.shape[-2]
        bank = after.bank.copy()
        bank[..., :m, :-1] = before.bank[..., :m, :-1]
        mean = np.concatenate([before.mean[..., :-1], after.mean[..., -1:]], axis=-1)
        return after._replace(bank=bank, mean=mean)

    def reset(self, observation: Observation, seed: int) -> None:
        """Begin a run."""
        self._learns = True
        self._method.reset(observation, seed)

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the command of the method."""
        self._learns = observation.time < self._until - 1e-9
        command: Command = self._method.step(observation, reference)
        return command

    def diagnostics(self) -> Diagnostics:
        """Return those of the method."""
        found: Diagnostics = self._method.diagnostics()
        return found
