"""Method 2 with the Kalman filter that its unscented filter is equal to: the same commands for less time."""

from __future__ import annotations

from dataclasses import dataclass, field

from servobench.controllers.composed import servo_entry

from servobench.controllers.estimators.kalman import KalmanConfig
from servobench.controllers.initial import InitialConfig
from servobench.controllers.laws.mfac import MfacConfig


@dataclass(frozen=True)
class KalmanMfacConfig:
    """Settings of `kalman_mfac`."""

    estimator: KalmanConfig = field(default_factory=KalmanConfig)  # Jacobian filter
    law: MfacConfig = field(default_factory=MfacConfig)  # eq. 45
    initial: InitialConfig = field(default_factory=InitialConfig)  # where the first Jacobian comes from


ENTRY = servo_entry(
    "kalman_mfac",
    "Kalman filter with model-free adaptive control: equals ukf_mfac, faster",
    KalmanMfacConfig,
    law="mfac",
    estimator="kalman",
)
