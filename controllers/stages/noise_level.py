"""The standard deviation of the feature's noise, estimated online from innovations.

    E ‖ν‖²/m = a σ² + b        ν innovation (m,), m; a the multiple of σ² in it; b its other variance, m²
    sample = (‖ν‖²/m − b)/a,   weight = (a σ²/(a σ² + b))²:   a sample counts less where b is large
    σ² = Σ weight · sample / Σ weight, with forgetting, from an initial guess that counts as `GUESS_SAMPLES`

A sample is capped at `MAX_SAMPLE_RATIO` σ², so that a camera that is moved does not pass for noise. During the warm-up
the cap is higher in proportion, so that a wrong guess is corrected at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch

GUESS_SAMPLES = 1.0  # [samples] weight of the initial guess
WARM_UP_SAMPLES = 10.0  # [samples] length of the warm-up, with the guess
FORGETTING = 0.99  # [1] factor of the sums per sample
MAX_SAMPLE_RATIO = 9.0  # [1] cap of a sample relative to σ²
MIN_VARIANCE_RATIO = 1e-2  # [1] floor of σ² relative to the initial guess


class NoiseLevel(NamedTuple):
    """The state of the estimate; every array is (...).

    Attributes:
        variance: σ², m².
        weight_sum: Σ weight.
        sample_sum: Σ weight · sample, m².
        floor: the lowest σ², m².
    """

    variance: FloatArray
    weight_sum: FloatArray
    sample_sum: FloatArray
    floor: FloatArray

    @classmethod
    def guess(cls, deviation: float, lead: tuple[int, ...] = ()) -> NoiseLevel:
        """Return the state of an initial guess of σ, m, with leading axes of the shape `lead`."""
        variance = np.full(lead, deviation**2)
        return cls(variance, np.full(lead, GUESS_SAMPLES), GUESS_SAMPLES * variance, MIN_VARIANCE_RATIO * variance)

    @property
    def deviation(self) -> FloatArray:
        """σ, (...), m."""
        deviation: FloatArray = np.sqrt(self.variance)
        return deviation

    def learn(self, square: FloatArray, multiple: float | FloatArray, other: FloatArray) -> NoiseLevel:
        """Return the state after an innovation; one of exactly 0 is that of the same frame and holds no information.

        Args:
            square: ‖ν‖²/m, (...), m².
            multiple: a, the multiple of σ² in its variance.
            other: b, (...), the rest of its variance, m².
        """
        return branch(square != 0.0, _learned, self, square, multiple, other)


def _learned(level: NoiseLevel, square: FloatArray, multiple: float | FloatArray, other: FloatArray) -> NoiseLevel:
    variance, weight_sum, sample_sum, floor = level
    own = multiple * variance
    share = own / (own + other)
    weight = share * share  # not share**2: its bits differ between a number and an array
    cap = MAX_SAMPLE_RATIO * np.maximum(1.0, WARM_UP_SAMPLES / weight_sum) * variance
    sample_sum = FORGETTING * sample_sum + weight * np.minimum((square - other) / multiple, cap)
    weight_sum = FORGETTING * weight_sum + weight
    return NoiseLevel(np.maximum(sample_sum / weight_sum, floor), weight_sum, sample_sum, floor)
