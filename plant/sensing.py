"""The settings of the path from the true feature to the observation, which all plants share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

from servobench.plant.settings import NonNegative, ShareBelowOne, settings

Config = TypeVar("Config")


@settings
class SensingConfig:
    """Settings of the path from the true feature to the observation."""

    feature_noise: NonNegative = 0.001
    """[unit of the feature] standard deviation of the white noise of each component."""
    latency: NonNegative = 0.0
    """[s] between exposure and delivery of a frame; a multiple of the control period, or whole milliseconds."""
    drop_probability: ShareBelowOne = 0.0
    """[1] chance that a frame is lost, independently of the others."""
    noise_factor: NonNegative = 1.0
    """[1] factor on all noise of the sensor, for studies of noise."""
    frame_period: NonNegative = 0.0
    """[s] between two frames, from the start of the run on; 0: a frame arrives at every control instant."""

    RENAMED: ClassVar[Mapping[str, str]] = {"latency_periods": "latency, in seconds (a period of 20 Hz is 0.05)"}


def can_vary_sensing(config: object) -> bool:
    """Return whether a plant with these settings has a nested section `sensing`."""
    return isinstance(getattr(config, "sensing", None), SensingConfig)


def vary_sensing(config: Config, noise_factor: float, latency: float | None) -> Config:
    """Return a plant's settings with noise multiplied by a factor and, unless it is None, another latency [s].

    Raises:
        ValueError: the plant has no section `sensing`, or a number is out of its bounds.
    """
    if not can_vary_sensing(config):
        raise ValueError("its noise and latency cannot be varied")
    values: Any = config
    sensing = values.sensing
    changed: Config = replace(
        values,
        sensing=replace(
            sensing,
            noise_factor=noise_factor * sensing.noise_factor,
            latency=sensing.latency if latency is None else latency,
        ),
    )
    return changed
