"""Resolved-rate control with a discrete PID on the error (eq. 43 of the paper, extended).

    v(k) = K_p e(k) + K_i I(k) + K_d d(k) [+ ẏ_ref(k)],      u(k) = Ĵᵀ (ĴĴᵀ + δ²I)⁻¹ v(k)

with e = y_ref − y (m,), its integral I and its filtered derivative d:

    I(k) = I(k−1) + dt e(k),   d(k) = (τ d(k−1) + e(k) − e(k−1)) / (τ + dt),   ẏ_ref(k) = (y_ref(k+1) − y_ref(k)) / dt

K_i = K_d = 0 and δ = 0 is eq. 43 (and eq. 9), whose minus sign belongs to the paper's error y − y_ref.
"""

from __future__ import annotations

from typing import final

import numpy as np

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimate import Estimate
from servobench.controllers.laws.inverses import damped_inverse
from servobench.controllers.laws.law import Law
from servobench.controllers.laws.limit import scale_to_limit
from servobench.plant.checks import FloatArray
from servobench.plant.settings import NonNegative, Positive, settings
from servobench.plant.signals import Observation


@settings
class PidConfig:
    """Settings of the PID law; the defaults damp a loop with three periods of delay at 20 Hz well."""

    proportional_gain: Positive = 2.5
    """[1/s] K_p; a share K_p dt = 0.125 of the error per period, as fast as the default of `mfac`."""
    integral_gain: NonNegative = 0.0
    """[1/s²] K_i; 0 as in the paper."""
    derivative_gain: NonNegative = 0.0
    """[1] K_d; 0 as in the paper."""
    derivative_filter: NonNegative = 0.1
    """[s] τ, time constant of the filtered derivative; two periods at 20 Hz."""
    damping: NonNegative = 0.02
    """[m/rad] δ, damping of the inverse; a tenth of the smallest singular value in a UR5's workspace."""
    feedforward: bool = False
    """Add the reference's own velocity; needs a preview of at least 1."""


@final
class PidLaw(Law):
    """u = Ĵ⁺ (K_p e + K_i I + K_d d [+ ẏ_ref]), limited as a whole so that the direction stays.

    Anti-windup by conditional integration: while the command is limited, the integral grows no further (it may shrink).
    Without a valid feature the integral and the derivative wait.
    """

    def __init__(self, config: PidConfig, knowledge: RobotKnowledge) -> None:
        """Take settings, limits and period.

        Raises:
            ValueError: a feedforward without a preview.
        """
        if config.feedforward and knowledge.preview < 1:
            raise ValueError(f"preview must be at least 1 for feedforward, got {knowledge.preview}")
        self._config = config
        self._limit = knowledge.spec.joint_velocity_limit
        self._dt = knowledge.spec.period
        self._m = knowledge.spec.m
        self._forget()

    def _forget(self) -> None:
        self._integral = np.zeros(self._m)
        self._derivative = np.zeros(self._m)
        self._last_error: FloatArray | None = None
        self._saturated = False

    def reset(self, observation: Observation) -> None:
        """Forget integral and derivative."""
        self._forget()

    def command(self, estimate: Estimate, observation: Observation, reference: FloatArray) -> FloatArray:
        """Return u, (n,), rad/s; see `Law.command`."""
        config = self._config
        e = reference[0] - observation.feature
        if observation.feature_valid:
            self._differentiate(e)
        integral = self._integral + self._dt * e if observation.feature_valid else self._integral
        v = config.proportional_gain * e + config.integral_gain * integral + config.derivative_gain * self._derivative
        if config.feedforward:
            v = v + (reference[1] - reference[0]) / self._dt
        wanted = damped_inverse(estimate.jacobian, config.damping) @ v
        u = scale_to_limit(wanted, self._limit)
        self._saturated = bool((np.abs(wanted) > self._limit).any())
        if not self._saturated or integral @ integral < self._integral @ self._integral:
            self._integral = integral
        return u

    def diagnostics(self) -> Diagnostics:
        """Return the norm of the integral, m s, and whether the command was limited."""
        return {"integral_norm": float(np.linalg.norm(self._integral)), "saturated": float(self._saturated)}

    def _differentiate(self, e: FloatArray) -> None:
        if self._last_error is not None:
            tau = self._config.derivative_filter
            self._derivative = (tau * self._derivative + e - self._last_error) / (tau + self._dt)
        self._last_error = e
