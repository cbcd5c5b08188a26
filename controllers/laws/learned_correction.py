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
from typing import NamedTuple, final

import numpy as np

from servobench.controllers.controller import Diagnostics
from servobench.controllers.laws.inverses import damped_inverse
from servobench.controllers.laws.limit import largest_excess
from servobench.controllers.laws.posture import step_with_posture
from servobench.controllers.laws.roll_out import step_size, sum_of_squares
from servobench.controllers.networks.rbf import ControllerNetwork
from servobench.plant.checks import FloatArray
from servobench.plant.lanes import norm, outer, transposed
from servobench.plant.signals import BoolArray, Observation


class CorrectionState(NamedTuple):
    """The state of the law.

    Attributes:
        C: (..., m + 1, (m + n) N_h): C above without the last update, and in the last row its ξ ⊗ h.
        update: α e(k+1) of the last update, (..., m), m.
        jacobian: Ĵ of the last step, (..., m, n), m/rad.
        predicted: e(k+1), (..., m), m.
        step_size: α, (...).
    """

    C: FloatArray
    update: FloatArray
    jacobian: FloatArray
    predicted: FloatArray
    step_size: FloatArray


@final
@dataclass(eq=False)
class LearnedCorrection:
    """The law above. W, (n, m + n, N_h), lies in the row space of Ĵ, so that W = Ĵᵀ C is held by C, half its size.

    C(k) = (1 − l) (ĴĴᵀ + δ²I)⁻¹ Ĵ(k) Ĵ(k−1)ᵀ [C(k−1) + (α e(k) (ξ ⊗ h))(k−1)]

    An update enters C at the next period, in one product with the projection, which halves the memory traffic.

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
        """Check the network."""
        if (self.network.error_history, self.network.position_history) != (1, 1):
            raise ValueError(
                "error_history and position_history must be 1 for base 'jacobian', got "
                f"{self.network.error_history} and {self.network.position_history}"
            )

    def start(self, observation: Observation) -> CorrectionState:
        """Return the state without weights."""
        lead = observation.feature.shape[:-1]
        m, n, hidden = self.network.m, self.network.n, self.network.weights.shape[2]
        zero, J = np.zeros((*lead, m)), np.zeros((*lead, m, n))
        C = np.zeros((*lead, m + 1, (m + n) * hidden))
        return CorrectionState(C=C, update=zero, jacobian=J, predicted=zero, step_size=np.zeros(lead))

    def step(
        self,
        state: CorrectionState,
        jacobian: FloatArray,
        error: FloatArray,
        joint_position: FloatArray,
        forward: FloatArray,
        learn: bool | BoolArray,
    ) -> tuple[CorrectionState, FloatArray]:
        """Return the new state and the joint step that is wanted, before any limit.

        Args:
            state: after the last step.
            jacobian: Ĵ, (..., m, n), m/rad.
            error: e, (..., m), m.
            joint_position: q, (..., n), rad.
            forward: feedforward feature step (..., m), m: the reference's own motion, which does not enter the error.
            learn: (...), whether the weights may be updated.

        Returns:
            The state, and dq, (..., n), rad.
        """
        pinv = damped_inverse(jacobian, self.damping)
        away = self.posture - joint_position
        wanted = step_with_posture(pinv, jacobian, self.error_share * error, away, self.posture_share)
        following = np.matvec(pinv, forward)
        if self.k == 0.0:
            return state, wanted + following
        C = self._projected(state, pinv, np.concatenate([error, joint_position], axis=-1))
        seen = C[..., -1, :]
        wanted = wanted + np.vecmat(np.matvec(C[..., :-1, :], seen), jacobian)
        excess = largest_excess(wanted, self.limit)
        ahead = error - np.matvec(jacobian, wanted) / np.maximum(excess, 1.0)[..., None]
        pull = np.vecmat(ahead, jacobian)
        others = np.vecdot(seen, seen)  # ‖G‖² without what Ĵᵀe adds
        alpha = step_size(self.k * np.vecdot(ahead, ahead), self.epsilon + np.vecdot(pull, pull) * others)
        alpha = alpha * (learn & (excess <= 1.0))
        new = CorrectionState(C, alpha[..., None] * ahead, jacobian, ahead, alpha)
        return new, wanted + (alpha * others)[..., None] * pull + following

    def _projected(self, state: CorrectionState, pinv: FloatArray, xi: FloatArray) -> FloatArray:
        """Return C with the last update, on the row space of the present Ĵ, and the present ξ ⊗ h below it."""
        kept = (1.0 - self.leak) * transposed(state.jacobian @ pinv)
        C = np.empty_like(state.C)
        both = np.concatenate([kept, np.matvec(kept, state.update)[..., None]], axis=-1)
        np.matmul(both, state.C, out=C[..., :-1, :])
        C[..., -1, :] = outer(xi, self.network.features(xi)).reshape(*xi.shape[:-1], -1)
        return C

    def weights(self, state: CorrectionState) -> FloatArray:
        """Return W after the last update, (..., n, m + n, N_h)."""
        C = state.C[..., :-1, :] + outer(state.update, state.C[..., -1, :])
        n, m = self.network.n, self.network.m
        return (transposed(state.jacobian) @ C).reshape(*C.shape[:-2], n, m + n, -1)

    def diagnostics(self, state: CorrectionState) -> Diagnostics:
        """Return criterion I_c (m²), step size α, predicted error ‖e(k+1)‖ (m) and norm of the weights."""
        return {
            "criterion": 0.5 * np.vecdot(state.predicted, state.predicted),
            "step_size": state.step_size,
            "predicted_error": norm(state.predicted),
            "learned_weight_norm": np.sqrt(sum_of_squares(self.weights(state), 3)),
        }
