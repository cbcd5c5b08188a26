"""A controller composed of a Jacobian estimator, a control law and the stages around them.

    Observation → pair → estimate → predict → law → feedforward, posture, limit, calming → Command

Any estimator works with any law. Which of them are known by name is written in `servobench.controllers.methods`; the
stages are the aids (`servobench.controllers.aids`). `Servo` is the pure composition, for one run or many side by side;
`ServoController` holds the state of one run.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, cast, final

import numpy as np

from servobench.controllers.aids import AidsConfig
from servobench.controllers.algebra import damped_inverse
from servobench.controllers.controller import Controller, Delays, Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator
from servobench.controllers.initial_jacobian import InitialJacobian
from servobench.controllers.laws.law import Estimate, Law
from servobench.controllers.stages.calibration import (
    Ahead,
    Calibration,
    CalibrationState,
    Regressed,
)
from servobench.controllers.stages.estimation import REGRESSED, Estimation, EstimationState
from servobench.controllers.stages.finish import Finish, scale_to_limit
from servobench.controllers.stages.prediction import Predictor, PredictorState, shifted
from servobench.plant.contract.checks import FloatArray, is_finite
from servobench.plant.contract.faults import ControllerDiverged
from servobench.plant.contract.lanes import branch, norm, where
from servobench.plant.contract.signals import BoolArray, Command, Observation

REACH = np.array(1.0)  # [rad] by which a joint half-way may differ from the present one
NEAR = 0.02  # [rad] length of half the way, up to which the present Jacobian serves
# [1] Share of the way to the target from which on it is taken for out of reach, if that remains half-way to it
REMAINDER = 0.7


class ServoState(NamedTuple):
    """The state of a composed controller."""

    estimation: EstimationState  # state of the pair and estimate stages
    law: Any  # state of the law
    initial: Any  # state of the provider of the initial Jacobian
    predictor: Any  # state of the predict stage; None without one
    ready: BoolArray  # (...), whether the initial Jacobian is known
    limited: BoolArray  # (...), whether the last command was limited
    calibration: Any  # state of the calibrating stage; None without one
    pace: Any  # state of calming; None without it

    @property
    def jacobian(self) -> FloatArray:
        """Ĵ of the last step, (..., m, n), in the units of the parts; NaN before."""
        return self.estimation.jacobian


class Stepped(NamedTuple):
    """A state and the command of its period, which each lane gets from probing or from the law."""

    state: ServoState
    joint_velocity: FloatArray  # (..., n), rad/s


class Servo:
    """Estimates the Jacobian from observed motions and commands with the estimate.

    Each motion spans the gap between two valid features, so that Δy and Δq belong together when frames are lost.
    Without aids joint positions are taken as read, so under camera latency Δy is that of a motion a little earlier:
    while the arm speeds up or slows down, this biases an estimator. While the initial Jacobian is probed, the probing
    moves are the command; estimator and law are not used.

    Attributes:
        faults: by lane, where the last step failed although it returned; here a step raises them instead.
        states: type of its state.
    """

    faults: Mapping[int, Exception] = MappingProxyType({})
    states: type = ServoState

    def __init__(
        self,
        estimator: Estimator[Any],
        law: Law[Any],
        initial: InitialJacobian[Any],
        knowledge: RobotKnowledge,
        aids: AidsConfig | None = None,
    ) -> None:
        """Compose a controller.

        Args:
            estimator: estimates the Jacobian.
            law: commands by the estimate.
            initial: provides the first Jacobian.
            knowledge: of the robot, in the units of the parts (`servobench.controllers.units`); it has the true delays
                where they are to be used instead of those of the aids.
            aids: the stages around estimator and law; None for none.

        Raises:
            ValueError: an aid that the estimator or the law brings itself.
        """
        aids = aids or AidsConfig()
        predicts = aids.delay != "ignored" or aids.response != "ignored" or aids.filter
        if predicts and "predict" in law.owns:
            raise ValueError(
                f"aids: {type(law).__name__} predicts by itself; leave delay, response and filter off"
            )
        delays = knowledge.true_delays or Delays(aids.latency, aids.command_delay, aids.lag)
        self.knowledge = knowledge
        self.law = law
        self.initial = initial
        self.estimation = Estimation(estimator, knowledge, aids, delays)
        self.predictor = Predictor(aids, knowledge.spec.period, delays) if predicts else None
        self.calibration: Any = _calibration(aids, knowledge, predicts=predicts)
        self.finish = Finish(aids, knowledge, type(law).__name__, law.owns)
        self._aids = aids
        self._turns = law.in_model_frame and aids.model in REGRESSED
        # Feedforward needs the row of the next instant, too.
        self._rows = 1 + int(aids.feedforward)
        if "preview" in law.owns:
            self._rows = 1 + knowledge.preview
        self._unit = knowledge.unit

    def start(self, observation: Observation) -> ServoState:
        """Return the state at the start of a run that begins with `observation`, in the unit of the plant."""
        observation = self._natural(observation)
        initial = self.initial.start(observation)
        known = self.initial.immediate
        lead = observation.lead
        if known:
            jacobian = self.initial.jacobian(initial)
        else:
            jacobian = np.zeros((*lead, self.knowledge.spec.m, self.knowledge.spec.n))
        return self._begin(initial, np.full(lead, known)[()], observation, jacobian)

    def step(self, state: ServoState, observation: Observation, reference: FloatArray) -> Stepped:
        """Return the new state and the joint velocity (..., n) [rad/s] for the period that begins now.

        Raises:
            ControllerDiverged: the estimate, or the command of the law, is not finite in at least one lane.
            RunFault: a part cannot go on in at least one lane.
        """
        if self._unit != 1.0:
            observation = self._natural(observation)
            reference = reference / self._unit
        if self.initial.immediate:
            return self._act(Stepped(state, observation.joint_position), observation, reference)
        stepped = Stepped(state, np.zeros_like(observation.joint_position))
        stepped = branch(np.logical_not(state.ready), self._probe, stepped, observation)
        return branch(stepped.state.ready, self._act, stepped, observation, reference)

    def jacobian(self, state: ServoState) -> FloatArray:
        """Return Ĵ of the last step, (..., m, n), in the unit of the plant per rad; NaN before."""
        J = state.jacobian
        if state.calibration is not None:
            J = branch(state.calibration.used, self._arm_jacobian, J, state.calibration)
        return self._unit * J

    def _arm_jacobian(self, _: FloatArray, calibration: CalibrationState) -> FloatArray:
        """Return the Jacobian of the calibrated arm, (..., m, n), in lanes where it is believed."""
        jacobian: FloatArray = self.calibration.jacobian(calibration)
        return jacobian

    def _natural(self, observation: Observation) -> Observation:
        return observation.with_values(observation.joint_position, observation.feature / self._unit)

    def _probe(self, stepped: Stepped, observation: Observation) -> Stepped:
        """Make a probing move in lanes without an initial Jacobian; the last one ends with the law's command."""
        initial, velocity, done = self.initial.step(stepped.state.initial, observation)
        state = stepped.state._replace(initial=initial)
        return Stepped(branch(done, self._end_probing, state, observation), velocity)

    def _end_probing(self, state: ServoState, observation: Observation) -> ServoState:
        jacobian = self.initial.jacobian(state.initial)
        return self._begin(state.initial, np.ones_like(state.ready), observation, jacobian)

    def _begin(
        self,
        initial: Any,  # noqa: ANN401
        ready: BoolArray,
        observation: Observation,
        jacobian: FloatArray,
    ) -> ServoState:
        return ServoState(
            estimation=self.estimation.start(observation, jacobian),
            law=self.law.start(observation),
            initial=initial,
            predictor=None if self.predictor is None else self.predictor.start(observation),
            ready=ready,
            limited=np.zeros_like(ready)[()],
            calibration=None if self.calibration is None else self.calibration.start(observation),
            pace=self.finish.start(observation),
        )

    def _act(self, stepped: Stepped, observation: Observation, reference: FloatArray) -> Stepped:
        """Estimate, predict and command in lanes whose initial Jacobian is known."""
        state = stepped.state
        estimation = self.estimation.update(state.estimation, observation, reference[..., 0, :])
        J = estimation.jacobian
        if not is_finite(J):
            raise ControllerDiverged(
                f"jacobian is not finite at {observation.time:.5g} s: {J.tolist()}"
            )
        predictor = state.predictor
        ahead = observation
        later = reference
        calibration = state.calibration
        drift: FloatArray = np.zeros(())
        if self.predictor is not None:
            predictor, ahead, lead, J = self.predictor.predict(
                predictor, self.estimation, estimation, observation
            )
            later = shifted(reference, lead, self._rows)
            if self.calibration is not None:
                calibration = self._calibrated(state, estimation, predictor, observation)
                seen = Ahead(ahead.feature, J, np.zeros_like(ahead.feature))
                seen = branch(
                    calibration.used,
                    self._believed,
                    seen,
                    calibration,
                    ahead.joint_position,
                    lead,
                    later[..., 0, :],
                )
                ahead = ahead.with_values(ahead.joint_position, seen.feature)
                J = seen.jacobian
                drift = seen.drift
                if not self._aids.feedforward:
                    # A law with a preview of its own sees the reference move against the drift.
                    periods = np.arange(self._rows)[:, None]
                    later = later - periods * drift[..., None, :]
        law, wanted = self._command(state, estimation, J, ahead, later)
        if not is_finite(wanted):
            raise ControllerDiverged(
                f"joint_velocity is not finite at {observation.time:.5g} s: {wanted.tolist()}, by the Jacobian "
                f"{J.tolist()}"
            )
        forward: FloatArray = np.zeros(())
        if self._aids.feedforward:
            forward = later[..., 1, :] - later[..., 0, :] - drift
        u, limited = self.finish.finish(wanted, J, ahead.joint_position, forward)
        u = self.law.restrained(law, wanted, u)
        pace = state.pace
        if pace is not None:
            pace, u, limited = self.finish.calm(pace, u, limited)
        law = self.law.noted(law, u, limited)
        if self.predictor is not None:
            predictor = self.predictor.note(predictor, u * self.knowledge.spec.period)
        new = ServoState(
            estimation, law, state.initial, predictor, state.ready, limited, calibration, pace
        )
        return Stepped(new, u)

    def _calibrated(
        self,
        state: ServoState,
        estimation: EstimationState,
        predictor: PredictorState,
        observation: Observation,
    ) -> CalibrationState:
        """Return the state of the calibrating stage at an observation."""
        pair = estimation.learned.pair
        due = np.equal(estimation.last.time, observation.time)
        regression = Regressed(
            feature=predictor.feature,
            jacobian=estimation.jacobian,
            delay=self.estimation.pairing.delay(pair) * self.knowledge.spec.period,
            deviation=pair.noise.deviation,
            moves=pair.regression.moves,
        )
        new: CalibrationState = self.calibration.update(
            state.calibration, observation, due, regression, pair.late
        )
        return new

    def _believed(
        self,
        _: Ahead,
        calibration: CalibrationState,
        bound: FloatArray,
        lead: FloatArray,
        target: FloatArray,
    ) -> Ahead:
        """Return the prediction of the calibrated arm in lanes where it is believed.

        Its Jacobian is that half-way to the target, (..., m): with it the error of a step grows with the cube of the
        way, with the present one with its square. Malis (ICRA 2004) takes the mean of both ends instead. A law that
        plans its way gains nothing from it and gets the present Jacobian.
        """
        ahead: Ahead = self.calibration.ahead(calibration, bound, lead)
        if "preview" in self.law.owns:
            return ahead
        inverse = damped_inverse(ahead.jacobian, self._aids.damping)
        half = 0.5 * np.matvec(inverse, target - ahead.feature)
        middle = bound + scale_to_limit(half, REACH)
        # On curves the target is near, and a second look at the arm would cost as much as the first one for nothing.
        far = norm(half) > NEAR
        return branch(far, self._half_way, ahead, calibration, middle, lead, target)

    def _half_way(
        self,
        ahead: Ahead,
        calibration: CalibrationState,
        middle: FloatArray,
        lead: FloatArray,
        target: FloatArray,
    ) -> Ahead:
        """Return a prediction with the Jacobian of other joint positions, (..., n), if they are nearer to the target.

        They are not where the target is out of reach: there only the present Jacobian leads to the nearest point.
        """
        there: Ahead = self.calibration.ahead(calibration, middle, lead)
        nearer = norm(target - there.feature) < REMAINDER * norm(target - ahead.feature)
        return ahead._replace(jacobian=where(nearer, there.jacobian, ahead.jacobian))

    def _command(
        self,
        state: ServoState,
        estimation: EstimationState,
        J: FloatArray,
        ahead: Observation,
        reference: FloatArray,
    ) -> tuple[Any, FloatArray]:
        """Return the law's new state and its joint velocity, (..., n), rad/s.

        A law that was trained on the nominal model works in its frame, into which features are rotated.
        """
        if self._turns:
            T = self.estimation.into_model_frame(estimation)
            J = T @ J
            reference = reference @ T.mT
            ahead = ahead.with_values(ahead.joint_position, np.vecmat(ahead.feature, T.mT))
        return self.law.command(state.law, Estimate(J), ahead, reference)

    def diagnostics(self, state: ServoState) -> Diagnostics:
        """Return the diagnostics of all stages, with `probing`, `saturated`, and `lead` [s] of the predict stage.

        `probing` is 1 while the initial Jacobian is being measured.
        """
        own: dict[str, Any] = {"probing": 1.0 - state.ready, "saturated": state.limited}
        if self.predictor is not None:
            own["lead"] = state.predictor.response.lead * self.knowledge.spec.period
        if self.calibration is not None:
            own.update(self.calibration.diagnostics(state.calibration))
        estimation = self.estimation.diagnostics(state.estimation)
        if not np.any(state.ready):
            return {**own, "jacobian_prediction_error": estimation["jacobian_prediction_error"]}
        return {**own, **estimation, **self.law.diagnostics(state.law)}


