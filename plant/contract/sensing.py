"""The settings of the path from the true feature to the observation, which all plants share, and families of noise.

A family of noise is a function here, its word in `Family`, a row of `family_of` and one of `SENSOR_AXES`. It returns
independent numbers of unit size, which `family_of` multiplies by the deviation σ of the settings:

    white      N(0, 1)
    mixture    N(0, 1) with probability 1 − ρ, N(μ, κ²) with ρ
    bimodal    N(0, 1) with probability 1 − ρ, N(μ, 1) and N(−μ, 1) with ρ/2 each
    stable     S(α, β, 1/√2, 0; 1), so that α = 2 is white
    uniform    U(−√3, √3), whose deviation is 1

μ is in multiples of σ here. `mixture` and `bimodal` are those of Leite, Araújo and Martins, "Regularized Maximum
Correntropy Criterion Kalman Filter for Uncalibrated Visual Servoing in the Presence of Non-Gaussian Feature Tracking
Noise", Sensors 23 (2023) 8518, for κ = 1; with μ = 0 and κ > 1 `mixture` is Tukey's contaminated normal distribution.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Annotated, Literal, NamedTuple, TypeAlias

import numpy as np
from annotated_types import Ge, Gt, Le

from servobench.plant.contract.checks import FloatArray, Shape
from servobench.plant.contract.dependence import Only
from servobench.plant.contract.lanes import norm
from servobench.plant.contract.seeds import Draw
from servobench.plant.contract.settings import (
    Delay,
    Extent,
    NonNegative,
    Number,
    Positive,
    Rows,
    Share,
    ShareBelowOne,
    Usual,
    check_field,
    settings,
)

Family: TypeAlias = Literal["white", "mixture", "bimodal", "stable", "uniform"]
"""A family of noise."""


@settings
class SensingConfig:
    """Settings of the path from the true feature to the observation."""

    feature_noise: Extent = 0.001
    """[m or px] standard deviation σ of each component, such as 1mm or 2px; pixels in metres: their size in the planned
    image."""
    latency: Delay = 0.0
    """[s] from exposure to delivery; rounded by at most 0.5 ms to fit the period."""
    drop_probability: ShareBelowOne = 0.0
    """[1] probability that a frame is lost."""
    noise_factor: Annotated[NonNegative, Usual(20.0)] = 1.0
    """[1] factor on all sensor noise."""
    frame_period: Delay = 0.0
    """[s] between two frames; 0: a frame at every control instant."""
    jitter: Delay = 0.0
    """[s] J; each frame is late by a further U(0, J), without overtaking."""
    noise: Family = "white"
    """Family of the noise of each component."""
    noise_shape: Rows = ()
    """[1] rows of a matrix L that multiplies the noise; empty: identity."""
    noise_share: Annotated[Share, Only(noise=("mixture", "bimodal"))] = 0.1
    """[1] ρ, displaced share, for "mixture" and "bimodal"."""
    noise_offset: Annotated[Extent, Only(noise=("mixture", "bimodal"))] = 0.02
    """[m or px] μ, displacement."""
    noise_spread: Annotated[Positive, Only(noise="mixture")] = 1.0
    """[1] κ, deviation of the displaced part of "mixture", over σ."""
    # Below 0.5 the numbers tell nothing.
    stability: Annotated[float, Ge(0.5), Le(2.0), Only(noise="stable")] = 1.5
    """[1] α of "stable": 2 is white, 1 Cauchy."""
    skewness: Annotated[float, Ge(-1.0), Le(1.0), Only(noise="stable")] = 0.0
    """[1] β of "stable"."""
    quantum: Extent = 0.0
    """[m or px] quantisation step of the feature; 0: none."""
    outliers: ShareBelowOne = 0.0
    """[1] share of frames in which the feature is detected elsewhere."""
    outlier_size: Annotated[Extent, Only(outliers=Gt(0.0))] = 0.05
    """[m or px] distance of an outlier, in a random direction."""
    outlier_duration: Annotated[Delay, Only(outliers=Gt(0.0))] = 0.0
    """[s] how long an outlier persists; 0: one frame."""
    occlusions: ShareBelowOne = 0.0
    """[1] share of frames in which the feature is hidden, at random times."""
    occlusion_duration: Annotated[Positive, Usual(10.0), Only(occlusions=Gt(0.0))] = 0.5
    """[s] length of each occlusion."""
    occlusion_windows: tuple[tuple[Number, Number], ...] = ()
    """[s] further occlusions: begin (included, above 0) and end (excluded)."""
    latency_swing: Delay = 0.0
    """[s] A; a frame exposed at t is late by a further A (1 + sin(2π t/P))."""
    swing_period: Annotated[Positive, Usual(100.0), Only(latency_swing=Gt(0.0))] = 4.0
    """[s] P of this swing."""
    camera_turn: Annotated[NonNegative, Usual(3.2)] = 0.0
    """[rad/s] turning rate of the first camera about its optical axis."""
    stamps: bool = False
    """Whether frames carry the time at which they were exposed, by the camera's clock."""
    clock_offset: Annotated[Number, Only(stamps=True)] = 0.0
    """[s] of this clock at time 0."""
    clock_drift: Annotated[Number, Gt(-1.0), Usual(1e-3), Only(stamps=True)] = 0.0
    """[s/s] by which this clock gains."""

    def __post_init__(self) -> None:
        """Check the windows."""
        for begin, end in self.occlusion_windows:
            if not 0.0 < begin < end:
                raise ValueError(
                    "occlusion_windows must be pairs of a begin above 0, as the run begins with a valid feature, and a "
                    f"later end, in s; got [{begin:g}, {end:g}]"
                )
        if self.outlier_size == 0.0:
            raise ValueError(
                "outlier_size must be above 0, got 0; without outliers, leave outliers at 0"
            )

    def extents(self, unit: str = "m", scale: float = 1.0) -> Extents:
        """Return the lengths among the settings in multiples of a unit of noise.

        Args:
            unit: of the features.
            scale: a metre of noise in this unit.

        Raises:
            ValueError: one of them is in pixels, and the features are not.
        """
        sizes = []
        for name in Extents._fields:
            size = getattr(self, name)
            if isinstance(size, str):
                if unit != "px":
                    raise ValueError(
                        f"sensing.{name} is {size}, but the features are in {unit}; write it in {unit}"
                    )
                size = float(size.removesuffix("px")) / scale
            sizes.append(size)
        return Extents(*sizes)


