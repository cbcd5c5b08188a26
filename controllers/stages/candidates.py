"""The delays of a camera that are compared, and where the arm was so many periods ago: between two rows, too."""

from __future__ import annotations

import math
from typing import final

import numpy as np
import numpy.typing as npt

from servobench.controllers.periods import whole_periods
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import pick

RESOLUTION = 0.0125  # [s] between candidate delays, about
LAST_THREE = np.array([0, 1, 2])
IntArray = npt.NDArray[np.int_]


@final
class Candidates:
    """Candidate delays and rows of the past at them; between two rows the arm is taken to have moved evenly.

    Attributes:
        delays: (D,), periods.
        beside: (D,), a neighbour of each.
        longest: whole periods of the last one.
    """

    def __init__(self, delays: FloatArray) -> None:
        """Take the delays, (D,), periods, in order."""
        self.delays = delays
        self.beside = np.abs(np.arange(len(delays)) - 1) % len(delays)
        self._whole = delays.astype(np.int_)
        self.longest = int(self._whole[-1])
        self._share = delays - self._whole
        self._around = (self._whole, self._whole + 1) if self._share.any() else (self._whole,)

    @classmethod
    def up_to(cls, longest: float, period: float) -> Candidates:
        """Return delays from 0 to the longest one [s], with control periods of `period` [s].

        They lie about `RESOLUTION` apart: a whole number of periods, or a period divided by a whole number.
        """
        spacing = max(1, whole_periods(RESOLUTION, period)) / max(1, whole_periods(period, RESOLUTION))
        count = 1 + math.floor(whole_periods(longest, period) / spacing)
        return cls(np.asarray(spacing * np.arange(count), dtype=np.float64))

    def ends(self, past: FloatArray) -> FloatArray:
        """Return the past (..., H, columns) at each delay, (..., D, columns)."""
        return self._between(*(past[..., rows, :] for rows in self._around))

    def begins(self, past: FloatArray, periods: IntArray) -> FloatArray:
        """Return the past (..., H, columns) at each delay and `periods` (...) before, (..., D, columns)."""
        return self._between(*(pick(past, rows + periods[..., None], axes=1) for rows in self._around))

    def exposed(self, past: FloatArray, candidate: IntArray) -> FloatArray:
        """Return the past (..., H, columns) at a candidate delay (...) and a period before, (..., 2, columns)."""
        whole, share = (np.take(each, candidate)[..., None] for each in (self._whole, self._share))
        rows = pick(past, whole + LAST_THREE, axes=1)
        return np.asarray(rows[..., :2, :] + share[..., None] * (rows[..., 1:, :] - rows[..., :2, :]))

    def _between(self, row: FloatArray, before: FloatArray | None = None) -> FloatArray:
        return row if before is None else np.asarray(row + self._share[:, None] * (before - row))
