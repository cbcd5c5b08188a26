"""The predict stage, a Smith predictor: the feature that the arm reaches once all delays have passed.

    ŷ = z + Ĵ (q(k) − q(k−d) + flight)              where the feature will be when all commands are carried out
    q̂ = q(k) + flight                               and the joints
    compared with the reference at k + lead

flight and lead follow from the part of the commands that is still to come, as below. z is the feature at its
exposure, d periods ago, as measured, or without the noise e that the regression finds in a frame:

    z ← z + Ĵ Δq(k−d)                               as far as the arm moved until the exposure
    z = y − e                                       with a valid feature y from which was learned

Prediction and filter can each be left out.

The response of the joints to commands is identified online. One finite response g, (..., N), holds for all joints:

    Δq(k) = Σ_{i=1..N} g_i dq(k−i)

where Δq(k) = q(k) − q(k−1) and dq(k−i) is the joint step that was commanded i periods ago. It covers the delay of a
command and the lag of the joints. g minimises Σ ‖Δq − Σ g_i dq‖² + Σ ρ_i (g_i − g₀_i)², g₀ = (1, 0, …), which is a
response without delay.
The motion that is still to come of the commands so far, and the time that it takes at constant speed:

    flight = Σ_i (g_{i+1} + … + g_N) dq(k−i),   lead = Σ_i (g_{i+1} + … + g_N) / Σ_i g_i periods

At fast rates Δq and dq are taken over a window of several periods, about `WINDOW` in all, and each period anew: the
motion of a joint in one period is lost in the steps of its encoder. A response can also be given: a delay and a lag of
first order.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import NamedTuple, Self, final

import numpy as np

from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import Delays
from servobench.controllers.periods import whole_periods
from servobench.controllers.stages.estimation import Estimation, EstimationState
from servobench.controllers.stages.pairing import Past
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, solve
from servobench.plant.contract.signals import Observation

# [s] Motions are compared over this time, and over a period at least: steps of encoders spoil shorter ones.
WINDOW = 0.05
# [rad²/s] ρ_1 for windows that last a second in all; one step of some milliradians outweighs it.
PRIOR_WEIGHT = 2e-4
PRIOR_GROWTH = 8.1  # [1/s] growth rate of ρ_i, because later responses are less likely
MAX_EXCITATION = 20.0  # [rad²/s] that is remembered; older excitation is forgotten in proportion
# [rad/s] Nothing is learned from smaller errors: they are 0.3 mm at the ball in 0.05 s.
PREDICTION_TOLERANCE = 0.01
SETTLED_LAGS = 15.0  # [1] time constants after which nothing of a given response is left
# [1] Largest g_i, which lies between 0 and 1 for a joint that does not overshoot.
MAX_RESPONSE = 1.5
MIN_TOTAL_RESPONSE = 0.5  # [1] least Σ g_i by which a lead is known; below, it counts as 0


class JointResponse(NamedTuple):
    """The response g by regularised least squares over all joints, and the quantities derived from it."""

    A: FloatArray  # (..., N, N), rad², the normal matrix
    b: FloatArray  # (..., N), rad²
    commands: FloatArray  # the commanded joint steps of the last periods, (..., N + w − 1, n), rad, the newest first
    response: FloatArray  # g, (..., N)
    left: FloatArray  # the part of each of the last N commands that is still to come, (..., N)
    lead: FloatArray  # (...) [periods]
    window: int  # w, periods
    period: float  # s

    @classmethod
    def immediate(
        cls, length: int, joint_position: FloatArray, period: float, window: int = 1
    ) -> JointResponse:
        """Return the response g₀ of an arm that follows at once and rests.

        Args:
            length: N, periods.
            joint_position: (..., n), of which only the shape counts.
            period: s.
            window: w, periods.
        """
        *lead, n = joint_position.shape
        growth = np.exp(PRIOR_GROWTH * period * np.arange(length))
        weights = PRIOR_WEIGHT * window**2 * period * growth
        first = np.broadcast_to(np.eye(length)[0], (*lead, length))
        A = np.broadcast_to(np.diag(weights), (*lead, length, length))
        b = weights[0] * first
        commands = np.zeros((*lead, length + window - 1, n))
        none = np.zeros(lead)
        state = cls(A, b, commands, first, first, none, window, period)
        return with_response(state, first)

    @classmethod
    def given(
        cls, delay: float, lag: float, period: float, length: int, joint_position: FloatArray
    ) -> JointResponse:
        """Return the response of joints with a delay and a first-order lag, which never changes.

        Args:
            delay: s, of a command.
            lag: s, time constant of a joint's velocity; 0 for none.
            period: s.
            length: periods after which nothing is left.
            joint_position: (..., n), of which only the shape counts.
        """
        *lead, n = joint_position.shape
        share = remaining_share(delay, lag, period, length)
        left = np.broadcast_to(share, (*lead, length))
        arrival = np.add.reduce(left, axis=-1)
        nothing = np.zeros((*lead, 0))
        commands = np.zeros((*lead, length, n))
        arrivals = np.full(tuple(lead), arrival)[()]
        return cls(
            A=nothing[..., None],
            b=nothing,
            commands=commands,
            response=nothing,
            left=left,
            lead=arrivals,
            window=1,
            period=period,
        )

    def command(self, joint_step: FloatArray) -> JointResponse:
        """Return the state after the joint step (..., n), rad, was commanded."""
        return self._replace(commands=pushed(self.commands, joint_step))

    def learn(self, joint_step: FloatArray) -> JointResponse:
        """Return the state after the joint step of the last window, (..., n), rad, unless it was predicted well."""
        steps = self._steps()
        error = joint_step - np.vecmat(self.response, steps)
        least = PREDICTION_TOLERANCE * self.window * self.period
        return branch(np.vecdot(error, error) >= least**2, _learned, self, joint_step, steps)

    def flight(self) -> FloatArray:
        """Return the joint motion (..., n), rad, that is still to come of the commands so far."""
        last = self.commands[..., : self.left.shape[-1], :]
        return np.vecmat(self.left, last)

    def _steps(self) -> FloatArray:
        """Return the commanded steps of the windows that end 1 … N periods ago, (..., N, n), rad."""
        if self.window == 1:
            return self.commands
        sums = np.cumsum(self.commands, axis=-2)
        first = sums[..., self.window - 1 : self.window, :]
        later = sums[..., self.window :, :] - sums[..., : -self.window, :]
        return np.concatenate([first, later], axis=-2)


def _learned(state: JointResponse, joint_step: FloatArray, steps: FloatArray) -> JointResponse:
    """Return the response with the joint step of one more window; as in `JointResponse.learn`."""
    # Windows overlap: each command is in `window` of them.
    weight = 1.0 / state.window
    A = state.A + weight * (steps @ steps.mT)
    b = state.b + weight * np.matvec(steps, joint_step)
    most = MAX_EXCITATION * state.window**2 * state.period
    excitation = A.trace(axis1=-2, axis2=-1)
    kept = np.minimum(1.0, most / excitation)[..., None]
    A = kept[..., None] * A
    b = kept * b
    response = solve(A, b)
    # In longer windows single entries are not identified, and limits would shift their sum.
    if state.window == 1:
        response = np.minimum(np.maximum(response, 0.0), MAX_RESPONSE)
    return with_response(state._replace(A=A, b=b), response)


def with_response(state: JointResponse, response: FloatArray) -> JointResponse:
    """Return the state with another response g, (..., N), and with the quantities derived from it."""
    backwards = response[..., ::-1].cumsum(axis=-1)
    ahead = backwards[..., ::-1]  # g_i + … + g_N
    left = np.zeros_like(ahead)
    left[..., :-1] = ahead[..., 1:]
    total = ahead[..., 0]
    known = total > MIN_TOTAL_RESPONSE
    lead = np.add.reduce(left, axis=-1) / np.maximum(total, MIN_TOTAL_RESPONSE)
    lead = np.minimum(lead, response.shape[-1]) * known
    return state._replace(response=response, left=left, lead=lead)


def remaining_share(delay: float, lag: float, period: float, length: int) -> FloatArray:
    """Return the share of the joint step of one period that is still to come 1 … `length` periods later, (length,).

    A velocity held for one period acts after the delay through v̇ = (u − v)/lag, so that after a time T of action the
    joint has gone (f(T) − f(T − dt))/dt of its step, f(T) = T − lag (1 − exp(−T/lag)) for T > 0.
    """
    periods = 1.0 + np.arange(length)
    acted: FloatArray = np.asarray(period * periods - delay)

    def travelled(time: FloatArray) -> FloatArray:
        acting = np.maximum(time, 0.0)
        if lag == 0.0:
            return np.asarray(acting)
        return np.asarray(acting + lag * np.expm1(-acting / lag))

    arrived = (travelled(acted) - travelled(acted - period)) / period
    return np.asarray(1.0 - arrived)


def pushed(history: FloatArray, newest: FloatArray) -> FloatArray:
    """Return the history (..., length, k) with the newest value (..., k) first."""
    return np.concatenate([newest[..., None, :], history[..., :-1, :]], axis=-2)


class PredictorState(NamedTuple):
    """The state of the predict stage."""

    response: JointResponse  # identified or given response of the joints
    feature: FloatArray  # z, (..., m), m


@final
class Predictor:
    """Predicts ŷ, q̂ and lead as above, each part if its aid is on.

    Attributes:
        window: w, periods, of the response.
    """

    def __init__(self, aids: AidsConfig, period: float, delays: Delays) -> None:
        """Take the settings, the period [s], and the delays of a given response."""
        self._aids = aids
        self._period = period
        self._delays = delays
        self.window = max(1, whole_periods(WINDOW, period))
        self._length = max(1, whole_periods(aids.response_length, period))
        self._share: float | None = None

    def frozen(self, share: float) -> Self:
        """Return a copy that predicts from a state of this stage with identification switched off.

        Args:
            share: of a frame's innovation that is noise, which the filter takes from every frame.
        """
        response = self._aids.response
        frozen = replace(self._aids, response=response if response == "ignored" else "given")
        other = copy.copy(self)
        other._aids = frozen
        other._share = share
        return other

    def start(self, observation: Observation) -> PredictorState:
        """Return the state of an arm at rest."""
        q = observation.joint_position
        if self._aids.response == "given":
            delay = self._delays.command_delay
            lag = self._delays.lag
            count = 1 + math.ceil((delay + SETTLED_LAGS * lag) / self._period)
            response = JointResponse.given(delay, lag, self._period, count, q)
        else:
            response = JointResponse.immediate(self._length, q, self._period, self.window)
        return PredictorState(response, observation.feature)

    def predict(
        self,
        state: PredictorState,
        stages: Estimation,
        estimation: EstimationState,
        observation: Observation,
    ) -> tuple[PredictorState, Observation, FloatArray, FloatArray]:
        """Return the new state, ŷ and q̂ as the observation that a law gets, lead, (...) [periods], and Ĵ(q̂).

        Args:
            state: one period ago.
            stages: pair and estimate stages.
            estimation: their state of this period.
            observation: of this period.
        """
        q = observation.joint_position
        past = stages.pairing.past(estimation.learned.pair, observation, self.window)

        # The joint positions that the arm is bound to reach, and when.
        response = state.response
        bound = q
        lead = np.zeros(q.shape[:-1])[()]
        if self._aids.response == "identified":
            response = response.learn(past.window)
        if self._aids.response != "ignored":
            bound = q + response.flight()
            lead = response.lead

        z = observation.feature
        if past.late is not None:
            # What the frame would show if it were not late.
            z = z + stages.motion(estimation, *past.late)
        if self._aids.filter:
            z = self._filtered(state, stages, estimation, observation, z, past)

        # From the exposure the arm moved to q, and will move on to `bound`, along which J_n is the mean of both ends.
        J, nominal = stages.ahead(estimation, bound)
        both = estimation.learned.pair.base + nominal
        flight = 0.5 * np.matvec(both, bound - q)
        predicted = past.predicted[1] + flight
        feature = z + stages.motion(estimation, past.exposed, bound - past.exposed, predicted)
        return PredictorState(response, z), observation.with_values(bound, feature), lead, J

    def _filtered(
        self,
        state: PredictorState,
        stages: Estimation,
        estimation: EstimationState,
        observation: Observation,
        frame: FloatArray,
        past: Past,
    ) -> FloatArray:
        """Return z, (..., m): a frame without its noise, and what is expected where no frame was learned from."""
        begin = past.exposed - past.before
        expected = state.feature + stages.motion(estimation, begin, past.before, past.predicted[0])
        noise = past.noise
        learned = np.equal(estimation.last.time, observation.time)
        if self._share is not None:
            noise = self._share * (frame - expected)
            learned = np.full_like(learned, fill_value=True)
        believed = learned[..., None] & observation.valid
        return np.where(believed, frame - noise, expected)

    def note(self, state: PredictorState, joint_step: FloatArray) -> PredictorState:
        """Return the state after the joint step (..., n), rad, left the chain."""
        if self._aids.response == "ignored":
            return state
        return state._replace(response=state.response.command(joint_step))


def shifted(reference: FloatArray, lead: FloatArray, rows: int) -> FloatArray:
    """Return the reference `lead` periods later, (..., rows, m): interpolated, and extrapolated beyond its end.

    Args:
        reference: (..., 1 + preview, m), m.
        lead: (...), periods, at least 0.
        rows: how many instants are wanted, at most 1 + preview.
    """
    now = reference[..., :rows, :]
    if reference.shape[-2] == 1:
        return now
    return branch(lead > 0.0, _interpolated, now, reference, lead)


def _interpolated(now: FloatArray, reference: FloatArray, lead: FloatArray) -> FloatArray:
    """Return y_0 + Σ_j s_j (y_{j+1} − y_j), (..., rows, m), with s_j the share of segment j that has passed."""
    rows = np.arange(now.shape[-2])
    segments = np.arange(reference.shape[-2] - 1)
    beyond = rows[:, None] - segments
    s = lead[..., None, None] + beyond
    # The last segment goes on beyond the end of the reference.
    s[..., :-1] = np.minimum(s[..., :-1], 1.0)
    s = np.maximum(s, 0.0)
    steps = reference[..., 1:, :] - reference[..., :-1, :]
    first = reference[..., :1, :]
    return first + s @ steps
