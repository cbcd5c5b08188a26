"""How what is seen relates to what a model says: a linear map and a delay, both estimated online.

For each candidate delay d = 0 … D−1 a filter of its own holds a map M, (m, m), and a covariance P, (m, m), that the
rows of M share. x_d is the feature step that the model predicts for the joint motion d periods ago:

    Δy = M x_d + v,   v ~ N(0, r I),   r = 2σ² + c² ‖x_d‖²             noise of two frames, and error of the model
    ν = Δy − M x_d,   s = r + x_dᵀ P x_d
    M ← M + ν (P x_d)ᵀ / s,   P ← P − (P x_d)(P x_d)ᵀ / s

This is recursive least squares; with P⁻¹ = 0 at first, constant r and no walk of P it is batch least squares. The
candidates are judged by how well they predict, −2 log of the likelihood of what was seen:

    ℓ_d = Σ ‖ν‖² / s + m ln s

All functions are pure; the axis of the candidates follows the leading axes of runs side by side.
"""

from __future__ import annotations

import numpy as np

from servobench.controllers.rotation import nearest_rotation
from servobench.plant.checks import FloatArray
from servobench.plant.faults import FilterDiverged
from servobench.plant.lanes import outer, plus_diagonal


def map_update(
    bank: FloatArray, x: FloatArray, feature_step: FloatArray, variance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Learn from one motion under every candidate delay.

    Args:
        bank: each map M above its covariance P, (..., D, 2m, m): what multiplies x in both is one product.
        x: feature steps that the model predicts, (..., D, m), m.
        feature_step: Δy, (..., m), m.
        variance: r, (..., D), m², positive.

    Returns:
        The new bank; ‖ν‖²/s, (..., D), what was seen against what was expected; and s, (..., D), m².
    """
    m = feature_step.shape[-1]
    known = np.matvec(bank, x)
    Px = known[..., m:]
    s = variance + np.vecdot(x, Px)
    known[..., :m] -= feature_step[..., None, :]  # −ν above P x: minus their products with the gain is the change
    nu = known[..., :m]
    return bank - outer(known, Px / s[..., None]), np.vecdot(nu, nu) / s, s


def near_rotation(M: FloatArray, P: FloatArray, deviation: float) -> tuple[FloatArray, FloatArray]:
    """Complete a map by the belief that it is nearly a rotation: where P is large, M says little.

    With the belief that an entry of the map is N(R, ς²) what is measured is M ~ N(R, P + ς² I) by rows, so that

        R = argmin ‖(M − R) (P + ς² I)^(−½)‖_F, the rotation nearest to M (P + ς² I)⁻¹
        M̄ = R + (M − R) ς² (P + ς² I)⁻¹

    Directions count by what is known of them: two known directions of three give the third.

    Args:
        M: (..., m, m).
        P: (..., m, m), positive definite.
        deviation: ς, of an entry of the map from the rotation; 0 for the rotation itself.

    Returns:
        M̄ and R.

    Raises:
        FilterDiverged: a P is not positive definite.
    """
    believed = plus_diagonal(P, deviation**2)
    try:
        np.linalg.cholesky(believed)
        information = np.linalg.inv(believed)
    except np.linalg.LinAlgError as error:
        raise FilterDiverged(f"covariance of the map is not positive definite: {P.tolist()}") from error
    R = nearest_rotation(M @ information)
    if deviation == 0.0:
        return R, R
    return R + (M - R) @ (deviation**2 * information), R
