"""The axes of the robustness map and the places on them: seven that are the map, and those of the sensor by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from servobench.harness.config.settings import ConfigurationError
from servobench.plant.contract.settings import suggest
from servobench.plant.robot.mismatch import Magnitude, parse_magnitudes

MOVE: Final = "camera_move"
LATENCY: Final = "latency"
NOISE: Final = "noise"


@dataclass(frozen=True)
class Line:
    """An axis of the map."""

    axis: str  # of the mismatch, the sensor's among them, or "latency" or "noise"
    title: str  # label of the axis
    places: tuple[Magnitude, ...]  # its magnitudes


LINES: Final = (
    Line("camera_rotation", "camera turned [°]", parse_magnitudes("camera_rotation", "0:180:30deg")),
    Line("links", "link lengths wrong by up to [%]", parse_magnitudes("links", "0:30:10%")),
    Line("joint_offsets", "joint zeros wrong by up to [°]", parse_magnitudes("joint_offsets", "0:20:5deg")),
    Line("tool", "tool wrong by up to [mm]", parse_magnitudes("tool", "0:100:25mm")),
    Line(LATENCY, "camera latency [ms]", tuple(Magnitude(50.0 * n, "ms") for n in range(6))),
    Line(NOISE, "sensor noise [times the usual]", tuple(Magnitude(float(n), "") for n in (0, 1, 2, 4, 8))),
    Line(MOVE, "camera moved half-way [°]", parse_magnitudes(MOVE, "0:180:45deg")),
)
SENSOR_LINES: Final = (
    Line("mixture", "noise displaced to one side [%]", parse_magnitudes("mixture", "0:20:5%")),
    Line("bimodal", "noise displaced to either side [%]", parse_magnitudes("bimodal", "0:20:5%")),
    Line("stable", "exponent of stable noise", parse_magnitudes("stable", "1:2:0.25")),
    Line("uniform", "uniform noise, deviation [mm]", parse_magnitudes("uniform", "0/1/2/4/8mm")),
    Line("quantised", "feature rounded to [mm]", parse_magnitudes("quantised", "0/1/2/5/10mm")),
    Line("outliers", "frames that are outliers [%]", parse_magnitudes("outliers", "0:40:10%")),
    Line("occlusions", "frames with the feature hidden [%]", parse_magnitudes("occlusions", "0:40:10%")),
    Line("lost_frames", "frames lost [%]", parse_magnitudes("lost_frames", "0:80:20%")),
    Line("frame_period", "time between frames [ms]", parse_magnitudes("frame_period", "50:200:50ms")),
    Line("jitter", "frames late by up to [ms]", parse_magnitudes("jitter", "0:200:50ms")),
)
KNOWN_LINES: Final = {line.axis: line for line in (*LINES, *SENSOR_LINES)}


def find_lines(axes: Sequence[str]) -> tuple[Line, ...]:
    """Return the axes of those names, in the order of the map; all of the usual map for none.

    Raises:
        ConfigurationError: an unknown name.
    """
    for axis in axes:
        if axis not in KNOWN_LINES:
            raise ConfigurationError(f"the map has no axis {axis!r}: {suggest(axis, KNOWN_LINES)}")
    return tuple(line for line in KNOWN_LINES.values() if line.axis in axes) or LINES
