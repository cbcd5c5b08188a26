"""The rotation nearest to a matrix."""

from __future__ import annotations

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import FilterDiverged
from servobench.plant.contract.lanes import branch


def nearest_rotation(M: FloatArray) -> FloatArray:
    """Return the rotation R, (..., m, m), nearest to M, (..., m, m), in the Frobenius norm: it maximises trace(RᵀM).

    Raises:
        FilterDiverged: an M has no singular value decomposition.
    """
    try:
        left, _, right = np.linalg.svd(M)
    except np.linalg.LinAlgError as error:
        raise FilterDiverged(f"map has no nearest rotation: {M.tolist()}") from error
    R = left @ right
    return branch(np.linalg.det(R) < 0.0, _reflected, R, left, right)


def _reflected(R: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    signs = np.ones(R.shape[-1])
    signs[-1] = -1.0
    return np.asarray((left * signs) @ right)
