"""A controller brought to rest and frozen there, as a linear system; and stability limits by simulation.

The state of a `Servo` is a tree of arrays. Its numbers are put in one vector x, so that a step is

    x₊ = f(x, w),   u = g(x, w),      w = (measured feature, measured joint positions, reference)

Only the subspace of x is kept that w reaches and u shows (Kalman's decomposition): shift registers, filters, integrals.
It is found by block Krylov steps with central differences along directions, so that the thousands of weights of a
network cost nothing. Truth values and whole numbers stay as they are.

The limits come from small motions of the kinematic plant without noise. Two runs from the same state differ by a small
offset of the reference; where a posture term moves the arm, both move. Neither the arm nor the controller is linear
here; only the motions are small.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias, final

import numpy as np

from servobench.controllers.controller import Controller, JacobianFunction
from servobench.controllers.servo import Servo, ServoController, ServoState
from servobench.controllers.stages.estimation import Estimation, EstimationState
from servobench.harness.analysis.loops.systems import ArmModel, StateSpace
from servobench.harness.config.settings import flatten
from servobench.harness.run.experiment import build
from servobench.harness.run.loop import LoopSettings, Rollout, begin, periods
from servobench.harness.run.request import find_robot
from servobench.harness.run.resolution import ResolvedRun
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.lanes import map_arrays
from servobench.plant.contract.sensing import without_disturbance
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import Command, Observation, trusted_observation
from servobench.plant.kinematic import KinematicConfig, build_kinematic
from servobench.plant.robot.hand_eye import HandEyeModel

Source: TypeAlias = Literal["true", "nominal", "estimated"]
WARM_UP = 3.0  # [s] of a move after any probing, in which aids identify delay, response and noise
SETTLING_PERIODS = 40  # of rest, after which histories and filters hold the rest only
PLANT = "kinematic"
TASK = "random"
OFFSET = 1e-4  # [m] of the desired feature in each axis, from which the motions begin
WINDOWS = 4  # of the run; a stable one has a smaller error in the last than in the second, and than at the begin
NEGLIGIBLE = 0.01  # [1] of the first error; rounding and slow learning may make a smaller one grow
DURATION = 20.0  # [s]
MAX_LATENCY = 3.0  # [s] largest latency that is tried
MAX_GAIN = 32.0  # largest factor that is tried
LEFT_OUT = (
    "sensing.jitter",
    "sensing.latency_swing",
    "mechanics.backlash",
    "mechanics.tool_frequency",
)
TIME_DIGITS = 9  # decimal places of a latency [s] that is tried
STEP = 1e-6  # of a difference, in the unit of each number: a micrometre, a microradian
RANK_TOLERANCE = 1e-6  # [1] a direction that is reached less than this counts as not reached
PRECISION = 0.02  # [1] of the limit of the gain

Linear = Callable[[FloatArray], FloatArray]


@final
class FrozenEstimation:
    """Pair and estimate stages that learn nothing more: a Jacobian of the joint positions, and the delay found so far.

    Attributes:
        pairing: the pair stage; None without one.
    """

    def __init__(self, estimation: Estimation, jacobian: JacobianFunction) -> None:
        """Take the stages, of which the pair stage goes on to remember joint positions, and the Jacobian."""
        self.pairing, self._jacobian = estimation.pairing, jacobian
        # of the Jacobian that was learned before
        self.into_model_frame = estimation.into_model_frame

    def ahead(
        self, state: EstimationState, joint_position: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the Jacobian at joint positions (..., n), twice; see `Estimation.ahead`."""
        jacobian = np.broadcast_to(self._jacobian(joint_position), state.jacobian.shape)
        return jacobian, jacobian

    def motion(
        self,
        state: EstimationState,
        begin: FloatArray,
        joint_step: FloatArray,
        predicted: FloatArray,
    ) -> FloatArray:
        """Return the motion of the feature, which is `predicted`."""
        del state, begin, joint_step
        return predicted

    def update(
        self, state: EstimationState, observation: Observation, desired: FloatArray
    ) -> EstimationState:
        """Return the state at an observation; see `Estimation.update`."""
        del desired
        q, learned = observation.joint_position, state.learned
        jacobian, _ = self.ahead(state, q)
        if self.pairing is not None:
            learned = learned._replace(pair=self.pairing.advance(learned.pair, q, jacobian))
        return state._replace(learned=learned, jacobian=jacobian)


