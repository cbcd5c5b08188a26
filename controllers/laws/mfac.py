"""Model-free adaptive control (eq. 45 of the paper).

    dq(k) = ρ (λI + ĴᵀĴ)⁻¹ Ĵᵀ e(k) = ρ Ĵᵀ (λI + ĴĴᵀ)⁻¹ e(k),      u(k) = dq(k) / dt,      ρ ∈ (0, 1], λ > 0

For ρ = 1 the step minimises ‖e − Ĵ dq‖² + λ‖dq‖². The paper has ρ = 1 and the error of the period before; here the
newest measured error is used. Along a singular value σ of Ĵ the loop gain a period is ρσ²/(λ + σ²).
"""

from __future__ import annotations

from typing import Annotated, NamedTuple, final

import numpy as np
from annotated_types import Le

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimate import Estimate
from servobench.controllers.laws.law import Law
from servobench.controllers.laws.limit import largest_excess
from servobench.plant.checks import FloatArray
from servobench.plant.lanes import plus_diagonal, transposed
from servobench.plant.settings import Positive, settings
from servobench.plant.signals import BoolArray, Observation


@settings
class MfacConfig:
    """Settings of the MFAC law."""

    step_factor: Annotated[Positive, Le(1.0)] = 0.15
    """[1] ρ; not the paper's 1: with three periods of delay a gain of 0.44 per period is unstable."""
    step_weight: Positive = 0.02
    """[m²/rad²] λ; halves the gain where a singular value is 0.14 m/rad."""
    feedforward: bool = False
    """Add the reference's next step; needs a preview of at least 1; not in the paper."""


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
    square = plus_diagonal(J @ transposed(J), step_weight)
    return np.asarray(step_factor * np.vecmat(np.linalg.solve(square, e[..., None])[..., 0], J))


class MfacState(NamedTuple):
    """Whether the last command was limited, (...); the law itself has no state."""

    saturated: BoolArray


@final
class MfacLaw(Law[MfacState]):
    """u = ρ Ĵᵀ (λI + ĴĴᵀ)⁻¹ e / dt (eq. 45), limited as a whole so that the direction stays.

    With `feedforward` the motion of the reference over the coming period is added without the factor ρ:
    dq = Ĵᵀ (λI + ĴĴᵀ)⁻¹ (ρ e + y_ref(k+1) − y_ref(k)).
    """

    def __init__(self, config: MfacConfig, knowledge: RobotKnowledge) -> None:
        """Take settings, limits and period.

        Raises:
            ValueError: a feedforward without a preview.
        """
        if config.feedforward and knowledge.preview < 1:
            raise ValueError(f"preview must be at least 1 for feedforward, got {knowledge.preview}")
        self._config = config
        self._limit = knowledge.spec.joint_velocity_limit
        self._dt = knowledge.spec.period

    def start(self, observation: Observation) -> MfacState:
        """No command was limited yet."""
        return MfacState(np.full(observation.feature.shape[:-1], False))

    def command(
        self, state: MfacState, estimate: Estimate, observation: Observation, reference: FloatArray
    ) -> tuple[MfacState, FloatArray]:
        """Return u, (..., n), rad/s; see `Law.command`."""
        config, J = self._config, estimate.jacobian
        dq = mfac_step(J, reference[..., 0, :] - observation.feature, config.step_factor, config.step_weight)
        if config.feedforward:
            dq = dq + mfac_step(J, reference[..., 1, :] - reference[..., 0, :], 1.0, config.step_weight)
        wanted = dq / self._dt
        excess = largest_excess(wanted, self._limit)
        return MfacState(excess > 1.0), np.asarray(wanted / np.maximum(excess, 1.0)[..., None])

    def diagnostics(self, state: MfacState) -> Diagnostics:
        """Return whether the last command was limited."""
        return {"saturated": state.saturated}
