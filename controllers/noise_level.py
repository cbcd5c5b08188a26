"""How noisy the feature is, estimated online from what predictions leave unexplained.

    E ‖ν‖²/m = a σ² + b        ν innovation (m,), m; a how often σ² is in it; b what else is, m²
    sample = (‖ν‖²/m − b)/a,   weight = (a σ²/(a σ² + b))²:   where b is large, ν says little about σ
    σ² = Σ weight · sample / Σ weight, with forgetting, from a first guess that counts as `GUESS` samples

A sample counts at most `LARGEST` σ², so that a camera that is moved does not make all that follows look like noise;
while less than `TRUSTED` samples are known, more in proportion, so that a wrong guess is left at once.
"""

from __future__ import annotations

from typing import final

GUESS = 1.0  # samples that the first guess is worth
TRUSTED = 10.0  # samples, the guess included
FORGETTING = 0.99  # of the sums, a sample
LARGEST = 9.0  # of a sample, in σ²
SMALLEST = 1e-2  # of σ² against the first guess: a perfect feature is none


@final
class NoiseLevel:
    """The estimate above; `variance` is σ², m²."""

    def __init__(self, deviation: float) -> None:
        """Start at a first guess of σ, m."""
        self.variance = deviation**2
        self._floor = SMALLEST * self.variance
        self._weights, self._sum = GUESS, GUESS * self.variance

    def learn(self, square: float, multiple: float, other: float) -> None:
        """Learn from an innovation.

        Args:
            square: ‖ν‖²/m, m².
            multiple: a.
            other: b, m².
        """
        if square == 0.0:  # the same frame again: it tells nothing
            return
        own = multiple * self.variance
        weight = (own / (own + other)) ** 2
        largest = LARGEST * max(1.0, TRUSTED / self._weights) * self.variance
        sample = min((square - other) / multiple, largest)
        self._sum = FORGETTING * self._sum + weight * sample
        self._weights = FORGETTING * self._weights + weight
        self.variance = max(self._sum / self._weights, self._floor)
