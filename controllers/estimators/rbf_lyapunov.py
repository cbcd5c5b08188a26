"""Estimator of the RBF + PID method: the same Jacobian network under a Lyapunov update (eqs. 40–44)."""

from __future__ import annotations

from typing import final

import numpy as np

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.rbf import LatestFeatures, jacobian_output
from servobench.plant.checks import FloatArray
from servobench.plant.settings import Positive, settings


@settings
class RbfLyapunovConfig:
    """Settings of the update; the gains are small because they are multiplied by ‖θ‖² of some ten."""

    n2: Positive = 0.005
    """[1/(m s)] n₂, weight of the error."""
    n3: Positive = 0.05
    """[1/m] n₃, weight of the prediction error."""


@final
class RbfLyapunovEstimator(Estimator):
    """Jacobian network whose update makes V = ½ n₂ eᵀe + ½ Σ‖W̃_i‖² decrease under u = K_p Ĵ⁺ e.

        Ĵ_i(q) = W_i θ_i(q)                                            (eqs. 40, 41)
        Ẇ_i = q̇_i (n₃ s − n₂ e) θ_i(q)ᵀ,   s = ẏ − Ĵ q̇                  (eq. 42)
        V̇ = −K_p n₂ ‖e‖² − n₃ ‖s‖² ≤ 0                                 (eq. 44)

    Symbols: e = y_ref − y (m,) m; s prediction error (m,) m/s; q̇ (n,) rad/s; W_i weights (m, L) m/rad; W̃_i their
    error; θ_i features (L,); n₂ and n₃ gains. Discretised with the duration of the motion: W_i ← W_i + ΔW_i with
    ΔW_i = Δq_i (n₃ s − n₂ e) θ_iᵀ.

    Departures from the paper: n₂ enters with a minus, since e = y_ref − y here and y − y_ref there. V̇ ≤ 0 holds for a
    target at rest; a moving one adds n₂ eᵀẏ_ref to V̇, which no choice of Ẇ cancels: the update stays as it is (s does
    not see the target), and the law may cancel the term by feeding ẏ_ref forward. In discrete time the gains must be
    small: n₃ Σ Δq_i² ‖θ_i‖² / duration < 2 for the s-part alone.
    """

    def __init__(self, config: RbfLyapunovConfig, knowledge: RobotKnowledge, networks: TrainedNetworks) -> None:
        """Start from the offline Jacobian network."""
        self._config = config
        self._network = networks.jacobian
        self._features = LatestFeatures(self._network)
        self._weights: FloatArray = self._network.weights
        self._restore()

    @property
    def weights(self) -> FloatArray:
        """W as it is now, (n, m, L), m/rad; a copy."""
        return np.array(self._weights)

    def reset(self, jacobian: FloatArray) -> None:
        """Forget everything and restore the offline network.

        Args:
            jacobian: Ĵ₀, (m, n); only its size is looked at, see `RbfEstimator.reset`.

        Raises:
            ValueError: `jacobian` is of another size than the network.
        """
        if jacobian.shape != (self._network.m, self._network.n):
            raise ValueError(f"jacobian must have shape {(self._network.m, self._network.n)}, got {jacobian.shape}")
        self._restore()

    def update(self, motion: Motion) -> None:
        """Learn from one motion."""
        theta, dq = self._features.at(motion.joint_position), motion.joint_step
        s = self._rate_error = (motion.feature_step - jacobian_output(self._weights, theta) @ dq) / motion.duration
        pull = self._config.n3 * s - self._config.n2 * motion.error
        self._weights = self._weights + pull[:, None] * (dq[:, None] * theta)[:, None, :]

    def jacobian(self, joint_position: FloatArray) -> FloatArray:
        """Return Ĵ at `joint_position` (n,), rad."""
        return jacobian_output(self._weights, self._features.at(joint_position))

    def diagnostics(self) -> Diagnostics:
        """Return ‖s‖, the prediction error of the feature's velocity (m/s), and the norm of all weights."""
        return {
            "rate_error": float(np.linalg.norm(self._rate_error)),
            "estimator_weight_norm": float(np.linalg.norm(self._weights)),
        }

    def _restore(self) -> None:
        self._weights = self._network.weights.copy()
        self._rate_error = np.zeros(self._network.m)
