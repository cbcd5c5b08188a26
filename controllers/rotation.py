"""The rotation nearest to a matrix."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dgesdd

from servobench.plant.checks import FloatArray
from servobench.plant.faults import FilterDiverged


def nearest_rotation(M: FloatArray) -> FloatArray:
    """Return the rotation R, (m, m), nearest to M, (m, m), in the Frobenius norm: it maximises trace(RᵀM).

    Raises:
        FilterDiverged: M has no singular value decomposition.
    """
    left, _, right, failed = dgesdd(M)
    if failed:
        raise FilterDiverged(f"map has no nearest rotation: {M.tolist()}")
    R: FloatArray = left.dot(right)
    if _determinant(R) < 0.0:
        left[:, -1] = -left[:, -1]
        R = left.dot(right)
    return R


def _determinant(R: FloatArray) -> float:
    if len(R) != 3:
        return float(np.linalg.det(R))
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    return float(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))
