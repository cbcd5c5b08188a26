"""The pair and estimate stages together: from observations to the Jacobian.

    own        Ĵ(q) = E(q)                     E learns from (Δq, Δy)
    nominal    Ĵ(q) = J_n(q) + E               E learns from (Δq, Δy − x)
    map        Ĵ(q) = M̄ J_n(q) + E             E learns from (Δq, Δy − M̄ x)
    map        Ĵ(q) = M̄ E(q)                   E learns from (Δq, RᵀΔy), where E brings a model itself

with the estimator E, the nominal Jacobian J_n, or Ĵ₀ where there is none, and from the pair stage the joint motion Δq
that belongs to the feature's motion Δy, its prediction x by the model, the map M̄ and the rotation R nearest to it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, final

import numpy as np

from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import Delays, Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import MOTION_TIME, Estimator, Motion
from servobench.controllers.stages.pairing import Paired, Pairing, PairState, whole_periods
from servobench.plant.checks import FloatArray
from servobench.plant.lanes import branch, norm
from servobench.plant.signals import Observation


class Seen(NamedTuple):
    """What was seen when the last motion ended.

    Attributes:
        time: (...) [s]; NaN before there is a valid feature.
        joint_position: (..., n) [rad].
        feature: (..., m).
        jacobian: Ĵ, (..., m, n), which predicts the next motion; NaN before.
    """

    time: FloatArray
    joint_position: FloatArray
    feature: FloatArray
    jacobian: FloatArray


class Learned(NamedTuple):
    """What changes with a motion.

    Attributes:
        estimator: state of the estimator.
        pair: state of the pair stage; None without one.
        unexplained: ‖Δy − ĴΔq‖, (...), with Ĵ from before the update; NaN before there is a motion.
    """

    estimator: Any
    pair: Any
    unexplained: FloatArray


class EstimationState(NamedTuple):
    """The state of both stages.

    Attributes:
        learned: from motions.
        seen: when the last motion ended.
        jacobian: Ĵ, (..., m, n), of this period; NaN before.
    """

    learned: Learned
    seen: Seen
    jacobian: FloatArray


@final
class Estimation:
    """Ĵ(q) as above. A motion lasts `MOTION_TIME` at least, so that as much is learned per second at every rate.

    Attributes:
        estimator: E.
        pairing: the pair stage; None where no aid looks back.
    """

    def __init__(self, estimator: Estimator[Any], knowledge: RobotKnowledge, aids: AidsConfig, delays: Delays) -> None:
        """Compose the stages.

        Raises:
            ValueError: a nominal model for an estimator that brings one.
        """
        if aids.model == "nominal" and estimator.brings_model:
            raise ValueError(f"aids.model must be 'own' or 'map' for {type(estimator).__name__}, which brings a model")
        self.estimator, self._model, self._spec = estimator, aids.model, knowledge.spec
        self._adds = aids.model != "own" and not estimator.brings_model
        self._shortest = (max(1, whole_periods(MOTION_TIME, knowledge.spec.period)) - 0.5) * knowledge.spec.period
        self.pairing = Pairing(aids, knowledge.spec, delays.latency) if aids.looks_back else None
        asked = aids.model != "own" or (self.pairing is not None and self.pairing.learns)
        self._nominal = knowledge.nominal_jacobian if asked and not estimator.brings_model else None
        self._longest = math.inf if self.pairing is None else (self.pairing.gap + 0.5) * knowledge.spec.period

    def start(self, observation: Observation, jacobian: FloatArray) -> EstimationState:
        """Return the state of one that has seen nothing and starts from Ĵ₀, (..., m, n), at rest."""
        lead, q = observation.feature.shape[:-1], observation.joint_position
        pair, own = None, jacobian
        if self.pairing is not None:
            pair = self.pairing.start(observation, self._given_base(q, jacobian))
            own = jacobian - pair.base if self._adds else jacobian
        estimator = self.estimator.start(own)
        if pair is not None and self.estimator.brings_model:
            pair = pair._replace(base=self.estimator.jacobian(estimator, q))
        unknown, never = np.full(jacobian.shape, np.nan), np.full(lead, np.nan)[()]
        seen = Seen(never, q, observation.feature, unknown)
        return EstimationState(Learned(estimator, pair, never), seen, unknown)

    def update(self, state: EstimationState, observation: Observation, desired: FloatArray) -> EstimationState:
        """Return the state at an observation; without a valid feature nothing is learned.

        Args:
            state: one period ago.
            observation: of this period.
            desired: y_ref, (..., m), of this period.
        """
        learned, seen, q = state.learned, state.seen, observation.joint_position
        pairing = self.pairing
        if pairing is not None:
            learned = learned._replace(pair=pairing.advance(learned.pair, q))
        duration = observation.time - seen.time
        due = observation.feature_valid & ~(duration < self._shortest)  # also the first one, of unknown duration
        known = due & (duration > 0.0) & (duration < self._longest)
        learned = branch(known, self._learn, learned, seen, observation, desired)
        if pairing is not None:
            pair = branch(due & np.logical_not(known), pairing.interrupt, learned.pair)
            learned = learned._replace(pair=pair)
        pair, own = learned.pair, self.estimator.jacobian(learned.estimator, q)
        jacobian = own
        if pair is not None:
            base = own if self.estimator.brings_model else self._given_base(q, pair.base)
            learned = learned._replace(pair=pair._replace(base=base))
            if self._model != "own":
                jacobian = pair.map @ base if self._model == "map" else base
                jacobian = jacobian + own if self._adds else jacobian
        lead = observation.feature.shape[:-1]
        time: Any = np.full(lead, observation.time) if lead else np.float64(observation.time)
        seen = branch(due, _newer, seen, Seen(time, q, observation.feature, jacobian))
        return EstimationState(learned, seen, jacobian)

    def _given_base(self, joint_position: FloatArray, otherwise: FloatArray) -> FloatArray:
        if self._nominal is None:
            return otherwise
        return np.asarray(self._nominal(joint_position), dtype=np.float64)

    def _learn(self, learned: Learned, seen: Seen, observation: Observation, desired: FloatArray) -> Learned:
        dy, error = observation.feature - seen.feature, desired - observation.feature
        duration = observation.time - seen.time
        if self.pairing is None:
            q = seen.joint_position
            motion = Motion(q, observation.joint_position - q, dy, error, duration)
            unexplained = norm(dy - np.matvec(seen.jacobian, motion.joint_step))
            return Learned(self.estimator.update(learned.estimator, motion), None, unexplained)
        pair, paired = self.pairing.learn(learned.pair, dy, duration)
        unexplained = norm(dy - np.matvec(seen.jacobian, paired.joint_step))
        motion = self._own_motion(pair, paired, Motion(*paired[:2], dy, error, duration, self.pairing.noise(pair)))
        known = self.pairing.is_known(pair)
        return Learned(branch(known, self.estimator.update, learned.estimator, motion), pair, unexplained)

    def _own_motion(self, pair: PairState, paired: Paired, motion: Motion) -> Motion:
        """Return the motion as the estimator is to explain it."""
        dy, error = motion.feature_step, motion.error
        if self._model == "map":
            if self._adds:
                dy = dy - np.matvec(pair.map, paired.predicted)
            else:
                dy, error = np.vecmat(dy, pair.rotation), np.vecmat(error, pair.rotation)
        elif self._adds:
            dy = dy - paired.predicted
        return Motion(motion.joint_position, motion.joint_step, dy, error, motion.duration, motion.noise)

    def diagnostics(self, state: EstimationState) -> Diagnostics:
        """Return those of both stages, with ‖Δy − ĴΔq‖ of the last motion as `jacobian_prediction_error`."""
        learned = state.learned
        found = {"jacobian_prediction_error": learned.unexplained, **self.estimator.diagnostics(learned.estimator)}
        return found if self.pairing is None else {**found, **self.pairing.diagnostics(learned.pair)}


def _newer(seen: Seen, now: Seen) -> Seen:
    return now
