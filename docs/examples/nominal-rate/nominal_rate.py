"""Two controllers of my own: a law by the nominal model, and an estimator that leans on it."""

from dataclasses import dataclass

import numpy as np

from servobench.controllers.controller import (
    Controller,
    ControllerEntry,
    Diagnostics,
    RobotKnowledge,
)
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.initial_jacobian import InitialConfig, initial_jacobian
from servobench.controllers.laws.pid import PidConfig, PidLaw
from servobench.controllers.servo import Servo, ServoController
from servobench.controllers.stages.finish import scale_to_limit
from servobench.plant.contract.checks import FloatArray, check_number
from servobench.plant.contract.lanes import branch, norm, outer
from servobench.plant.contract.signals import Command, Observation


@dataclass(frozen=True)
class NominalRateConfig:
    """Settings; every field needs a default. They are set by --set nominal_rate.gain=3.0 or in a TOML file."""

    gain: float = 2.0  # K_p, 1/s
    damping: float = 0.02  # δ, m/rad

    def __post_init__(self) -> None:
        check_number("gain", self.gain, above=0.0)
        check_number("damping", self.damping, above=0.0)


class NominalRate(Controller):
    """u = Jᵀ (J Jᵀ + δ² I)⁻¹ K_p e with J of the nominal model at the present joints."""

    def __init__(self, config: NominalRateConfig, knowledge: RobotKnowledge) -> None:
        if knowledge.nominal_jacobian is None:  # a ValueError here is one clear line for the user
            raise ValueError("nominal_rate needs a nominal model, and this plant has none")
        self._config = config
        self._model = knowledge.nominal_jacobian
        self._limit = knowledge.spec.joint_velocity_limit
        self._jacobian: FloatArray | None = None

    def reset(self, observation: Observation, seed: int) -> None:
        self._jacobian = None

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        e = reference[0] - observation.feature  # row 0 is now, the rest is the preview
        J = self._jacobian = self._model(observation.joint_position)
        v = self._config.gain * e
        u = J.T @ np.linalg.solve(J @ J.T + self._config.damping**2 * np.eye(len(e)), v)
        return Command(scale_to_limit(u, self._limit))

    def diagnostics(self) -> Diagnostics:
        return {}  # names and numbers for the log

    def estimated_jacobian(self) -> FloatArray | None:
        return self._jacobian  # optional; the log compares it with the true one


ENTRY = ControllerEntry(
    "nominal_rate", "resolved rate by the nominal Jacobian", NominalRateConfig, NominalRate
)


@dataclass(frozen=True)
class NominalBroydenConfig:
    """Settings of a pair: own ones, and those of the parts that are reused."""

    step_factor: float = 0.2  # η
    law: PidConfig = PidConfig()
    initial: InitialConfig = InitialConfig()


class NominalBroyden(Estimator[FloatArray]):
    """Ĵ(q) = J_nominal(q) + E, with Broyden's update of the correction E alone."""

    def __init__(self, step_factor: float, knowledge: RobotKnowledge) -> None:
        if knowledge.nominal_jacobian is None:
            raise ValueError("nominal_broyden needs a nominal model, and this plant has none")
        self._step_factor, self._model = step_factor, knowledge.nominal_jacobian

    def start(self, jacobian: FloatArray) -> FloatArray:
        return np.zeros_like(jacobian)  # the state: E, (..., m, n)

    def update(self, E: FloatArray, motion: Motion) -> FloatArray:
        return branch(norm(motion.joint_step) > 0.01, self._correct, E, motion)

    def _correct(self, E: FloatArray, motion: Motion) -> FloatArray:
        dq = motion.joint_step
        misfit = motion.feature_step - np.matvec(self.jacobian(E, motion.joint_position), dq)
        return E + self._step_factor * outer(misfit, dq / np.vecdot(dq, dq)[..., None])

    def jacobian(self, E: FloatArray, joint_position: FloatArray) -> FloatArray:
        return self._model(joint_position) + E

    def diagnostics(self, E: FloatArray) -> Diagnostics:
        return {"correction_norm": norm(E.reshape(*E.shape[:-2], -1))}


def build_broyden(config: NominalBroydenConfig, knowledge: RobotKnowledge) -> ServoController:
    """Compose the estimator with a law and a provider of the initial Jacobian."""
    estimator, law = NominalBroyden(config.step_factor, knowledge), PidLaw(config.law, knowledge)
    return ServoController(
        Servo(estimator, law, initial_jacobian(config.initial, knowledge), knowledge)
    )


BROYDEN_ENTRY = ControllerEntry(
    "nominal_broyden",
    "Broyden around the model",
    NominalBroydenConfig,
    build_broyden,
    side_by_side=True,
)
