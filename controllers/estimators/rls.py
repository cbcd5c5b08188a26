"""Recursive least squares with exponential forgetting.

    K = PΔq / (λ + ΔqᵀPΔq),      Ĵ ← Ĵ + (Δy − ĴΔq) Kᵀ,      P ← (P − K ΔqᵀP) / λ,      0 < λ ≤ 1

It minimises Σ λ^(k−t) ‖Δy_t − J Δq_t‖² + λ^k tr[(J − Ĵ₀) P₀⁻¹ (J − Ĵ₀)ᵀ]; all rows of J share P (n, n), 1/rad².
λ = 1 is batch least squares.
"""

from __future__ import annotations

from typing import Annotated, final

import numpy as np
from annotated_types import Le

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.estimators.kalman import cholesky_of
from servobench.plant.checks import FloatArray
from servobench.plant.settings import NonNegative, Positive, settings


@settings
class RlsConfig:
    """Settings of recursive least squares."""

    forgetting: Annotated[Positive, Le(1.0)] = 0.95
    """[1] λ per motion; remembers some 20 motions."""
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
    J: FloatArray, P: FloatArray, joint_step: FloatArray, feature_step: FloatArray, *, forgetting: float
) -> tuple[FloatArray, FloatArray]:
    """Correct by one motion, P in Joseph form.

    Args:
        J: (m, n), m/rad.
        P: (n, n), 1/rad².
        joint_step: Δq, (n,), rad.
        feature_step: Δy, (m,), m.
        forgetting: λ.

    Returns:
        The new Jacobian and P.
    """
    PH = P @ joint_step
    K = PH / (forgetting + joint_step @ PH)
    A = P - np.outer(K, PH)
    P = (A + np.outer(forgetting * K - A @ joint_step, K)) / forgetting
    return J + np.outer(feature_step - J @ joint_step, K), (P + P.T) / 2


@final
class RlsEstimator(Estimator):
    """Ĵ ← Ĵ + (Δy − ĴΔq) Kᵀ with forgetting λ; motions below a minimum ‖Δq‖ are left out.

    Forgetting inflates P in directions in which nothing moves, without bound. So P is scaled back to a mean diagonal
    of at most `covariance_limit`; scaling keeps it symmetric and positive definite.
    """

    def __init__(self, config: RlsConfig, knowledge: RobotKnowledge | None = None) -> None:
        """Take the settings; nothing about the robot is needed."""
        self._config = config

    def reset(self, jacobian: FloatArray) -> None:
        """Start from Ĵ₀, (m, n), m/rad."""
        self._J = jacobian.copy()
        self._P = np.eye(jacobian.shape[1]) * self._config.initial_covariance
        self._updated = False

    def update(self, motion: Motion) -> None:
        """Correct by one motion.

        Raises:
            FilterDiverged: P is no longer positive definite.
        """
        config, dq = self._config, motion.joint_step
        self._updated = bool(np.linalg.norm(dq) >= config.min_joint_step)
        if not self._updated:
            return
        self._J, self._P = rls_update(self._J, self._P, dq, motion.feature_step, forgetting=config.forgetting)
        self._P *= min(1.0, config.covariance_limit / self._mean_diagonal())
        cholesky_of(self._P)

    def diagnostics(self) -> Diagnostics:
        """Return whether the last motion was used and the mean of P's diagonal, 1/rad²."""
        return {"estimator_updated": float(self._updated), "covariance_mean": self._mean_diagonal()}

    def _mean_diagonal(self) -> float:
        return float(np.trace(self._P) / self._P.shape[0])
