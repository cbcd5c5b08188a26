"""Settings of what lies around an FMU: delay of commands, noise, latency and gaps of the feature."""

from __future__ import annotations

from dataclasses import dataclass

from servobench.plant.checks import check_number


@dataclass(frozen=True)
class FmuConfig:
    """Settings of an FMU plant; the same as those of the kinematic plant where both have them."""

    command_delay_periods: int = 1  # periods between a command and its first effect
    feature_noise: float = 0.001  # in the feature's unit (m), standard deviation an axis
    latency_periods: int = 0  # periods between exposure and delivery of the feature
    drop_probability: float = 0.0  # chance that a frame is lost

    def __post_init__(self) -> None:
        """Check the numbers that no part below checks."""
        check_number("command_delay_periods", self.command_delay_periods, at_least=0)
        check_number("feature_noise", self.feature_noise, at_least=0.0)
