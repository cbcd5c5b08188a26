"""A controller composed of a Jacobian estimator, a control law and a provider of the initial Jacobian.

    J(k) ← estimator(Δy, Δq),      u(k) = law(J(k), y(k), y_ref(k), y_ref(k+1), …)

Any estimator works with any law. Which of them are known by name is written in `servobench.controllers.parts`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import final

from servobench.controllers.controller import Controller, Diagnostics, RobotKnowledge
from servobench.controllers.estimate import Estimate
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.initial import InitialJacobian
from servobench.controllers.laws.law import Law
from servobench.controllers.laws.prediction import Predictor, shifted
from servobench.plant.checks import FloatArray, is_finite
from servobench.plant.faults import ControllerDiverged
from servobench.plant.signals import Command, Observation


@final
class ServoController(Controller):
    """Estimates the Jacobian from observed motions and commands with the estimate.

    Each step learns from the motion between the last valid feature and the present one, so that Δy and Δq span the same
    gap when frames are lost; a step without a valid feature learns nothing. Joint positions are read without delay, so
    under camera latency Δy is that of a motion a little earlier: while the arm speeds up or slows down, an estimator is
    misled. While the initial Jacobian is probed, the probing moves are the command; estimator and law are not used.

    Attributes:
        estimator: the Jacobian estimator.
        law: the control law.
    """

    def __init__(
        self,
        estimator: Estimator,
        law: Law,
        initial: InitialJacobian,
        knowledge: RobotKnowledge,
        predictor: Predictor | None = None,
    ) -> None:
        """Compose a controller; `reset` must be called before the first `step`.

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
        self._predictor = predictor
        self.estimator = estimator
        self.law = law
        self._initial = initial
        self._knowledge = knowledge
        self._forget()

    def _shared(self) -> Iterable[object]:
        return vars(self._knowledge).values()

    def _forget(self) -> None:
        self._ready = False
        self._probing = False
        self._last_valid: Observation | None = None
        self._jacobian: FloatArray | None = None
        self._prediction_error = float("nan")

    def reset(self, observation: Observation, seed: int) -> None:
        """Forget everything; see `Controller.reset`. No part draws random numbers, so `seed` changes nothing.

        Raises:
            ValueError: an observation of the wrong size.
        """
        del seed
        self._knowledge.check(observation)
        self._initial.reset(observation)
        self._forget()

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the command for the period that begins now; see `Controller.step`.

        Raises:
            ValueError: an observation or a reference of the wrong size.
            ControllerDiverged: the estimate, or what the law asked for, is not finite.
        """
        self._knowledge.check(observation, reference)
        probing = None if self._ready else self._initial.step(observation)
        if probing is not None:
            self._probing = True
            return Command(probing)
        if not self._ready:
            self.estimator.reset(self._initial.jacobian())
            self.law.reset(observation)
            if self._predictor is not None:
                self._predictor.reset()
            self._ready, self._probing = True, False
        self._learn(observation, reference)
        estimate = self.estimator.estimate(observation.joint_position)
        J = self._jacobian = estimate.jacobian
        if not is_finite(J):
            raise ControllerDiverged(f"jacobian is not finite at {observation.time:.5g} s: {J.tolist()}")
        u = self._command(estimate, observation, reference)
        if not is_finite(u):
            raise ControllerDiverged(
                f"joint_velocity is not finite at {observation.time:.5g} s: {u.tolist()}, by the Jacobian {J.tolist()}"
            )
        return Command(u)

    def _command(self, estimate: Estimate, observation: Observation, reference: FloatArray) -> FloatArray:
        """Return what leaves the chain predict, law, posture, limit: a joint velocity (n,), rad/s."""
        predictor = self._predictor
        if predictor is None:
            return self.law.command(estimate, observation, reference)
        bound = predictor.predict(estimate, observation)
        ahead = Observation(observation.time, bound.joint_position, bound.feature, observation.feature_valid)
        u = self.law.command(estimate, ahead, shifted(reference, bound.lead, len(reference)))
        predictor.note(u * self._knowledge.spec.period)
        return u

    def diagnostics(self) -> Diagnostics:
        """Return those of estimator and law, with `probing` and `jacobian_prediction_error`.

        `jacobian_prediction_error` is ‖Δy − ĴΔq‖ in m of the last motion, with Ĵ from before its update; NaN until
        something has moved. `probing` is 1 while the initial Jacobian is being measured.
        """
        own = {"probing": float(self._probing), "jacobian_prediction_error": self._prediction_error}
        if not self._ready:
            return own
        return {**own, **self.estimator.diagnostics(), **self.law.diagnostics()}

    def estimated_jacobian(self) -> FloatArray | None:
        """Return the Jacobian (m, n) that the last step used, or None before there is one."""
        return None if self._jacobian is None else self._jacobian.copy()

    def _learn(self, observation: Observation, reference: FloatArray) -> None:
        if not observation.feature_valid:
            return
        last, self._last_valid = self._last_valid, observation
        if last is None or observation.time <= last.time:
            return
        motion = Motion(
            joint_position=last.joint_position,
            joint_step=observation.joint_position - last.joint_position,
            feature_step=observation.feature - last.feature,
            error=reference[0] - observation.feature,
            duration=observation.time - last.time,
        )
        J = self.estimator.jacobian(motion.joint_position)
        unexplained = motion.feature_step - J.dot(motion.joint_step)
        self._prediction_error = math.sqrt(unexplained.dot(unexplained))
        self.estimator.update(motion)
