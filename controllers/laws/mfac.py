"""Model-free adaptive control (eq. 45 of the paper).

    dq(k) = ρ (λI + ĴᵀĴ)⁻¹ Ĵᵀ e(k) = ρ Ĵᵀ (λI + ĴĴᵀ)⁻¹ e(k),      u(k) = dq(k) / dt,      ρ ∈ (0, 1], λ > 0

For ρ = 1 the step minimises ‖e − Ĵ dq‖² + λ‖dq‖². The paper has ρ = 1 and the error of the period before; here the
newest measured error is used. Along a singular value σ of Ĵ the loop gain a period is ρσ²/(λ + σ²).
"""

import math
from typing import final

import numpy as np

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.laws.law import Estimate, Law
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import plus_diagonal, solve
from servobench.plant.contract.settings import Positive, PositiveOrInfinite, settings
from servobench.plant.contract.signals import Observation


@settings
class MfacConfig:
    """Settings of the MFAC law."""

    gain: PositiveOrInfinite = 3.25
    """[1/s] K: ρ = 1 − exp(−K dt); the paper's ρ = 1 (`inf`) is unstable with three periods of delay."""
    step_weight: Positive = 0.02
    """[m²/rad²] λ; halves the gain where a singular value is 0.14 m/rad."""


def mfac_step(J: FloatArray, e: FloatArray, step_factor: float, step_weight: float) -> FloatArray:
    """Return dq = ρ Jᵀ (λI + JJᵀ)⁻¹ e, the form of eq. 45 that solves m equations instead of n.

    Args:
        J: (..., m, n), m/rad.
        e: y_ref − y, (..., m), m.
        step_factor: ρ.
        step_weight: λ, m²/rad².

    Returns:
        The joint step of one period, (..., n), rad.
    """
    square = plus_diagonal(J @ J.mT, step_weight)
    solution = solve(square, e)
    return step_factor * np.vecmat(solution, J)


@final
class MfacLaw(Law[None]):
    """u = ρ Ĵᵀ (λI + ĴĴᵀ)⁻¹ e / dt (eq. 45)."""

    def __init__(self, config: MfacConfig, knowledge: RobotKnowledge) -> None:
        """Take settings and period."""
        self._dt = knowledge.spec.period
        self._rho = 1.0 - math.exp(-config.gain * self._dt)
        self._lambda = config.step_weight

    def start(self, observation: Observation) -> None:
        """Begin; the law has no state."""

    def command(
        self, state: None, estimate: Estimate, observation: Observation, reference: FloatArray
    ) -> tuple[None, FloatArray]:
        """Return u, (..., n), rad/s; see `Law.command`."""
        e = reference[..., 0, :] - observation.feature
        return state, mfac_step(estimate.jacobian, e, self._rho, self._lambda) / self._dt
