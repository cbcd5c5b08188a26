"""The predicted loop of the proposed method and the update of its controller matrix (eqs. 7–27), as pure functions.

With Ĵ and the weights frozen, for t = 1 … T:

    q(k+t−1) = limit(ψ(ξ) ξ),   e(k+t) = y_ref(k+t) − y_ref(k+t−1) + e(k+t−1) − Ĵ Δq(k+t−1)
    G_j = Σ_t [Ĵᵀ e(k+t)] ξ_j(k+t−1) h(k+t−1)ᵀ,   α = k Σ_t ‖e(k+t)‖² / (ε + ‖G‖²_F),   W_j ← W_j + α G_j

−G is the gradient of I_c = ½ Σ ‖e(k+t)‖² with the paper's truncation (eq. 18): each term is differentiated through its
own step only. Departures from the paper: ε, the joint-speed limit inside the prediction, and α > 0 where the
paper writes a negative α into an update with the opposite sign.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from controllers.laws.law import scale_to_limit
from controllers.networks import ControllerNetwork, controller_output, information_vector
from plant.signals import FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class RollOut:
    """What the predicted loop went through.

    Attributes:
        errors: e(k+1) … e(k+T), (T, m), m.
        xi: ξ(k) … ξ(k+T−1), (T, p).
        h: h(k) … h(k+T−1), (T, N_h).
    """

    errors: FloatArray
    xi: FloatArray
    h: FloatArray

    @property
    def criterion(self) -> float:
        """I_c = ½ Σ ‖e(k+t)‖² (eq. 15), m²."""
        return 0.5 * float(np.vdot(self.errors, self.errors))


def roll_out(
    network: ControllerNetwork,
    weights: FloatArray,
    jacobian: FloatArray,
    history: tuple[FloatArray, FloatArray],
    reference_steps: FloatArray,
    step_limit: FloatArray,
) -> RollOut:
    """Predict the loop T steps ahead with everything frozen.

    Args:
        network: structure, centres and widths.
        weights: W, (n, p, N_h), as they are now.
        jacobian: Ĵ, (m, n), m/rad.
        history: errors e(k) …, (L_e, m), and joint positions q(k−1) …, (L_c, n), the newest first.
        reference_steps: y_ref(k+t) − y_ref(k+t−1) for t = 1 … T, (T, m), m.
        step_limit: (n,), rad, largest joint step of a period.

    Returns:
        Errors, information vectors and hidden layers.
    """
    errors, positions = history
    horizon = len(reference_steps)
    e_ahead = np.empty((horizon, errors.shape[1]))
    xis, hs = np.empty((horizon, network.centres.shape[1])), np.empty((horizon, network.centres.shape[0]))
    for t in range(horizon):
        xis[t] = information_vector(errors, positions)
        hs[t] = network.features(xis[t])
        q = positions[0]
        dq = scale_to_limit(controller_output(weights, xis[t], hs[t]) - q, step_limit)
        e_ahead[t] = errors[0] + reference_steps[t] - jacobian @ dq
        errors = np.concatenate([e_ahead[t : t + 1], errors[:-1]])
        positions = np.concatenate([(q + dq)[None], positions[:-1]])
    return RollOut(e_ahead, xis, hs)


def descent_direction(jacobian: FloatArray, ahead: RollOut) -> FloatArray:
    """Return G = −∂I_c/∂W with the paper's truncation, (n, p, N_h) (eq. 18)."""
    n, p, hidden = jacobian.shape[1], ahead.xi.shape[1], ahead.h.shape[1]
    pull = ahead.errors @ jacobian
    outer = (pull[:, :, None] * ahead.xi[:, None, :]).reshape(len(pull), n * p)
    return np.asarray((outer.T @ ahead.h).reshape(n, p, hidden))


def update_step(direction: FloatArray, ahead: RollOut, k: float, epsilon: float) -> float:
    """Return α = k Σ‖e(k+t)‖² / (ε + ‖G‖²_F) (eq. 23 with ε); 0 where there is nothing to descend."""
    norm = float(np.vdot(direction, direction))
    if epsilon + norm == 0.0:
        return 0.0
    return k * float(np.vdot(ahead.errors, ahead.errors)) / (epsilon + norm)
