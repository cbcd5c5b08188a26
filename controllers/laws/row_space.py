"""The row space of the Jacobian: what in a joint motion moves the feature at all."""

from __future__ import annotations

import numpy as np

from servobench.plant.checks import FloatArray

LARGEST_CONDITION = 1e3  # ‖Ĵ‖ ‖Ĵ⁺‖ up to which the normal equations, that square it, lose no more than six digits
NEGLIGIBLE = 1e-15  # a singular value this small against the largest is rounding


def project_to_row_space(weights: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return Ĵ⁺Ĵ W: the part of the weights (n, p, N_h) whose output moves the feature under `jacobian` (m, n)."""
    return np.asarray((_row_space_projector(jacobian) @ weights.reshape(len(weights), -1)).reshape(weights.shape))


def _row_space_projector(jacobian: FloatArray) -> FloatArray:
    """Return Ĵ⁺Ĵ, (n, n): by the normal equations where they are accurate, by singular values elsewhere."""
    m, n = jacobian.shape
    if m <= n:
        try:
            inverse = np.linalg.solve(jacobian @ jacobian.T, jacobian)  # (Ĵ⁺)ᵀ
        except np.linalg.LinAlgError:
            pass  # a rank below m is for the singular values to tell
        else:
            if np.vdot(jacobian, jacobian) * np.vdot(inverse, inverse) < LARGEST_CONDITION**2:
                return jacobian.T @ inverse
    _, singular, rows = np.linalg.svd(jacobian, full_matrices=False)
    basis = rows[singular > NEGLIGIBLE * singular[0]]
    return np.asarray(basis.T @ basis)
