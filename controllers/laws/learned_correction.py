"""A controller matrix that follows the present Jacobian, plus one that is learned: what `rbfnn_bridged` commands.

    dq = K e + N (q_c − q) + Σ_j W_j h(ξ) ξ_j,   ξ = [e, q]
    K = γ Ĵᵀ(ĴĴᵀ + δ²I)⁻¹,   N = κ (I − Ĵ⁺Ĵ),   γ = 1 − exp(−K_p dt),   κ = 1 − exp(−K_n dt)

The first two terms are what the offline controller network of `rbfnn_mfac` imitates at the nominal Jacobian, written
down with the estimated one. The third is the network of the paper (eqs. 11–17), from zero weights, learned by the
paper's update (eqs. 18, 19, 23) with a horizon of one, from the predicted error of the loop with all three terms:

    e(k+1) = e − Ĵ limited(dq),   G_j = [Ĵᵀ e(k+1)] ξ_j hᵀ,   W_j ← (1 − l) Ĵ⁺Ĵ W_j + α G_j

One predicted period is enough where delays are bridged, and the update is then of rank one, so that its norm and what
it adds to the command are products of three norms. The leak l makes it forget what is not learned again. Nothing is
learned while the command is limited.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import final

import numpy as np

from servobench.controllers.controller import Diagnostics
from servobench.controllers.laws.inverses import damped_inverse
from servobench.controllers.laws.posture import step_with_posture
from servobench.controllers.networks.rbf import ControllerNetwork
from servobench.plant.checks import FloatArray
from servobench.plant.signals import Observation


@final
@dataclass(eq=False)
class LearnedCorrection:
    """The law above. W, (n, m + n, N_h), lies in the row space of Ĵ, so that W = Ĵᵀ C is held by C, half its size.

    C ← (1 − l) (ĴĴᵀ + δ²I)⁻¹ Ĵ(k) Ĵ(k−1)ᵀ C + α e(k+1) (ξ ⊗ h)

    Attributes:
        network: has the hidden layer; its ξ must hold one error and one joint position.
        posture: q_c, (n,), rad.
        limit: of a joint step, (n,), rad.
        k: step size, 0 ≤ k < 2; 0 learns nothing.
        epsilon: ε, m⁴.
        leak: l, share of the weights that is forgotten per period.
        error_share: γ, per period.
        posture_share: κ, per period.
        damping: δ, m/rad.
    """

    network: ControllerNetwork
    posture: FloatArray
    limit: FloatArray
    _: KW_ONLY
    k: float
    epsilon: float
    leak: float
    error_share: float
    posture_share: float
    damping: float

    def __post_init__(self) -> None:
        """Check the network and start without weights."""
        if (self.network.error_history, self.network.position_history) != (1, 1):
            raise ValueError(
                "error_history and position_history must be 1 for base 'jacobian', got "
                f"{self.network.error_history} and {self.network.position_history}"
            )
        self._reach: FloatArray = 1.0 / self.limit
        self._forget()

    def reset(self, observation: Observation) -> None:
        """Set all weights to zero."""
        self._forget()

    def _forget(self) -> None:
        network = self.network
        self._C: FloatArray = np.zeros((network.m, (network.m + network.n) * network.weights.shape[2]))
        self._jacobian: FloatArray = np.zeros((network.m, network.n))  # Ĵ of the last step
        self.step_size = 0.0
        self._predicted: FloatArray = np.zeros(0)  # e(k+1), m

    def step(
        self, jacobian: FloatArray, error: FloatArray, joint_position: FloatArray, forward: FloatArray, learn: bool
    ) -> FloatArray:
        """Return the joint step that is wanted, before any limit.

        Args:
            jacobian: Ĵ, (m, n), m/rad.
            error: e, (m,), m.
            joint_position: q, (n,), rad.
            forward: feedforward feature step (m,), m: the reference's own motion, which does not enter the error.
            learn: whether the weights may be updated.

        Returns:
            dq, (n,), rad.
        """
        pinv = damped_inverse(jacobian, self.damping)
        away = self.posture - joint_position
        wanted = step_with_posture(pinv, jacobian, self.error_share * error, away, self.posture_share)
        following = pinv.dot(forward)
        if self.k == 0.0:
            return np.asarray(wanted + following)
        kept = (1.0 - self.leak) * self._jacobian.dot(pinv).T
        C = self._C = kept.dot(self._C)
        self._jacobian = jacobian
        xi = np.concatenate([error, joint_position])
        seen = np.multiply.outer(xi, self.network.features(xi)).ravel()  # ξ ⊗ h
        wanted += C.dot(seen).dot(jacobian)
        excess = max(1.0, float(max(map(abs, (wanted * self._reach).tolist()))))
        ahead = self._predicted = error - jacobian.dot(wanted) / excess
        self.step_size = 0.0
        if not learn or excess > 1.0:
            return np.asarray(wanted + following)
        pull = ahead.dot(jacobian)
        others = float(seen.dot(seen))  # ‖G‖² without what Ĵᵀe adds
        self.step_size = self.k * float(ahead.dot(ahead)) / (self.epsilon + float(pull.dot(pull)) * others)
        C += np.multiply.outer(self.step_size * ahead, seen)
        return np.asarray(wanted + (self.step_size * others) * pull + following)

    @property
    def weights(self) -> FloatArray:
        """W as it is now, (n, m + n, N_h)."""
        network = self.network
        return np.asarray(self._jacobian.T @ self._C).reshape(network.n, network.m + network.n, -1)

    def diagnostics(self) -> Diagnostics:
        """Return criterion I_c (m²), step size α, predicted error ‖e(k+1)‖ (m) and norm of the weights."""
        return {
            "criterion": 0.5 * float(self._predicted.dot(self._predicted)),
            "step_size": self.step_size,
            "predicted_error": float(np.linalg.norm(self._predicted)),
            "learned_weight_norm": float(np.linalg.norm(self.weights)),
        }
