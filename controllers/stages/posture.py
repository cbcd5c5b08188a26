"""The posture stage: joint motion in the null space of the Jacobian, which does not move the feature."""

from __future__ import annotations

import numpy as np

from servobench.plant.contract.checks import FloatArray


def step_with_posture(
    inverse: FloatArray, jacobian: FloatArray, feature_step: FloatArray, away: FloatArray, share: float
) -> FloatArray:
    """Return J⁺ v + κ (I − J⁺J)(q_c − q), (..., n), rad.

    Args:
        inverse: J⁺, damped or not, (..., n, m), rad/m.
        jacobian: J, (..., m, n), m/rad.
        feature_step: v, (..., m), m.
        away: q_c − q, from the present joint position to the wanted posture, (..., n), rad.
        share: κ, of that distance; 0 for no posture.
    """
    step: FloatArray = np.matvec(inverse, feature_step - share * np.matvec(jacobian, away)) + share * away
    return step