def frozen(servo: Servo, state: ServoState, jacobian: JacobianFunction) -> tuple[Servo, ServoState]:
    """Return a servo that identifies nothing more, with a given Jacobian, and its state.

    Of the past joint positions only those are kept that the present delay needs.
    """
    other, pairing = copy.copy(servo), servo.estimation.pairing
    learned = state.estimation.learned._replace(estimator=None, anchor=None)  # they may be large
    other.estimation = FrozenEstimation(servo.estimation, jacobian)  # type: ignore[assignment]
    if pairing is not None:
        pair = learned.pair
        other.predictor = (
            None
            if servo.predictor is None
            else servo.predictor.frozen(float(pair.regression.share))
        )
        window = 0 if servo.predictor is None else servo.predictor.window
        rows = max(int(pairing.delay(pair)) + 4, window + 1)
        learned = learned._replace(pair=pair._replace(past=pair.past[:rows]))
    return other, state._replace(estimation=state.estimation._replace(learned=learned))


@dataclass(frozen=True, eq=False)
class Rest:
    """An arm at rest."""

    joint_position: FloatArray  # (n,) [rad]
    feature: FloatArray  # (m,), the measured and the desired one
    time: float  # of the next step [s]
    preview: int  # future rows of the reference

    def observation(
        self, feature: FloatArray, joint_position: FloatArray, after: float = 0.0
    ) -> Observation:
        """Return the observation of other values, (..., m) and (..., n), `after` [s] later."""
        seen = np.full(feature.shape, fill_value=True)
        valid: Any = seen.all(axis=-1)
        return trusted_observation(self.time + after, joint_position, feature, valid, seen)

    def reference(self, feature: FloatArray) -> FloatArray:
        """Return the constant reference (..., 1 + preview, m) at a desired feature, (..., m)."""
        return np.repeat(feature[..., None, :], 1 + self.preview, axis=-2)