class Extents(NamedTuple):
    """Lengths among the settings of a sensor, in metres of a ball that moves across the planned camera."""

    feature_noise: float  # σ
    noise_offset: float  # μ
    quantum: float  # to which features are rounded
    outlier_size: float  # distance of an outlier


LENGTH = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
EXTENTS = {**LENGTH, "px": math.nan}
SHARE = {"%": 1e-2, "": 1.0}
NUMBER = {"": 1.0}
TIME = {"ms": 1e-3, "s": 1.0}
ANGLE = {"deg": math.pi / 180.0, "rad": 1.0}


class SensorAxis(NamedTuple):
    """A word for one setting of a sensor."""

    # Its units with their sizes in SI units, NaN for pixels; the empty one is for a plain number.
    units: Mapping[str, float]
    example: str  # an example of a magnitude
    setting: str  # its key in `SensingConfig`
    family: Family | None = None  # the family of noise that it chooses; None for none


SENSOR_AXES = {
    "mixture": SensorAxis(SHARE, "10%", "noise_share", "mixture"),
    "bimodal": SensorAxis(SHARE, "10%", "noise_share", "bimodal"),
    "stable": SensorAxis(NUMBER, "1.5", "stability", "stable"),
    "uniform": SensorAxis(EXTENTS, "2mm", "feature_noise", "uniform"),
    "quantised": SensorAxis(EXTENTS, "5mm", "quantum"),
    "outliers": SensorAxis(SHARE, "40%", "outliers"),
    "occlusions": SensorAxis(SHARE, "20%", "occlusions"),
    "lost_frames": SensorAxis(SHARE, "20%", "drop_probability"),
    "frame_period": SensorAxis(TIME, "100ms", "frame_period"),
    "jitter": SensorAxis(TIME, "100ms", "jitter"),
    "latency_swing": SensorAxis(TIME, "200ms", "latency_swing"),
    "camera_turn": SensorAxis(ANGLE, "15deg", "camera_turn"),
}


def sensor_settings(axes: Iterable[tuple[str, str, float | str]]) -> dict[str, float | str]:
    """Return the settings of a sensor that some axes stand for, by their names in `SensingConfig`.

    Args:
        axes: names of `SENSOR_AXES` with magnitudes as they were written, and in SI units or as texts in pixels.

    Raises:
        ValueError: a magnitude out of the bounds of its setting, or two families of noise.
    """
    changes = {}
    for name, written, size in axes:
        axis = SENSOR_AXES[name]
        # Shares and plain numbers are checked as they were written, for the sake of messages.
        given = written if axis.units in (SHARE, NUMBER) else size
        check_field(name, SensingConfig, axis.setting, given)
        changes[axis.setting] = size
        if axis.family is not None:
            if "noise" in changes:
                raise ValueError(
                    f"noise is of one family, got {changes['noise']} and {axis.family}; give one of them"
                )
            changes["noise"] = axis.family
    return changes


# Floor of differences that rounding could make 0 or negative: half the grid of the generator's numbers.
TINY = 2.0**-54


