"""Inverses of a Jacobian: damped where the feature hardly moves, and the projection on what moves it at all."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dposv

from servobench.plant.checks import FloatArray

MAX_DAMPED_RATIO = 1e9  # [1] of ‖J‖²/δ²; above it rounding errors of JJᵀ are not small against δ²
MAX_CONDITION = 1e3  # [1] of ‖J‖ ‖J⁺‖; the normal equations square it and then lose six digits
MIN_SINGULAR_RATIO = 1e-15  # [1] of a singular value to the largest; smaller ones are rounding errors


def damped_inverse(J: FloatArray, damping: float) -> FloatArray:
    """Return Jᵀ (JJᵀ + δ²I)⁻¹, (n, m), rad/m, for J (m, n); the pseudo-inverse where δ = 0.

    It is computed from a Cholesky factor, or from singular values where rounding errors would exceed δ.

    Args:
        J: (m, n), m/rad.
        damping: δ, m/rad; directions in which J is weaker than this get little joint motion.
    """
    if damping == 0.0:
        return np.asarray(np.linalg.pinv(J))
    square = J.dot(J.T)
    if not square.trace() < MAX_DAMPED_RATIO * damping**2:
        return damped_inverse_by_svd(J, damping)
    square.flat[:: len(J) + 1] += damping**2
    return np.asarray(dposv(square, J)[1]).T


def damped_inverse_by_svd(J: FloatArray, damping: float) -> FloatArray:
    """Return the same from singular values, which is accurate for any J and takes longer."""
    U, sigma, Vt = np.linalg.svd(J, full_matrices=False)
    return np.asarray((Vt.T * (sigma / (sigma**2 + damping**2))) @ U.T)


def project_to_row_space(weights: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return Ĵ⁺Ĵ W: the part of the weights (n, p, N_h) whose output moves the feature under `jacobian` (m, n)."""
    return np.asarray((_row_space_projector(jacobian) @ weights.reshape(len(weights), -1)).reshape(weights.shape))


def _row_space_projector(jacobian: FloatArray) -> FloatArray:
    """Return Ĵ⁺Ĵ, (n, n), from the normal equations where they are accurate, else from singular values."""
    m, n = jacobian.shape
    if m <= n:
        try:
            inverse = np.linalg.solve(jacobian @ jacobian.T, jacobian)  # (Ĵ⁺)ᵀ
        except np.linalg.LinAlgError:
            pass  # the rank is below m; singular values find it
        else:
            if np.vdot(jacobian, jacobian) * np.vdot(inverse, inverse) < MAX_CONDITION**2:
                return jacobian.T @ inverse
    _, singular, rows = np.linalg.svd(jacobian, full_matrices=False)
    basis = rows[singular > MIN_SINGULAR_RATIO * singular[0]]
    return np.asarray(basis.T @ basis)
