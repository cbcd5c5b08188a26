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
from scipy.linalg.lapack import dposv

from controllers.controller import Diagnostics
from controllers.laws.pid import damped_inverse
from controllers.laws.roll_out import RollOut, descent_direction, update_step
from controllers.networks import ControllerNetwork
from plant.signals import FloatArray, Observation


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
        self._gains, self._network, self._posture = gains, network, posture
        self._reach: FloatArray = 1.0 / limit
        self._eye = np.eye(network.n)
        self._forget()

    def reset(self, observation: Observation) -> None:
        """Set all weights to zero."""
        self._forget()

    def _forget(self) -> None:
        self.weights: FloatArray = np.zeros(self._network.weights.shape)
        self.step_size = 0.0
        self.ahead: RollOut | None = None

    def step(
        self, jacobian: FloatArray, error: FloatArray, joint_position: FloatArray, forward: FloatArray, learn: bool
    ) -> FloatArray:
        """Return the joint step that is wanted, before any limit.

        Args:
            jacobian: Ĵ, (m, n), m/rad.
            error: e, (m,), m.
            joint_position: q, (n,), rad.
            forward: feature step that is made besides, (m,), m: that of the reference, which it leaves the error as is.
            learn: whether the weights may be updated.

        Returns:
            dq, (n,), rad.
        """
        gains, m = self._gains, len(jacobian)
        pinv = fast_damped_inverse(jacobian, gains.damping)
        row_space = pinv.dot(jacobian)
        following = pinv.dot(forward)
        linear = np.concatenate([gains.error_share * pinv, gains.posture_share * (row_space - self._eye)], axis=1)
        constant = -linear[:, m:].dot(self._posture)
        if gains.k == 0.0:
            return np.asarray(linear.dot(np.concatenate([error, joint_position])) + constant + following)
        n, p, hidden = self.weights.shape
        row_space *= 1.0 - gains.leak
        self.weights = row_space.dot(self.weights.reshape(n, p * hidden)).reshape(n, p, hidden)
        ahead = self.ahead = self._predict(jacobian, linear, constant, np.concatenate([error, joint_position]))
        self.step_size = 0.0
        if not learn or excess_of(ahead.wanted, self._reach) > 1.0:
            return np.asarray(ahead.wanted + following)
        direction = descent_direction(jacobian, ahead)
        self.step_size = update_step(direction, ahead, gains.k, gains.epsilon)
        direction *= self.step_size
        self.weights += direction
        learned: FloatArray = direction.reshape(n * p, hidden).dot(ahead.h[0]).reshape(n, p).dot(ahead.xi[0])
        return np.asarray(ahead.wanted + learned + following)

    def diagnostics(self) -> Diagnostics:
        """Return criterion I_c (m²), step size α, predicted error ‖e(k+T)‖ (m) and norm of the weights."""
        return {
            "criterion": self.ahead.criterion if self.ahead else 0.0,
            "step_size": self.step_size,
            "predicted_error": float(np.linalg.norm(self.ahead.errors[-1])) if self.ahead else 0.0,
            "learned_weight_norm": float(np.linalg.norm(self.weights)),
        }

    def _predict(self, jacobian: FloatArray, linear: FloatArray, constant: FloatArray, xi: FloatArray) -> RollOut:
        """Predict the loop with dq = linear ξ + constant + Σ_j W_j h ξ_j, (n, p), (n,), everything frozen."""
        (n, p, hidden), m, horizon = self.weights.shape, len(jacobian), self._gains.horizon
        flat, moves = self.weights.reshape(n * p, hidden), np.concatenate([-jacobian, self._eye])
        xis, hs, wanted = np.empty((horizon + 1, p)), np.empty((horizon, hidden)), constant
        xis[0] = xi
        for t in range(horizon):
            h = hs[t] = self._network.features(xis[t])
            dq = (flat.dot(h).reshape(n, p) + linear).dot(xis[t]) + constant
            if t == 0:
                wanted = dq
            excess = excess_of(dq, self._reach)
            xis[t + 1] = xis[t] + moves.dot(dq if excess <= 1.0 else dq / excess)
        return RollOut(xis[1:, :m], xis[:-1], hs, wanted)


def excess_of(joint_step: FloatArray, reach: FloatArray) -> float:
    """Return by which factor a joint step (n,), rad, exceeds its limits, `reach` (n,), 1/rad, being their inverses."""
    return float(max(map(abs, (joint_step * reach).tolist())))


def fast_damped_inverse(J: FloatArray, damping: float) -> FloatArray:
    """Return Jᵀ (JJᵀ + δ²I)⁻¹, (n, m), by a Cholesky factor: `damped_inverse`, sooner, up to rounding."""
    square = J.dot(J.T)
    square.flat[:: len(J) + 1] += damping**2
    _, solution, failed = dposv(square, J)
    if failed:  # δ is lost in the rounding of a Jacobian with fewer joints than features
        return damped_inverse(J, damping)
    return np.asarray(solution).T
