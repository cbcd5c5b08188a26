"""Method 1 of the paper: a Jacobian network under a Lyapunov update, with the pseudo-inverse law (eqs. 40–43)."""

from __future__ import annotations

from dataclasses import dataclass, field

from controllers.controller import ControllerEntry, RobotKnowledge
from controllers.estimators.rbf_lyapunov import RbfLyapunovConfig, RbfLyapunovEstimator
from controllers.initial import InitialConfig, initial_jacobian
from controllers.laws.pid import PidConfig, PidLaw
from controllers.servo import ServoController
from controllers.training import obtain_networks
from controllers.training_config import TrainingConfig


@dataclass(frozen=True)
class RbfPidConfig:
    """Settings of `rbf_pid`; the same training as that of `rbfnn_mfac` gives the same Jacobian network."""

    estimator: RbfLyapunovConfig = field(default_factory=RbfLyapunovConfig)  # eq. 42
    law: PidConfig = field(default_factory=PidConfig)  # eq. 43
    training: TrainingConfig = field(default_factory=TrainingConfig)  # offline fit of the Jacobian network
    initial: InitialConfig = field(default_factory=InitialConfig)  # moves before the first step; its matrix is not used


def build(config: RbfPidConfig, knowledge: RobotKnowledge) -> ServoController:
    """Return the controller.

    Raises:
        ValueError: settings that do not fit the plant, or networks that cannot be had.
    """
    networks = obtain_networks(config.training, knowledge)
    return ServoController(
        RbfLyapunovEstimator(config.estimator, networks.jacobian),
        PidLaw(config.law, knowledge),
        initial_jacobian(config.initial, knowledge),
        knowledge,
    )


ENTRY = ControllerEntry(
    "rbf_pid",
    "Jacobian network under a Lyapunov update with the pseudo-inverse law (eqs. 40-43)",
    RbfPidConfig,
    build,
)
