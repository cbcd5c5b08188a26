"""Bounds under a camera that turns about its optical axis: they know how it turns."""

from __future__ import annotations

from typing import final

import numpy as np
import numpy.typing as npt

from servobench.controllers.controller import Controller, Diagnostics, RobotKnowledge
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import Command, Observation
from servobench.plant.robot.hand_eye import FEATURE


@final
class Unturned(Controller):
    """A controller of the ball's place that works in the frame of the camera at time 0, where nothing turns.

    y₀ = R_z(ρ (t − latency)) y(t),   y₀_ref(t) = R_z(ρ t) y_ref(t)
    """

    def __init__(self, controller: Controller, rate: float, knowledge: RobotKnowledge) -> None:
        """Take a controller of a camera that rests, ρ [rad/s], and the truth.

        Raises:
            ValueError: the features are not the place of the ball.
        """
        if knowledge.spec.feature is not FEATURE:
            raise ValueError("a bound knows of camera_turn with --sensing position only; leave it at 0")
        delays = knowledge.true_delays
        self._controller, self._rate, self._period = controller, rate, knowledge.spec.period
        self._latency, self._now = 0.0 if delays is None else delays.latency, 0.0

    def reset(self, observation: Observation, seed: int) -> None:
        """See `Controller.reset`."""
        self._now = observation.time
        self._controller.reset(self._unturned(observation), seed)

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """See `Controller.step`."""
        self._now = observation.time
        times = observation.time + self._period * np.arange(len(reference))
        return self._controller.step(self._unturned(observation), turned(reference, self._rate * times))

    def diagnostics(self) -> Diagnostics:
        """See `Controller.diagnostics`."""
        return self._controller.diagnostics()

    def estimated_jacobian(self) -> FloatArray | None:
        """See `Controller.estimated_jacobian`; in the frame of the camera now."""
        jacobian = self._controller.estimated_jacobian()
        return None if jacobian is None else turned(jacobian.T, -self._rate * self._now).T

    def _unturned(self, observation: Observation) -> Observation:
        exposed = max(0.0, observation.time - self._latency)
        return observation.with_values(observation.joint_position, turned(observation.feature, self._rate * exposed))


def turned(places: FloatArray, angle: npt.ArrayLike) -> FloatArray:
    """Return places (..., 3) m turned about z by angles (...) [rad]."""
    (x, y, z), c, s = np.moveaxis(places, -1, 0), np.cos(angle), np.sin(angle)
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1)
