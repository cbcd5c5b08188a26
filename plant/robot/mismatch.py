"""Named, seeded deviations of the true robot from the nominal model that controllers know.

A mismatch is written as words joined by `+`: a profile (a key of `PROFILES`), single axes with a
magnitude (`camera_rotation=60deg`, `links=10%`, `joint_offsets=3deg`, `tool=20mm`, `gear_ratio=5%`,
`camera_move=90deg`; of cameras in pixels `focal=10%`, `centre=10px`, `distortion=10%`; of cameras on the hand
`mount=5deg`), or both (`moderate+gear_ratio=5%`). `factory` takes the arm from a calibration file (`factory=FILE`;
without a file, that of one real UR5).
Words for the sensor (`outliers=40%`; see `plant.contract.sensing`) and for gears and tool (`backlash=2deg`; see
`plant.robot.mechanics`) stand among the axes; they change settings of the plant and draw no robot.

Links, joint offsets, gear ratios and the three components of the tool offset are each drawn uniformly from plus or
minus the magnitude. The camera turns about an axis drawn at random; by an angle drawn from plus or minus the
magnitude in a profile, and by exactly the magnitude as a single axis. It turns about the middle of the workspace,
which therefore stays where it was in the image, and the axis is drawn among those that tilt the optical axis by at
most 45°: a camera tilted further would be below the table. `camera_move` turns the camera in the same way, by
exactly the magnitude and with a tilt of at most 30°, but in the middle of the run. Every axis draws from a random
stream of its own, so the same seed gives the same directions at all magnitudes. The axes of cameras in pixels are
drawn by `servobench.plant.cameras.placement`.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields, replace
from functools import cached_property
from math import radians
from typing import Self

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import words_between
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.sensing import ANGLE, LENGTH, SENSOR_AXES, SHARE, sensor_settings
from servobench.plant.contract.settings import likely_meant, nearest, remark, suggest
from servobench.plant.robot.hand_eye import HandEyeModel, RobotModel, turn_about
from servobench.plant.robot.makers import measured_arm
from servobench.plant.robot.mechanics import MECHANICS_AXES
from servobench.plant.robot.robot import Robot

MAX_TILT = radians(45.0)
MAX_MOVE_TILT = radians(30.0)
MAX_MAGNITUDES = 10_000  # largest number of magnitudes in a range


def _unknown_word(text: str, word: str) -> ValueError:
    """Return the error about one word of a mismatch: mistyped, out of place, or unknown."""
    name = word.partition("=")[0]
    if name in PROFILES:
        remedy = "a profile stands first, and there is one at most"
        if "=" in word and name != "factory":
            remedy = f"the profile {name} has no magnitude"
        return ValueError(f"mismatch {text!r}: {word!r} is not known here; {remedy}")
    known = list(PROFILES)
    if "=" in word:
        known += AXES
    near = nearest(name, known)
    hint = f"did you mean {near!r}? " if near else ""
    examples = ", ".join(f"{axis}={example}" for axis, (_, example) in AXES.items())
    wanted = f"one profile ({', '.join(PROFILES)}, factory=FILE) and then axes such as {examples}, joined by '+'"
    return ValueError(f"mismatch {text!r}: {word!r} is not known here; {hint}wanted {wanted}")


@dataclass(frozen=True)
class Mismatch:
    """Bounds of the deviation of the true robot from the nominal one; `str` returns the text that `parse` reads."""

    profile: str = "none"
    """A key of `PROFILES`; empty where only axes are given."""
    axes: tuple[tuple[str, Magnitude], ...] = ()
    """Axes with their magnitudes, on top of the profile; each at most once."""
    calibration: str | None = None
    """Calibration file of the profile `factory`; None for the one that the package brings."""

    def __post_init__(self) -> None:
        """Check the magnitudes."""
        for axis, magnitude in self.axes:
            if [name for name, _ in self.axes].count(axis) > 1:
                raise ValueError(f"mismatch {str(self)!r} has the axis {axis} twice; give it once")
            magnitude.size(axis)  # refuses a unit that the axis does not have
            if axis not in SENSOR_AXES and axis not in MECHANICS_AXES:
                magnitude.check_bounds(axis)
        # Sensor and mechanics have bounds of their own for their axes.
        _ = self.plant_settings

    @classmethod
    @configuration_errors()
    def parse(cls, text: str) -> Self:
        """Return the mismatch that `text` describes.

        Args:
            text: profiles and axes joined by `+`, see the module's docstring.

        Raises:
            ConfigurationError: no text, an unknown word, a missing or malformed magnitude, or one out of its bounds.
        """
        if not isinstance(text, str):
            raise ConfigurationError(
                f"mismatch must be a text such as 'moderate' or 'links=10%', got {text!r}"
            )
        profile = ""
        calibration = None
        axes = []
        for position, word in enumerate(words_between(text, "+")):
            name, equals, value = word.partition("=")
            is_profile = name in PROFILES and position == 0
            if is_profile and (name == "factory" or not equals):
                profile = name
                calibration = value if equals else None
            elif name in AXES:
                axes.append((name, Magnitude.parse(name, value)))
            else:
                raise _unknown_word(text, word)
        return cls(profile, tuple(axes), calibration)

    def __str__(self) -> str:
        """Return the text that `parse` reads, as it stands in the column `mismatch`."""
        words = []
        if self.calibration is not None:
            words.append(f"{self.profile}={self.calibration}")
        elif self.profile:
            words.append(self.profile)
        words += [f"{axis}={magnitude}" for axis, magnitude in self.axes]
        return "+".join(words)

    def with_axis(self, axis: str, magnitude: Magnitude) -> Mismatch:
        """Return this mismatch with one axis added.

        Raises:
            ValueError: it has this axis already.
        """
        profile = "" if self == Mismatch() else self.profile
        return replace(self, profile=profile, axes=(*self.axes, (axis, magnitude)))

    def size(self, axis: str) -> float:
        """Return the magnitude of an axis in SI units [rad, m or 1] or in pixels; 0 where it is not given."""
        given = dict(self.axes)
        if axis in given:
            return given[axis].size(axis)
        return PROFILES.get(self.profile, {}).get(axis, 0.0)

    @property
    def moves_robot(self) -> bool:
        """Whether the robot or its camera differs from the nominal one at the start of a run."""
        if self.profile == "factory":
            return True
        own = set(AXES) - set(SENSOR_AXES) - set(MECHANICS_AXES) - {"camera_move"}
        return any(self.size(axis) > 0.0 for axis in own)

    @cached_property
    def plant_settings(self) -> dict[str, float | str]:
        """Settings of the plant that the axes of sensor, gears and tool stand for, by dotted key.

        Raises:
            ValueError: a magnitude out of the bounds of its setting, or two families of noise.
        """
        sensed = []
        geared = {}
        for axis, magnitude in self.axes:
            size = magnitude.size(axis)
            if axis in SENSOR_AXES:
                # Pixels keep their unit, as a setting without one is in metres.
                value = str(magnitude) if magnitude.unit in PIXELS else size
                sensed.append((axis, str(magnitude), value))
            elif axis in MECHANICS_AXES:
                geared[f"mechanics.{MECHANICS_AXES[axis].setting}"] = size
        own = {f"sensing.{name}": value for name, value in sensor_settings(sensed).items()}
        return own | geared

    @property
    def camera_exact(self) -> bool:
        """Whether the camera turns by exactly `camera_rotation`, not by an angle drawn below it."""
        return any(axis == "camera_rotation" for axis, _ in self.axes)


def parse_magnitudes(axis: str, text: str) -> tuple[Magnitude, ...]:
    """Return the magnitudes in `begin:end:step` (both ends included) or `one/another`, with the unit at the end.

    Args:
        axis: name of the axis, such as "camera_rotation".
        text: such as "0:180:30deg" or "5/10/20mm".

    Raises:
        ValueError: an unknown axis, a malformed or an empty range, or a magnitude out of its bounds.
    """
    if axis not in AXES:
        raise ValueError(
            f"unknown mismatch axis {axis!r} (a setting is as kinematic.lag): {suggest(axis, AXES)}"
        )
    unit_of_example = re.sub("[0-9.]", "", AXES[axis][1])
    example = RANGES[unit_of_example]
    number = r"[0-9]*\.?[0-9]+"
    range_or_list = rf"{number}(?::{number}:{number}|(?:/{number})*)"
    match = re.fullmatch(rf"({range_or_list})\s*([a-z%]*)", text.strip())
    if match is None:
        raise ValueError(
            f"{axis} needs begin:end:step with a unit, such as {axis}={example}; got {text!r}"
        )
    values, unit = match.groups()
    numbers = [float(part) for part in re.split("[:/]", values)]
    if ":" in values:
        numbers = _range(axis, text, *numbers)
    magnitudes = tuple(Magnitude.parse(axis, f"{number!r}{unit}") for number in numbers)
    for magnitude in magnitudes:
        Mismatch("", ((axis, magnitude),))  # refuses a magnitude that is out of bounds
    return magnitudes


def parse_range(name: str, text: str) -> list[float] | list[int]:
    """Return the numbers of `begin:end:step`, both ends included; whole ones where all three are.

    Args:
        name: the setting or axis that has these values, for messages.
        text: such as "0:0.2:0.05".

    Raises:
        ValueError: no such range, or an empty one.
    """
    parts = text.split(":")
    try:
        # A wrong number of parts is a TypeError.
        numbers = _range(name, text, *map(float, parts))
    except (TypeError, OverflowError) as error:
        raise ValueError(f"the range {text!r} of {name} must be begin:end:step") from error
    if all(map(str.isdigit, parts)):
        return [int(number) for number in numbers]
    return numbers


def _range(name: str, text: str, begin: float, end: float, step: float) -> list[float]:
    """Return the numbers from begin to end in steps, rounded to nine digits."""
    where = f"the range {text!r} of {name}"
    steps = -1.0
    if step > 0.0:
        # Rounding must not cost the last step.
        steps = (end - begin) / step + 1e-9
    if not steps < MAX_MAGNITUDES:
        raise ValueError(f"{where} has more than {MAX_MAGNITUDES:,} magnitudes; use larger steps")
    if steps < 0.0:  # it begins beyond its end
        raise ValueError(f"{where} is empty")
    whole_steps = math.floor(steps)
    values = [round(begin + i * step, 9) for i in range(whole_steps + 1)]
    if steps - whole_steps > 1e-6:
        raise ValueError(
            f"{where} must be begin:end:step, but its last step ends at {values[-1]:g}"
        )
    return values


@dataclass(frozen=True)
class MismatchSample:
    """The values drawn for one run; all of them go into the log."""

    link_scale: FloatArray  # (n+1, 3), factors on the translations between joints
    joint_offset: FloatArray  # (n,), rad, added to the nominal offsets
    gear_ratio: FloatArray  # (n,), factors on the nominal gear ratios
    tool_offset: FloatArray  # (3,), m, in the flange frame
    camera_axis: FloatArray  # (3,), unit vector in the camera frame
    camera_angle: float  # rad
    move_axis: FloatArray  # (3,), the same for the move in the middle of the run
    move_angle: float  # rad

    def moved(self, model: RobotModel, robot: Robot) -> RobotModel | None:
        """Return the true `robot`, `model`, after its camera was moved in the middle of the run; None if it is not."""
        if self.move_angle == 0.0:
            return None
        return model.turned(self.move_angle * self.move_axis, robot.workspace.centre)

    def as_record(self) -> dict[str, object]:
        """Return the values as plain lists and floats, for JSON."""
        return {
            field.name: np.asarray(getattr(self, field.name)).tolist() for field in fields(self)
        }


def sample_mismatch(
    mismatch: Mismatch, robot: Robot, seed: int
) -> tuple[HandEyeModel, MismatchSample]:
    """Draw a true robot.

    Args:
        mismatch: how far it may be from the nominal robot.
        robot: by its maker's description.
        seed: non-negative.

    Returns:
        The true robot and the values that were drawn.

    Raises:
        ValueError: the calibration file is missing, malformed or that of another robot.
    """
    sample = _draw_sample(mismatch, robot.n, seed)
    arm = robot.measured or robot.nominal.arm
    if mismatch.profile == "factory":
        arm = measured_arm(robot, mismatch.calibration)
    true_arm = replace(
        arm,
        translation=arm.translation * sample.link_scale,
        joint_offset=arm.joint_offset + sample.joint_offset,
        gear_ratio=arm.gear_ratio * sample.gear_ratio,
        tool=arm.tool + sample.tool_offset,
    )
    turn = sample.camera_angle * sample.camera_axis
    centre = np.asarray(robot.workspace.centre)
    X_BC = turn_about(robot.nominal.X_BC, turn, centre)
    return HandEyeModel(true_arm, X_BC), sample


def _draw_sample(mismatch: Mismatch, n: int, seed: int) -> MismatchSample:
    """Draw the values of a mismatch for an arm with `n` joints; every axis has a random stream of its own."""
    size = mismatch.size

    def stream(name: str) -> np.random.Generator:
        return named_generator(seed, f"mismatch.{name}")

    def draw(name: str, *shape: int) -> FloatArray:
        return stream(name).uniform(-1.0, 1.0, shape)

    def factors(name: str, *shape: int) -> FloatArray:
        """A magnitude of 0 gives factors of 1 for any draw, which saves a generator."""
        magnitude = size(name)
        if magnitude > 0.0:
            return 1.0 + magnitude * draw(name, *shape)
        return np.ones(shape)

    most_angle = size("camera_rotation")
    camera_angle = most_angle
    if not mismatch.camera_exact:
        camera_angle = float(most_angle * draw("camera_angle", 1)[0])
    move_angle = size("camera_move")
    return MismatchSample(
        link_scale=factors("links", n + 1, 3),
        joint_offset=size("joint_offsets") * draw("joint_offsets", n),
        gear_ratio=factors("gear_ratio", n),
        tool_offset=size("tool") * draw("tool", 3),
        camera_axis=draw_camera_axis(most_angle, MAX_TILT, stream("camera_axis")),
        camera_angle=camera_angle,
        move_axis=draw_camera_axis(move_angle, MAX_MOVE_TILT, stream("move_axis")),
        move_angle=move_angle,
    )


def draw_camera_axis(angle: float, max_tilt: float, generator: np.random.Generator) -> FloatArray:
    """Draw an axis such that a turn about it by up to `angle` tilts the optical axis by at most `max_tilt`.

    A turn by φ about an axis at γ from the optical axis tilts that by τ with sin(τ/2) = sin(φ/2) sin γ.
    """
    sin_half_tilt = math.sin(max_tilt / 2)
    max_sin_gamma = sin_half_tilt / max(math.sin(angle / 2), sin_half_tilt)
    min_cos_gamma = math.sqrt(1.0 - max_sin_gamma**2)
    # A uniform cosine makes directions uniform on the cap around the optical axis.
    cos_gamma = 1.0 - generator.uniform() * (1.0 - min_cos_gamma)
    sin_gamma = math.sqrt(1.0 - cos_gamma**2)
    turn = generator.uniform(0.0, 2 * math.pi)
    sign = (-1.0, 1.0)[generator.integers(2)]
    x = sin_gamma * math.cos(turn)
    y = sin_gamma * math.sin(turn)
    return np.array([x, y, sign * cos_gamma])


PIXELS = {"px": 1.0}
# Largest magnitudes [rad, m, px] by the first unit of each kind
MAX_SIZE = {"deg": math.pi, "mm": 1.0, "px": 1000.0}
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
    **{
        name: (axis.units, axis.example) for name, axis in {**SENSOR_AXES, **MECHANICS_AXES}.items()
    },
}
RANGES = {
    "%": "0:30:10%", "deg": "0:180:30deg", "mm": "0:60:20mm", "px": "0:20:5px", "ms": "0:200:50ms", "": "1:2:0.5",
    "rad": "0:0.06:0.02rad",
}  # fmt: skip


def _profile(
    share: float, zeros: float, turn: float, tool: float, centre: float
) -> dict[str, float]:
    """Return the magnitudes of a profile; zeros (and mount) and turn in deg, tool in m, centre in px."""
    angles = {"joint_offsets": radians(zeros), "camera_rotation": radians(turn)}
    cameras = {"focal": share, "centre": centre, "distortion": share, "mount": radians(zeros)}
    return {"links": share, **angles, "tool": tool, **cameras}


PROFILES = {
    "none": {},
    "factory": {},
    "moderate": _profile(0.05, 3.0, 15.0, 0.02, 5.0),
    "severe": _profile(0.1, 6.0, 45.0, 0.04, 10.0),
    "lab": _profile(0.008, 0.1, 8.0, 0.01, 2.0) | {"mount": radians(8.0)},
}
PROFILE_SETTINGS = {
    "lab": {
        "command_delay": 0.005,
        "lag": 0.03,
        "sensing.latency": 0.095,
        "sensing.feature_noise": 0.0034,
    }
}
"""Defaults of plants that come with a profile, by dotted key [s, m]; sources of all numbers are in docs/mismatch.md."""
USUAL_SHARE = 0.3  # [1] beyond which a share without a unit is likely one of percent


@dataclass(frozen=True)
class Magnitude:
    """The magnitude of one axis, such as 60deg; `str` returns it with its unit."""

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
        size = magnitude.size(axis)
        units, _ = AXES[axis]
        is_plain_share = not magnitude.unit and "%" in units
        if is_plain_share and USUAL_SHARE < size < 1.0:
            remark(f"{axis}={text} is {size:.0%}; if {magnitude}% is meant, write the unit, too")
        return magnitude

    def size(self, axis: str) -> float:
        """Return the magnitude in SI units [rad, m or 1], or in pixels.

        Raises:
            ValueError: the unit is none of the axis.
        """
        units, _ = AXES[axis]
        if self.unit not in units:
            raise _not_a_magnitude(axis, str(self))
        return self.number * units[self.unit]

    def check_bounds(self, axis: str) -> None:
        """Refuse a magnitude that no deviation of a robot or a camera has.

        Raises:
            ValueError: it is negative, a share of 1 or more, or larger than the largest one of its kind.
        """
        size = self.size(axis)
        units, _ = AXES[axis]
        if units is SHARE:
            most = 1.0
            wanted = "below"
            fits = 0.0 <= size < most
        else:
            most = MAX_SIZE.get(next(iter(units)), math.pi)
            wanted = "at most"
            fits = 0.0 <= size <= most
        if not fits:
            bound = replace(self, number=round(most / units[self.unit], 9))
            meant = likely_meant(self.number, "" if self.unit else "1", most.__gt__)
            raise ValueError(f"{axis} must be at least 0 and {wanted} {bound}, got {self}{meant}")

    def __str__(self) -> str:
        """Return the text that `parse` reads."""
        return f"{self.number!r}".removesuffix(".0") + self.unit


def _not_a_magnitude(axis: str, text: str) -> ValueError:
    """Return the error about a text that is no magnitude of an axis."""
    units, example = AXES[axis]
    if re.fullmatch(r"\s*-\s*[0-9.]+\s*[a-z%]*\s*", text):
        return ValueError(
            f"{axis} has no sign, as each robot draws one where there is one; got {text!r}"
        )
    names = ", ".join(repr(unit) if unit else "none" for unit in units)
    wanted = f"a magnitude with one of the units {names}, such as {axis}={example}"
    return ValueError(f"mismatch axis {axis} needs {wanted}; got {text!r}")
