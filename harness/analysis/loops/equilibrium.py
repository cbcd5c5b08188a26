"""A controller brought to rest: warmed up by a move, then frozen where it arrived; and stability limits by simulation.

The limits come from small motions of the kinematic plant without noise. Two runs from the same state differ by a small
offset of the reference; where a posture term moves the arm, both move. Neither the arm nor the controller is linear
here; only the motions are small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, final

import numpy as np

from servobench.controllers.controller import Controller
from servobench.controllers.servo import Servo, ServoController, ServoState
from servobench.harness.analysis.loops.linearisation import Rest, frozen, linearise
from servobench.harness.analysis.loops.systems import ArmModel, StateSpace
from servobench.harness.config.robots import find_robot
from servobench.harness.run.experiment import build
from servobench.harness.run.loop import LoopSettings, Rollout, begin, periods
from servobench.harness.run.resolution import ResolvedRun
from servobench.plant.bench.plant import Plant, PlantSetup
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.sensing import without_disturbance
from servobench.plant.contract.signals import Command, Observation
from servobench.plant.kinematic import KinematicConfig, build_kinematic
from servobench.plant.robot.hand_eye import HandEyeModel

Source: TypeAlias = Literal["true", "nominal", "estimated"]
SOURCES: tuple[Source, ...] = ("true", "nominal", "estimated")
WARM_UP = 3.0  # [s] of a move, in which aids identify delay, response and noise
SETTLING_PERIODS = 40  # of rest, after which histories and filters hold the rest only
PLANT = "kinematic"
TASK = "random"
OFFSET = 1e-4  # [m] of the desired feature in each axis, from which the motions begin
WINDOWS = 4  # of the run; a stable one has a smaller error in the last than in the second, and than at the begin
NEGLIGIBLE = 0.01  # [1] of the first error; rounding and slow learning may make a smaller one grow
DURATION = 20.0  # [s]
MAX_LATENCY = 3.0  # [s] largest latency that is tried
MAX_GAIN = 32.0  # largest factor that is tried
TIME_DIGITS = 3  # of a latency [s], as worlds advance in whole milliseconds
PRECISION = 0.02  # [1] of the limit of the gain


@dataclass(frozen=True, eq=False)
class Warm:
    """A controller after its warm-up.

    Attributes:
        controller: in the state that the move left.
        model: the true robot.
        nominal: the robot by its maker's description.
        rest: the place where it is now, as if the feature were wanted there.
        arm: linear model of arm and camera there.
    """

    controller: Controller
    model: HandEyeModel
    nominal: HandEyeModel
    rest: Rest
    arm: ArmModel


def warm_up(resolved: ResolvedRun, duration: float = WARM_UP) -> Warm:
    """Carry out the begin of a run on the kinematic plant.

    Args:
        resolved: the run; its task is a move to a target at rest.
        duration: of the warm-up [s].

    Raises:
        ConfigurationError: a name or a setting that cannot be used.
        RunFault: the controller or the plant cannot go on.
    """
    experiment, seed = build(resolved), resolved.request.seed
    plant, controller, run = experiment.plant, experiment.controller, experiment.run
    length = LoopSettings(run.periods(duration), run.preview_rows)
    rollout = begin(plant, controller, experiment.desired(length.periods), length, (seed, seed))
    for _ in periods(rollout, controller):
        pass
    observation, truth, model = rollout.observation, plant.truth(), experiment.drawn.true
    if truth.jacobian is None or not isinstance(model, HandEyeModel):
        raise ValueError(f"plant must be {PLANT} for a linear model, got {resolved.request.plant}")
    arm = arm_model(resolved.plant, truth.jacobian, run.period)
    rest = Rest(observation.joint_position, truth.feature, observation.time, run.preview_rows)
    return Warm(controller, model, find_robot(resolved.request.robot).nominal, rest, arm)


def arm_model(config: KinematicConfig, jacobian: FloatArray, period: float) -> ArmModel:
    """Return the linear model of the kinematic plant with these settings and a Jacobian (m, n).

    Frames that come less often than commands count as later by their mean additional age.
    """
    age = max(config.sensing.frame_period - period, 0.0) / 2.0
    return ArmModel(jacobian, period, config.lag, config.command_delay, config.sensing.latency + age)


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
        raise TypeError(f"controller must be a ServoController after its warm-up, got {type(controller).__name__}")
    state, q = controller.state, rest.joint_position
    J = {"true": warm.arm.jacobian, "nominal": warm.nominal.jacobian(q), "estimated": state.jacobian}[source]
    servo, state = frozen(controller.servo, state, lambda _: J)
    reference = rest.reference(rest.feature)
    period = warm.arm.period
    for k in range(SETTLING_PERIODS):
        state, _ = servo.step(state, rest.observation(rest.feature, q, k * period), reference)
    return servo, state, replace(rest, time=rest.time + SETTLING_PERIODS * period)


def linear_controller(warm: Warm, source: Source) -> StateSpace:
    """Return a composed controller around its rest as a linear system; see `at_rest` and `linearise`."""
    return linearise(*at_rest(warm, source))


class SmallLoop:
    """A composed controller, frozen at its rest, on the kinematic plant without noise."""

    def __init__(self, warm: Warm, model: HandEyeModel, config: KinematicConfig) -> None:
        """Freeze the controller, whose estimator returns the true Jacobian at every posture.

        Args:
            warm: the composed controller after its warm-up.
            model: the true robot.
            config: of the plant; its noise and lost frames are left out.
        """
        servo, state, self._rest = at_rest(warm, "true")
        self._servo, self._state = frozen(servo, state, model.jacobian)
        self._model, self._config, self._period = model, config, warm.arm.period
        self.latency = config.sensing.latency

    def is_stable(self, factor: float = 1.0, latency: float | None = None) -> bool:
        """Return whether small motions die out.

        Args:
            factor: on the command.
            latency: of the camera [s]; None for that of the plant's settings.
        """
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

    def _plant(self, latency: float | None) -> Plant:
        late = self.latency if latency is None else latency
        sensing = replace(without_disturbance(self._config.sensing), latency=round(late, TIME_DIGITS))
        setup = PlantSetup(self._model, self._rest.joint_position, self._period)
        return build_kinematic(replace(self._config, sensing=sensing), setup)

    def _features(self, factor: float, latency: float | None, offset: float) -> FloatArray:
        """Return the true feature in each period, (periods, m), with the desired one moved by an offset [m]."""
        plant, rest = self._plant(latency), self._rest
        count = round(DURATION / self._period)
        desired = np.broadcast_to(rest.feature + offset, (count + 1 + rest.preview, len(rest.feature)))
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
        measured = self._rest.observation(observation.feature, observation.joint_position, observation.time)
        self._state, u = self._servo.step(self._state, measured, reference)
        return Command(self._factor * u)
