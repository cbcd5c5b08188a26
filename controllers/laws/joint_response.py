"""The response of the joints to commands, identified online, and the part of the commands that is still to come.

One finite response g, (..., N), holds for all joints:

    Δq(k) = Σ_{i=1..N} g_i dq(k−i)

where Δq(k) = q(k) − q(k−1) and dq(k−i) is the joint step that was commanded i periods ago. It covers the delay of a
command and the lag of the joints. g minimises Σ ‖Δq − Σ g_i dq‖² + Σ ρ_i (g_i − g₀_i)², g₀ = (1, 0, …), which is a
response without delay.
The motion that is still to come of the commands so far, and the time that it takes at constant speed:

    flight = Σ_i (g_{i+1} + … + g_N) dq(k−i),   lead = Σ_i (g_{i+1} + … + g_N) / Σ_i g_i periods
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servobench.plant.checks import FloatArray
from servobench.plant.lanes import branch, transposed

PRIOR_WEIGHT = 1e-5  # [rad²] ρ_1; one step of some milliradians outweighs it
PRIOR_GROWTH = 1.5  # [1] of ρ_i from one period to the next, because later responses are less likely
MAX_EXCITATION = 1.0  # [rad²] that is remembered; older excitation is forgotten in proportion
PREDICTION_TOLERANCE = 5e-4  # [rad] nothing is learned from smaller errors (0.3 mm at the ball)
MAX_RESPONSE = 1.5  # [1] of a g_i, which lies between 0 and 1 for a joint that does not overshoot


class JointResponse(NamedTuple):
    """The response g by regularised least squares over all joints, and what follows from it.

    Attributes:
        A: (..., N, N), rad², the normal matrix.
        b: (..., N), rad².
        commands: dq(k−1) … dq(k−N), (..., N, n), rad.
        response: g, (..., N).
        left: g_{i+1} + … + g_N for i = 1 … N, (..., N).
        lead: (...) [periods].
    """

    A: FloatArray
    b: FloatArray
    commands: FloatArray
    response: FloatArray
    left: FloatArray
    lead: FloatArray

    @classmethod
    def immediate(cls, length: int, joint_position: FloatArray) -> JointResponse:
        """Return the response g₀ of an arm that follows at once and rests.

        Args:
            length: N, periods.
            joint_position: (..., n), of which only the shape counts.
        """
        *lead, n = joint_position.shape
        prior = PRIOR_WEIGHT * np.eye(length)[0]
        A, b = np.diag(PRIOR_WEIGHT * PRIOR_GROWTH ** np.arange(length)), np.broadcast_to(prior, (*lead, length))
        commands, A = np.zeros((*lead, length, n)), np.broadcast_to(A, (*lead, length, length))
        return cls(A, b, commands, b / PRIOR_WEIGHT, np.zeros((*lead, length)), np.zeros(lead))

    def command(self, joint_step: FloatArray) -> JointResponse:
        """Return the state after the joint step (..., n), rad, was commanded."""
        return self._replace(commands=pushed(self.commands, joint_step))

    def learn(self, joint_step: FloatArray) -> JointResponse:
        """Return the state after the joint step of the last period, (..., n), rad, unless it was predicted well."""
        error = joint_step - np.vecmat(self.response, self.commands)
        return branch(np.vecdot(error, error) >= PREDICTION_TOLERANCE**2, _learned, self, joint_step)

    def flight(self) -> FloatArray:
        """Return the joint motion (..., n), rad, that is still to come of the commands so far."""
        return np.asarray(np.vecmat(self.left, self.commands))


def _learned(state: JointResponse, joint_step: FloatArray) -> JointResponse:
    commands = state.commands
    A, b = state.A + commands @ transposed(commands), state.b + np.matvec(commands, joint_step)
    kept = np.minimum(1.0, MAX_EXCITATION / A.trace(axis1=-2, axis2=-1))[..., None]
    A, b = kept[..., None] * A, kept * b
    response = np.linalg.solve(A, b[..., None])[..., 0]
    return with_response(state._replace(A=A, b=b), np.minimum(np.maximum(response, 0.0), MAX_RESPONSE))


def with_response(state: JointResponse, response: FloatArray) -> JointResponse:
    """Return the state with another response g, (..., N), and with what follows from it."""
    left = np.zeros_like(response)
    left[..., :-1] = response[..., :0:-1].cumsum(axis=-1)[..., ::-1]
    total, length = np.add.reduce(response, axis=-1), response.shape[-1]
    lead = np.add.reduce(left, axis=-1) / np.maximum(total, 0.5)
    return state._replace(response=response, left=left, lead=np.minimum(lead, length) * (total > 0.5))


def pushed(history: FloatArray, newest: FloatArray) -> FloatArray:
    """Return the history (..., length, k) with the newest value (..., k) first."""
    return np.concatenate([newest[..., None, :], history[..., :-1, :]], axis=-2)
