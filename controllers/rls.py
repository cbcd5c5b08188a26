"""Recursive least squares with forgetting for the Jacobian, with resolved-rate control."""

from __future__ import annotations

from dataclasses import dataclass, field

from servobench.controllers.composed import servo_entry

from servobench.controllers.estimators.rls import RlsConfig
from servobench.controllers.initial import InitialConfig
from servobench.controllers.laws.pid import PidConfig


@dataclass(frozen=True)
class RlsServoConfig:
    """Settings of `rls`."""

    estimator: RlsConfig = field(default_factory=RlsConfig)  # least squares with forgetting
    law: PidConfig = field(default_factory=PidConfig)  # resolved rate
    initial: InitialConfig = field(default_factory=InitialConfig)  # where the first Jacobian comes from


ENTRY = servo_entry(
    "rls",
    "recursive least squares with forgetting, with the pseudo-inverse law",
    RlsServoConfig,
    law="pid",
    estimator="rls",
)
