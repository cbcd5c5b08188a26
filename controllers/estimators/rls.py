"""Recursive least squares with exponential forgetting.

    K = PΔq / (λ + ΔqᵀPΔq),      Ĵ ← Ĵ + (Δy − ĴΔq) Kᵀ,      P ← (P − K ΔqᵀP) / λ,      0 < λ ≤ 1

It minimises Σ λ^(k−t) ‖Δy_t − J Δq_t‖² + λ^k tr[(J − Ĵ₀) P₀⁻¹ (J − Ĵ₀)ᵀ]; all rows of J share P (n, n), 1/rad².
λ = 1 is batch least squares.
"""

from typing import final

import numpy as np

from servobench.controllers.controller import Diagnostics
from servobench.controllers.estimators.estimator import GatedEstimator, Motion
from servobench.controllers.estimators.kalman import WalkState, cholesky_of
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import outer, transposed
from servobench.plant.contract.settings import NonNegative, Positive, PositiveOrInfinite, settings


@settings
class RlsConfig:
    """Settings of recursive least squares."""

    memory: PositiveOrInfinite = 0.975
    """[s] of motion that is remembered: λ = exp(−duration/memory), 0.95 for a motion of 0.05 s."""
    initial_covariance: Positive = 100.0
    """[1/rad²] P₀ = p₀ I: Ĵ₀ weighs as much as a motion of 0.1 rad of each joint."""
    covariance_limit: Positive = 100.0
    """[1/rad²] bound of the mean of P's diagonal, without which P of a joint at rest grows without bound."""
    min_joint_step: NonNegative = 0.01
    """[rad] smaller motions are left out: 1 mm of noise hides them."""

    def __post_init__(self) -> None:
        """Check across fields."""
        if self.covariance_limit < self.initial_covariance:
            raise ValueError(
                f"covariance_limit must be at least initial_covariance = {self.initial_covariance:g}, "
                f"got {self.covariance_limit:g}"
            )


def rls_update(
    J: FloatArray, P: FloatArray, joint_step: FloatArray, feature_step: FloatArray, *, forgetting: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Correct by one motion, P in Joseph form.

    Args:
        J: (..., m, n), m/rad.
        P: (..., n, n), 1/rad².
        joint_step: Δq, (..., n), rad.
        feature_step: Δy, (..., m), m.
        forgetting: λ, (...).

    Returns:
        The new Jacobian and P.
    """
    PH = np.matvec(P, joint_step)
    K = PH / (forgetting + np.vecdot(joint_step, PH))[..., None]
    A = P - outer(K, PH)
    P = (A + outer(forgetting[..., None] * K - np.matvec(A, joint_step), K)) / forgetting[..., None, None]
    return J + outer(feature_step - np.matvec(J, joint_step), K), (P + transposed(P)) / 2


@final
class RlsEstimator(GatedEstimator[WalkState]):
    """Ĵ ← Ĵ + (Δy − ĴΔq) Kᵀ with forgetting λ; motions below a minimum ‖Δq‖ are left out.

    Forgetting inflates P in directions in which nothing moves, without bound. So P is scaled back to a mean diagonal
    of at most `covariance_limit`; scaling keeps it symmetric and positive definite.
    """

    _config: RlsConfig

    def start(self, jacobian: FloatArray) -> WalkState:
        """Start from Ĵ₀, (..., m, n), m/rad, with P (..., n, n), 1/rad²."""
        lead, n = jacobian.shape[:-2], jacobian.shape[-1]
        P = np.broadcast_to(np.eye(n) * self._config.initial_covariance, (*lead, n, n))
        return WalkState(jacobian, P, np.full(lead, False))

    def _correct(self, state: WalkState, motion: Motion) -> WalkState:
        config, dq, dy = self._config, motion.joint_step, motion.feature_step
        J, P = rls_update(state.J, state.P, dq, dy, forgetting=np.exp(-np.asarray(motion.duration) / config.memory))
        P = P * np.minimum(1.0, config.covariance_limit / _mean_diagonal(P))[..., None, None]
        cholesky_of(P)
        return state._replace(J=J, P=P)

    def diagnostics(self, state: WalkState) -> Diagnostics:
        """Return whether the last motion was used and the mean of P's diagonal, 1/rad²."""
        return {"estimator_updated": state.updated, "covariance_mean": _mean_diagonal(state.P)}


def _mean_diagonal(P: FloatArray) -> FloatArray:
    mean: FloatArray = P.trace(axis1=-2, axis2=-1) / P.shape[-1]
    return mean
