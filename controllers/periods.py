"""Times in control periods, and rows of a preview at instants between the control instants."""

import numpy as np

from servobench.plant.contract.checks import FloatArray

# [1] Relative distance to a whole number below which a number of periods is whole.
_WHOLE = 1e-9


def in_periods(time: float, period: float) -> float:
    """Return `time` [s] in control periods of `period` [s]: a fraction, or exactly a whole number up to rounding."""
    count = time / period
    if abs(count - round(count)) < _WHOLE * max(1.0, count):
        return float(round(count))
    return count


def whole_periods(time: float, period: float) -> int:
    """Return the number of control periods that is nearest to a time [s]."""
    return round(time / period)


def check_preview(wanted: float, rows: int, period: float, settings: str) -> None:
    """Refuse a preview that does not reach far enough.

    Args:
        wanted: how far the law looks ahead [s].
        rows: of the preview, one for each control period.
        period: of control [s].
        settings: names of those that add up to `wanted`.

    Raises:
        ValueError: it is too short.
    """
    if rows < in_periods(wanted, period):
        raise ValueError(
            f"preview must reach {settings} = {wanted:g} s, got {rows} rows of {period:g} s; lengthen run.preview_time"
        )


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
    return (1.0 - share) * rows[..., before, :] + share * rows[..., after, :]
