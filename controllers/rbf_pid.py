"""Method 1 of the paper: a Jacobian network under a Lyapunov update, with the pseudo-inverse law (eqs. 40–43)."""

from __future__ import annotations

from dataclasses import dataclass, field

from servobench.controllers.composed import servo_entry

from servobench.controllers.estimators.rbf_lyapunov import RbfLyapunovConfig
from servobench.controllers.initial import InitialConfig
from servobench.controllers.laws.pid import PidConfig
from servobench.controllers.networks.config import TrainingConfig


@dataclass(frozen=True)
class RbfPidConfig:
    """Settings of `rbf_pid`; the same training as that of `rbfnn_mfac` gives the same Jacobian network."""

    estimator: RbfLyapunovConfig = field(default_factory=RbfLyapunovConfig)  # eq. 42
    law: PidConfig = field(default_factory=PidConfig)  # eq. 43
    training: TrainingConfig = field(default_factory=TrainingConfig)  # offline fit of the Jacobian network
    initial: InitialConfig = field(default_factory=InitialConfig)  # moves before the first step; its matrix is not used


ENTRY = servo_entry(
    "rbf_pid",
    "Jacobian network under a Lyapunov update with the pseudo-inverse law (eqs. 40-43)",
    RbfPidConfig,
    law="pid",
    estimator="rbf_lyapunov",
)
