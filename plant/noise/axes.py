"""One word each for what a sensor does wrong, such as `outliers=40%`: the axes of a mismatch that are of the sensor.

A word sets one setting of the section `sensing`; that of a family of noise chooses the family as well. Whatever else
there is to set, such as how long an outlier lasts, is as configured.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Final, NamedTuple

from servobench.plant.sensing import Family, SensingConfig

LENGTH: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
SHARE: Final = {"%": 1e-2, "": 1.0}
NUMBER: Final = {"": 1.0}
TIME: Final = {"ms": 1e-3, "s": 1.0}


class SensorAxis(NamedTuple):
    """A word for one setting of a sensor.

    Attributes:
        units: its units with their sizes in SI units; the empty one for a plain number.
        example: of a magnitude.
        setting: what it sets.
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


def disturbed(sensing: SensingConfig, axes: Iterable[tuple[str, float]]) -> SensingConfig:
    """Return the settings of a sensor with some axes put on top.

    Args:
        sensing: the settings.
        axes: names of `SENSOR_AXES` with magnitudes in SI units.

    Raises:
        ValueError: a magnitude out of the bounds of its setting, or two families of noise.
    """
    family: Family | None = None
    for name, size in axes:
        axis = SENSOR_AXES[name]
        if axis.family is not None:
            if family is not None:
                raise ValueError(f"noise is of one family, got {family} and {axis.family}; give one of them")
            family = axis.family
        change: dict[str, Any] = {axis.setting: size}
        try:
            sensing = replace(sensing, **change)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    return sensing if family is None else replace(sensing, noise=family)
