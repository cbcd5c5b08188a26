"""The settings of the path from the true feature to the observation, which all plants share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeAlias

from annotated_types import Ge, Le

from servobench.plant.contract.settings import NonNegative, Number, Positive, Share, ShareBelowOne, settings

Family: TypeAlias = Literal["white", "mixture", "bimodal", "stable", "uniform"]
"""A family of noise, as `servobench.plant.bench.noise` defines them."""
Stability: TypeAlias = Annotated[float, Ge(0.5), Le(2.0)]
"""Exponent α of a stable distribution; below 0.5 its numbers tell nothing."""
Skewness: TypeAlias = Annotated[float, Ge(-1.0), Le(1.0)]
"""From −1 to 1."""


@settings
class SensingConfig:
    """Settings of the path from the true feature to the observation."""

    feature_noise: NonNegative = 0.001
    """[m] standard deviation σ of the noise of each component; of pixels, its size in the planned image."""
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


def without_disturbance(sensing: SensingConfig) -> SensingConfig:
    """Return the settings of a sensor with the same latency and frame period that is right in every frame."""
    return SensingConfig(0.0, sensing.latency, frame_period=sensing.frame_period)


LENGTH: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
SHARE: Final = {"%": 1e-2, "": 1.0}
NUMBER: Final = {"": 1.0}
TIME: Final = {"ms": 1e-3, "s": 1.0}


class SensorAxis(NamedTuple):
    """A word for one setting of a sensor.

    Attributes:
        units: its units with their sizes in SI units; the empty one for a plain number.
        example: of a magnitude.
        setting: its key in `SensingConfig`.
        family: the family of noise that it chooses; None for none.
    """

    units: Mapping[str, float]
    example: str
    setting: str
    family: Family | None = None


SENSOR_AXES: Final[Mapping[str, SensorAxis]] = {
    "mixture": SensorAxis(SHARE, "10%", "noise_share", "mixture"),
    "bimodal": SensorAxis(SHARE, "10%", "noise_share", "bimodal"),
    "stable": SensorAxis(NUMBER, "1.5", "stability", "stable"),
    "uniform": SensorAxis(LENGTH, "2mm", "feature_noise", "uniform"),
    "quantised": SensorAxis(LENGTH, "5mm", "quantum"),
    "outliers": SensorAxis(SHARE, "40%", "outliers"),
    "occlusions": SensorAxis(SHARE, "20%", "occlusions"),
    "lost_frames": SensorAxis(SHARE, "20%", "drop_probability"),
    "frame_period": SensorAxis(TIME, "100ms", "frame_period"),
    "jitter": SensorAxis(TIME, "100ms", "jitter"),
}


def sensor_settings(axes: Iterable[tuple[str, float]]) -> dict[str, float | str]:
    """Return the settings of a sensor that some axes stand for, by their names in `SensingConfig`.

    Args:
        axes: names of `SENSOR_AXES` with magnitudes in SI units.

    Raises:
        ValueError: a magnitude out of the bounds of its setting, or two families of noise.
    """
    changes: dict[str, Any] = {}
    families: list[Family] = []
    for name, size in axes:
        axis = SENSOR_AXES[name]
        own: dict[str, Any] = {axis.setting: size}
        try:
            SensingConfig(**own)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        changes |= own
        if axis.family is not None:
            families.append(axis.family)
            changes["noise"] = axis.family
    if len(families) > 1:
        raise ValueError(f"noise is of one family, got {families[0]} and {families[1]}; give one of them")
    return changes
