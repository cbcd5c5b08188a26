"""The pair stage under an unknown delay: which joint motion belongs to the feature motion that was just seen.

For each candidate delay d = 0 … D the joint motion that ended d periods ago, over as many periods as the feature motion
took, and the feature motion that a model predicts for it.
"""

from __future__ import annotations

from typing import final

import numpy as np

from servobench.plant.checks import FloatArray

MAX_GAP = 16  # [periods] that a motion over lost frames may span; after a longer gap the past is forgotten


@final
class MotionHistory:
    """Joint positions and sums of predicted feature steps of the last periods, rows [q, Σ x], the newest last."""

    def __init__(self, candidates: int, joints: int, features: int) -> None:
        """Keep the past for as many candidate delays."""
        self._candidates, self._n, self._m = candidates, joints, features
        self._rows: FloatArray | None = None

    def forget(self) -> None:
        """Forget the past; before the next motion the arm counts as having been at rest."""
        self._rows = None

    def append(self, joint_position: FloatArray, joint_step: FloatArray, predicted: FloatArray, periods: int) -> None:
        """Add one observed motion; over lost frames the joints count as having moved evenly.

        Args:
            joint_position: where it began, (n,), rad.
            joint_step: Δq, (n,), rad.
            predicted: the feature step that the model predicts, (m,), m.
            periods: that it took, at most `MAX_GAP`.
        """
        if self._rows is None:
            self._rows = np.zeros((self._candidates + MAX_GAP + 1, self._n + self._m))
            self._rows[:, : self._n] = joint_position
        begin = np.concatenate([joint_position, self._rows[-1, self._n :]])
        step = np.concatenate([joint_step, predicted])
        share = np.arange(1, periods + 1)[:, None] / periods if periods > 1 else 1.0
        self._rows = np.concatenate([self._rows[periods:], np.atleast_2d(begin + step * share)])

    def motions(self, periods: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return, for each candidate delay, the motion over `periods` that ended so many periods ago.

        Returns:
            Joint positions where it began, (D, n), rad; joint steps, (D, n), rad; predicted feature steps, (D, m), m.
        """
        if self._rows is None:
            raise ValueError("motions must be asked for after append")
        last, count, n = self._candidates + MAX_GAP, self._candidates, self._n
        begin = self._rows[last - periods : last - periods - count : -1]
        passed = self._rows[last : last - count : -1] - begin
        return begin[:, :n], passed[:, :n], passed[:, n:]
