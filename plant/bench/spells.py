"""Spells: stretches of frames in which something is wrong with the sensor, such as an outlier or an occlusion.

In a frame outside of a spell, a spell begins with probability p and lasts d frames:

    share of the frames in spells  π = p d / (p d + 1 − p),   so p = π / (π + d (1 − π))

For d = 1 the frames are independent and p = π. A signal that is drawn anew for each spell, with mean 0 and variance s²,
and is 0 outside, has the autocovariance s² π (d − h)/d at a lag of h < d frames and 0 beyond.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import where
from servobench.plant.contract.signals import BoolArray


def begin_probability(share: float, frames: int) -> float:
    """Return p, the probability that a spell begins in a frame outside of one.

    Args:
        share: π, of the frames that are in spells, below 1.
        frames: d, length of a spell.
    """
    return share / (share + frames * (1.0 - share))


class Spell(NamedTuple):
    """The state of the spells of each lane.

    Attributes:
        left: (...), frames of the present spell that are left after this one.
        inside: (...), whether the present frame is in a spell.
        value: (..., *), what the present spell drew, or the last one.
    """

    left: npt.NDArray[np.int_]
    inside: BoolArray
    value: FloatArray

    @classmethod
    def none(cls, lead: tuple[int, ...], value: FloatArray) -> Spell:
        """Return the state before the first frame, outside of any spell."""
        return cls(np.zeros(lead, dtype=np.int_)[()], np.zeros(lead, dtype=np.bool_)[()], value)

    def next(self, begins: BoolArray, frames: int, value: FloatArray) -> Spell:
        """Return the state at the next frame.

        Args:
            begins: (...), whether a spell begins in lanes that are outside of one.
            frames: length of a spell.
            value: (..., *), of a spell that begins.
        """
        goes_on = self.left > 0
        new = np.logical_and(begins, np.logical_not(goes_on))
        left = np.where(new, frames - 1, np.maximum(self.left - 1, 0))[()]
        return Spell(left, np.logical_or(goes_on, new), where(new, value, self.value))
