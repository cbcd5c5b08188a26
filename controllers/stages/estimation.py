"""The pair and estimate stages together: from observations to the Jacobian.

    own          Ĵ(q) = E(q)                      E learns from (Δq, Δy)
    nominal      Ĵ(q) = J_n(q) + E(q) − E₀(q)     E learns from (Δq, Δy − J_n Δq + E₀ Δq)
    regression   Ĵ(q) = B(q) + E(q) − E₀(q)       E learns from (Δq, Δy − B Δq + E₀ Δq)

with the estimator E, which is E₀ at first (0 where it estimates one matrix), the nominal Jacobian J_n, or Ĵ₀ where
there is none, the regression B on J_n (`stages.regression`), and from the pair stage the joint motion Δq that belongs
to the feature's motion Δy.
"""

import math
from typing import Any, NamedTuple, final

import numpy as np

from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import Delays, Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import MOTION_TIME, Estimator, Motion
from servobench.controllers.periods import whole_periods
from servobench.controllers.stages.pairing import Pairing
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, norm
from servobench.plant.contract.signals import BoolArray, Observation


class LastFrame(NamedTuple):
    """The frame at which the last motion ended."""

    time: FloatArray  # (...) [s]; NaN before there is a valid feature
    joint_position: FloatArray  # (..., n) [rad]
    feature: FloatArray  # (..., m)
    valid: BoolArray  # (..., m), which features were last
    jacobian: FloatArray  # Ĵ, (..., m, n), which predicts the next motion; NaN before


class Learned(NamedTuple):
    """The states that change with a motion."""

    estimator: Any  # state of the estimator
    anchor: Any  # its state at the pair stage's anchor, which returns if later frames were false
    pair: Any  # state of the pair stage; None without one
    unexplained: (
        FloatArray  # ‖Δy − ĴΔq‖, (...), with Ĵ from before the update; NaN before there is a motion
    )


class EstimationState(NamedTuple):
    """The state of both stages."""

    learned: Learned  # from motions
    last: LastFrame  # the frame at which the last motion ended
    jacobian: FloatArray  # Ĵ, (..., m, n), of this period; NaN before
    own: FloatArray  # the part of it that is the estimator's


