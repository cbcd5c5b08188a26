"""How what is seen relates to what a model says: a linear map and a delay, both estimated online.

For each candidate delay d = 0 … D a filter of its own holds a map M, (m, m), and a covariance P, (m, m), that the rows
of M share. x_d is the feature step that the model predicts for the joint motion d periods ago:

    Δy = M x_d + v,   v ~ N(0, r I),   r = 2σ² + c² ‖x_d‖²             noise of two frames, and error of the model
    ν = Δy − M x_d,   s = r + x_dᵀ P x_d
    M ← M + ν (P x_d)ᵀ / s,   P ← P − (P x_d)(P x_d)ᵀ / s

This is recursive least squares; with P⁻¹ = 0 at first, constant r and no walk of P it is batch least squares. The
candidates are judged by how well they predict, −2 log of the likelihood of what was seen:

    ℓ_d = Σ ‖ν‖² / s + m ln s

All functions are pure; the leading axis runs over the candidates.
"""

from __future__ import annotations

import numpy as np

from plant.signals import FloatArray


def map_update(
    M: FloatArray, P: FloatArray, x: FloatArray, feature_step: FloatArray, variance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Learn from one motion under every candidate delay.

    Args:
        M: maps, (D, m, m).
        P: covariances, (D, m, m).
        x: feature steps that the model predicts, (D, m), m.
        feature_step: Δy, (m,), m.
        variance: r, (D,), m², positive.

    Returns:
        The new M and P; ‖ν‖²/s, (D,), what was seen against what was expected; and s, (D,), m².
    """
    Px = np.matmul(P, x[:, :, None])[:, :, 0]
    s = variance + np.add.reduce(x * Px, axis=1)
    nu = feature_step - np.matmul(M, x[:, :, None])[:, :, 0]
    gain = Px / s[:, None]
    renewed = M + nu[:, :, None] * gain[:, None, :]
    return renewed, P - Px[:, :, None] * gain[:, None, :], np.add.reduce(nu * nu, axis=1) / s, s


def nearest_rotation(M: FloatArray) -> FloatArray:
    """Return the rotation R, (m, m), nearest to M, (m, m), in the Frobenius norm: it maximises trace(RᵀM)."""
    left, _, right = np.linalg.svd(M)
    R = np.asarray(left @ right)
    if np.linalg.det(R) < 0.0:
        left[:, -1] = -left[:, -1]
        R = np.asarray(left @ right)
    return R


def near_rotation(M: FloatArray, P: FloatArray, deviation: float) -> tuple[FloatArray, FloatArray]:
    """Complete a map by the belief that it is nearly a rotation: where P is large, M says little.

        R = the rotation nearest to M P⁻¹: directions count by what is known of them
        M̄ = M + (R − M) P (P + ς² I)⁻¹: what M and the belief M ~ N(R, ς²) an entry make together

    Two known directions of three give the third.

    Args:
        M: (m, m).
        P: (m, m), positive definite.
        deviation: ς, of an entry of the map from the rotation; 0 for the rotation itself.

    Returns:
        M̄ and R.
    """
    R = nearest_rotation(M @ np.linalg.inv(P))
    if deviation == 0.0:
        return R, R
    share = P @ np.linalg.inv(P + deviation**2 * np.eye(len(P)))
    return M + (R - M) @ share, R
