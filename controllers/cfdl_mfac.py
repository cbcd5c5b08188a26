"""Compact-form model-free adaptive control after Hou and Jin: both halves as in their method."""

from __future__ import annotations

from dataclasses import dataclass, field

from servobench.controllers.composed import servo_entry

from servobench.controllers.estimators.cfdl import CfdlConfig
from servobench.controllers.initial import InitialConfig
from servobench.controllers.laws.mfac import MfacConfig


@dataclass(frozen=True)
class CfdlMfacConfig:
    """Settings of `cfdl_mfac`."""

    estimator: CfdlConfig = field(default_factory=CfdlConfig)  # pseudo-Jacobian matrix
    law: MfacConfig = field(default_factory=MfacConfig)  # eq. 45
    initial: InitialConfig = field(default_factory=InitialConfig)  # where the first Jacobian comes from


ENTRY = servo_entry(
    "cfdl_mfac",
    "compact-form model-free adaptive control of Hou and Jin",
    CfdlMfacConfig,
    law="mfac",
    estimator="cfdl",
)