@final
class Estimation:
    """Estimates Ĵ(q) as above from motions of at least `MOTION_TIME`: it learns as fast at every control period.

    Attributes:
        estimator: E.
        pairing: the pair stage; None where no aid needs past joint positions.
    """

    def __init__(
        self, estimator: Estimator[Any], knowledge: RobotKnowledge, aids: AidsConfig, delays: Delays
    ) -> None:
        """Compose the stages."""
        self.estimator, self._model = estimator, aids.model
        period, self._filters = knowledge.spec.period, aids.filter
        self._shortest = (max(1, whole_periods(MOTION_TIME, period)) - 0.5) * period
        self.pairing = Pairing(aids, knowledge, delays.latency) if aids.needs_past else None
        self._nominal = knowledge.nominal_jacobian
        self._uses_own = estimator.brings_model and aids.model == "own"
        shape = knowledge.spec.m, knowledge.spec.n
        self._first = (
            estimator.start(np.zeros(shape))
            if estimator.brings_model and aids.model != "own"
            else None
        )
        self._longest = math.inf if self.pairing is None else (self.pairing.gap + 0.5) * period

    def start(self, observation: Observation, jacobian: FloatArray) -> EstimationState:
        """Return the state before any motion, starting from Ĵ₀, (..., m, n), at rest."""
        lead, q = observation.feature.shape[:-1], observation.joint_position
        base = self._given(q, jacobian)
        estimator = self.estimator.start(jacobian if self._model == "own" else jacobian - base)
        if self._uses_own:
            base = self.estimator.jacobian(estimator, q)
        pair = None if self.pairing is None else self.pairing.start(observation, base)
        unknown, never = np.full(jacobian.shape, np.nan), np.full(lead, np.nan)[()]
        last = LastFrame(never, q, observation.feature, observation.valid, unknown)
        return EstimationState(Learned(estimator, estimator, pair, never), last, unknown, unknown)

    def update(
        self, state: EstimationState, observation: Observation, desired: FloatArray
    ) -> EstimationState:
        """Return the state at an observation; without a valid feature nothing is learned.

        Args:
            state: one period ago.
            observation: of this period.
            desired: y_ref, (..., m), of this period.
        """
        learned, last, q = state.learned, state.last, observation.joint_position
        if self.pairing is not None:
            before = learned.pair.base
            base = (
                self.estimator.jacobian(learned.estimator, q)
                if self._uses_own
                else self._given(q, before)
            )
            learned = learned._replace(pair=self.pairing.advance(learned.pair, q, base))
        duration, both = observation.time - last.time, observation.valid & last.valid
        # not "duration >= shortest": that of the first frame is NaN
        due = np.logical_or.reduce(observation.valid, axis=-1) & ~(duration < self._shortest)
        known = (
            due
            & np.logical_or.reduce(both, axis=-1)
            & (duration > 0.0)
            & (duration < self._longest)
        )
        learned = branch(known, self._learn, learned, last, observation, desired, both)
        if self.pairing is not None:
            pair = branch(due & np.logical_not(known), self.pairing.interrupt, learned.pair)
            anchor = branch(pair.anchor.miss == 0.0, _other, learned.anchor, learned.estimator)
            learned = learned._replace(anchor=anchor, pair=pair)
        own = self.estimator.deviation(learned.estimator, self._first, q)
        jacobian = (
            own if self.pairing is None else self._with_model(own, learned, q, learned.pair.base)
        )
        lead = observation.feature.shape[:-1]
        time: Any = np.full(lead, observation.time) if lead else np.float64(observation.time)
        this = LastFrame(time, q, observation.feature, observation.valid, jacobian)
        last = branch(due, lambda _, newer: newer, last, this)
        return EstimationState(learned, last, jacobian, own)

    def ahead(
        self, state: EstimationState, joint_position: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return Ĵ by the state at any joint position, (..., n) rad, and the model's J_n there, (..., m, n) each."""
        learned, q = state.learned, joint_position
        if self._uses_own:
            whole: FloatArray = self.estimator.jacobian(learned.estimator, q)
            return whole, whole
        nominal = self._given(q, learned.pair.base)
        own = self.estimator.deviation(learned.estimator, self._first, q)
        return self._with_model(own, learned, q, nominal), nominal

    def motion(
        self,
        state: EstimationState,
        begin: FloatArray,
        joint_step: FloatArray,
        predicted: FloatArray,
    ) -> FloatArray:
        """Return the motion of the feature, (..., m), that the state expects of one of the joints.

        Args:
            state: the state, of which the estimator's own part is that of this period's joint position.
            begin: (..., n), rad, where it begins.
            joint_step: (..., n), rad.
            predicted: J_n Δq along it, (..., m).
        """
        if self._uses_own:
            return predicted
        own, pair = np.matvec(state.own, joint_step), state.learned.pair
        if self._model == "nominal":
            return np.asarray(predicted + own)
        if self._model == "own" or self.pairing is None:
            return np.asarray(own)
        h = self.pairing.regression.regressors(begin + 0.5 * joint_step, joint_step, predicted)
        return np.asarray(self.pairing.regression.explained(pair.regression, h) + own)

    def into_model_frame(self, state: EstimationState) -> FloatArray:
        """Return Rᵀ, (..., m, m), that turns measured features into those of the nominal cameras."""
        rotation: FloatArray = state.learned.pair.regression.rotation
        return rotation.mT

    def _given(self, joint_position: FloatArray, otherwise: FloatArray) -> FloatArray:
        if self._nominal is None:
            return otherwise
        return np.asarray(self._nominal(joint_position), dtype=np.float64)

    def _with_model(
        self, own: FloatArray, learned: Learned, joint_position: FloatArray, nominal: FloatArray
    ) -> FloatArray:
        """Return Ĵ at joint positions, (..., m, n), for the estimator's own part and J_n there."""
        if self._model == "own" or self.pairing is None:
            return own
        if self._model == "regression":
            nominal = self.pairing.regression.jacobian(
                learned.pair.regression, joint_position, nominal
            )
        return nominal + own

    def _learn(
        self,
        learned: Learned,
        last: LastFrame,
        observation: Observation,
        desired: FloatArray,
        valid: BoolArray,
    ) -> Learned:
        """Learn from a motion; features that were not `valid` at both ends are taken to move as predicted."""
        error, pairing, noise = desired - observation.feature, self.pairing, None
        dy, duration = observation.feature - last.feature, observation.time - last.time
        q, pair, explained = last.joint_position, learned.pair, np.zeros_like(dy)
        step = observation.joint_position - q
        if pairing is not None:
            pair, paired = pairing.learn(pair, dy, duration, valid)
            dy, duration, valid, q, step, x, h, before, back = paired
            learned = learned._replace(
                estimator=branch(back, _other, learned.estimator, learned.anchor)
            )
            noise = pairing.noise(pair)
            if self._filters:
                dy = dy - (pair.regression.mean[..., -1] - before.mean[..., -1])
            if self._model != "own":
                explained = (
                    x if self._model == "nominal" else pairing.regression.explained(before, h)
                )
            if self._first is not None:
                explained = explained - np.matvec(self.estimator.jacobian(self._first, q), step)
        predicted = np.matvec(last.jacobian, step)
        dy = np.where(valid, dy, predicted)
        motion = Motion(q, step, dy - explained, error, duration, noise)
        estimator = self.estimator.update(learned.estimator, motion)
        return learned._replace(estimator=estimator, pair=pair, unexplained=norm(dy - predicted))

    def diagnostics(self, state: EstimationState) -> Diagnostics:
        """Return the diagnostics of both stages, with ‖Δy − ĴΔq‖ of the last motion as `jacobian_prediction_error`."""
        learned = state.learned
        found = {
            "jacobian_prediction_error": learned.unexplained,
            **self.estimator.diagnostics(learned.estimator),
        }
        return (
            found if self.pairing is None else {**found, **self.pairing.diagnostics(learned.pair)}
        )


def _other(_: Any, other: Any) -> Any:  # noqa: ANN401 - states of an estimator
    return other
