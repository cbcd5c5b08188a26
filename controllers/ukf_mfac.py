"""Method 2 of the paper: unscented Kalman filter for the Jacobian, model-free adaptive control (eq. 45)."""

from __future__ import annotations

from dataclasses import dataclass, field

from servobench.controllers.composed import servo_entry

from servobench.controllers.estimators.ukf import UkfConfig
from servobench.controllers.initial import InitialConfig
from servobench.controllers.laws.mfac import MfacConfig


@dataclass(frozen=True)
class UkfMfacConfig:
    """Settings of `ukf_mfac`."""

    estimator: UkfConfig = field(default_factory=UkfConfig)  # Jacobian filter
    law: MfacConfig = field(default_factory=MfacConfig)  # eq. 45
    initial: InitialConfig = field(default_factory=InitialConfig)  # where the first Jacobian comes from


ENTRY = servo_entry(
    "ukf_mfac",
    "unscented Kalman filter with model-free adaptive control (eq. 45)",
    UkfMfacConfig,
    law="mfac",
    estimator="ukf",
)
