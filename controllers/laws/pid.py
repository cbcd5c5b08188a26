"""Resolved-rate control with a discrete PID on the error (eq. 43 of the paper, extended).

    v(k) = γ/dt e(k) + K_i I(k) + K_d d(k),      u(k) = Ĵᵀ (ĴĴᵀ + δ²I)⁻¹ v(k),      γ = 1 − exp(−K_p dt)

with e = y_ref − y (..., m), its integral I and its filtered derivative d:

    I(k) = I(k−1) + dt e(k),   d(k) = (τ d(k−1) + e(k) − e(k−1)) / (τ + T)

T is the time since the last valid feature, that of e(k−1), dt if none is lost. γ/dt tends to K_p at fast rates; so the
error decays as exp(−K_p t) at every rate. K_i = K_d = 0 and δ = 0 is eq. 43 (and eq. 9), whose minus sign belongs to
the paper's error y − y_ref.
"""

import math
from typing import Annotated, NamedTuple, final

import numpy as np
from annotated_types import Gt

from servobench.controllers.algebra import damped_inverse
from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.laws.law import Estimate, Law
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.dependence import Only
from servobench.plant.contract.lanes import branch, norm
from servobench.plant.contract.settings import NonNegative, Positive, settings
from servobench.plant.contract.signals import BoolArray, Observation


@settings
class PidConfig:
    """Settings of the PID law; the defaults damp a loop with three periods of delay at 20 Hz well."""

    proportional_gain: Positive = 2.5
    """[1/s] K_p; 0.12 of the error per period of 0.05 s."""
    integral_gain: NonNegative = 0.0
    """[1/s²] K_i; 0 as in the paper."""
    derivative_gain: NonNegative = 0.0
    """[1] K_d; 0 as in the paper."""
    derivative_filter: Annotated[NonNegative, Only(derivative_gain=Gt(0.0))] = 0.1
    """[s] τ of the filtered derivative; two periods at 20 Hz."""
    damping: NonNegative = 0.02
    """[m/rad] δ of the inverse; a tenth of a UR5's smallest singular value."""


class PidState(NamedTuple):
    """The state of the law."""

    integral: FloatArray  # I, (..., m), m s
    derivative: FloatArray  # d, (..., m), m/s
    last_error: FloatArray  # e of the last valid feature, (..., m), m
    integral_before: FloatArray  # I of the period before, (..., m), m s
    since_feature: FloatArray  # T, (...), s; inf before there is one


@final
class PidLaw(Law[PidState]):
    """u = Ĵ⁺ (K_p e + K_i I + K_d d).

    Anti-windup by conditional integration: while the command is limited, the integral grows no further (it may shrink).
    Without a valid feature the integral and the derivative wait.
    """

    def __init__(self, config: PidConfig, knowledge: RobotKnowledge) -> None:
        """Take settings and period."""
        self._config = config
        self._dt = knowledge.spec.period
        self._rate = -math.expm1(-config.proportional_gain * self._dt) / self._dt

    def start(self, observation: Observation) -> PidState:
        """Return zero integral and derivative."""
        zero = np.zeros(observation.feature.shape)
        never = np.full(observation.lead, np.inf)
        return PidState(
            integral=zero,
            derivative=zero,
            last_error=zero,
            integral_before=zero,
            since_feature=never,
        )

    def command(
        self, state: PidState, estimate: Estimate, observation: Observation, reference: FloatArray
    ) -> tuple[PidState, FloatArray]:
        """Return the new state and u, (..., n), rad/s; see `Law.command`."""
        config = self._config
        e = reference[..., 0, :] - observation.feature
        state = state._replace(
            integral_before=state.integral, since_feature=state.since_feature + self._dt
        )
        state = branch(observation.feature_valid, self._learn, state, e)
        integral = config.integral_gain * state.integral
        derivative = config.derivative_gain * state.derivative
        v = self._rate * e + integral + derivative
        return state, np.matvec(damped_inverse(estimate.jacobian, config.damping), v)

    def noted(self, state: PidState, joint_velocity: FloatArray, limited: BoolArray) -> PidState:
        """Hold an integral that grows while the command is limited."""
        integral = state.integral
        before = state.integral_before
        grows = np.vecdot(integral, integral) >= np.vecdot(before, before)
        return branch(limited & grows, _held, state)

    def diagnostics(self, state: PidState) -> Diagnostics:
        """Return the norm of the integral, m s."""
        return {"integral_norm": norm(state.integral)}

    def _learn(self, state: PidState, e: FloatArray) -> PidState:
        """Integrate and differentiate the error of a valid feature; the first one has no derivative."""
        tau = self._config.derivative_filter
        T = state.since_feature
        derivative = (tau * state.derivative + e - state.last_error) / (tau + T)[..., None]
        return PidState(
            integral=state.integral + self._dt * e,
            derivative=derivative,
            last_error=e,
            integral_before=state.integral_before,
            since_feature=np.zeros_like(T),
        )


def _held(state: PidState) -> PidState:
    """Return the state with the integral of the period before."""
    return state._replace(integral=state.integral_before)
