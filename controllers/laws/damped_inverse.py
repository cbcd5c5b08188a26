"""The inverse of a Jacobian that does not chase directions in which the feature hardly moves."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dposv

from servobench.plant.checks import FloatArray

LARGEST = 1e9  # of ‖J‖²/δ²: beyond it rounding is no longer small against δ²


def damped_inverse(J: FloatArray, damping: float) -> FloatArray:
    """Return Jᵀ (JJᵀ + δ²I)⁻¹, (n, m), rad/m, for J (m, n); the pseudo-inverse where δ = 0.

    By a Cholesky factor; where rounding would drown δ, by singular values.

    Args:
        J: (m, n), m/rad.
        damping: δ, m/rad: directions in which J is weaker than this are not chased.
    """
    if damping == 0.0:
        return np.asarray(np.linalg.pinv(J))
    square = J.dot(J.T)
    if not square.trace() < LARGEST * damping**2:
        return damped_inverse_by_svd(J, damping)
    square.flat[:: len(J) + 1] += damping**2
    return np.asarray(dposv(square, J)[1]).T


def damped_inverse_by_svd(J: FloatArray, damping: float) -> FloatArray:
    """Return the same by singular values, exact for any J, for more time."""
    U, sigma, Vt = np.linalg.svd(J, full_matrices=False)
    return np.asarray((Vt.T * (sigma / (sigma**2 + damping**2))) @ U.T)
