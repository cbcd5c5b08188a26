"""The horizon of a predictive law as equal blocks of constant joint velocity, at any control rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servobench.controllers.periods import in_periods
from servobench.plant.contract.checks import FloatArray

REFERENCE_BLOCK = 0.05  # [s] length of the blocks for which weights are stated


@dataclass(frozen=True)
class Blocks:
    """B blocks of length Δ, with B Δ the horizon; a joint step of a block is Δ times its velocity.

    Weights are stated for blocks of Δ₀ = 0.05 s. For others they follow from the integrals over the horizon, of which
    the sums over the blocks are approximations, so that the optimum in continuous time stays the same:

        Σ ‖error‖² + q Σ ‖step‖²  ≈  (1/Δ) ∫ ‖error‖² dt + q Δ ∫ ‖velocity‖² dt   with q = q₀ (Δ₀ / Δ)²

    Attributes:
        count: B.
        length: Δ [s].
        period: of control [s].
    """

    count: int
    length: float
    period: float

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
            delay: from now to the begin of the first block [s].
        """
        return np.array([in_periods(delay + t * self.length, self.period) for t in range(self.count + 1)])


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
