"""Better than the paper: its networks behind an estimated map and delay, and a law that is predicted past all delays.

What is added to `rbfnn_mfac`, each with a switch, and why it works is told in docs/methods.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from servobench.controllers.composed import servo_entry

from servobench.controllers.estimators.rbf_aligned import RbfAlignedConfig
from servobench.controllers.initial import InitialConfig
from servobench.controllers.laws.rbfnn_bridged import RbfnnBridgedConfig
from servobench.controllers.networks.config import TrainingConfig


@dataclass(frozen=True)
class RbfnnMfacPlusConfig:
    """Settings of `rbfnn_mfac_plus`."""

    estimator: RbfAlignedConfig = field(default_factory=RbfAlignedConfig)  # network, map and delay
    law: RbfnnBridgedConfig = field(default_factory=RbfnnBridgedConfig)  # prediction and learned correction
    training: TrainingConfig = field(default_factory=TrainingConfig)  # offline fits of both networks
    initial: InitialConfig = field(default_factory=InitialConfig)  # moves before the first step; its matrix is not used


ENTRY = servo_entry(
    "rbfnn_mfac_plus",
    "the proposed method with an estimated camera map and delay, prediction past all delays and a faster law",
    RbfnnMfacPlusConfig,
    law="rbfnn_bridged",
    estimator="rbf_aligned",
)
