"""The message from an estimator to a control law."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from servobench.plant.checks import FloatArray

MAX_DELAY = 14  # [periods] the longest delay that an estimator may report, so that a law knows how much past to keep


@dataclass(frozen=True, eq=False, slots=True)
class Estimate:
    """What an estimator hands to the law in each period.

    Attributes:
        jacobian: Ĵ, (..., m, n), m/rad, at the present joint position.
        delay: (...) [periods] by which features are late, from 0 to `MAX_DELAY`; 0 where it is not identified.
        noise: (...) [m] standard deviation of the feature per axis; None where it is not identified. No law of this
            package reads it: `rbfnn_bridged` finds its own from its own innovations.
    """

    jacobian: FloatArray
    delay: npt.NDArray[np.int_] | int = 0
    noise: FloatArray | None = None