def mixture(
    generator: np.random.Generator,
    shape: Shape,
    *,
    share: float,
    offset: float,
    spread: float = 1.0,
) -> FloatArray:
    """Return numbers of two normal distributions.

    Args:
        generator: of the random numbers.
        shape: of the result.
        share: ρ, probability of the second one.
        offset: μ, mean of the second one.
        spread: κ, deviation of the second one.
    """
    second = generator.random(shape) < share
    deviation = np.where(second, spread, 1.0)
    mean = np.where(second, offset, 0.0)
    return deviation * generator.standard_normal(shape) + mean


def bimodal(
    generator: np.random.Generator, shape: Shape, *, share: float, offset: float
) -> FloatArray:
    """Return normal numbers of deviation 1, with equal shares displaced to either side.

    Args:
        generator: of the random numbers.
        shape: of the result.
        share: ρ, probability of a displacement.
        offset: μ, its size.
    """
    chance = generator.random(shape)
    not_above = np.where(chance < share, -1.0, 0.0)
    side = np.where(chance < share / 2.0, 1.0, not_above)
    return generator.standard_normal(shape) + offset * side


def stable(
    generator: np.random.Generator, shape: Shape, *, stability: float, skewness: float = 0.0
) -> FloatArray:
    """Return α-stable numbers S(α, β, 1/√2, 0; 1) by the method of Chambers, Mallows and Stuck.

    With V uniform in (−π/2, π/2), W exponential and θ = arctan(β tan(πα/2))/α:

        Z = sin(α(V + θ)) / (cos(αθ) cos V)^(1/α) · (cos(V − α(V + θ)) / W)^((1 − α)/α)        α ≠ 1
        Z = 2/π [(π/2 + βV) tan V − β ln(π/2 W cos V / (π/2 + βV))]                             α = 1

    Chambers, Mallows and Stuck, "A Method for Simulating Stable Random Variables", J. Am. Stat. Assoc. 71 (1976) 340;
    corrected in Weron, "On the Chambers-Mallows-Stuck method", Stat. Prob. Lett. 28 (1996) 165. The parametrisation is
    number 1 of Nolan, as the default of `scipy.stats.levy_stable`.

    Args:
        generator: of the random numbers.
        shape: of the result.
        stability: α, above 0 up to 2.
        skewness: β, from −1 to 1.
    """
    a = stability
    b = skewness
    gamma = math.sqrt(0.5)  # scale
    V = math.pi * (generator.random(shape) - 0.5)
    W = np.maximum(-np.log1p(-generator.random(shape)), TINY)
    if a == 1.0:
        slope = np.maximum(math.pi / 2.0 + b * V, TINY)
        logarithm = np.log(math.pi / 2.0 * W * np.cos(V) / slope)
        Z = slope * np.tan(V) - b * logarithm
        # In this parametrisation a scale γ shifts the numbers as well, by 2/π β γ ln γ.
        return gamma * 2.0 / math.pi * (Z + b * math.log(gamma))
    theta = math.atan(b * math.tan(math.pi * a / 2.0)) / a
    turned = a * (V + theta)
    first = np.sin(turned) / (math.cos(a * theta) * np.cos(V)) ** (1.0 / a)
    second = np.maximum(np.cos(V - turned), TINY) / W
    return gamma * first * second ** ((1.0 - a) / a)


def uniform(generator: np.random.Generator, shape: Shape) -> FloatArray:
    """Return uniform numbers of mean 0 and deviation 1."""
    return math.sqrt(3.0) * (2.0 * generator.random(shape) - 1.0)


def family_of(config: SensingConfig, extents: Extents) -> Draw:
    """Return the noise of a sensor with settings `config`, in multiples of its deviation σ; a row for each family."""
    share = config.noise_share
    offset = 0.0
    if extents.feature_noise > 0.0:
        offset = extents.noise_offset / extents.feature_noise
    families: dict[Family, Draw] = {
        "white": np.random.Generator.standard_normal,
        "mixture": partial(mixture, share=share, offset=offset, spread=config.noise_spread),
        "bimodal": partial(bimodal, share=share, offset=offset),
        "stable": partial(stable, stability=config.stability, skewness=config.skewness),
        "uniform": uniform,
    }
    return families[config.noise]


def quantise(feature: FloatArray, quantum: float) -> FloatArray:
    """Return a feature rounded to the nearest multiple of a quantum, both in its unit; half goes to the even one."""
    return np.rint(feature / quantum) * quantum


def draw_directions(generator: np.random.Generator, shape: Shape) -> FloatArray:
    """Return unit vectors, (..., m), of directions that are uniform on the sphere."""
    x = generator.standard_normal(shape)
    return x / norm(x)[..., None]
