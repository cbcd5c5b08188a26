"""A controller brought to rest: warmed up by a move of the arm, then frozen where it arrived."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from servobench.controllers.controller import Controller
from servobench.controllers.servo import Servo, ServoController, ServoState
from servobench.harness.analysis.loops.arm import ArmModel
from servobench.harness.analysis.loops.linearise import Rest, frozen, linearise
from servobench.harness.analysis.loops.matrices import StateSpace
from servobench.harness.config.robots import find_robot
from servobench.harness.run.experiment import Experiment, build
from servobench.harness.run.resolved import ResolvedRun
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import Observation
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.hand_eye import HandEyeModel

Source: TypeAlias = Literal["true", "nominal", "estimated"]
SOURCES: tuple[Source, ...] = ("true", "nominal", "estimated")
WARM_UP = 3.0  # [s] of a move, in which aids identify delay, response and noise
SETTLING_PERIODS = 40  # of rest, after which histories and filters hold the rest only
PLANT = "kinematic"
TASK = "random"


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
    experiment = build(resolved)
    plant, controller, run = experiment.plant, experiment.controller, experiment.run
    observation = _run(experiment, run.periods(duration), resolved.request.seed)
    truth, model = plant.truth(), experiment.drawn.true
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


def _run(experiment: Experiment, periods: int, seed: int) -> Observation:
    plant, controller, preview = experiment.plant, experiment.controller, experiment.run.preview_rows
    desired = experiment.scenario.reference.sampled(plant.spec.period, periods + preview + 1)
    observation = plant.reset(seed)
    controller.reset(observation, seed)
    for k in range(periods):
        observation = plant.step(controller.step(observation, desired[k : k + 1 + preview]))
    return observation


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
