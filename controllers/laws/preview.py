"""The reference and other rows of samples at instants between the control instants: all laws plan in physical time."""

from __future__ import annotations

import numpy as np

from servobench.controllers.periods import in_periods
from servobench.plant.contract.checks import FloatArray


def check_preview(wanted: float, rows: int, period: float, what: str) -> None:
    """Refuse a preview that does not reach far enough.

    Args:
        wanted: how far the law looks ahead [s].
        rows: of the preview, one for each control period.
        period: of control [s].
        what: the settings that add up to `wanted`.

    Raises:
        ValueError: it is too short.
    """
    if rows < in_periods(wanted, period):
        raise ValueError(f"preview must reach {what} = {wanted:g} s, got {rows} rows of {period:g} s")


def sampled(rows: FloatArray, places: FloatArray) -> FloatArray:
    """Return samples between equidistant rows, (..., K, m): interpolated, and the row itself at a whole place.

    Args:
        rows: (..., N, m).
        places: (K,), from 0 to N − 1, in rows.
    """
    before = places.astype(np.int_)
    share = (places - before)[:, None]
    if not share.any():
        return rows[..., before, :]
    after = np.minimum(before + 1, rows.shape[-2] - 1)
    return np.asarray((1.0 - share) * rows[..., before, :] + share * rows[..., after, :])
