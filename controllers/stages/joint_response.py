"""The response of the joints to commands, identified online, and the part of the commands that is still to come.

One finite response g, (..., N), holds for all joints:

    Δq(k) = Σ_{i=1..N} g_i dq(k−i)

where Δq(k) = q(k) − q(k−1) and dq(k−i) is the joint step that was commanded i periods ago. It covers the delay of a
command and the lag of the joints. g minimises Σ ‖Δq − Σ g_i dq‖² + Σ ρ_i (g_i − g₀_i)², g₀ = (1, 0, …), which is a
response without delay.
The motion that is still to come of the commands so far, and the time that it takes at constant speed:

    flight = Σ_i (g_{i+1} + … + g_N) dq(k−i),   lead = Σ_i (g_{i+1} + … + g_N) / Σ_i g_i periods

At fast rates an entry of g spans several periods, about `SPAN` in all: dq(k−i) is then the sum over a span, and what is
left of a command is interpolated within it. A response can also be given: a delay and a first-order lag.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from servobench.plant.checks import FloatArray
from servobench.plant.lanes import branch, transposed

SPAN = 0.01  # [s] of an entry of g, and no shorter than a period; steps of encoders spoil shorter ones
PRIOR_WEIGHT = 2e-4  # [rad²/s] ρ_1, of spans of a second; one step of some milliradians outweighs it
PRIOR_GROWTH = 8.1  # [1/s] growth rate of ρ_i, because later responses are less likely
MAX_EXCITATION = 20.0  # [rad²/s] that is remembered; older excitation is forgotten in proportion
PREDICTION_TOLERANCE = 0.01  # [rad/s] nothing is learned from smaller errors (0.3 mm at the ball in 0.05 s)
MAX_RESPONSE = 1.5  # [1] of a g_i, which lies between 0 and 1 for a joint that does not overshoot


class JointResponse(NamedTuple):
    """The response g by regularised least squares over all joints, and what follows from it.

    Attributes:
        A: (..., N, N), rad², the normal matrix.
        b: (..., N), rad².
        commands: the commanded joint steps of the last periods, (..., N r, n), rad, the newest first; r periods a span.
        response: g, (..., N).
        left: the part of each of these commands that is still to come, (..., N r).
        lead: (...) [periods].
        span: s, of an entry of g.
    """

    A: FloatArray
    b: FloatArray
    commands: FloatArray
    response: FloatArray
    left: FloatArray
    lead: FloatArray
    span: float

    @classmethod
    def immediate(cls, length: int, joint_position: FloatArray, period: float, span: int = 1) -> JointResponse:
        """Return the response g₀ of an arm that follows at once and rests.

        Args:
            length: N, spans.
            joint_position: (..., n), of which only the shape counts.
            period: s.
            span: r, periods.
        """
        *lead, n = joint_position.shape
        time = span * period
        weights = PRIOR_WEIGHT * time * np.exp(PRIOR_GROWTH * time * np.arange(length))
        first = np.broadcast_to(np.eye(length)[0], (*lead, length))
        A, commands = np.broadcast_to(np.diag(weights), (*lead, length, length)), np.zeros((*lead, length * span, n))
        left = np.zeros((*lead, length * span))
        state = cls(A, weights[0] * first, commands, first, left, np.zeros(lead), time)
        return with_response(state, first)

    @classmethod
    def given(cls, delay: float, lag: float, period: float, length: int, joint_position: FloatArray) -> JointResponse:
        """Return the response of joints with a delay and a first-order lag, which never changes.

        Args:
            delay: s, of a command.
            lag: s, time constant of a joint's velocity; 0 for none.
            period: s.
            length: periods after which nothing is left.
            joint_position: (..., n), of which only the shape counts.
        """
        lead = joint_position.shape[:-1]
        left = np.broadcast_to(remaining_share(delay, lag, period, length), (*lead, length))
        state = cls.immediate(1, joint_position, period, length)
        return state._replace(left=left, lead=np.full(lead, np.add.reduce(left, axis=-1))[()])

    def command(self, joint_step: FloatArray) -> JointResponse:
        """Return the state after the joint step (..., n), rad, was commanded."""
        return self._replace(commands=pushed(self.commands, joint_step))

    def learn(self, joint_step: FloatArray) -> JointResponse:
        """Return the state after the joint step of the last span, (..., n), rad, unless it was predicted well."""
        spans = self._spans()
        error = joint_step - np.vecmat(self.response, spans)
        return branch(
            np.vecdot(error, error) >= (PREDICTION_TOLERANCE * self.span) ** 2, _learned, self, joint_step, spans
        )

    def flight(self) -> FloatArray:
        """Return the joint motion (..., n), rad, that is still to come of the commands so far."""
        return np.asarray(np.vecmat(self.left, self.commands))

    def _spans(self) -> FloatArray:
        """Return the commanded steps of each span, (..., N, n), rad."""
        *lead, count, n = self.commands.shape
        length = self.response.shape[-1]
        if count == length:
            return self.commands
        spans: FloatArray = np.add.reduce(self.commands.reshape(*lead, length, count // length, n), axis=-2)
        return spans


def _learned(state: JointResponse, joint_step: FloatArray, spans: FloatArray) -> JointResponse:
    weight = spans.shape[-2] / state.commands.shape[-2]  # motions of one span overlap at fast rates
    A = state.A + weight * (spans @ transposed(spans))
    b = state.b + weight * np.matvec(spans, joint_step)
    kept = np.minimum(1.0, MAX_EXCITATION * state.span / A.trace(axis1=-2, axis2=-1))[..., None]
    A, b = kept[..., None] * A, kept * b
    response = np.linalg.solve(A, b[..., None])[..., 0]
    return with_response(state._replace(A=A, b=b), np.minimum(np.maximum(response, 0.0), MAX_RESPONSE))


def with_response(state: JointResponse, response: FloatArray) -> JointResponse:
    """Return the state with another response g, (..., N), and with what follows from it."""
    length, count = response.shape[-1], state.commands.shape[-2]
    ahead = np.zeros((*response.shape[:-1], length + 1))  # g_{i+1} + … + g_N for i = 0 … N
    ahead[..., :-1] = response[..., ::-1].cumsum(axis=-1)[..., ::-1]
    left = ahead[..., 1:] if count == length else np.vecmat(ahead, _within_spans(length, count // length))
    total = ahead[..., 0]
    lead = np.add.reduce(left, axis=-1) / np.maximum(total, 0.5)
    return state._replace(response=response, left=left, lead=np.minimum(lead, count) * (total > 0.5))


@cache
def _within_spans(length: int, span: int) -> FloatArray:
    """Return the weights (N + 1, N r) by which what is left is interpolated between spans.

    An entry of g is fitted to all commands of its span, so that the sum up to it is the mean of what is left of them.
    It is interpolated between the middles of the spans, and moved within each span so that this mean holds.
    """
    middles = np.concatenate([[0.0], span * np.arange(length) + (span + 1) / 2])
    ages = 1.0 + np.arange(length * span)
    between = np.stack([np.interp(ages, middles, row) for row in np.eye(length + 1)])
    mean = between.reshape(length + 1, length, span).mean(axis=-1)
    weights: FloatArray = between + np.repeat(np.eye(length + 1)[:, 1:] - mean, span, axis=-1)
    return weights


def remaining_share(delay: float, lag: float, period: float, length: int) -> FloatArray:
    """Return the share of the joint step of one period that is still to come 1 … `length` periods later, (length,).

    A velocity held for one period acts after the delay through v̇ = (u − v)/lag, so that after a time T of action the
    joint has gone (f(T) − f(T − dt))/dt of its step, f(T) = T − lag (1 − exp(−T/lag)) for T > 0.
    """
    acted: FloatArray = np.asarray(period * (1.0 + np.arange(length)) - delay)

    def travelled(time: FloatArray) -> FloatArray:
        acting = np.maximum(time, 0.0)
        return np.asarray(acting if lag == 0.0 else acting + lag * np.expm1(-acting / lag))

    return np.asarray(1.0 - (travelled(acted) - travelled(acted - period)) / period)


def pushed(history: FloatArray, newest: FloatArray) -> FloatArray:
    """Return the history (..., length, k) with the newest value (..., k) first."""
    return np.concatenate([newest[..., None, :], history[..., :-1, :]], axis=-2)
