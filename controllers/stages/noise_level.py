"""The standard deviation of the feature's noise, estimated online from innovations.

The posterior of σ on a grid of factors of two about a first guess, from innovations ν (K,) of variance a σ² + b, of
which a part are outliers with a deviation of `OUTLIER`, which does not depend on σ:

    ℓ_j ← f ℓ_j + min(‖ν‖²/s_j + K ln s_j, K ln OUTLIER² + 4.6),   s_j = a σ_j² + b
    ln σ = Σ μ_j ln σ_j,   μ_j ∝ exp(−ℓ_j/2);   at first ln σ_j ~ N(ln of the guess, 1.5²)

The cap is the density of a contaminated normal distribution: it does not depend on σ, so that neither does a small
guess pass for certainty, nor an outlier for noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servobench.plant.contract.checks import FloatArray, Shape
from servobench.plant.contract.lanes import branch

LOG_RATIOS = np.log(2.0) * np.arange(-2, 8)  # [1] ln of σ_j relative to the guess
RATIOS = np.exp(2.0 * LOG_RATIOS)  # [1] σ_j² relative to the guess
LOG_DEVIATION = 1.5  # [1] prior deviation of ln σ
FORGETTING = 0.99  # [1] f, what is left of the scores after a sample
OUTLIER = 0.1  # [unit of the feature] deviation of outliers
OUTLIER_ODDS = 4.6  # [1] −2 ln of the share of outliers, a tenth
MIN_LOG_LIKELIHOOD = -600.0  # [1] exp of less than −700 underflows


class NoiseLevel(NamedTuple):
    """The state of the estimate."""

    variance: FloatArray  # σ², (...), m²
    scores: FloatArray  # ℓ_j, (..., grid)
    guess: FloatArray  # the first σ², (...), m²

    @classmethod
    def start(cls, deviation: float, lead: Shape = ()) -> NoiseLevel:
        """Return the state of a first guess of σ, m, with leading axes of the shape `lead`."""
        variance = np.full(lead, deviation**2)[()]
        prior = np.square(LOG_RATIOS / LOG_DEVIATION)
        scores = np.broadcast_to(prior, (*lead, len(prior)))
        return cls(variance, scores, guess=variance)

    @property
    def deviation(self) -> FloatArray:
        """σ, (...), m."""
        return np.sqrt(self.variance)

    def learn(
        self, square: FloatArray, count: FloatArray, multiple: FloatArray, other: FloatArray
    ) -> NoiseLevel:
        """Return the state after an innovation; one of exactly 0 is that of the same frame and holds no information.

        Args:
            square: ‖ν‖², (...), m².
            count: K, (...), number of features in it.
            multiple: a, (...), of σ² in its variance.
            other: b, (...), the rest of its variance, m².
        """
        return branch(square != 0.0, _learned, self, square, count, multiple, other)


def _learned(
    level: NoiseLevel,
    square: FloatArray,
    count: FloatArray,
    multiple: FloatArray,
    other: FloatArray,
) -> NoiseLevel:
    """Return the level after an innovation that is not 0; as in `NoiseLevel.learn`."""
    a = (multiple * level.guess)[..., None]
    b = np.maximum(other, 0.0)[..., None]
    K = count[..., None]
    s = a * RATIOS + b
    inlier = square[..., None] / s + K * np.log(s)
    outlier = K * np.log(OUTLIER**2) + OUTLIER_ODDS
    scores = FORGETTING * level.scores + np.minimum(inlier, outlier)
    least = np.minimum.reduce(scores, axis=-1)
    scores = scores - least[..., None]
    likelihood = np.exp(np.maximum(-0.5 * scores, MIN_LOG_LIKELIHOOD))
    total = np.add.reduce(likelihood, axis=-1)
    log_ratio = np.vecdot(likelihood, LOG_RATIOS) / total
    variance = level.guess * np.exp(2.0 * log_ratio)
    return level._replace(variance=variance, scores=scores)
