"""The horizon of a predictive law in blocks, the integrals a, b, c of eq. 46, and the laws without limits.

Symbols (times τ and horizon H in `Blocks`; in the paper a block is a control period):

| here | meaning | shape | unit |
|---|---|---|---|
| `H` | horizon | | blocks |
| `alpha` | α in (0, 1], weight of a later error against an earlier one, a block | | |
| `beta` | β = exp(−ρ), share of the error that may be left after one block | | |
| `a`, `b`, `c` | ∫ τ² α^τ dτ, ∫ τ α^τ dτ, ∫ τ (αβ)^τ dτ over [0, H] | | blocks³, blocks², blocks² |
| `J` | estimated ∂y/∂q | (m, n) | m/rad |
| `Q` | diagonal of the move weight | (n,) | m²/rad² |

Departure from the paper: its closed forms are 0/0 at α = 1 and at αβ = 1 and lose all digits near them; there a power
series takes over. They follow from φ_p(s) = ∫₀¹ x^p exp(−s x) dx with s = −H ln γ: ∫₀ᴴ τ^p γ^τ dτ = H^{p+1} φ_p(s).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np

from servobench.controllers.periods import in_periods
from servobench.plant.contract.checks import FloatArray

# Below this s the series of 18 terms is exact to rounding; above it the closed form is.
_SERIES_BELOW = 0.5
_SERIES_TERMS = 18
_MIN_POWER = 1e-150  # [1] smaller weights count as 0, so that products with them do not underflow
REFERENCE_BLOCK = 0.05  # [s] length of the blocks for which weights are stated
_NODES, _NODE_WEIGHTS = np.polynomial.legendre.leggauss(24)


class HorizonIntegrals(NamedTuple):
    """a, b and c of eq. 46."""

    a: float
    b: float
    c: float


def horizon_integrals(horizon: float, alpha: float, rho: float) -> HorizonIntegrals:
    """Return a, b and c of eq. 46.

    Args:
        horizon: H, blocks, positive.
        alpha: α in (0, 1].
        rho: ρ ≥ 0, decay rate a block.
    """
    rate = -math.log(alpha)
    return HorizonIntegrals(
        a=_weighted_power_integral(2, rate, horizon),
        b=_weighted_power_integral(1, rate, horizon),
        c=_weighted_power_integral(1, rate + rho, horizon),
    )


def _weighted_power_integral(power: int, rate: float, horizon: float) -> float:
    """∫₀ᴴ τ^p exp(−rate τ) dτ for p = 1 or 2."""
    s = rate * horizon
    if s < _SERIES_BELOW:
        term = 1.0
        total = 0.0
        for k in range(_SERIES_TERMS):
            total += term / (power + k + 1)
            term *= -s / (k + 1)
        return float(horizon ** (power + 1) * total)
    decay = math.exp(-s)
    value = (1.0 - decay * (1.0 + s)) / s**2
    if power == 2:
        value = (2.0 * value - decay) / s
    return float(horizon ** (power + 1) * value)


def _power(alpha: float, tau: float) -> float:
    """α^τ, or 0 where it is so small that products with it would underflow."""
    value = float(alpha**tau)
    return value if value > _MIN_POWER else 0.0


def decay_shares(horizon: int, rho: float) -> FloatArray:
    """Return the share 1 − β^τ of the error that should be gone after τ = 1 … H blocks, (H,).

    Args:
        horizon: H, blocks.
        rho: ρ, β = exp(−ρ).
    """
    return np.array([-math.expm1(-rho * tau) for tau in range(1, horizon + 1)])


def decay_targets(error: FloatArray, reference_step: FloatArray, shares: FloatArray) -> FloatArray:
    """Return the feature displacements that the prediction should follow: r_τ + (1 − β^τ) e for τ = 1 … H.

    Args:
        error: e = y_ref − y now, (..., m), m.
        reference_step: r_τ = y_ref(k+τ) − y_ref(k), (..., H, m), m.
        shares: 1 − β^τ, (H,).

    Returns:
        (..., H, m), m.
    """
    return reference_step + shares[:, None] * error[..., None, :]


def move_weights(horizon: int, alpha: float, terminal_weight: float) -> FloatArray:
    """Return the weights (H,) of the errors after 1 … H moves: α^τ, plus `terminal_weight` on the last one."""
    weights = np.array([_power(alpha, tau) for tau in range(1, horizon + 1)])
    weights[-1] += terminal_weight
    return weights


def preview_weights(horizon: int, alpha: float) -> FloatArray:
    """Return v (H,) with ∫₀ᴴ τ α^τ r(τ) dτ = Σ_τ v_τ r_τ for the r(τ) that is linear between r_0 = 0, r_1, …, r_H."""
    v = np.zeros(horizon + 1)
    x = 0.5 * (_NODES + 1.0)
    for start in range(horizon):
        tau = start + x
        powers = np.array([_power(alpha, t) for t in tau.tolist()])
        density = 0.5 * _NODE_WEIGHTS * tau * powers
        v[start] += density @ (1.0 - x)
        v[start + 1] += density @ x
    return v[1:]


@final
class UnlimitedPlan:
    """The minimiser without limits, of free moves or of one constant step, for many runs at once.

        min  ½ Σ_st C_st (J dq_s)ᵀ(J dq_t) − Σ_t p_tᵀ J dq_t + ½ Σ_t dq_tᵀ Q dq_t

    Its stationarity C (dq Jᵀ) J + dq Q = p J holds for dq = Z J Q⁻¹ with C Z G + Z = p, G = J Q⁻¹ Jᵀ. With C = U Λ Uᵀ,
    once for all, and G = V S Vᵀ, m × m, the solution is Z = U [(Uᵀ p V)_ij / (1 + λ_i s_j)] Vᵀ.

    | here | meaning | shape | unit |
    |---|---|---|---|
    | `coupling` | C | (moves, moves) | 1 |
    | `pull` | p = pull · targets | (moves, moves) | 1 |
    | `travel` | S = travel · dq, the way after each move | (moves, moves) | 1 |
    """

    def __init__(
        self, coupling: FloatArray, pull: FloatArray, travel: FloatArray, move_weight: FloatArray
    ) -> None:
        """Diagonalise the coupling.

        Args:
            coupling: C, see above.
            pull: see above.
            travel: see above.
            move_weight: diagonal of Q, (n,), positive, m²/rad².
        """
        eigenvalues, U = np.linalg.eigh(coupling)
        self._move_weight = move_weight
        self._eigenvalues = np.maximum(eigenvalues, 0.0)[:, None]
        self._forth = U.T @ pull
        # One product gives dq above S.
        self._back = np.concatenate([U, travel @ U])

    @classmethod
    def of_free_moves(cls, weights: FloatArray, move_weight: FloatArray) -> UnlimitedPlan:
        """Return that of ½ Σ_t w_t ‖target_t − J Σ_{s≤t} dq_s‖² + ½ Σ_t dq_tᵀ Q dq_t.

        Args:
            weights: w, (H,).
            move_weight: diagonal of Q, (n,), positive.
        """
        until = np.tri(len(weights))
        return cls(until.T * weights @ until, until.T * weights, until, move_weight)

    @classmethod
    def of_constant_step(cls, gain: float, horizon: int, move_weight: FloatArray) -> UnlimitedPlan:
        """Return that of ½ a ‖J dq‖² − targetᵀ J dq + ½ dqᵀ Q dq: (a JᵀJ + Q) dq = Jᵀ target.

        With target = (b − c) e it is eq. 46 for Q = q I; for another Q the printed eq. 46 is not this minimiser.

        Args:
            gain: a, blocks³.
            horizon: H, blocks; the way is H dq.
            move_weight: diagonal of Q, (n,), positive.
        """
        return cls(np.array([[gain]]), np.eye(1), np.array([[float(horizon)]]), move_weight)

    def minimise(self, J: FloatArray, targets: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the moves dq and the ways S, both (..., moves, n), rad.

        Args:
            J: (..., m, n), m/rad.
            targets: (..., moves, m); for a constant step m times blocks².
        """
        weighted = J / self._move_weight
        s, V = np.linalg.eigh(weighted @ J.mT)
        along = self._forth @ targets @ V / (1.0 + self._eigenvalues * s[..., None, :])
        stacked = self._back @ (along @ (V.mT @ weighted))
        moves = len(self._forth)
        return stacked[..., :moves, :], stacked[..., moves:, :]


