"""A controller matrix that follows the present Jacobian, plus one that is learned: what `rbfnn_bridged` commands.

    dq = K e + N (q_c − q) + Σ_j W_j h(ξ) ξ_j,   ξ = [e, q]
    K = γ Ĵᵀ(ĴĴᵀ + δ²I)⁻¹,   N = κ (I − Ĵ⁺Ĵ),   γ = 1 − exp(−K_p dt),   κ = 1 − exp(−K_n dt)

The first two terms are what the offline controller network of `rbfnn_mfac` imitates at the nominal Jacobian, written
down with the estimated one. The third is the network of the paper (eqs. 11–17), from zero weights, learned by the
paper's update (eqs. 18, 19, 23) from the predicted errors of the loop with all three terms:

    e(k+t) = e(k+t−1) − Ĵ limited(dq(k+t−1)),   W_j ← (1 − l) Ĵ⁺Ĵ W_j + α Σ_t [Ĵᵀ e(k+t)] ξ_j h(ξ)ᵀ

The leak l makes it forget what is not learned again. Nothing is learned while the command is limited.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from controllers.laws.law import scale_to_limit
from controllers.laws.roll_out import RollOut, descent_direction, update_step
from controllers.networks import ControllerNetwork, controller_output
from plant.signals import FloatArray


@dataclass(frozen=True)
class CorrectionGains:
    """What the correction needs to know besides the present Jacobian.

    Attributes:
        horizon: T, predicted periods.
        k: step size, 0 ≤ k < 2; 0 learns nothing.
        epsilon: ε, m⁴.
        leak: l, share of the weights that is forgotten a period.
        error_share: γ.
        posture_share: κ.
        damping: δ, m/rad.
    """

    horizon: int
    k: float
    epsilon: float
    leak: float
    error_share: float
    posture_share: float
    damping: float


@final
class LearnedCorrection:
    """The law above; it holds the weights W, (n, m + n, N_h)."""

    def __init__(
        self, gains: CorrectionGains, network: ControllerNetwork, posture: FloatArray, limit: FloatArray
    ) -> None:
        """Take the hidden layer of `network`, q_c (n,), rad, and the limit of a joint step (n,), rad.

        Raises:
            ValueError: a network whose ξ holds more than one error and one joint position.
        """
        if (network.error_history, network.position_history) != (1, 1):
            raise ValueError(
                "error_history and position_history must be 1 for base 'jacobian', got "
                f"{network.error_history} and {network.position_history}"
            )
        self._gains, self._network, self._posture, self._limit = gains, network, posture, limit
        self.forget()

    def forget(self) -> None:
        """Set all weights to zero."""
        self.weights: FloatArray = np.zeros(self._network.weights.shape)
        self.step_size = 0.0
        self.ahead: RollOut | None = None

    def step(self, jacobian: FloatArray, error: FloatArray, joint_position: FloatArray, learn: bool) -> FloatArray:
        """Return the joint step that is wanted, before any limit.

        Args:
            jacobian: Ĵ, (m, n), m/rad.
            error: e, (m,), m.
            joint_position: q, (n,), rad.
            learn: whether the weights may be updated.

        Returns:
            dq, (n,), rad.
        """
        gains = self._gains
        pinv = np.linalg.solve(jacobian @ jacobian.T + gains.damping**2 * np.eye(len(jacobian)), jacobian).T
        K, row_space = gains.error_share * pinv, pinv @ jacobian
        N = gains.posture_share * (np.eye(len(row_space)) - row_space)
        if gains.k == 0.0:
            return np.asarray(K @ error + N @ (self._posture - joint_position))
        n, p, hidden = self.weights.shape
        self.weights = (((1.0 - gains.leak) * row_space) @ self.weights.reshape(n, -1)).reshape(n, p, hidden)
        ahead = self.ahead = self._predict(jacobian, np.hstack([K, -N]), N @ self._posture, error, joint_position)
        self.step_size = 0.0
        if not learn or np.maximum.reduce(np.abs(ahead.wanted) / self._limit) > 1.0:
            return ahead.wanted
        direction = descent_direction(jacobian, ahead)
        self.step_size = update_step(direction, ahead, gains.k, gains.epsilon)
        self.weights = self.weights + self.step_size * direction
        return ahead.wanted + self.step_size * controller_output(direction, ahead.xi[0], ahead.h[0])

    def _predict(
        self, jacobian: FloatArray, linear: FloatArray, constant: FloatArray, error: FloatArray, q: FloatArray
    ) -> RollOut:
        """Predict the loop with dq = linear ξ + constant + Σ_j W_j h ξ_j, (n, p), (n,), everything frozen."""
        (n, p, hidden), m, horizon = self.weights.shape, len(error), self._gains.horizon
        flat = self.weights.reshape(n * p, hidden)
        xis, hs, errors = np.empty((horizon, p)), np.empty((horizon, hidden)), np.empty((horizon, m))
        xi, wanted = np.concatenate([error, q]), constant
        for t in range(horizon):
            xis[t] = xi
            h = hs[t] = self._network.features(xi)
            dq = (flat.dot(h).reshape(n, p) + linear).dot(xi) + constant
            if t == 0:
                wanted = dq
            dq = scale_to_limit(dq, self._limit)
            xi[:m] -= jacobian.dot(dq)
            xi[m:] += dq
            errors[t] = xi[:m]
        return RollOut(errors, xis, hs, wanted)
