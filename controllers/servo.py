"""A controller composed of a Jacobian estimator, a control law and a provider of the initial Jacobian.

    J(k) ← estimator(Δy, Δq),      u(k) = law(J(k), y(k), y_ref(k), y_ref(k+1), …)

Any estimator works with any law. Which of them are known by name is written in `servobench.controllers.parts`. `Servo`
is the pure composition, for one run or many side by side; `ServoController` holds the state of one run.
"""

from __future__ import annotations

from typing import Any, NamedTuple, final

import numpy as np

from servobench.controllers.controller import Controller, Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.initial import InitialJacobian
from servobench.controllers.laws.law import Law
from servobench.controllers.laws.prediction import Predictor, shifted
from servobench.plant.checks import FloatArray, is_finite
from servobench.plant.faults import ControllerDiverged
from servobench.plant.lanes import branch, norm
from servobench.plant.signals import BoolArray, Command, Observation


class Seen(NamedTuple):
    """What was seen with the last valid feature.

    Attributes:
        time: (...) [s]; NaN before.
        joint_position: (..., n) [rad].
        feature: (..., m).
        jacobian: Ĵ, (..., m, n), which predicts the next motion; NaN before.
    """

    time: FloatArray
    joint_position: FloatArray
    feature: FloatArray
    jacobian: FloatArray


class ServoState(NamedTuple):
    """The state of a composed controller.

    Attributes:
        estimator: of the estimator.
        law: of the law.
        initial: of the provider of the initial Jacobian.
        predictor: of the predict stage; None without one.
        ready: (...), whether the initial Jacobian is known.
        jacobian: (..., m, n), the one of the last step; NaN before.
        seen: with the last valid feature.
        unexplained: (...), ‖Δy − ĴΔq‖ of the last motion, with Ĵ from before its update; NaN before.
    """

    estimator: Any
    law: Any
    initial: Any
    predictor: Any
    ready: BoolArray
    jacobian: FloatArray
    seen: Seen
    unexplained: FloatArray


