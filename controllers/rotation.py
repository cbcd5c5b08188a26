"""The rotation nearest to a matrix."""

from __future__ import annotations

import numpy as np

from servobench.plant.checks import FloatArray
from servobench.plant.faults import FilterDiverged


def nearest_rotation(M: FloatArray) -> FloatArray:
    """Return the rotation R, (..., m, m), nearest to M, (..., m, m), in the Frobenius norm: it maximises trace(RᵀM).

    Raises:
        FilterDiverged: an M has no singular value decomposition.
    """
    try:
        left, _, right = np.linalg.svd(M)
    except np.linalg.LinAlgError as error:
        raise FilterDiverged(f"map has no nearest rotation: {M.tolist()}") from error
    signs = np.ones(M.shape[:-1])
    signs[..., -1] = np.copysign(1.0, np.linalg.det(left @ right))
    return np.asarray((left * signs[..., None, :]) @ right)
