"""The predicted loop of the proposed method and the update of its controller matrix (eqs. 7–27), as pure functions.

With Ĵ and the weights frozen, for t = 1 … T, in steps of the length for which the network was trained:

    q(k+t−1) = limit(ψ(ξ) ξ),   e(k+t) = y_ref(k+t) − y_ref(k+t−1) + e(k+t−1) − Ĵ Δq(k+t−1)
    G_j = Σ_t [Ĵᵀ e(k+t)] ξ_j(k+t−1) h(k+t−1)ᵀ,   α = k Σ_t ‖e(k+t)‖² / (ε + ‖G‖²_F),   W_j ← W_j + α G_j

−G is the gradient of I_c = ½ Σ ‖e(k+t)‖² with the paper's truncation (eq. 18): each term is differentiated through its
own step only. Departures from the paper: ε, the joint-speed limit inside the prediction, and α > 0 where the
paper writes a negative α into an update with the opposite sign.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from servobench.controllers.networks.rbf import ControllerNetwork, controller_output, information_vector
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import transposed


class RollOut(NamedTuple):
    """The trajectory of the predicted loop."""

    errors: FloatArray  # e(k+1) … e(k+T), (..., T, m), m
    xi: FloatArray  # ξ(k) … ξ(k+T−1), (..., T, p)
    h: FloatArray  # h(k) … h(k+T−1), (..., T, N_h)
    wanted: FloatArray  # ψ(ξ) ξ less `ControllerNetwork.origin`, (..., n), rad, the first step before its limit


def roll_out(
    network: ControllerNetwork,
    weights: FloatArray,
    jacobian: FloatArray,
    history: tuple[FloatArray, FloatArray],
    reference_steps: FloatArray,
    step_limit: FloatArray,
) -> RollOut:
    """Predict the loop T steps ahead with frozen weights and Jacobian.

    Args:
        network: structure, centres and widths.
        weights: W, (..., n, p, N_h), as they are now.
        jacobian: Ĵ, (..., m, n), m/rad.
        history: errors e(k) …, (..., L_e, m), and joint positions q(k−1) …, (..., L_c, n), the newest first.
        reference_steps: y_ref(k+t) − y_ref(k+t−1) for t = 1 … T, (..., T, m), m.
        step_limit: (n,), rad, largest joint step.

    Returns:
        Errors, information vectors and hidden layers.
    """
    *lead, horizon, m = reference_steps.shape
    n, p, hidden = weights.shape[-3:]
    lengths = history[0].shape[-2], history[1].shape[-2]
    A = np.broadcast_to(_shift(m, n, *lengths), (*lead, p, p + n + m)).copy()
    A[..., :m, p : p + n] = -jacobian
    states, hs = np.empty((*lead, horizon + 1, p + n + m)), np.empty((*lead, horizon, hidden))
    xis = states[..., :p]  # a state is [ξ, Δq, y_ref(k+t) − y_ref(k+t−1)], and A times it is the next ξ
    xis[..., 0, :], states[..., :-1, p + n :] = information_vector(*history), reference_steps
    reach, wanted = 1.0 / step_limit, np.zeros((*lead, n))
    for t in range(horizon):
        state, xi = states[..., t, :], xis[..., t, :]
        h = hs[..., t, :] = network.features(xi)
        dq = controller_output(weights, xi, h) - network.origin(xi)
        if t == 0:
            wanted = dq
        excess = np.maximum.reduce(np.abs(dq) * reach, axis=-1, keepdims=True, initial=1.0)
        state[..., p : p + n] = dq / excess
        np.matvec(A, state, out=xis[..., t + 1, :])
    return RollOut(xis[..., 1:, :m].copy(), xis[..., :-1, :].copy(), hs, wanted)


@cache
def _shift(m: int, n: int, error_history: int, position_history: int) -> FloatArray:
    """Return A with ξ(k+t) = A [ξ(k+t−1), Δq, Δy_ref] where Ĵ = 0, (p, p + n + m).

    The newest error is e + Δy_ref and the newest position q + Δq; older ones move on by one place.
    """
    newest, p = m * error_history, m * error_history + n * position_history
    A = np.zeros((p, p + n + m))
    for size, begin, end, added in ((m, 0, newest, p + n), (n, newest, p, p)):
        first, older = slice(begin, begin + size), slice(begin + size, end)
        A[first, first] = A[first, added : added + size] = np.eye(size)
        A[older, begin : end - size] = np.eye(end - begin - size)
    A.flags.writeable = False
    return A


def descent_direction(jacobian: FloatArray, ahead: RollOut) -> FloatArray:
    """Return G = −∂I_c/∂W with the paper's truncation, (..., n, p, N_h) (eq. 18)."""
    pull = ahead.errors @ jacobian
    outer = pull[..., :, None] * ahead.xi[..., None, :]
    *lead, horizon, n, p = outer.shape
    return np.asarray(transposed(outer.reshape(*lead, horizon, n * p)) @ ahead.h).reshape(*lead, n, p, -1)


def update_step(direction: FloatArray, ahead: RollOut, k: float, epsilon: float) -> FloatArray:
    """Return α = k Σ‖e(k+t)‖² / (ε + ‖G‖²_F), (...), (eq. 23 with ε); 0 where there is nothing to descend."""
    wanted, size = k * sum_of_squares(ahead.errors, 2), epsilon + sum_of_squares(direction, 3)
    quotient: FloatArray = wanted * (size > 0.0) / (size + (size == 0.0))
    return quotient


def sum_of_squares(array: FloatArray, axes: int) -> FloatArray:
    """Return the sum of squares over the last axes, (...)."""
    flat = array.reshape(*array.shape[:-axes], -1)
    total: FloatArray = np.vecdot(flat, flat)
    return total