def _calibration(
    aids: AidsConfig, knowledge: RobotKnowledge, *, predicts: bool
) -> Calibration | None:
    """Return the calibrating stage, if an aid asks for it.

    Raises:
        ValueError: there is no model of the robot, or no stage that predicts.
    """
    if aids.model != "arm":
        return None
    if knowledge.nominal_model is None:
        raise ValueError(
            "aids.model: 'arm' needs the geometry of the robot, which is not known here"
        )
    if not predicts:
        raise ValueError("aids.model: 'arm' needs aids.response or aids.filter")
    return Calibration(knowledge, knowledge.nominal_model)


@final
class ServoController(Controller):
    """A `Servo` as a controller of one run, whose state it holds.

    Attributes:
        servo: the composition.
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
        """Return the diagnostics of the servo."""
        if self.state is None:
            return {}
        return self.servo.diagnostics(self.state)

    def estimated_jacobian(self) -> FloatArray | None:
        """Return the Jacobian (m, n) that the last step used, or None before there is one."""
        if self.state is None or np.isnan(self.state.jacobian).any():
            return None
        return self.servo.jacobian(self.state)

    def save(self) -> ServoState | None:
        """Return the state, a value that never changes."""
        return self.state

    def restore(self, state: object) -> None:
        """Go back to a state that `save` returned.

        Raises:
            TypeError: not such a state.
        """
        if not isinstance(state, self.servo.states):
            raise TypeError(f"state must come from save, got {type(state).__name__}")
        self.state = cast(ServoState, state)
