"""Estimator of the RBF + PID method: the same Jacobian network under a Lyapunov update (eqs. 40–44)."""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.estimators.rbf import started_rows
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.latest import LatestFeatures
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm
from servobench.plant.contract.settings import Positive, settings


@settings
class RbfLyapunovConfig:
    """Settings of the update; the gains are small because they are multiplied by ‖θ‖² of some ten."""

    n2: Positive = 0.005
    """[1/(m s)] n₂, weight of the error."""
    n3: Positive = 0.05
    """[1/m] n₃, weight of the prediction error."""


class RbfLyapunovState(NamedTuple):
    """W by rows of the Jacobian, (..., m, n, L), m/rad; and s of the last motion, (..., m), m/s."""

    rows: FloatArray
    rate_error: FloatArray


@final
class RbfLyapunovEstimator(Estimator[RbfLyapunovState]):
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

    brings_model = True

    def __init__(self, config: RbfLyapunovConfig, knowledge: RobotKnowledge, networks: TrainedNetworks) -> None:
        """Take the settings and the offline Jacobian network, from which a run starts."""
        self._config = config
        self._network = networks.jacobian
        self._features = LatestFeatures(self._network)

    def start(self, jacobian: FloatArray) -> RbfLyapunovState:
        """Start from the offline network; see `started_rows`."""
        return RbfLyapunovState(started_rows(self._network, jacobian), np.zeros(jacobian.shape[:-1]))

    def update(self, state: RbfLyapunovState, motion: Motion) -> RbfLyapunovState:
        """Learn from one motion."""
        q, dq, theta = motion.joint_position, motion.joint_step[..., None, :], self._features.at(motion.joint_position)
        unexplained = motion.feature_step - np.matvec(self._features.jacobian(state.rows, q), motion.joint_step)
        s = unexplained / np.asarray(motion.duration)[..., None]
        pull = self._config.n3 * s - self._config.n2 * motion.error
        rows = self._network.gradient(pull[..., None, :], dq, theta[..., None, :, :])
        np.add(rows, state.rows, out=rows)
        return RbfLyapunovState(rows, s)

    def jacobian(self, state: RbfLyapunovState, joint_position: FloatArray) -> FloatArray:
        """Return Ĵ at `joint_position` (..., n), rad, as (..., m, n) in m/rad."""
        return self._features.jacobian(state.rows, joint_position)

    def diagnostics(self, state: RbfLyapunovState) -> Diagnostics:
        """Return ‖s‖, the prediction error of the feature's velocity (m/s), and the norm of all weights."""
        flat = state.rows.reshape(*state.rows.shape[:-3], -1)
        return {"rate_error": norm(state.rate_error), "estimator_weight_norm": norm(flat)}
