"""Imperfect mechanics between the reported joints q and the ball: gear ripple, backlash, and a flexible tool.

    g = q + a sin(k q),      x ← min(max(x, g − b), g + b)            joints behind their gears (play operator)
    δ̇ = w − ṗ,      ẇ = −ω² δ − 2 ζ ω (w − ṗ)                        a ball that hangs on a spring and a damper

p is the place of the ball of a rigid tool at x, δ [m] and w [m/s] deflection and velocity of the true one, all in the
base frame. Gravity is left out: the ball rests at δ = 0. Play is exact where q is monotone.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple, TypeAlias

import numpy as np

from servobench.plant.contract.checks import FloatArray, fewest_parts
from servobench.plant.contract.sensing import ANGLE, NUMBER, SensorAxis
from servobench.plant.contract.settings import NonNegative, Positive, ShareBelowOne, Usual, settings
from servobench.plant.robot.hand_eye import FEATURE, RobotModel

MAX_PART: Final = (
    0.005  # [s] over which play is updated once and the acceleration of a tool changes linearly
)
# [rad/s] of a flexible tool: the closed form of its motion loses its digits below, and overflows far above.
FREQUENCIES: Final = (0.1, 1e6)
Motion: TypeAlias = tuple[FloatArray, FloatArray]
"""p [m] and ṗ [m/s], (..., 3) each."""


class Tool(NamedTuple):
    """The state of a flexible tool: δ [m] and w [m/s], (..., 3) each."""

    deflection: FloatArray
    velocity: FloatArray


@settings
class MechanicsConfig:
    """Settings of gears and tool; all off by default."""

    backlash: Annotated[NonNegative, Usual(0.2)] = 0.0
    """[rad] b: half of the play between each gear and its joint."""
    ripple: Annotated[NonNegative, Usual(0.2)] = 0.0
    """[rad] a: each gear leads by a sin(k q)."""
    ripple_order: Positive = 8.0
    """[1] k, periods of the ripple in a turn."""
    tool_frequency: NonNegative = 0.0
    """[rad/s] ω, natural frequency of a flexible tool; 0: rigid."""
    tool_damping: ShareBelowOne = 0.02
    """[1] ζ, its damping ratio."""

    def __post_init__(self) -> None:
        """Check the frequency."""
        low, high = FREQUENCIES
        if self.tool_frequency != 0.0 and not low <= self.tool_frequency <= high:
            raise ValueError(
                f"tool_frequency must be 0 or from {low:g} to {high:g}, got {self.tool_frequency:g}"
            )

    @property
    def geared(self) -> bool:
        """Whether joints behind the gears are elsewhere than reported."""
        return self.backlash > 0.0 or self.ripple > 0.0

    def parts(self, period: float) -> int:
        """Return in how many parts a period [s] is integrated."""
        off = self.tool_frequency == 0.0 and self.backlash == 0.0
        return 1 if off else fewest_parts(period, MAX_PART)

    def transmitted(self, q: FloatArray) -> FloatArray:
        """Return g, (..., n) rad."""
        return transmitted(q, self.ripple, self.ripple_order)

    def slope(self, q: FloatArray) -> FloatArray:
        """Return ∂g/∂q, (..., n)."""
        return 1.0 + self.ripple * self.ripple_order * np.cos(self.ripple_order * q)

    def driven(self, x: FloatArray, q: FloatArray) -> FloatArray:
        """Return x after the gears moved to q, (..., n) rad."""
        g = self.transmitted(q)
        return np.minimum(np.maximum(x, g - self.backlash), g + self.backlash)

    def driven_velocity(self, x: FloatArray, q: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return ẋ, (..., n) rad/s, for q̇ (..., n): 0 of a joint that is within its play."""
        g, speed = self.transmitted(q), self.slope(q) * velocity
        return np.where(
            np.where(speed > 0.0, x <= g - self.backlash, x >= g + self.backlash), speed, 0.0
        )

    def swung(self, tool: Tool, before: Motion, after: Motion, time: float) -> Tool:
        """Return a flexible tool a time [s] later, in closed form for ṗ that is a parabola with the right distance.

        With p̈ = α + 2 β t, δ is c₀ + c₁ t, c₁ = −2 β/ω², c₀ = −α/ω² − 2 ζ c₁/ω, and a decaying oscillation.
        """
        omega, sigma = self.tool_frequency, self.tool_damping * self.tool_frequency
        damped = math.sqrt(omega**2 - sigma**2)
        left, c, s = (
            math.exp(-sigma * time),
            math.cos(damped * time),
            math.sin(damped * time) / damped,
        )
        (start, begin), (end, finish) = before, after
        bend = 3.0 * (begin + finish) - 6.0 * (end - start) / time
        drift = -2.0 * bend / (time**2 * omega**2)
        centre = (begin - finish + bend) / (time * omega**2) - 2.0 * sigma * drift / omega**2
        d, r = tool.deflection - centre, tool.velocity - begin - drift
        deflection = centre + drift * time + left * ((c + sigma * s) * d + s * r)
        return Tool(deflection, finish + drift + left * ((c - sigma * s) * r - omega**2 * s * d))

    def check(self, model: RobotModel) -> None:
        """Refuse a flexible tool where the features are not the place of the ball.

        Raises:
            ValueError: says so.
        """
        if self.tool_frequency > 0.0 and model.channel is not FEATURE:
            raise ValueError(
                "mechanics.tool_frequency needs the sensing position; leave it at 0 with other sensing"
            )


def transmitted(q: FloatArray, ripple: float | FloatArray, order: float) -> FloatArray:
    """Return g = q + r sin(k q), (..., n) rad, for a ripple r [rad] of k periods in a turn."""
    return q + ripple * np.sin(order * q)


@dataclass(frozen=True, eq=False)
class RippledJacobian:
    """A Jacobian by reported joint positions, of one by the joints behind gears without play."""

    function: Callable[[FloatArray], FloatArray]
    mechanics: MechanicsConfig

    def __call__(self, joint_position: FloatArray) -> FloatArray:
        """Return J(g(q)) ∂g/∂q, (..., m, n), at (..., n) rad."""
        own = self.mechanics.slope(joint_position)[..., None, :]
        return self.function(self.mechanics.transmitted(joint_position)) * own


MECHANICS_AXES: Final = {
    "backlash": SensorAxis(ANGLE, "2deg", "backlash"),
    "ripple": SensorAxis(ANGLE, "0.03rad", "ripple"),
    "flexible_tool": SensorAxis(NUMBER, "12", "tool_frequency"),
}
