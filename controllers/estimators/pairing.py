"""The pair stage under an unknown delay: which joint motion belongs to the feature motion that was just seen.

For each candidate delay d = 0 … D−1 the joint motion that ended d periods ago, over as many periods as the feature
motion took, and the feature motion that a model predicts for it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from servobench.plant.checks import FloatArray
from servobench.plant.lanes import branch, pick
from servobench.plant.signals import BoolArray

MAX_GAP = 16  # [periods] that a motion over lost frames may span; after a longer gap the past is forgotten


class MotionHistory(NamedTuple):
    """Joint positions and sums of predicted feature steps of the last periods; a state with a pure `append`.

    Attributes:
        rows: [q, Σ x], (..., D + `MAX_GAP` + 1, n + m), the newest last.
        empty: (...), whether there is no past: before the next motion the arm counts as having been at rest.
    """

    rows: FloatArray
    empty: BoolArray

    @classmethod
    def start(cls, lead: tuple[int, ...], candidates: int, joints: int, features: int) -> MotionHistory:
        """Return an empty one for as many candidate delays, with leading axes of the shape `lead`."""
        return cls(np.zeros((*lead, candidates + MAX_GAP + 1, joints + features)), np.full(lead, True))

    def forget(self) -> MotionHistory:
        """Return one without a past."""
        return self._replace(empty=np.full(np.shape(self.empty), True))

    def append(
        self, joint_position: FloatArray, joint_step: FloatArray, predicted: FloatArray, periods: npt.NDArray[np.int_]
    ) -> MotionHistory:
        """Return one with one more observed motion; over lost frames the joints count as having moved evenly.

        Args:
            joint_position: where it began, (..., n), rad.
            joint_step: Δq, (..., n), rad.
            predicted: the feature step that the model predicts, (..., m), m.
            periods: that it took, (...), from 1 to `MAX_GAP`.
        """
        rows = branch(self.empty, _at_rest, self.rows, joint_position)
        long, before = periods > 1, rows[..., -1, joint_position.shape[-1] :]
        end = np.concatenate([joint_position + joint_step, before + predicted], axis=-1)
        appended = branch(np.logical_not(long), _append_period, rows, end)
        appended = branch(long, _append_gap, appended, joint_position, joint_step, predicted, periods)
        return MotionHistory(appended, self.empty & False)

    def motions(self, periods: npt.NDArray[np.int_], joints: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return, for each candidate delay, the motion over `periods`, (...), that ended so many periods ago.

        Returns:
            Joint positions where it began, (..., D, n), rad; joint steps, (..., D, n), rad; predicted feature steps,
            (..., D, m), m.
        """
        last = self.rows.shape[-2] - 1
        count = last - MAX_GAP
        begin = pick(self.rows, last - np.arange(count) - periods[..., None], axes=1)
        passed = self.rows[..., last : last - count : -1, :] - begin
        return begin[..., :joints], passed[..., :joints], passed[..., joints:]


def _at_rest(rows: FloatArray, joint_position: FloatArray) -> FloatArray:
    n = joint_position.shape[-1]
    still = np.broadcast_to(joint_position[..., None, :], (*rows.shape[:-1], n))
    return np.concatenate([still, np.zeros((*rows.shape[:-1], rows.shape[-1] - n))], axis=-1)


def _append_period(rows: FloatArray, end: FloatArray) -> FloatArray:
    return np.concatenate([rows[..., 1:, :], end[..., None, :]], axis=-2)


def _append_gap(
    rows: FloatArray,
    joint_position: FloatArray,
    joint_step: FloatArray,
    predicted: FloatArray,
    periods: npt.NDArray[np.int_],
) -> FloatArray:
    count, gap = rows.shape[-2], periods[..., None]
    begin = np.concatenate([joint_position, rows[..., -1, joint_position.shape[-1] :]], axis=-1)
    step = np.concatenate([joint_step, predicted], axis=-1)
    index = np.arange(count) + gap
    new = index - count + 1
    between = begin[..., None, :] + step[..., None, :] * (new / gap)[..., None]
    return np.where((new > 0)[..., None], between, pick(rows, np.minimum(index, count - 1), axes=1))
