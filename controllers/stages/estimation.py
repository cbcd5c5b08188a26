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
from servobench.controllers.choice import choose
from servobench.controllers.controller import Delays, Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import MOTION_TIME, Estimator, Motion
from servobench.controllers.periods import whole_periods
from servobench.controllers.stages.pairing import Pairing
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, norm
from servobench.plant.contract.signals import BoolArray, Observation

REGRESSED = ("regression", "arm")  # models with a regression on the nominal Jacobian


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
    # ‖Δy − ĴΔq‖, (...), with Ĵ from before the update; NaN before there is a motion
    unexplained: FloatArray


class EstimationState(NamedTuple):
    """The state of both stages."""

    learned: Learned  # from motions
    last: LastFrame  # the frame at which the last motion ended
    jacobian: FloatArray  # Ĵ, (..., m, n), of this period; NaN before
    own: FloatArray  # the part of Ĵ that is the estimator's


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
        spec = knowledge.spec
        period = spec.period
        self.estimator = estimator
        self._model = aids.model
        self._filters = aids.filter
        self._nominal = knowledge.nominal_jacobian
        self._uses_own = estimator.brings_model and aids.model == "own"
        # Half a period keeps rounding of times out of the comparison with a motion's duration.
        self._shortest = (max(1, whole_periods(MOTION_TIME, period)) - 0.5) * period
        self._longest = math.inf
        self.pairing: Any = None
        if aids.needs_past:
            self.pairing = Pairing(aids, knowledge, delays.latency)
            self._longest = (self.pairing.gap + 0.5) * period
        self._first = None
        if estimator.brings_model and aids.model != "own":
            self._first = estimator.start(np.zeros((spec.m, spec.n)))

    def start(self, observation: Observation, jacobian: FloatArray) -> EstimationState:
        """Return the state before any motion, starting from Ĵ₀, (..., m, n), at rest."""
        lead = observation.lead
        q = observation.joint_position
        base = self._given(q, jacobian)
        deviation = jacobian
        if self._model != "own":
            deviation = jacobian - base
        estimator = self.estimator.start(deviation)
        if self._uses_own:
            base = self.estimator.jacobian(estimator, q)
        pair = None if self.pairing is None else self.pairing.start(observation, base)
        unknown = np.full(jacobian.shape, np.nan)
        never = np.full(lead, np.nan)[()]
        learned = Learned(estimator, anchor=estimator, pair=pair, unexplained=never)
        last = LastFrame(never, q, observation.feature, observation.valid, unknown)
        return EstimationState(learned, last, jacobian=unknown, own=unknown)

    def update(
        self, state: EstimationState, observation: Observation, desired: FloatArray
    ) -> EstimationState:
        """Return the state at an observation; without a valid feature nothing is learned.

        Args:
            state: one period ago.
            observation: of this period.
            desired: y_ref, (..., m), of this period.
        """
        learned = state.learned
        last = state.last
        q = observation.joint_position
        if self.pairing is not None:
            base = self._base(learned, q)
            learned = learned._replace(pair=self.pairing.advance(learned.pair, q, base))

        # The duration of the first frame is NaN, and that frame is due: hence "not shorter" instead of "at least".
        duration = observation.time - last.time
        shorter = duration < self._shortest
        due = np.logical_or.reduce(observation.valid, axis=-1) & ~shorter
        valid = observation.valid & last.valid
        ends_motion = due & np.logical_or.reduce(valid, axis=-1)
        known = ends_motion & (duration > 0.0) & (duration < self._longest)
        learned = branch(known, self._learn, learned, last, observation, desired, valid)
        if self.pairing is not None:
            pair = branch(
                due & np.logical_not(known), self.pairing.interrupt, learned.pair, observation
            )
            believed = pair.anchor.miss == 0.0
            anchor = choose(believed, learned.estimator, learned.anchor)
            learned = learned._replace(anchor=anchor, pair=pair)

        own = self.estimator.deviation(learned.estimator, self._first, q)
        jacobian = own
        if self.pairing is not None:
            jacobian = self._with_model(own, learned, q, learned.pair.base)
        lead = observation.lead
        time: Any = np.full(lead, observation.time) if lead else np.float64(observation.time)
        this = LastFrame(time, q, observation.feature, observation.valid, jacobian)
        return EstimationState(learned, choose(due, this, last), jacobian, own)

    def ahead(
        self, state: EstimationState, joint_position: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return Ĵ by the state at any joint position, (..., n) rad, and the model's J_n there, (..., m, n) each."""
        learned = state.learned
        q = joint_position
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
        own = np.matvec(state.own, joint_step)
        if self._model == "nominal":
            return predicted + own
        if self._model == "own":
            return np.asarray(own)
        regression = self.pairing.regression
        h = regression.regressors(begin + 0.5 * joint_step, joint_step, predicted)
        return regression.explained(state.learned.pair.regression, h) + own

    def into_model_frame(self, state: EstimationState) -> FloatArray:
        """Return Rᵀ, (..., m, m), that turns measured features into those of the nominal cameras."""
        rotation: FloatArray = state.learned.pair.regression.rotation
        return rotation.mT

    def _base(self, learned: Learned, joint_position: FloatArray) -> FloatArray:
        """Return J_n of the pair stage at a joint position, (..., m, n)."""
        if self._uses_own:
            return self.estimator.jacobian(learned.estimator, joint_position)
        return self._given(joint_position, learned.pair.base)

    def _given(self, joint_position: FloatArray, otherwise: FloatArray) -> FloatArray:
        """Return the nominal Jacobian at a joint position, (..., m, n), or `otherwise` where there is none."""
        if self._nominal is None:
            return otherwise
        return np.asarray(self._nominal(joint_position), dtype=np.float64)

    def _with_model(
        self, own: FloatArray, learned: Learned, joint_position: FloatArray, nominal: FloatArray
    ) -> FloatArray:
        """Return Ĵ at joint positions, (..., m, n), for the estimator's own part and J_n there."""
        if self._model == "own":
            return own
        if self._model in REGRESSED:
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
        q = last.joint_position
        dq = observation.joint_position - q
        dy = observation.feature - last.feature
        duration = observation.time - last.time
        pair = learned.pair
        noise = None
        explained = np.zeros_like(dy)
        if self.pairing is not None:
            pair, paired = self.pairing.learn(pair, dy, duration, valid, observation)
            q = paired.joint_position
            dq = paired.joint_step
            dy = paired.feature_step
            duration = paired.duration
            valid = paired.valid
            estimator = choose(paired.back, learned.anchor, learned.estimator)
            learned = learned._replace(estimator=estimator)
            noise = self.pairing.noise(pair)
            if self._filters:
                dy = dy - (pair.regression.mean[..., -1] - paired.before.mean[..., -1])
            if self._model == "nominal":
                explained = paired.predicted
            elif self._model in REGRESSED:
                explained = self.pairing.regression.explained(paired.before, paired.h)
            if self._first is not None:
                explained = explained - np.matvec(self.estimator.jacobian(self._first, q), dq)

        predicted = np.matvec(last.jacobian, dq)
        dy = np.where(valid, dy, predicted)
        motion = Motion(
            joint_position=q,
            joint_step=dq,
            feature_step=dy - explained,
            error=desired - observation.feature,
            duration=duration,
            noise=noise,
        )
        estimator = self.estimator.update(learned.estimator, motion)
        return learned._replace(estimator=estimator, pair=pair, unexplained=norm(dy - predicted))

    def diagnostics(self, state: EstimationState) -> Diagnostics:
        """Return the diagnostics of both stages, with ‖Δy − ĴΔq‖ of the last motion as `jacobian_prediction_error`."""
        learned = state.learned
        found = {
            "jacobian_prediction_error": learned.unexplained,
            **self.estimator.diagnostics(learned.estimator),
        }
        if self.pairing is None:
            return found
        return {**found, **self.pairing.diagnostics(learned.pair)}
