"""Broyden's rank-one update of the Jacobian with resolved-rate control, the classic of uncalibrated servoing."""

from __future__ import annotations

from dataclasses import dataclass, field

from servobench.controllers.composed import servo_entry
from servobench.controllers.estimators.broyden import BroydenConfig
from servobench.controllers.initial import InitialConfig
from servobench.controllers.laws.pid import PidConfig


@dataclass(frozen=True)
class BroydenServoConfig:
    """Settings of `broyden`."""

    estimator: BroydenConfig = field(default_factory=BroydenConfig)  # rank-one update
    law: PidConfig = field(default_factory=PidConfig)  # resolved rate
    initial: InitialConfig = field(default_factory=InitialConfig)  # where the first Jacobian comes from


ENTRY = servo_entry(
    "broyden",
    "Broyden's rank-one update with the pseudo-inverse law",
    BroydenServoConfig,
    law="pid",
    estimator="broyden",
)
