"""What a mismatch consists of: its axes with their units and bounds, their magnitudes, and profiles of several axes."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from math import radians
from typing import Self

from servobench.plant.contract.sensing import SENSOR_AXES

ANGLE = {"deg": math.pi / 180.0, "rad": 1.0}
LENGTH = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
SHARE = {"%": 1e-2, "": 1.0}
PIXELS = {"px": 1.0}
MAX_SIZE = {"deg": math.pi, "mm": 1.0, "px": 1000.0}  # [rad, m, px] by the first unit of each kind
AXES = {
    "links": (SHARE, "10%"),
    "joint_offsets": (ANGLE, "3deg"),
    "camera_rotation": (ANGLE, "60deg"),
    "tool": (LENGTH, "20mm"),
    "gear_ratio": (SHARE, "5%"),
    "camera_move": (ANGLE, "90deg"),
    "focal": (SHARE, "10%"),
    "centre": (PIXELS, "10px"),
    "distortion": (SHARE, "10%"),
    "mount": (ANGLE, "5deg"),
    **{name: (axis.units, axis.example) for name, axis in SENSOR_AXES.items()},
}
RANGES = {
    "%": "0:30:10%", "deg": "0:180:30deg", "mm": "0:60:20mm", "px": "0:20:5px", "ms": "0:200:50ms", "": "1:2:0.5",
}  # fmt: skip
PROFILES: dict[str, dict[str, float]] = {
    "none": {},
    "factory": {},
    "moderate": {
        "links": 0.05,
        "joint_offsets": radians(3.0),
        "camera_rotation": radians(15.0),
        "tool": 0.02,
        "focal": 0.05,
        "centre": 5.0,
        "distortion": 0.05,
        "mount": radians(3.0),
    },
    "severe": {
        "links": 0.1,
        "joint_offsets": radians(6.0),
        "camera_rotation": radians(45.0),
        "tool": 0.04,
        "focal": 0.1,
        "centre": 10.0,
        "distortion": 0.1,
        "mount": radians(6.0),
    },
}


@dataclass(frozen=True)
class Magnitude:
    """How far one axis goes, such as 60deg; `str` gives it back with its unit."""

    number: float
    """In the unit, 0 or above."""
    unit: str
    """A unit of the axis; empty for a plain share."""

    @classmethod
    def parse(cls, axis: str, text: str) -> Self:
        """Return the magnitude that `text` describes.

        Args:
            axis: name of the axis, a key of `AXES`.
            text: number and unit, such as "60deg".

        Raises:
            ValueError: not a number with a unit of the axis.
        """
        match = re.fullmatch(r"([0-9]*\.?[0-9]+(?:e-?[0-9]+)?)\s*([a-z%]*)", text.strip())
        if match is None:
            raise _not_a_magnitude(axis, text)
        magnitude = cls(float(match[1]), match[2])
        magnitude.size(axis)
        return magnitude

    def size(self, axis: str) -> float:
        """Return the magnitude in SI units [rad, m or 1], or in pixels.

        Raises:
            ValueError: the unit is none of the axis.
        """
        if self.unit not in AXES[axis][0]:
            raise _not_a_magnitude(axis, str(self))
        return self.number * AXES[axis][0][self.unit]

    def __str__(self) -> str:
        """Return the text that `parse` reads."""
        return f"{self.number!r}".removesuffix(".0") + self.unit


def _not_a_magnitude(axis: str, text: str) -> ValueError:
    units, example = AXES[axis]
    names = ", ".join(repr(unit) if unit else "none" for unit in units)
    return ValueError(
        f"mismatch axis {axis} needs a magnitude with one of the units {names}, such as {axis}={example}; got {text!r}"
    )
