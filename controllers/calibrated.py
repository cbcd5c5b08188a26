"""The upper bound: resolved-rate control by the true Jacobian, u = J(q)⁺ (K_p e + ẏ_ref). It is told the truth."""

from __future__ import annotations

from dataclasses import dataclass, field

from servobench.controllers.composed import servo_entry

from servobench.controllers.estimators.true import TrueConfig
from servobench.controllers.initial import InitialConfig
from servobench.controllers.laws.pid import PidConfig


@dataclass(frozen=True)
class CalibratedConfig:
    """Settings of `calibrated`."""

    estimator: TrueConfig = field(default_factory=TrueConfig)  # is told the truth
    law: PidConfig = field(
        default_factory=lambda: PidConfig(feedforward=True)
    )  # resolved rate, with the reference's own velocity
    initial: InitialConfig = field(default_factory=InitialConfig)  # where the first Jacobian comes from


ENTRY = servo_entry(
    "calibrated",
    "pseudo-inverse of the true Jacobian, with feedforward: the upper bound",
    CalibratedConfig,
    law="pid",
    estimator="true",
)
