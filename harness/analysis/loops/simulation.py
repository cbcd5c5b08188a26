"""Stability limits by simulation: small motions of the kinematic plant without noise, the estimator frozen.

Two runs from the same state differ by a small offset of the reference; where a posture term moves the arm, both move.
Neither the arm nor the controller is linear here; only the motions are small.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servobench.harness.analysis.loops.equilibrium import Warm, at_rest
from servobench.harness.analysis.loops.linearise import frozen
from servobench.plant.bench.plant import Plant, PlantSetup
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.sensing import without_disturbance
from servobench.plant.contract.signals import Command
from servobench.plant.kinematic import KinematicConfig, build_kinematic
from servobench.plant.robot.hand_eye import HandEyeModel

OFFSET = 1e-4  # [m] of the desired feature in each axis, from which the motions begin
WINDOWS = 4  # of the run; a stable one has a smaller error in the last than in the second, and than at the begin
NEGLIGIBLE = 0.01  # [1] of the first error; rounding and slow learning may make a smaller one grow
DURATION = 20.0  # [s]
MAX_LATENCY = 3.0  # [s] largest latency that is tried
MAX_GAIN = 32.0  # largest factor that is tried
TIME_DIGITS = 3  # of a latency [s], as worlds advance in whole milliseconds
PRECISION = 0.02  # [1] of the limit of the gain


class SmallLoop:
    """A composed controller, frozen at its rest, on the kinematic plant without noise."""

    def __init__(self, warm: Warm, model: HandEyeModel, config: KinematicConfig) -> None:
        """Freeze the controller, whose estimator tells the true Jacobian wherever the arm is.

        Args:
            warm: the composed controller after its warm-up.
            model: the true robot.
            config: of the plant; its noise and lost frames are left out.
        """
        servo, state, self._rest = at_rest(warm, "true")
        self._servo, self._state = frozen(servo, state, model.jacobian)
        self._model, self._config, self._period = model, config, warm.arm.period
        self.latency = config.sensing.latency

    def is_stable(self, factor: float = 1.0, latency: float | None = None) -> bool:
        """Return whether small motions die out.

        Args:
            factor: on the command.
            latency: of the camera [s]; None for that of the plant's settings.
        """
        moved, rested = (self._features(factor, latency, offset) for offset in (OFFSET, 0.0))
        errors = np.linalg.norm(moved - rested - OFFSET, axis=-1)
        length = len(errors) // WINDOWS
        last = errors[-length:].max()
        gone = last < NEGLIGIBLE * errors[0]
        return bool(gone or last < min(errors[length : 2 * length].max(), errors[0]))

    def latency_limit(self) -> float:
        """Return the largest latency, in whole periods more than that of the plant, before one that is unstable [s]."""
        latency = self.latency
        if not self.is_stable():
            return 0.0
        while latency < MAX_LATENCY and self.is_stable(latency=latency + self._period):
            latency += self._period
        return latency

    def gain_limit(self) -> float:
        """Return the factor on the command above which the loop is unstable, up to `MAX_GAIN`."""
        stable, unstable = 1.0 / MAX_GAIN, MAX_GAIN
        while unstable / stable > 1.0 + PRECISION:
            middle = float(np.sqrt(stable * unstable))
            stable, unstable = (middle, unstable) if self.is_stable(middle) else (stable, middle)
        return float(np.sqrt(stable * unstable))

    def _plant(self, latency: float | None) -> Plant:
        late = self.latency if latency is None else latency
        sensing = replace(without_disturbance(self._config.sensing), latency=round(late, TIME_DIGITS))
        setup = PlantSetup(self._model, self._rest.joint_position, self._period)
        return build_kinematic(replace(self._config, sensing=sensing), setup)

    def _features(self, factor: float, latency: float | None, offset: float) -> FloatArray:
        """Return the true feature in each period, (periods, m), with the desired one moved by an offset [m]."""
        plant, state, rest, period = self._plant(latency), self._state, self._rest, self._period
        reference = rest.reference(rest.feature + offset)
        observation = plant.reset(0)
        features = np.zeros((round(DURATION / period), len(rest.feature)))
        for k in range(len(features)):
            seen = rest.observation(observation.feature, observation.joint_position, k * period)
            state, u = self._servo.step(state, seen, reference)
            observation = plant.step(Command(factor * u))
            features[k] = plant.truth().feature
        plant.close()
        return features
