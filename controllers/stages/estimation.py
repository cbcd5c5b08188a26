"""The pair and estimate stages together: from observations to the Jacobian.

    own        Ĵ(q) = E(q)                     E learns from (Δq, Δy)
    nominal    Ĵ(q) = J_n(q) + E               E learns from (Δq, Δy − x)
    map        Ĵ(q) = M̄ J_n(q) + E             E learns from (Δq, Δy − M̄ x)
    map        Ĵ(q) = M̄ E(q)                   E learns from (Δq, RᵀΔy), where E brings a model itself

With a camera model, a map stands between L(y, z), at the measured features, and the nominal motions G(q) of the points
(`point_map`):

    map        Ĵ(q) = L M̄ G(q) + E             E learns from (Δq, Δy − L M̄ x)
    map        Ĵ(q) = L M̄ G(q) + E(q) − E₀(q)  E learns from (Δq, Δy − L M̄ x + E₀ Δq), where E brings a model E₀
    map        Ĵ(q) = L M̄ G_E(q)               E learns from (Δq, Δy, L M̄), where E estimates the arm

with the estimator E, the nominal Jacobian J_n, or Ĵ₀ where there is none, and from the pair stage the joint motion Δq
that belongs to the feature's motion Δy, its prediction x by the model, the map M̄ and the rotation R nearest to it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple, final

import numpy as np

from servobench.controllers.aids import AidsConfig
from servobench.controllers.camera_model import block_diagonal, feature_jacobian, turned_interaction
from servobench.controllers.controller import Delays, Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import MOTION_TIME, Estimator, Motion
from servobench.controllers.periods import whole_periods
from servobench.controllers.stages.pairing import NO_DEPTH, Paired, Pairing, PairState
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, norm, transposed
from servobench.plant.contract.signals import BoolArray, Observation


class LastFrame(NamedTuple):
    """The frame at which the last motion ended.

    Attributes:
        time: (...) [s]; NaN before there is a valid feature.
        joint_position: (..., n) [rad].
        feature: (..., m).
        valid: (..., m), which features were last.
        jacobian: Ĵ, (..., m, n), which predicts the next motion; NaN before.
    """

    time: FloatArray
    joint_position: FloatArray
    feature: FloatArray
    valid: BoolArray
    jacobian: FloatArray


class Learned(NamedTuple):
    """The states that change with a motion.

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
        last: the frame at which the last motion ended.
        jacobian: Ĵ, (..., m, n), of this period; NaN before.
    """

    learned: Learned
    last: LastFrame
    jacobian: FloatArray


@final
class Estimation:
    """Estimates Ĵ(q) as above from motions of at least `MOTION_TIME`: it learns as fast at every control period.

    Attributes:
        estimator: E.
        pairing: the pair stage; None where no aid needs past joint positions.
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
        self._cameras = knowledge.nominal_cameras if aids.model == "map" else None
        self.pairing = Pairing(aids, knowledge.spec, delays.latency, self._cameras) if aids.needs_past else None
        shape = knowledge.spec.m, knowledge.spec.n
        self._first = estimator.start(np.zeros(shape)) if self._cameras and estimator.brings_model else None
        at_rest = np.zeros(knowledge.spec.n)
        self._estimates_arm = self._first is not None and estimator.motions(self._first, at_rest) is not None
        asked = aids.model != "own" or (self.pairing is not None and self.pairing.learns)
        self._nominal = knowledge.nominal_jacobian if asked and not estimator.brings_model else None
        self._longest = math.inf if self.pairing is None else (self.pairing.gap + 0.5) * knowledge.spec.period

    def start(self, observation: Observation, jacobian: FloatArray) -> EstimationState:
        """Return the state before any motion, starting from Ĵ₀, (..., m, n), at rest."""
        lead, q = observation.feature.shape[:-1], observation.joint_position
        pair, own = None, jacobian
        if self.pairing is not None:
            given = self._given_base(q, jacobian)
            depth, motions = self._depths_and_motions(q)
            pair = self.pairing.start(observation, given if self._cameras is None else motions, depth)
            own = jacobian - given if self._adds else jacobian
        estimator = self.estimator.start(own)
        if pair is not None and self.estimator.brings_model and self._cameras is None:
            pair = pair._replace(base=self.estimator.jacobian(estimator, q))
        unknown, never = np.full(jacobian.shape, np.nan), np.full(lead, np.nan)[()]
        last = LastFrame(never, q, observation.feature, observation.valid, unknown)
        return EstimationState(Learned(estimator, pair, never), last, unknown)

    def update(self, state: EstimationState, observation: Observation, desired: FloatArray) -> EstimationState:
        """Return the state at an observation; without a valid feature nothing is learned.

        Args:
            state: one period ago.
            observation: of this period.
            desired: y_ref, (..., m), of this period.
        """
        learned, last, q = state.learned, state.last, observation.joint_position
        pairing, (depth, motions) = self.pairing, self._depths_and_motions(q)
        if pairing is not None:
            learned = learned._replace(pair=pairing.advance(learned.pair, q, depth))
        duration, both = observation.time - last.time, observation.valid & last.valid
        due = np.logical_or.reduce(observation.valid, axis=-1) & ~(
            duration < self._shortest
        )  # true at the first frame: its duration is NaN
        known = due & np.logical_or.reduce(both, axis=-1) & (duration > 0.0) & (duration < self._longest)
        learned = branch(known, self._learn, learned, last, observation, desired, both)
        if pairing is not None:
            pair = branch(due & np.logical_not(known), pairing.interrupt, learned.pair)
            learned = learned._replace(pair=pair)
        jacobian = own = self.estimator.jacobian(learned.estimator, q)
        if pairing is not None and self._cameras is not None:
            base, jacobian = self._point_jacobian(
                learned, self._cameras.rates(observation.feature, depth), motions, own, q
            )
            learned = learned._replace(pair=learned.pair._replace(base=base))
        elif pairing is not None:
            base = own if self.estimator.brings_model else self._given_base(q, learned.pair.base)
            learned = learned._replace(pair=learned.pair._replace(base=base))
            if self._model != "own":
                jacobian = learned.pair.map @ base if self._model == "map" else base
                jacobian = jacobian + own if self._adds else jacobian
        lead = observation.feature.shape[:-1]
        time: Any = np.full(lead, observation.time) if lead else np.float64(observation.time)
        last = branch(due, _newest, last, LastFrame(time, q, observation.feature, observation.valid, jacobian))
        return EstimationState(learned, last, jacobian)

    def into_model_frame(self, state: EstimationState, observation: Observation) -> FloatArray:
        """Return T, (..., m, m), that turns measured features into those of the nominal cameras.

        With a camera model, T = L Rᵀ L⁺ of each point, whose motion is taken to be across the optical axis.
        """
        rotation: FloatArray = state.learned.pair.rotation
        if self._cameras is None:
            return rotation.mT
        depth = self._cameras.depths_and_motions(observation.joint_position)[0]
        rates = self._cameras.rates(observation.feature, depth)
        inverse = block_diagonal(np.asarray(np.linalg.pinv(rates)))
        return np.asarray(turned_interaction(rates, transposed(rotation)) @ inverse)

    def _depths_and_motions(self, joint_position: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return depths (..., c p) [m] and G (..., 3 c p, n) [m/rad]; empty without a camera model."""
        return (NO_DEPTH, NO_DEPTH) if self._cameras is None else self._cameras.depths_and_motions(joint_position)

    def _point_jacobian(
        self, learned: Learned, rates: FloatArray, motions: FloatArray, own: FloatArray, joint_position: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return G by the present estimate of the arm, and Ĵ."""
        base = self.estimator.motions(learned.estimator, joint_position)
        if base is not None:
            return base, feature_jacobian(rates, learned.pair.map, base)
        if self._first is not None:
            own = own - self.estimator.jacobian(self._first, joint_position)
        return motions, feature_jacobian(rates, learned.pair.map, motions) + own

    def _given_base(self, joint_position: FloatArray, otherwise: FloatArray) -> FloatArray:
        if self._nominal is None:
            return otherwise
        return np.asarray(self._nominal(joint_position), dtype=np.float64)

    def _learn(
        self, learned: Learned, last: LastFrame, observation: Observation, desired: FloatArray, valid: BoolArray
    ) -> Learned:
        """Learn from a motion; features that were not `valid` at both ends are taken to move as predicted."""
        dy, error = observation.feature - last.feature, desired - observation.feature
        duration = observation.time - last.time
        if self.pairing is None:
            q = last.joint_position
            step = observation.joint_position - q
            predicted = np.matvec(last.jacobian, step)
            dy = np.where(valid, dy, predicted)
            return Learned(
                self.estimator.update(learned.estimator, Motion(q, step, dy, error, duration)),
                None,
                norm(dy - predicted),
            )
        middle = 0.5 * (last.feature + observation.feature)
        pair, paired = self.pairing.learn(learned.pair, dy, duration, middle, valid)
        predicted = np.matvec(last.jacobian, paired.joint_step)
        dy = np.where(valid, dy, predicted)
        motion = self._own_motion(pair, paired, Motion(*paired[:2], dy, error, duration, self.pairing.noise(pair)))
        known = self.pairing.is_known(pair)
        return Learned(branch(known, self.estimator.update, learned.estimator, motion), pair, norm(dy - predicted))

    def _own_motion(self, pair: PairState, paired: Paired, motion: Motion) -> Motion:
        """Return the motion without the part that the model explains, for the estimator."""
        if self._cameras is not None:
            return self._point_motion(pair, paired, motion)
        dy, error = motion.feature_step, motion.error
        if self._model == "map":
            if self._adds:
                dy = dy - np.matvec(pair.map, paired.predicted)
            else:
                dy, error = np.vecmat(dy, pair.rotation), np.vecmat(error, pair.rotation)
        elif self._adds:
            dy = dy - paired.predicted
        return replace(motion, feature_step=dy, error=error)

    def _point_motion(self, pair: PairState, paired: Paired, motion: Motion) -> Motion:
        rates, x = paired.rates, paired.predicted[..., None]
        if self._first is None:
            explained = feature_jacobian(rates, pair.map, x)[..., 0]
        elif self._estimates_arm:
            return replace(motion, interaction=turned_interaction(rates, pair.map))
        else:
            nominal = self.estimator.jacobian(self._first, motion.joint_position)
            explained = feature_jacobian(rates, pair.map, x)[..., 0] - np.matvec(nominal, motion.joint_step)
        return replace(motion, feature_step=motion.feature_step - explained)

    def diagnostics(self, state: EstimationState) -> Diagnostics:
        """Return the diagnostics of both stages, with ‖Δy − ĴΔq‖ of the last motion as `jacobian_prediction_error`."""
        learned = state.learned
        found = {"jacobian_prediction_error": learned.unexplained, **self.estimator.diagnostics(learned.estimator)}
        return found if self.pairing is None else {**found, **self.pairing.diagnostics(learned.pair)}


def _newest(last: LastFrame, now: LastFrame) -> LastFrame:
    return now
