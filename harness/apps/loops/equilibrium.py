"""A controller brought to rest and frozen there, as a linear system.

The state of a `Servo` is a tree of arrays. Its numbers are put in one vector x, so that a step is

    x₊ = f(x, w),   u = g(x, w),      w = (measured feature, measured joint positions, reference)

Only the subspace of x is kept that w reaches and u shows (Kalman's decomposition): shift registers, filters, integrals.
It is found by block Krylov steps with central differences along directions, so that the thousands of weights of a
network cost nothing. Truth values and whole numbers stay as they are.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias, final

import numpy as np

from servobench.controllers.controller import Controller
from servobench.controllers.servo import Servo, ServoController, ServoState
from servobench.controllers.stages.estimation import Estimation, EstimationState
from servobench.harness.apps.loops.systems import ArmModel, StateSpace
from servobench.harness.config.settings import flatten
from servobench.harness.run.experiment import build
from servobench.harness.run.loop import LoopSettings, begin, periods
from servobench.harness.run.resolution import ResolvedRun
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.lanes import map_arrays
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import JacobianFunction, Observation, trusted_observation
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import HandEyeModel

Source: TypeAlias = Literal["true", "nominal", "estimated"]
WARM_UP = 3.0  # [s] a move after any probing, in which aids identify delay, response and noise
SETTLING_PERIODS = 40  # rest after which histories and filters hold nothing else
PLANT = "kinematic"
TASK = "random"
# Settings of the plant that its linear model does not have
LEFT_OUT = (
    "sensing.jitter",
    "sensing.latency_swing",
    "mechanics.backlash",
    "mechanics.tool_frequency",
)
DIFFERENCE_STEP = 1e-6  # in the unit of each number: a micrometre, a microradian
RANK_TOLERANCE = 1e-6  # [1] a direction that is reached less than this counts as not reached

Linear = Callable[[FloatArray], FloatArray]


@final
class FrozenEstimation:
    """Pair and estimate stages that learn nothing more: a Jacobian of the joint positions, and the delay found so far.

    Attributes:
        pairing: the pair stage; None without one.
    """

    def __init__(self, estimation: Estimation, jacobian: JacobianFunction) -> None:
        """Take the stages, of which the pair stage goes on to remember joint positions, and the Jacobian."""
        self.pairing = estimation.pairing
        self._jacobian = jacobian
        # The frame in which the Jacobian was learned before
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
        q = observation.joint_position
        learned = state.learned
        jacobian, _ = self.ahead(state, q)
        if self.pairing is not None:
            learned = learned._replace(pair=self.pairing.advance(learned.pair, q, jacobian))
        return state._replace(learned=learned, jacobian=jacobian)


def frozen(servo: Servo, state: ServoState, jacobian: JacobianFunction) -> tuple[Servo, ServoState]:
    """Return a servo that identifies nothing more, with a given Jacobian, and its state.

    Of the past joint positions only those are kept that the present delay needs.
    """
    other = copy.copy(servo)
    other.estimation = FrozenEstimation(servo.estimation, jacobian)  # type: ignore[assignment]
    learned = state.estimation.learned._replace(estimator=None, anchor=None)  # they may be large
    pairing = servo.estimation.pairing
    if pairing is not None:
        pair = learned.pair
        window = 0
        if servo.predictor is not None:
            other.predictor = servo.predictor.frozen(float(pair.regression.share))
            window = servo.predictor.window
        rows = max(int(pairing.delay(pair)) + 4, window + 1)
        shorter = pair._replace(past=pair.past[:rows])
        learned = learned._replace(pair=shorter)
    estimation = state.estimation._replace(learned=learned)
    return other, state._replace(estimation=estimation)


@dataclass(frozen=True, eq=False)
class Rest:
    """An arm at rest."""

    joint_position: FloatArray  # (n,) [rad]
    feature: FloatArray  # (m,), the measured and the desired one
    time: float  # time of the next step [s]
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
        state: the servo's state at the rest, in which a step changes nothing that matters.
        rest: the rest.

    Returns:
        A system with the inputs (m + n + m,) and the outputs u, (n,) rad/s. All rows of the reference move together.
    """
    packing = Packing(state)
    m = len(rest.feature)
    n = len(rest.joint_position)

    def stepped(x: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return x₊ = f(x, w) and u = g(x, w), a row each."""
        feature = rest.feature + w[:, :m]
        joint_position = rest.joint_position + w[:, m : m + n]
        reference = rest.reference(rest.feature + w[:, m + n :])
        measured = rest.observation(feature, joint_position)
        new, u = servo.step(packing.unpack(x), measured, reference)
        return packing.pack(new, len(x)), u

    def differences(dx: FloatArray, dw: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of x₊ and u along directions, a row each."""
        # One call steps all runs side by side: first those in the directions, then those against them.
        size = len(dx)
        x = packing.centre + DIFFERENCE_STEP * np.vstack([dx, -dx])
        w = DIFFERENCE_STEP * np.vstack([dw, -dw])
        new, u = stepped(x, w)
        with np.errstate(invalid="ignore"):
            slope = (new[:size] - new[size:]) / (2.0 * DIFFERENCE_STEP)
            # A number that is infinite in the state, such as an unset one, does not move.
            slope = np.nan_to_num(slope, nan=0.0, posinf=0.0, neginf=0.0)
        return slope, (u[:size] - u[size:]) / (2.0 * DIFFERENCE_STEP)

    inputs = np.eye(2 * m + n)
    at_centre = np.zeros((len(inputs), len(packing.centre)))
    B, D = differences(at_centre, inputs)
    shown = []

    def forward(directions: FloatArray) -> FloatArray:
        """Return A times directions of x, (s, k), and note C times them."""
        no_input = np.zeros((directions.shape[1], len(inputs)))
        new, u = differences(directions.T, no_input)
        shown.append(u.T)
        return new.T

    basis, images = reached(forward, B.T)
    C = np.hstack([*shown, np.zeros((n, 0))])
    return observed(StateSpace(basis.T @ images, basis.T @ B.T, C, D.T))


def observed(system: StateSpace) -> StateSpace:
    """Return a system without the states that its outputs never show."""
    # What an output shows of (A, C) is what an input reaches of (Aᵀ, Cᵀ).
    basis, images = reached(lambda directions: system.A.T @ directions, system.C.T)
    return StateSpace(images.T @ basis, basis.T @ system.B, system.C @ basis, system.D)


def reached(image: Linear, first: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis V, (s, r), of the span of first, A first, A² first, …, and A V.

    Args:
        image: of directions (s, k) under A.
        first: (s, k).
    """
    basis = np.zeros((len(first), 0))
    images = np.zeros((len(first), 0))
    scale = max(1.0, float(np.abs(first).max(initial=0.0)))
    candidates = first
    while candidates.size:
        for _ in range(2):  # once more for the rounding of the first time
            candidates = candidates - basis @ (basis.T @ candidates)
        tall, small = np.linalg.qr(candidates)
        left, values, _ = np.linalg.svd(small)
        new = (tall @ left)[:, values > RANK_TOLERANCE * scale]
        if new.shape[1] == 0:
            break
        candidates = image(new)
        basis = np.hstack([basis, new])
        images = np.hstack([images, candidates])
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
            first = place
            place += array.size
            return x[:, first:place].reshape(len(x), *array.shape)

        return map_arrays(filled, self._state)

    def pack(self, state: ServoState, lanes: int) -> FloatArray:
        """Return the numbers of runs side by side, (lanes, s); with 0 lanes those of a single run, (1, s)."""
        rows = max(lanes, 1)
        parts = []

        def noted(array: Any) -> Any:  # noqa: ANN401 - an array of any kind
            if np.issubdtype(array.dtype, np.floating):
                shape = (lanes, *array.shape[1:]) if lanes else array.shape
                parts.append(np.broadcast_to(array, shape).reshape(rows, -1))
            return array

        map_arrays(noted, state)
        if not parts:
            return np.zeros((rows, 0))
        return np.hstack(parts)


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
    """Carry out the first seconds of a run on the kinematic plant, whose task is a move to a target at rest.

    Raises:
        ConfigurationError: a name or a setting that cannot be used.
        RunFault: the controller or the plant cannot go on.
    """
    experiment = build(resolved)
    plant = experiment.plant
    controller = experiment.controller
    run = experiment.run
    probing = 0  # [periods]
    if isinstance(controller, ServoController):
        probing = controller.servo.initial.duration
    length = LoopSettings(probing + run.periods(WARM_UP), run.preview_rows)
    desired = experiment.desired(length.periods)
    seed = resolved.request.seed
    rollout = begin(plant, controller, desired, length, (seed, seed))
    for _ in periods(rollout, controller):
        pass
    observation = rollout.observation
    truth = plant.truth()
    model = experiment.drawn.true
    if truth.jacobian is None or not isinstance(model, HandEyeModel):
        raise ConfigurationError(
            f"robot {resolved.request.robot}: a linear model is of {PLANT} before the bench's camera"
        )
    arm = arm_model(resolved.plant, truth.jacobian, run.period)
    rest = Rest(observation.joint_position, truth.feature, observation.time, run.preview_rows)
    nominal = find_robot(resolved.request.robot).nominal
    return Warm(controller, model, nominal, rest, arm, resolved.plant)


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
    controller = warm.controller
    rest = warm.rest
    if not isinstance(controller, ServoController) or controller.state is None:
        raise TypeError(
            f"controller must be a ServoController after its warm-up, got {type(controller).__name__}"
        )
    q = rest.joint_position
    jacobians = {
        "true": warm.arm.jacobian,
        "nominal": warm.nominal.jacobian(q),
        "estimated": controller.state.jacobian,
    }
    J = jacobians[source]
    servo, state = frozen(controller.servo, controller.state, lambda _: J)
    reference = rest.reference(rest.feature)
    period = warm.arm.period
    for k in range(SETTLING_PERIODS):
        observation = rest.observation(rest.feature, q, k * period)
        state, _ = servo.step(state, observation, reference)
    return servo, state, replace(rest, time=rest.time + SETTLING_PERIODS * period)
