"""The predict stage: the feature that the arm is bound for, past all delays.

    ŷ = z + Ĵ (q(k) − q(k−d) + flight)              where the feature will be when all commands are carried out
    q̂ = q(k) + flight                               and the joints
    compared with the reference at k + lead

z is the feature at its exposure, d periods ago (`feature_filter`); flight and lead follow from the part of the commands
that is still to come (`joint_response`).
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import NamedTuple, final

import numpy as np
import numpy.typing as npt

from servobench.controllers.estimate import MAX_DELAY, Estimate
from servobench.controllers.laws.feature_filter import FeatureFilter
from servobench.controllers.laws.joint_response import JointResponse, pushed
from servobench.controllers.noise_level import NoiseLevel
from servobench.plant.checks import FloatArray
from servobench.plant.lanes import branch
from servobench.plant.signals import BoolArray, Observation

IntArray = npt.NDArray[np.int_]
PERIODS = np.arange(MAX_DELAY + 2)
EXPOSURE_AND_BEFORE = np.array([[0], [1]])  # [periods] the exposure of a frame and the period before


class Prediction(NamedTuple):
    """What the predict stage hands to a law.

    Attributes:
        feature: ŷ, (..., m), m.
        joint_position: q̂, (..., n), rad.
        lead: (...) [periods] by which the reference is to be shifted, a fraction.
    """

    feature: FloatArray
    joint_position: FloatArray
    lead: FloatArray


class PredictorState(NamedTuple):
    """The state of the predict stage.

    Attributes:
        response: of the joints.
        filter: of the feature.
        delay: (...) [periods] of the camera, at which the filter runs; −1 before the first frame.
        past: q(k), q(k−1), …, (..., `MAX_DELAY` + 2, n), rad.
    """

    response: JointResponse
    filter: FeatureFilter
    delay: IntArray
    past: FloatArray


@final
@dataclass(frozen=True, eq=False)
class Predictor:
    """ŷ, q̂ and lead as above; each half can be switched off, and with both off they are what is measured.

    The keywords are those settings of `RbfnnBridgedConfig`.
    """

    _: KW_ONLY
    bridge: bool = True
    response_length: int = 12
    observe: bool = True
    feature_noise: float = 0.001
    find_noise: bool = True
    model_error: float = 0.2

    def start(self, observation: Observation) -> PredictorState:
        """Return the state of an arm at rest."""
        q, y = observation.joint_position, observation.feature
        noise = NoiseLevel.guess(self.feature_noise, y.shape[:-1])
        return PredictorState(
            response=JointResponse.immediate(self.response_length, q),
            filter=FeatureFilter(y, noise.variance, noise),
            delay=np.full(y.shape[:-1], -1),
            past=np.repeat(q[..., None, :], MAX_DELAY + 2, axis=-2),
        )

    def predict(
        self, state: PredictorState, estimate: Estimate, observation: Observation
    ) -> tuple[PredictorState, Prediction]:
        """Return the new state and the prediction of this period.

        Raises:
            ValueError: a delay beyond what is kept of the past.
        """
        delay, J, q = state.delay * 0 + estimate.delay, estimate.jacobian, observation.joint_position
        if (delay < 0).any() or (delay > MAX_DELAY).any():
            raise ValueError(f"delay must be from 0 to {MAX_DELAY} periods, got {estimate.delay}")
        past, response = pushed(state.past, q), state.response
        if self.bridge:
            response = response.learn(q - past[..., 1, :])
            bound = q + response.flight()
        else:
            delay, bound = delay * 0, q
        chosen = (delay[..., None, None] + EXPOSURE_AND_BEFORE == PERIODS).astype(np.float64) @ past
        found, exposed = state.filter._replace(feature=observation.feature), chosen[..., 0, :]
        if self.observe:
            found = self._observe(state, delay, J, exposed - chosen[..., 1, :], observation)
        feature = found.feature + np.matvec(J, bound - exposed)
        return PredictorState(response, found, delay, past), Prediction(feature, bound, response.lead)

    def note(self, state: PredictorState, joint_step: FloatArray) -> PredictorState:
        """Return the state after the joint step (..., n), rad, left the chain."""
        return state._replace(response=state.response.command(joint_step))

    def _observe(
        self,
        state: PredictorState,
        delay: IntArray,
        jacobian: FloatArray,
        joint_step: FloatArray,
        observation: Observation,
    ) -> FeatureFilter:
        """Return the filter at the exposure, `delay` periods ago, up to which the joints moved by `joint_step`."""
        same, y = delay == state.delay, observation.feature
        found = branch(same, self._follow, state.filter, jacobian, joint_step, y, observation.feature_valid)
        return branch(np.logical_not(same), FeatureFilter.restart, found, y)

    def _follow(
        self,
        state: FeatureFilter,
        jacobian: FloatArray,
        joint_step: FloatArray,
        feature: FloatArray,
        valid: bool | BoolArray,
    ) -> FeatureFilter:
        state = state.advance(jacobian, joint_step, self.model_error)
        return branch(valid, FeatureFilter.correct, state, feature, self.find_noise)


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