@dataclass(frozen=True)
class Blocks:
    """B blocks of length Δ, with B Δ the horizon; a joint step of a block is Δ times its velocity.

    Weights are stated for blocks of Δ₀ = 0.05 s. For others they follow from the integrals over the horizon, of which
    the sums over the blocks are approximations, so that the optimum in continuous time stays the same:

        Σ ‖error‖² + q Σ ‖step‖²  ≈  (1/Δ) ∫ ‖error‖² dt + q Δ ∫ ‖velocity‖² dt   with q = q₀ (Δ₀ / Δ)²
    """

    count: int  # B
    length: float  # Δ [s]
    period: float  # control period [s]

    @classmethod
    def of(cls, horizon_time: float, moves: int, period: float) -> Blocks:
        """Return `moves` blocks over `horizon_time` [s], or fewer ones: none is shorter than a control period [s]."""
        count = max(1, min(moves, int(in_periods(horizon_time, period))))
        return cls(count, max(horizon_time / count, period), period)

    @property
    def periods(self) -> float:
        """Length of a block in control periods."""
        return in_periods(self.length, self.period)

    @property
    def relative_length(self) -> float:
        """Δ / Δ₀."""
        return in_periods(self.length, REFERENCE_BLOCK)

    def places(self, delay: float) -> FloatArray:
        """Return the places in a preview of the beginning of the first block and the ends of all, (B + 1,), in rows.

        Args:
            delay: from now to the beginning of the first block [s].
        """
        times = [delay + t * self.length for t in range(self.count + 1)]
        return np.array([in_periods(time, self.period) for time in times])


def bridging_shares(delay: float, period: float) -> FloatArray:
    """Return the share of each of the last steps sent that takes effect after `delay`, the newest one last.

    Args:
        delay: from a command to its effect [s].
        period: of control [s].
    """
    count = in_periods(delay, period)
    shares = np.ones(int(np.ceil(count)))
    if len(shares):
        shares[0] = count - (len(shares) - 1)
    return shares
