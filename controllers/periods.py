"""Times in control periods."""

from __future__ import annotations

_WHOLE: float = 1e-9  # [1] a number of periods that is as near to a whole one is that one


def in_periods(time: float, period: float) -> float:
    """Return `time` [s] in control periods of `period` [s]: a fraction, or exactly a whole number up to rounding."""
    count = time / period
    return float(round(count)) if abs(count - round(count)) < _WHOLE * max(1.0, count) else count


def whole_periods(time: float, period: float) -> int:
    """Return the number of control periods that is nearest to a time [s]."""
    return round(time / period)
