"""The response of the joints to commands, identified online, and the part of the commands that is still to come.

One finite response g, (N,), holds for all joints:

    Δq(k) = Σ_{i=1..N} g_i dq(k−i)

where Δq(k) = q(k) − q(k−1) and dq(k−i) is the joint step that was commanded i periods ago. It covers the delay of a
command and the lag of the joints. g minimises Σ ‖Δq − Σ g_i dq‖² + Σ ρ_i (g_i − g₀_i)², g₀ = (1, 0, …), which is a
response without delay.
The motion that is still to come of the commands so far, and the time that it takes at constant speed:

    flight = Σ_i (g_{i+1} + … + g_N) dq(k−i),   lead = Σ_i (g_{i+1} + … + g_N) / Σ_i g_i periods
"""

from __future__ import annotations

from typing import final

import numpy as np

from servobench.plant.checks import FloatArray

PRIOR_WEIGHT = 1e-5  # [rad²] ρ_1; one step of some milliradians outweighs it
PRIOR_GROWTH = 1.5  # [1] of ρ_i from one period to the next, because later responses are less likely
MAX_EXCITATION = 1.0  # [rad²] that is remembered; older excitation is forgotten in proportion
PREDICTION_TOLERANCE = 5e-4  # [rad] smaller errors teach nothing (0.3 mm at the ball)
MAX_RESPONSE = 1.5  # [1] of a g_i, which lies between 0 and 1 for a joint that does not overshoot


@final
class JointResponse:
    """The response g by regularised least squares over all joints, and what follows from it."""

    def __init__(self, length: int, joints: int) -> None:
        """Expect an arm that follows at once.

        Args:
            length: N, periods.
            joints: n.
        """
        self._A = np.diag(PRIOR_WEIGHT * PRIOR_GROWTH ** np.arange(length))
        self._b: FloatArray = PRIOR_WEIGHT * np.eye(length)[0]
        self._commands: FloatArray = np.zeros((length, joints))  # dq(k−1) … dq(k−N), rad
        self.response: FloatArray = self._b / PRIOR_WEIGHT
        self._settle()

    def command(self, joint_step: FloatArray) -> None:
        """Take the joint step (n,), rad, that is commanded now."""
        self._commands = np.concatenate([joint_step[None], self._commands[:-1]])

    def learn(self, joint_step: FloatArray) -> None:
        """Learn from the joint step of the last period, (n,), rad, unless it was predicted well."""
        commands = self._commands
        error = joint_step - self.response.dot(commands)
        if float(error.dot(error)) < PREDICTION_TOLERANCE**2:
            return
        self._A = self._A + commands @ commands.T
        self._b = self._b + commands @ joint_step
        kept = min(1.0, MAX_EXCITATION / float(self._A.trace()))
        self._A, self._b = kept * self._A, kept * self._b
        self.response = np.linalg.solve(self._A, self._b).clip(0.0, MAX_RESPONSE)
        self._settle()

    def _settle(self) -> None:
        left = np.append(np.cumsum(self.response[:0:-1])[::-1], 0.0)
        total = float(self.response.sum())
        self._left: FloatArray = left
        self.lead = min(float(left.sum()) / total, float(len(left))) if total > 0.5 else 0.0

    def flight(self) -> FloatArray:
        """Return the joint motion (n,), rad, that is still to come of the commands so far."""
        return np.asarray(self._left @ self._commands)
