"""Families of sensor noise as pure functions of a random generator.

Each returns independent numbers of unit size; `family_of` multiplies them by the deviation σ of the settings.

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
from collections.abc import Callable
from functools import partial
from typing import Final, TypeAlias

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.sensing import Family, SensingConfig

Shape: TypeAlias = tuple[int, ...]
Draw: TypeAlias = Callable[[np.random.Generator, Shape], FloatArray]

# Floor of differences that rounding could make 0 or negative: half the grid of the generator's numbers.
TINY: Final = 2.0**-54


def mixture(
    generator: np.random.Generator, shape: Shape, *, share: float, offset: float, spread: float = 1.0
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
    return np.where(second, spread, 1.0) * generator.standard_normal(shape) + np.where(second, offset, 0.0)


def bimodal(generator: np.random.Generator, shape: Shape, *, share: float, offset: float) -> FloatArray:
    """Return normal numbers of deviation 1, with equal shares displaced to either side.

    Args:
        generator: of the random numbers.
        shape: of the result.
        share: ρ, probability of a displacement.
        offset: μ, its size.
    """
    chance = generator.random(shape)
    side = np.where(chance < share / 2.0, 1.0, np.where(chance < share, -1.0, 0.0))
    return generator.standard_normal(shape) + offset * side


def stable(generator: np.random.Generator, shape: Shape, *, stability: float, skewness: float = 0.0) -> FloatArray:
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
    a, b, gamma = stability, skewness, math.sqrt(0.5)
    V = math.pi * (generator.random(shape) - 0.5)
    W = np.maximum(-np.log1p(-generator.random(shape)), TINY)
    if a == 1.0:
        slope = np.maximum(math.pi / 2.0 + b * V, TINY)
        Z = slope * np.tan(V) - b * np.log(math.pi / 2.0 * W * np.cos(V) / slope)
        return np.asarray(gamma * 2.0 / math.pi * (Z + b * math.log(gamma)))
    theta = math.atan(b * math.tan(math.pi * a / 2.0)) / a
    turned = a * (V + theta)
    Z = np.sin(turned) / (math.cos(a * theta) * np.cos(V)) ** (1.0 / a)
    return np.asarray(gamma * Z * (np.maximum(np.cos(V - turned), TINY) / W) ** ((1.0 - a) / a))


def uniform(generator: np.random.Generator, shape: Shape) -> FloatArray:
    """Return uniform numbers of mean 0 and deviation 1."""
    return math.sqrt(3.0) * (2.0 * generator.random(shape) - 1.0)


def family_of(config: SensingConfig) -> Draw:
    """Return the noise of a sensor with settings `config`, in multiples of its deviation σ; a row for each family."""
    share, offset = config.noise_share, 0.0
    if config.feature_noise > 0.0:
        offset = config.noise_offset / config.feature_noise
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
    return np.asarray(np.rint(feature / quantum) * quantum)


def draw_directions(generator: np.random.Generator, shape: Shape) -> FloatArray:
    """Return unit vectors, (..., m), of directions that are uniform on the sphere."""
    x = generator.standard_normal(shape)
    return np.asarray(x / np.sqrt(np.vecdot(x, x))[..., None])
