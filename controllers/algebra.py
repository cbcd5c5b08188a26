"""Linear algebra of the chain: damped pseudo-inverse, projection on the row space, and nearest rotation."""

import numpy as np

from servobench.plant.contract import lanes
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import FilterDiverged
from servobench.plant.contract.lanes import branch, entries, plus_diagonal

MAX_DAMPED_RATIO = (
    1e9  # [1] largest ‖J‖²/δ²; above it rounding errors of JJᵀ are not small against δ²
)
# [1] Ratio of a singular value to the largest one, below which it is a rounding error.
MIN_SINGULAR_RATIO = 1e-15


def nearest_rotation(M: FloatArray) -> FloatArray:
    """Return the rotation R, (..., m, m), nearest to M, (..., m, m), in the Frobenius norm: it maximises trace(RᵀM).

    Raises:
        FilterDiverged: an M has no singular value decomposition.
    """
    try:
        return lanes.nearest_rotation(M)
    except np.linalg.LinAlgError as error:
        raise FilterDiverged(f"map has no nearest rotation: {M.tolist()}") from error


def damped_inverse(J: FloatArray, damping: float) -> FloatArray:
    """Return Jᵀ (JJᵀ + δ²I)⁻¹, (..., n, m), rad/m, for J (..., m, n); the pseudo-inverse where δ = 0.

    It solves the normal equations, or takes singular values where rounding errors would exceed δ.

    Args:
        J: (..., m, n), m/rad.
        damping: δ, m/rad; directions in which J is weaker than this get little joint motion.
    """
    if damping == 0.0:
        return np.asarray(np.linalg.pinv(J))
    square = J @ J.mT
    ordinary = square.trace(axis1=-2, axis2=-1) < MAX_DAMPED_RATIO * damping**2
    inverse = branch(ordinary, _solve_normal_equations, J, square, damping)
    return branch(~ordinary, _decompose, inverse, J, damping).mT


def _solve_normal_equations(J: FloatArray, square: FloatArray, damping: float) -> FloatArray:
    """Return (JJᵀ + δ²I)⁻¹ J, (..., m, n), for square = JJᵀ."""
    return np.asarray(np.linalg.solve(plus_diagonal(square, damping**2), J), dtype=np.float64)


def _decompose(_: FloatArray, J: FloatArray, damping: float) -> FloatArray:
    """Return (JJᵀ + δ²I)⁻¹ J, (..., m, n), from singular values."""
    U, sigma, Vt = np.linalg.svd(J, full_matrices=False)
    inverse = sigma / (sigma**2 + damping**2)
    return (U * inverse[..., None, :]) @ Vt


def project_to_row_space(weights: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return Ĵ⁺Ĵ W: the part of weights (..., n, p, N_h) whose output moves the feature under Ĵ (..., m, n)."""
    _, singular, rows = np.linalg.svd(jacobian, full_matrices=False)
    counts = singular > MIN_SINGULAR_RATIO * singular[..., :1]
    basis = rows * counts[..., None]
    flat = entries(weights)
    return np.asarray(basis.mT @ (basis @ flat)).reshape(weights.shape)
