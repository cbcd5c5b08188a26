"""Method 5, the proposed one: a Jacobian network and a controller network, both trained offline and learning online."""

from __future__ import annotations

from dataclasses import dataclass, field

from servobench.controllers.composed import servo_entry

from servobench.controllers.estimators.rbf import RbfConfig
from servobench.controllers.initial import InitialConfig
from servobench.controllers.laws.rbfnn import RbfnnConfig
from servobench.controllers.networks.config import TrainingConfig


@dataclass(frozen=True)
class RbfnnMfacConfig:
    """Settings of `rbfnn_mfac`."""

    estimator: RbfConfig = field(default_factory=RbfConfig)  # eqs. 28–39
    law: RbfnnConfig = field(default_factory=RbfnnConfig)  # eqs. 7–27
    training: TrainingConfig = field(default_factory=TrainingConfig)  # offline fits of both networks
    initial: InitialConfig = field(default_factory=InitialConfig)  # moves before the first step; its matrix is not used


ENTRY = servo_entry(
    "rbfnn_mfac",
    "the proposed method: a controller network and a Jacobian network that learn online (eqs. 7-39)",
    RbfnnMfacConfig,
    law="rbfnn",
    estimator="rbf",
)
