"""The lower bound: resolved-rate control by the Jacobian of the start, u = Ĵ₀⁺ K_p e."""

from __future__ import annotations

from dataclasses import dataclass, field

from servobench.controllers.composed import servo_entry

from servobench.controllers.estimators.constant import ConstantConfig
from servobench.controllers.initial import InitialConfig
from servobench.controllers.laws.pid import PidConfig


@dataclass(frozen=True)
class ConstantServoConfig:
    """Settings of `constant`."""

    estimator: ConstantConfig = field(default_factory=ConstantConfig)  # learns nothing
    law: PidConfig = field(default_factory=PidConfig)  # resolved rate
    initial: InitialConfig = field(default_factory=InitialConfig)  # where the first Jacobian comes from


ENTRY = servo_entry(
    "constant",
    "pseudo-inverse of the first Jacobian for ever: the lower bound",
    ConstantServoConfig,
    law="pid",
    estimator="constant",
)
