"""Method 5, the proposed one: a Jacobian network and a controller network, both trained offline and learning online."""

from __future__ import annotations

from dataclasses import dataclass, field

from controllers.controller import ControllerEntry, RobotKnowledge
from controllers.estimators.rbf import RbfConfig, RbfEstimator
from controllers.initial import InitialConfig, initial_jacobian
from controllers.laws.rbfnn import RbfnnConfig, RbfnnLaw
from controllers.servo import ServoController
from controllers.training import obtain_networks
from controllers.training_config import TrainingConfig


@dataclass(frozen=True)
class RbfnnMfacConfig:
    """Settings of `rbfnn_mfac`."""

    estimator: RbfConfig = field(default_factory=RbfConfig)  # eqs. 28–39
    law: RbfnnConfig = field(default_factory=RbfnnConfig)  # eqs. 7–27
    training: TrainingConfig = field(default_factory=TrainingConfig)  # offline fits of both networks
    initial: InitialConfig = field(default_factory=InitialConfig)  # moves before the first step; its matrix is not used


def build(config: RbfnnMfacConfig, knowledge: RobotKnowledge) -> ServoController:
    """Return the proposed controller.

    Raises:
        ValueError: settings that do not fit the plant, or networks that cannot be had.
    """
    networks = obtain_networks(config.training, knowledge)
    return ServoController(
        RbfEstimator(config.estimator, networks.jacobian),
        RbfnnLaw(config.law, networks.controller, knowledge),
        initial_jacobian(config.initial, knowledge),
        knowledge,
    )


ENTRY = ControllerEntry(
    "rbfnn_mfac",
    "the proposed method: a controller network and a Jacobian network that learn online (eqs. 7-39)",
    RbfnnMfacConfig,
    build,
)