@final
class Servo:
    """Estimates the Jacobian from observed motions and commands with the estimate.

    Each step learns from the motion between the last valid feature and the present one, so that Δy and Δq span the same
    gap when frames are lost; a step without a valid feature learns nothing. Joint positions are read without delay, so
    under camera latency Δy is that of a motion a little earlier: while the arm speeds up or slows down, an estimator is
    misled. While the initial Jacobian is probed, the probing moves are the command; estimator and law are not used.
    """

    def __init__(
        self,
        estimator: Estimator[Any],
        law: Law[Any],
        initial: InitialJacobian[Any],
        knowledge: RobotKnowledge,
        predictor: Predictor | None = None,
    ) -> None:
        """Compose a controller.

        Args:
            estimator: estimates the Jacobian.
            law: commands by the estimate.
            initial: provides the first Jacobian.
            knowledge: of the robot.
            predictor: the predict stage; None: the law gets what is measured.

        Raises:
            ValueError: a predictor for a law that predicts itself.
        """
        if predictor is not None and "predict" in law.owns:
            raise ValueError(f"predictor must be None for {type(law).__name__}, which predicts itself")
        self.estimator, self.law, self.initial = estimator, law, initial
        self.knowledge, self.predictor = knowledge, predictor

    def start(self, observation: Observation) -> ServoState:
        """Return the state at the start of a run that begins with `observation`."""
        initial = self.initial.start(observation)
        lead, (m, n) = observation.feature.shape[:-1], (self.knowledge.spec.m, self.knowledge.spec.n)
        unknown = np.full((*lead, m, n), np.nan)
        known = self.initial.immediate
        first = self.initial.jacobian(initial) if known else np.zeros((*lead, m, n))
        return ServoState(
            estimator=self.estimator.start(first),
            law=self.law.start(observation),
            initial=initial,
            predictor=None if self.predictor is None else self.predictor.start(observation),
            ready=np.full(lead, known)[()],
            jacobian=unknown,
            seen=Seen(np.full(lead, np.nan)[()], observation.joint_position, observation.feature, unknown),
            unexplained=np.full(lead, np.nan)[()],
        )

    def step(self, state: ServoState, observation: Observation, reference: FloatArray) -> tuple[ServoState, FloatArray]:
        """Return the new state and the joint velocity (..., n) [rad/s] for the period that begins now.

        Raises:
            ControllerDiverged: the estimate, or what the law asked for, is not finite in at least one lane.
            RunFault: a part cannot go on in at least one lane.
        """
        if self.initial.immediate:
            return self._act((state, observation.joint_position), observation, reference)
        both = state, np.zeros_like(observation.joint_position)
        both = branch(np.logical_not(state.ready), self._probe, both, observation)
        return branch(both[0].ready, self._act, both, observation, reference)

    def _probe(self, both: tuple[ServoState, FloatArray], observation: Observation) -> tuple[ServoState, FloatArray]:
        initial, velocity, done = self.initial.step(both[0].initial, observation)
        state = branch(done, self._begin, both[0]._replace(initial=initial), observation)
        return state, velocity

    def _begin(self, state: ServoState, observation: Observation) -> ServoState:
        return state._replace(
            estimator=self.estimator.start(self.initial.jacobian(state.initial)),
            law=self.law.start(observation),
            predictor=None if self.predictor is None else self.predictor.start(observation),
            ready=np.full(observation.feature.shape[:-1], True),
        )

    def _act(
        self, both: tuple[ServoState, FloatArray], observation: Observation, reference: FloatArray
    ) -> tuple[ServoState, FloatArray]:
        state, _ = both
        learned = state.estimator, state.unexplained
        learns = observation.feature_valid & (state.seen.time < observation.time)
        estimator, unexplained = branch(learns, self._learn, learned, state.seen, observation, reference[..., 0, :])
        estimate = self.estimator.estimate(estimator, observation.joint_position)
        J = estimate.jacobian
        if not is_finite(J):
            raise ControllerDiverged(f"jacobian is not finite at {observation.time:.5g} s: {J.tolist()}")
        law, predictor = state.law, state.predictor
        if self.predictor is None:
            law, u = self.law.command(law, estimate, observation, reference)
        else:
            predictor, bound = self.predictor.predict(predictor, estimate, observation)
            ahead = observation.seen_as(bound.joint_position, bound.feature)
            law, u = self.law.command(law, estimate, ahead, shifted(reference, bound.lead, reference.shape[-2]))
            predictor = self.predictor.note(predictor, u * self.knowledge.spec.period)
        if not is_finite(u):
            raise ControllerDiverged(
                f"joint_velocity is not finite at {observation.time:.5g} s: {u.tolist()}, by the Jacobian {J.tolist()}"
            )
        law = self.law.noted(law, u)
        lead = observation.feature.shape[:-1]
        time: Any = np.full(lead, observation.time) if lead else np.float64(observation.time)
        now = Seen(time, observation.joint_position, observation.feature, J)
        seen = branch(observation.feature_valid, _newer, state.seen, now)
        return ServoState(estimator, law, state.initial, predictor, state.ready, J, seen, unexplained), u

    def _learn(
        self, learned: tuple[Any, FloatArray], seen: Seen, observation: Observation, desired: FloatArray
    ) -> tuple[Any, FloatArray]:
        motion = Motion(
            joint_position=seen.joint_position,
            joint_step=observation.joint_position - seen.joint_position,
            feature_step=observation.feature - seen.feature,
            error=desired - observation.feature,
            duration=observation.time - seen.time,
        )
        unexplained = norm(motion.feature_step - np.matvec(seen.jacobian, motion.joint_step))
        return self.estimator.update(learned[0], motion), unexplained

    def diagnostics(self, state: ServoState) -> Diagnostics:
        """Return those of estimator and law, with `probing` and `jacobian_prediction_error`.

        `jacobian_prediction_error` is ‖Δy − ĴΔq‖ in m of the last motion, with Ĵ from before its update; NaN until
        something has moved. `probing` is 1 while the initial Jacobian is being measured.
        """
        own = {"probing": 1.0 - state.ready, "jacobian_prediction_error": state.unexplained}
        if not np.any(state.ready):
            return own
        return {**own, **self.estimator.diagnostics(state.estimator), **self.law.diagnostics(state.law)}


def _newer(seen: Seen, now: Seen) -> Seen:
    return now


@final
class ServoController(Controller):
    """A `Servo` as a controller of one run, whose state it holds.

    Attributes:
        servo: what it is composed of.
        state: the state; None before the first `reset`.
    """

    def __init__(self, servo: Servo) -> None:
        """Hold a servo; `reset` must be called before the first `step`."""
        self.servo = servo
        self.state: ServoState | None = None

    def reset(self, observation: Observation, seed: int) -> None:
        """Forget everything; see `Controller.reset`. No part draws random numbers, so `seed` changes nothing.

        Raises:
            ValueError: an observation of the wrong size.
        """
        del seed
        self.servo.knowledge.check(observation)
        self.state = self.servo.start(observation)

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the command for the period that begins now; see `Controller.step`.

        Raises:
            ValueError: an observation or a reference of the wrong size, or no `reset` before.
            RunFault: see `Servo.step`.
        """
        self.servo.knowledge.check(observation, reference)
        if self.state is None:
            raise ValueError("reset must be called before the first step")
        self.state, u = self.servo.step(self.state, observation, reference)
        return Command(u)

    def diagnostics(self) -> Diagnostics:
        """Return those of `Servo.diagnostics`."""
        return {} if self.state is None else self.servo.diagnostics(self.state)

    def estimated_jacobian(self) -> FloatArray | None:
        """Return the Jacobian (m, n) that the last step used, or None before there is one."""
        if self.state is None or np.isnan(self.state.jacobian).any():
            return None
        return self.state.jacobian.copy()

    def save(self) -> ServoState | None:
        """Return the state, a value that never changes."""
        return self.state

    def restore(self, state: object) -> None:
        """Go back to a state that `save` returned.

        Raises:
            TypeError: not such a state.
        """
        if not isinstance(state, ServoState):
            raise TypeError(f"state must come from save, got {type(state).__name__}")
        self.state = state