def linearise(servo: Servo, state: ServoState, rest: Rest) -> StateSpace:
    """Return the controller's deviations from a rest: from feature, joint positions and reference to the command.

    Args:
        servo: of a single run.
        state: at the rest, in which a step changes nothing that matters.
        rest: where.

    Returns:
        A system with the inputs (m + n + m,) and the outputs u, (n,) rad/s. All rows of the reference move together.
    """
    packing = Packing(state)
    m, n = len(rest.feature), len(rest.joint_position)

    def stepped(x: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        measured = rest.observation(rest.feature + w[:, :m], rest.joint_position + w[:, m : m + n])
        new, u = servo.step(
            packing.unpack(x), measured, rest.reference(rest.feature + w[:, m + n :])
        )
        return packing.pack(new, len(x)), u

    def differences(dx: FloatArray, dw: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of x₊ and u along directions, a row each."""
        size = len(dx)
        x = packing.centre + STEP * np.vstack([dx, -dx])
        new, u = stepped(x, STEP * np.vstack([dw, -dw]))
        with np.errstate(invalid="ignore"):
            change = np.nan_to_num(
                (new[:size] - new[size:]) / (2.0 * STEP), nan=0.0, posinf=0.0, neginf=0.0
            )
        return change, (u[:size] - u[size:]) / (2.0 * STEP)

    inputs = np.eye(2 * m + n)
    B, D = differences(np.zeros((len(inputs), len(packing.centre))), inputs)
    shown = []

    def forward(directions: FloatArray) -> FloatArray:
        new, u = differences(directions.T, np.zeros((directions.shape[1], len(inputs))))
        shown.append(u.T)
        return new.T

    basis, images = reached(forward, B.T)
    C = np.hstack([*shown, np.zeros((n, 0))])
    return observed(StateSpace(basis.T @ images, basis.T @ B.T, C, D.T))


def observed(system: StateSpace) -> StateSpace:
    """Return a system without the states that its outputs never show."""
    basis, images = reached(lambda directions: system.A.T @ directions, system.C.T)
    return StateSpace(images.T @ basis, basis.T @ system.B, system.C @ basis, system.D)


def reached(image: Linear, first: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis V, (s, r), of the span of first, A first, A² first, …, and A V.

    Args:
        image: of directions (s, k) under A.
        first: (s, k).
    """
    basis, images = np.zeros((len(first), 0)), np.zeros((len(first), 0))
    candidates, scale = first, max(1.0, float(np.abs(first).max(initial=0.0)))
    while candidates.size:
        for _ in range(2):  # once more for the rounding of the first time
            candidates = candidates - basis @ (basis.T @ candidates)
        tall, small = np.linalg.qr(candidates)
        left, values, _ = np.linalg.svd(small)
        new = (tall @ left)[:, values > RANK_TOLERANCE * scale]
        if new.shape[1] == 0:
            break
        candidates = image(new)
        basis, images = np.hstack([basis, new]), np.hstack([images, candidates])
    return basis, images


class Packing:
    """The numbers of a state as a vector, and back."""

    def __init__(self, state: ServoState) -> None:
        """Take the state of a single run, around which directions are measured."""
        self._state = state
        self.centre = self.pack(state, 0)[0]

    def unpack(self, x: FloatArray) -> ServoState:
        """Return the states of runs side by side whose numbers are x, (lanes, s)."""
        place = 0

        def filled(array: Any) -> Any:  # noqa: ANN401 - an array of any kind
            nonlocal place
            if not np.issubdtype(array.dtype, np.floating):
                return np.broadcast_to(array, (len(x), *array.shape))
            begin, place = place, place + array.size
            return x[:, begin:place].reshape(len(x), *array.shape)

        return map_arrays(filled, self._state)

    def pack(self, state: ServoState, lanes: int) -> FloatArray:
        """Return the numbers of runs side by side, (lanes, s); with 0 lanes those of a single run, (1, s)."""
        parts = []

        def noted(array: Any) -> Any:  # noqa: ANN401 - an array of any kind
            if np.issubdtype(array.dtype, np.floating):
                lead = (lanes, *array.shape[1:]) if lanes else array.shape
                parts.append(np.broadcast_to(array, lead).reshape(max(lanes, 1), -1))
            return array

        map_arrays(noted, state)
        return np.hstack(parts) if parts else np.zeros((max(lanes, 1), 0))


@dataclass(frozen=True, eq=False)
class Warm:
    """A controller after its warm-up."""

    controller: Controller  # in the state that the move left
    model: HandEyeModel  # the true robot
    nominal: HandEyeModel  # the robot by its maker's description
    rest: Rest  # the place where it is now, as if the feature were wanted there
    arm: ArmModel  # linear model of arm and camera there
    plant: KinematicConfig  # settings of the plant


def warm_up(resolved: ResolvedRun) -> Warm:
    """Carry out the begin of a run on the kinematic plant, whose task is a move to a target at rest.

    Raises:
        ConfigurationError: a name or a setting that cannot be used.
        RunFault: the controller or the plant cannot go on.
    """
    experiment, seed = build(resolved), resolved.request.seed
    plant, controller, run = experiment.plant, experiment.controller, experiment.run
    probing = controller.servo.initial.duration if isinstance(controller, ServoController) else 0
    length = LoopSettings(probing + run.periods(WARM_UP), run.preview_rows)
    rollout = begin(plant, controller, experiment.desired(length.periods), length, (seed, seed))
    for _ in periods(rollout, controller):
        pass
    observation, truth, model = rollout.observation, plant.truth(), experiment.drawn.true
    if truth.jacobian is None or not isinstance(model, HandEyeModel):
        raise ValueError(f"plant must be {PLANT} for a linear model, got {resolved.request.plant}")
    arm = arm_model(resolved.plant, truth.jacobian, run.period)
    rest = Rest(observation.joint_position, truth.feature, observation.time, run.preview_rows)
    return Warm(
        controller, model, find_robot(resolved.request.robot).nominal, rest, arm, resolved.plant
    )


def arm_model(config: KinematicConfig, jacobian: FloatArray, period: float) -> ArmModel:
    """Return the linear model of the kinematic plant with these settings and a Jacobian (m, n).

    Frames that come less often than commands count as later by their mean additional age. A remark names settings that
    the model leaves out.

    Raises:
        ConfigurationError: joints that overshoot, which the model does not have.
    """
    if config.overshoot > 0.0:
        raise ConfigurationError(
            f"kinematic.overshoot must be 0 for a linear model, got {config.overshoot:g}"
        )
    age = max(config.sensing.frame_period - period, 0.0) / 2.0
    values = flatten(config)
    if out := [name for name in LEFT_OUT if values[name] > 0.0]:
        remark(
            f"the linear model leaves out {', '.join(out)}: margins and limits are those without"
        )
    return ArmModel(jacobian, period, config.lag, config.command_delay, config.sensing.latency, age)


def at_rest(warm: Warm, source: Source) -> tuple[Servo, ServoState, Rest]:
    """Return a composed controller frozen at its rest: the servo with a frozen estimator, its state, and the rest.

    Args:
        warm: with a `ServoController`.
        source: the Jacobian at which the estimator is frozen: the true one, the nominal one, or the estimated one.

    Raises:
        TypeError: a controller that is not composed.
    """
    controller, rest = warm.controller, warm.rest
    if not isinstance(controller, ServoController) or controller.state is None:
        raise TypeError(
            f"controller must be a ServoController after its warm-up, got {type(controller).__name__}"
        )
    state, q = controller.state, rest.joint_position
    J = {
        "true": warm.arm.jacobian,
        "nominal": warm.nominal.jacobian(q),
        "estimated": state.jacobian,
    }[source]
    servo, state = frozen(controller.servo, state, lambda _: J)
    reference = rest.reference(rest.feature)
    period = warm.arm.period
    for k in range(SETTLING_PERIODS):
        state, _ = servo.step(state, rest.observation(rest.feature, q, k * period), reference)
    return servo, state, replace(rest, time=rest.time + SETTLING_PERIODS * period)


class SmallLoop:
    """A composed controller, frozen at its rest, on the kinematic plant without noise."""

    def __init__(self, warm: Warm) -> None:
        """Freeze a composed controller, whose estimator returns the true Jacobian at every posture.

        Noise and lost frames of the plant are left out.
        """
        servo, state, self._rest = at_rest(warm, "true")
        self._servo, self._state = frozen(servo, state, warm.model.jacobian)
        self._warm, self._period, self.latency = warm, warm.arm.period, warm.plant.sensing.latency

    def is_stable(self, factor: float = 1.0, latency: float | None = None) -> bool:
        """Return whether small motions die out with a factor on the command and another latency of the camera [s]."""
        moved, rested = (self._features(factor, latency, offset) for offset in (OFFSET, 0.0))
        errors = np.linalg.norm(moved - rested - OFFSET, axis=-1)
        length = len(errors) // WINDOWS
        last = errors[-length:].max()
        gone = last < NEGLIGIBLE * errors[0]
        return bool(gone or last < min(errors[length : 2 * length].max(), errors[0]))

    def latency_limit(self) -> float:
        """Return the largest latency, in whole periods more than that of the plant, before one that is unstable [s]."""
        latency = self.latency
        if not self.is_stable():
            return 0.0
        while latency < MAX_LATENCY and self.is_stable(latency=latency + self._period):
            latency += self._period
        return latency

    def gain_limit(self) -> float:
        """Return the factor on the command above which the loop is unstable, up to `MAX_GAIN`."""
        stable, unstable = 1.0 / MAX_GAIN, MAX_GAIN
        while unstable / stable > 1.0 + PRECISION:
            middle = float(np.sqrt(stable * unstable))
            stable, unstable = (middle, unstable) if self.is_stable(middle) else (stable, middle)
        return float(np.sqrt(stable * unstable))

    def _features(self, factor: float, latency: float | None, offset: float) -> FloatArray:
        """Return the true feature in each period, (periods, m), with the desired one moved by an offset [m]."""
        rest, late = self._rest, self.latency if latency is None else latency
        sensing = replace(
            without_disturbance(self._warm.plant.sensing), latency=round(late, TIME_DIGITS)
        )
        setup = PlantSetup(self._warm.model, rest.joint_position, self._period)
        plant = build_kinematic(replace(self._warm.plant, sensing=sensing), setup)
        count = round(DURATION / self._period)
        desired = np.broadcast_to(
            rest.feature + offset, (count + 1 + rest.preview, len(rest.feature))
        )
        controller = _FrozenController(self._servo, self._state, rest, factor)
        rollout = Rollout(plant, plant.reset(0), desired, LoopSettings(count + 1, rest.preview))
        features = np.array([period.truth.feature for period in periods(rollout, controller)])
        plant.close()
        return features[1:]


@final
class _FrozenController(Controller):
    """A frozen servo after its rest, whose command is multiplied by a factor."""

    def __init__(self, servo: Servo, state: ServoState, rest: Rest, factor: float) -> None:
        self._servo, self._state, self._rest, self._factor = servo, state, rest, factor

    def reset(self, observation: Observation, seed: int) -> None:
        """Keep the state of the rest."""

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """See `Controller.step`."""
        measured = self._rest.observation(
            observation.feature, observation.joint_position, observation.time
        )
        self._state, u = self._servo.step(self._state, measured, reference)
        return Command(self._factor * u)
