"""Method 3 of the paper: unscented Kalman filter for the Jacobian, model predictive control (eq. 46)."""

from __future__ import annotations

from dataclasses import dataclass, field

from servobench.controllers.composed import servo_entry

from servobench.controllers.estimators.ukf import UkfConfig
from servobench.controllers.initial import InitialConfig
from servobench.controllers.laws.mpc.mpc import MpcConfig


@dataclass(frozen=True)
class UkfMpcConfig:
    """Settings of `ukf_mpc`."""

    estimator: UkfConfig = field(default_factory=UkfConfig)  # Jacobian filter
    law: MpcConfig = field(default_factory=MpcConfig)  # eq. 46 with limits and preview
    initial: InitialConfig = field(default_factory=InitialConfig)  # where the first Jacobian comes from


ENTRY = servo_entry(
    "ukf_mpc",
    "unscented Kalman filter with model predictive control (eq. 46)",
    UkfMpcConfig,
    law="mpc",
    estimator="ukf",
)
