"""The standard deviation of the feature's noise, estimated online from innovations.

    E ‖ν‖²/m = a σ² + b        ν innovation (m,), m; a how often multiple of σ² in it; b its other variance, m²
    sample = (‖ν‖²/m − b)/a,   weight = (a σ²/(a σ² + b))²:   a sample counts less where b is large
    σ² = Σ weight · sample / Σ weight, with forgetting, from an initial guess that counts as `GUESS_SAMPLES`

A sample is capped at `MAX_SAMPLE_RATIO` σ², so that a camera that is moved does not pass for noise. During the warm-up
the cap is higher in proportion, so that a wrong guess is corrected at once.
"""

from __future__ import annotations

from typing import final

GUESS_SAMPLES = 1.0  # [samples] weight of the initial guess
WARM_UP_SAMPLES = 10.0  # [samples] the guess included
FORGETTING = 0.99  # [1] of the sums, per sample
MAX_SAMPLE_RATIO = 9.0  # [1] of a sample to σ²
MIN_VARIANCE_RATIO = 1e-2  # [1] floor of σ² relative to the initial guess


@final
class NoiseLevel:
    """The estimate above; `variance` is σ², m²."""

    def __init__(self, deviation: float) -> None:
        """Start at an initial guess of σ, m."""
        self.variance = deviation**2
        self._floor = MIN_VARIANCE_RATIO * self.variance
        self._weights, self._sum = GUESS_SAMPLES, GUESS_SAMPLES * self.variance

    def learn(self, square: float, multiple: float, other: float) -> None:
        """Learn from an innovation.

        Args:
            square: ‖ν‖²/m, m².
            multiple: a, the multiple of σ² in its variance.
            other: b, the rest of its variance, m².
        """
        if square == 0.0:  # the same frame again, which holds no information
            return
        own = multiple * self.variance
        weight = (own / (own + other)) ** 2
        largest = MAX_SAMPLE_RATIO * max(1.0, WARM_UP_SAMPLES / self._weights) * self.variance
        sample = min((square - other) / multiple, largest)
        self._sum = FORGETTING * self._sum + weight * sample
        self._weights = FORGETTING * self._weights + weight
        self.variance = max(self._sum / self._weights, self._floor)
