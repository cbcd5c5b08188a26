"""The predict stage, a Smith predictor: the feature that the arm reaches once all delays have passed.

    ŷ = z + Ĵ (q(k) − q(k−d) + flight)              where the feature will be when all commands are carried out
    q̂ = q(k) + flight                               and the joints
    compared with the reference at k + lead

flight and lead follow from the part of the commands that is still to come (`joint_response`). z is the feature at its
exposure, d periods ago, as measured, or without the noise e that the regression finds in a frame:

    z ← z + Ĵ Δq(k−d)                               as far as the arm moved until the exposure
    z = y − e                                       with a valid feature y from which was learned

Prediction and filter can each be left out.
"""

import copy
import math
from dataclasses import replace
from typing import NamedTuple, Self, final

import numpy as np

from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import Delays
from servobench.controllers.periods import whole_periods
from servobench.controllers.stages.estimation import Estimation, EstimationState
from servobench.controllers.stages.joint_response import WINDOW, JointResponse
from servobench.controllers.stages.pairing import Past
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch
from servobench.plant.contract.signals import Observation

SETTLED_LAGS = 15.0  # [1] time constants after which nothing of a given response is left


class PredictorState(NamedTuple):
    """The state of the predict stage."""

    response: JointResponse  # of the joints
    feature: FloatArray  # z, (..., m), m


@final
class Predictor:
    """Predicts ŷ, q̂ and lead as above, each part if its aid is on.

    Attributes:
        window: w, periods, of the response.
    """

    def __init__(self, aids: AidsConfig, period: float, delays: Delays) -> None:
        """Take the settings.

        Args:
            aids: the settings.
            period: s.
            delays: of a given response.
        """
        self._aids, self._period, self._delays = aids, period, delays
        self.window = max(1, whole_periods(WINDOW, period))
        self._share: float | None = None
        self._length = max(1, whole_periods(aids.response_length, period))

    def frozen(self, share: float) -> Self:
        """Return a copy that predicts from a state of this stage with identification switched off.

        Args:
            share: of a frame's innovation that is noise, which the filter takes from every frame.
        """
        aids, other = self._aids, copy.copy(self)
        other._aids = replace(aids, response=aids.response if aids.response == "ignored" else "given")
        other._share = share
        return other

    def start(self, observation: Observation) -> PredictorState:
        """Return the state of an arm at rest."""
        q, delays = observation.joint_position, self._delays
        if self._aids.response == "given":
            count = 1 + math.ceil((delays.command_delay + SETTLED_LAGS * delays.lag) / self._period)
            response = JointResponse.given(delays.command_delay, delays.lag, self._period, count, q)
        else:
            response = JointResponse.immediate(self._length, q, self._period, self.window)
        return PredictorState(response, observation.feature)

    def predict(
        self, state: PredictorState, stages: Estimation, estimation: EstimationState, observation: Observation
    ) -> tuple[PredictorState, Observation, FloatArray, FloatArray]:
        """Return the new state, ŷ and q̂ as the observation that a law gets, lead, (...) [periods], and Ĵ(q̂).

        Args:
            state: one period ago.
            stages: pair and estimate stages.
            estimation: their state of this period.
            observation: of this period.
        """
        q, pairing = observation.joint_position, stages.pairing
        if pairing is None:
            raise ValueError("aids: a stage that predicts needs the pair stage")
        past = pairing.past(estimation.learned.pair, q, self.window)
        response, bound, lead = state.response, q, np.zeros_like(past.delay)
        if self._aids.response != "ignored":
            response = response.learn(past.window) if self._aids.response == "identified" else response
            bound, lead = q + response.flight(), response.lead
        z = observation.feature
        if self._aids.filter:
            z = self._filtered(state, stages, estimation, past, observation)
        J, nominal = stages.ahead(estimation, bound)
        flight = 0.5 * np.matvec(estimation.learned.pair.base + nominal, bound - q)
        feature = z + stages.motion(estimation, past.exposed, bound - past.exposed, past.predicted[1] + flight)
        return PredictorState(response, z), observation.with_values(bound, feature), lead, J

    def _filtered(
        self,
        state: PredictorState,
        stages: Estimation,
        estimation: EstimationState,
        past: Past,
        observation: Observation,
    ) -> FloatArray:
        """Return z, (..., m), at the exposure."""
        moved = stages.motion(estimation, past.exposed - past.before, past.before, past.predicted[0])
        expected, y, noise = state.feature + moved, observation.feature, past.noise
        learned = np.equal(estimation.last.time, observation.time)
        if self._share is not None:
            noise, learned = self._share * (y - expected), np.full_like(learned, fill_value=True)
        return np.where(learned[..., None] & observation.valid, y - noise, expected)

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
    return branch(lead > 0.0, _interpolated, now, reference, lead) if reference.shape[-2] > 1 else now


def _interpolated(now: FloatArray, reference: FloatArray, lead: FloatArray) -> FloatArray:
    """Return y_0 + Σ_j s_j (y_{j+1} − y_j), (..., rows, m), with s_j the share of segment j that has passed."""
    segments = reference.shape[-2] - 1
    passed = lead[..., None, None] + (np.arange(now.shape[-2])[:, None] - np.arange(segments))
    passed[..., :-1] = np.minimum(passed[..., :-1], 1.0)  # the last segment goes on
    steps = reference[..., 1:, :] - reference[..., :-1, :]
    return np.asarray(reference[..., :1, :] + np.maximum(passed, 0.0) @ steps)
