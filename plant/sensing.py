"""The settings of the path from the true feature to the observation, which all plants share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, TypeAlias, TypeVar

from annotated_types import Ge, Le

from servobench.plant.settings import NonNegative, Number, Positive, Share, ShareBelowOne, settings

Config = TypeVar("Config")
Family: TypeAlias = Literal["white", "mixture", "bimodal", "stable", "uniform"]
"""A family of noise, as `servobench.plant.noise.families` defines them."""
Stability: TypeAlias = Annotated[float, Ge(0.5), Le(2.0)]
"""Exponent α of a stable distribution; below 0.5 its numbers tell nothing."""
Skewness: TypeAlias = Annotated[float, Ge(-1.0), Le(1.0)]
"""From −1 to 1."""


@settings
class SensingConfig:
    """Settings of the path from the true feature to the observation."""

    feature_noise: NonNegative = 0.001
    """[m] standard deviation σ of the noise of each component; of pixels, what it is in the planned image."""
    latency: NonNegative = 0.0
    """[s] between exposure and delivery of a frame; a multiple of the control period, or whole milliseconds."""
    drop_probability: ShareBelowOne = 0.0
    """[1] chance that a frame is lost, independently of the others."""
    noise_factor: NonNegative = 1.0
    """[1] factor on all noise of the sensor, for studies of noise."""
    frame_period: NonNegative = 0.0
    """[s] between two frames, from the start of the run on; 0: a frame arrives at every control instant."""
    jitter: NonNegative = 0.0
    """[s] J: each frame is late by U(0, J) in addition to the latency; frames do not overtake each other."""
    noise: Family = "white"
    """Family of the noise of each component."""
    noise_share: Share = 0.1
    """[1] ρ, share of the noise that is displaced, for "mixture" and "bimodal"."""
    noise_offset: NonNegative = 0.02
    """[unit of the feature] μ, by how much it is displaced."""
    noise_spread: Positive = 1.0
    """[1] κ, deviation of the displaced part of "mixture" over σ."""
    stability: Stability = 1.5
    """[1] α, exponent of the family "stable": 2 is white, 1 is Cauchy."""
    skewness: Skewness = 0.0
    """[1] β, skewness of the family "stable"."""
    quantum: NonNegative = 0.0
    """[unit of the feature] the feature is rounded to multiples of it; 0: it is not."""
    outliers: ShareBelowOne = 0.0
    """[1] share of the frames that are outliers: the feature is seen elsewhere."""
    outlier_size: Positive = 0.05
    """[unit of the feature] distance of an outlier, in a direction drawn at random."""
    outlier_duration: NonNegative = 0.0
    """[s] how long an outlier stays where it is; 0: one frame."""
    occlusions: ShareBelowOne = 0.0
    """[1] share of the frames in which the feature is hidden, at random times."""
    occlusion_duration: Positive = 0.5
    """[s] length of each of these occlusions."""
    occlusion_windows: tuple[tuple[Number, Number], ...] = ()
    """[s] further occlusions: begin (included, above 0) and end (excluded) of each."""

    def __post_init__(self) -> None:
        """Check the windows."""
        for begin, end in self.occlusion_windows:
            if not 0.0 < begin < end:
                raise ValueError(
                    "occlusion_windows must be pairs of a begin above 0, as the run begins with a valid feature, and a "
                    f"later end, in s; got [{begin:g}, {end:g}]"
                )

    RENAMED: ClassVar[Mapping[str, str]] = {"latency_periods": "latency, in seconds (a period of 20 Hz is 0.05)"}


def without_disturbance(sensing: SensingConfig) -> SensingConfig:
    """Return the settings of a sensor with the same latency and frame period that is right in every frame."""
    return SensingConfig(0.0, sensing.latency, frame_period=sensing.frame_period)


def can_vary_sensing(config: object) -> bool:
    """Return whether a plant with these settings has a nested section `sensing`."""
    return isinstance(getattr(config, "sensing", None), SensingConfig)


def change_sensing(config: Config, change: Callable[[SensingConfig], SensingConfig]) -> Config:
    """Return a plant's settings with its section `sensing` changed.

    Raises:
        ValueError: the plant has no section `sensing`, or a number is out of its bounds.
    """
    if not can_vary_sensing(config):
        raise ValueError("its noise and latency cannot be varied")
    values: Any = config
    changed: Config = replace(values, sensing=change(values.sensing))
    return changed


def vary_sensing(config: Config, noise_factor: float, latency: float | None) -> Config:
    """Return a plant's settings with noise multiplied by a factor and, unless it is None, another latency [s].

    Raises:
        ValueError: see `change_sensing`.
    """

    def change(sensing: SensingConfig) -> SensingConfig:
        late = sensing.latency if latency is None else latency
        return replace(sensing, noise_factor=noise_factor * sensing.noise_factor, latency=late)

    return change_sensing(config, change)
