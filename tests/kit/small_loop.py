"""The oracle of predicted limits of stability: small motions of the kinematic plant without noise.

Two runs from the same state differ by a small offset of the reference; where a posture term moves the arm, both move.
Neither the arm nor the controller is linear here; only the motions are small.
"""

from dataclasses import replace

import numpy as np

from servobench.harness.apps.loops.equilibrium import Warm, at_rest, frozen
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.signals import Command
from servobench.plant.kinematic import build_kinematic

OFFSET = 1e-4  # [m] shift of the desired feature in each axis, which starts the motions
# A run is cut into windows; a stable one has a smaller error in the last than in the second, and than at its start.
WINDOWS = 4
# An error below this share of the first one has died out; rounding and slow learning may make it grow again.
SETTLED_ERROR_RATIO = 0.01  # [1]
DURATION = 20.0  # [s] length of a simulated run
MAX_LATENCY = 3.0  # [s] largest latency that is tried
MAX_GAIN = 32.0  # [1] largest factor that is tried
TIME_DIGITS = 9  # decimal places of a latency [s] that is tried
GAIN_PRECISION = 0.02  # [1] relative precision of the limit of the gain


class SmallLoop:
    """A composed controller, frozen at its rest, on the kinematic plant without noise."""

    def __init__(self, warm: Warm) -> None:
        """Freeze a composed controller, whose estimator returns the true Jacobian at every posture.

        Noise and lost frames of the plant are left out.
        """
        servo, state, self._rest = at_rest(warm, "true")
        self._servo, self._state = frozen(servo, state, warm.model.jacobian)
        self._warm = warm
        self._period = warm.arm.period
        self.latency = warm.plant.sensing.latency

    def is_stable(self, factor: float = 1.0, latency: float | None = None) -> bool:
        """Return whether small motions die out with a factor on the command and another latency of the camera [s]."""
        moved = self._features(factor, latency, OFFSET)
        rested = self._features(factor, latency, 0.0)
        errors = np.linalg.norm(moved - rested - OFFSET, axis=-1)
        length = len(errors) // WINDOWS
        first = errors[0]
        second_window = errors[length : 2 * length].max()
        last_window = errors[-length:].max()
        settled = last_window < SETTLED_ERROR_RATIO * first
        return bool(settled or last_window < min(second_window, first))

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
        # Bisection between factors, whose middle is their geometric mean
        stable = 1.0 / MAX_GAIN
        unstable = MAX_GAIN
        while unstable / stable > 1.0 + GAIN_PRECISION:
            middle = float(np.sqrt(stable * unstable))
            if self.is_stable(middle):
                stable = middle
            else:
                unstable = middle
        return float(np.sqrt(stable * unstable))

    def _features(self, factor: float, latency: float | None, offset: float) -> FloatArray:
        """Return the true feature in each period, (periods, m), with the desired one moved by an offset [m]."""
        rest = self._rest
        late = self.latency if latency is None else latency
        frames = self._warm.plant.sensing.frame_period
        sensing = SensingConfig(0.0, round(late, TIME_DIGITS), frame_period=frames)
        setup = PlantSetup(self._warm.model, rest.joint_position, self._period)
        plant = build_kinematic(replace(self._warm.plant, sensing=sensing), setup)
        reference = rest.reference(rest.feature + offset)
        observation = plant.reset(0)
        state = self._state
        features = []
        for _ in range(round(DURATION / self._period)):
            measured = rest.observation(
                observation.feature, observation.joint_position, observation.time
            )
            state, u = self._servo.step(state, measured, reference)
            observation = plant.step(Command(factor * u))
            features.append(plant.truth().feature)
        plant.close()
        return np.array(features)
