"""The predict stage, a Smith predictor: the feature that the arm reaches once all delays have passed.

    ŷ = z + Ĵ (q(k) − q(k−d) + flight)              where the feature will be when all commands are carried out
    q̂ = q(k) + flight                               and the joints
    compared with the reference at k + lead

flight and lead follow from the part of the commands that is still to come (`joint_response`). z is the feature at its
exposure, d periods ago, as measured or filtered by the motion of the joints between frames (`FeatureFilter`):

    z ← z + Ĵ Δq(k−d),   p ← p + c² ‖Ĵ‖² ‖Δq(k−d)‖²/n + r²        as far as the arm moved until the exposure
    L = p / (p + σ²),   z ← z + L (y − z),   p ← (1 − L) p               with a valid feature y

It is a Kalman filter with one variance p for all axes. In motion the Jacobian's error c makes it follow the camera,
whether or not Ĵ predicts a motion of the feature; at rest it averages: L tends to r/σ. A frame outside the innovation
gate (a camera that was moved) restarts it. Prediction and filter can each be left out.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import NamedTuple, final

import numpy as np

from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import Delays
from servobench.controllers.estimators.estimator import MOTION_TIME
from servobench.controllers.periods import whole_periods
from servobench.controllers.stages.joint_response import WINDOW, JointResponse
from servobench.controllers.stages.noise_level import NoiseLevel
from servobench.controllers.stages.pairing import Past
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch
from servobench.plant.contract.signals import BoolArray, Observation

SETTLED_LAGS = 15.0  # [1] time constants after which nothing of a given response is left
REST_DRIFT = 4.472136e-4  # [m/√s] process noise of z at rest; r in the formula is that of a period
RESTART_RATIO = 25.0  # [1] squared innovation over its variance; above it the filter restarts at y


class FeatureFilter(NamedTuple):
    """The state of the feature filter, and its steps.

    Attributes:
        feature: z, (..., m), m.
        variance: p, (...), m².
        noise: σ, standard deviation of the feature per axis.
    """

    feature: FloatArray
    variance: FloatArray
    noise: NoiseLevel

    def restart(self, feature: FloatArray) -> FeatureFilter:
        """Return the filter at a feature y, (..., m), m."""
        return self._replace(feature=feature, variance=self.noise.variance)

    def advance(self, jacobian: FloatArray, joint_step: FloatArray, model_error: float, period: float) -> FeatureFilter:
        """Return the filter one period later, before the frame of that period.

        Args:
            jacobian: Ĵ, (..., m, n), m/rad.
            joint_step: Δq, (..., n), rad.
            model_error: c, error of the Jacobian as a share of ‖Ĵ‖, which lasts for `MOTION_TIME`.
            period: s.
        """
        flat = jacobian.reshape(*jacobian.shape[:-2], -1)
        uncertainty = np.vecdot(flat, flat) * np.vecdot(joint_step, joint_step) / joint_step.shape[-1]
        error = model_error**2 * (MOTION_TIME / period)
        return self._replace(
            feature=self.feature + np.matvec(jacobian, joint_step),
            variance=self.variance + error * uncertainty + REST_DRIFT**2 * period,
        )

    def correct(self, feature: FloatArray, valid: BoolArray, find_noise: bool) -> FeatureFilter:
        """Return the filter after a frame in which at least one feature was measured; the others stay as predicted.

        Args:
            feature: y, (..., m), m.
            valid: which of them were measured, (..., m).
            find_noise: learn σ from y − z.
        """
        z, p, noise = self
        feature = np.where(valid, feature, z)
        error, innovation_variance = feature - z, p + noise.variance
        square = np.vecdot(error, error) / np.add.reduce(valid, axis=-1)
        share = p / innovation_variance
        if find_noise:
            noise = noise.learn(square, 1.0, p)
        corrected = FeatureFilter(z + share[..., None] * error, (1.0 - share) * p, noise)
        return branch(square > RESTART_RATIO * innovation_variance, FeatureFilter.restart, corrected, feature)


class PredictorState(NamedTuple):
    """The state of the predict stage.

    Attributes:
        response: of the joints.
        filter: of the feature.
        delay: (...) [periods] of the camera, at which the filter runs; −1 before the first frame.
    """

    response: JointResponse
    filter: FeatureFilter
    delay: FloatArray


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
        self._length = max(1, whole_periods(aids.response_length, period))

    def frozen(self) -> Predictor:
        """Return a copy that predicts from a state of this stage with identification switched off."""
        aids, other = self._aids, copy.copy(self)
        other._aids = replace(aids, response=aids.response if aids.response == "ignored" else "given", noise="given")
        return other

    def start(self, observation: Observation) -> PredictorState:
        """Return the state of an arm at rest."""
        q, y, delays = observation.joint_position, observation.feature, self._delays
        noise = NoiseLevel.guess(self._aids.feature_noise, y.shape[:-1])
        if self._aids.response == "given":
            count = 1 + math.ceil((delays.command_delay + SETTLED_LAGS * delays.lag) / self._period)
            response = JointResponse.given(delays.command_delay, delays.lag, self._period, count, q)
        else:
            response = JointResponse.immediate(self._length, q, self._period, self.window)
        return PredictorState(response, FeatureFilter(y, noise.variance, noise), np.full(y.shape[:-1], -1.0))

    def predict(
        self, state: PredictorState, jacobian: FloatArray, past: Past, observation: Observation
    ) -> tuple[PredictorState, Observation, FloatArray]:
        """Return the new state, ŷ and q̂ as the observation that a law gets, and lead, (...) [periods], a fraction."""
        q, response, lead = observation.joint_position, state.response, np.zeros_like(state.filter.variance)
        bound = q
        if self._aids.response != "ignored":
            if self._aids.response == "identified":
                response = response.learn(past.window)
            bound, lead = q + response.flight(), response.lead
        found = state.filter._replace(feature=observation.feature)
        if self._aids.filter:
            found = self._observe(state, past, jacobian, observation)
        feature = found.feature + np.matvec(jacobian, bound - past.exposed)
        return PredictorState(response, found, past.delay), observation.with_values(bound, feature), lead

    def note(self, state: PredictorState, joint_step: FloatArray) -> PredictorState:
        """Return the state after the joint step (..., n), rad, left the chain."""
        if self._aids.response == "ignored":
            return state
        return state._replace(response=state.response.command(joint_step))

    def _observe(
        self, state: PredictorState, past: Past, jacobian: FloatArray, observation: Observation
    ) -> FeatureFilter:
        """Return the filter at the exposure."""
        same, y = past.delay == state.delay, observation.feature
        found = branch(same, self._follow, state.filter, jacobian, past.before, y, observation.valid)
        return branch(np.logical_not(same), FeatureFilter.restart, found, y)

    def _follow(
        self,
        state: FeatureFilter,
        jacobian: FloatArray,
        joint_step: FloatArray,
        feature: FloatArray,
        valid: BoolArray,
    ) -> FeatureFilter:
        state = state.advance(jacobian, joint_step, self._aids.filter_error, self._period)
        measured = np.logical_or.reduce(valid, axis=-1)
        return branch(measured, FeatureFilter.correct, state, feature, valid, self._aids.noise == "identified")


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
