"""Imperfect mechanics between the reported joints q and the ball: gear ripple, backlash, and a flexible tool.

    g = q + a sin(k q),      x ← min(max(x, g − b), g + b)            joints behind their gears (play operator)
    δ̇ = w − ṗ,      ẇ = −ω² δ − 2 ζ ω (w − ṗ)                        a ball that hangs on a spring and a damper

p is the place of the ball of a rigid tool at x, δ [m] and w [m/s] deflection and velocity of the true one, all in the
base frame. Gravity is left out: the ball rests at δ = 0. Play is exact where q is monotone.
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple, TypeAlias

import numpy as np
from annotated_types import Gt

from servobench.plant.contract.checks import FloatArray, fewest_parts
from servobench.plant.contract.dependence import Only
from servobench.plant.contract.sensing import ANGLE, NUMBER, SensorAxis
from servobench.plant.contract.settings import NonNegative, Positive, ShareBelowOne, Usual, settings
from servobench.plant.contract.signals import JacobianFunction
from servobench.plant.robot.hand_eye import FEATURE, RobotModel

# In each part of a period play is updated once and the acceleration of a tool changes linearly.
MAX_PART = 0.005  # [s]
# The closed form of a flexible tool's motion loses its digits below these frequencies, and overflows far above.
FREQUENCIES = (0.1, 1e6)  # [rad/s]
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
    """[rad] b, half the play between gear and joint."""
    ripple: Annotated[NonNegative, Usual(0.2)] = 0.0
    """[rad] a; each gear leads by a sin(k q)."""
    ripple_order: Annotated[Positive, Only(ripple=Gt(0.0))] = 8.0
    """[1] k, ripple periods per turn."""
    tool_frequency: NonNegative = 0.0
    """[rad/s] ω, natural frequency of a flexible tool; 0: rigid."""
    tool_damping: Annotated[ShareBelowOne, Only(tool_frequency=Gt(0.0))] = 0.02
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
        if self.tool_frequency == 0.0 and self.backlash == 0.0:
            return 1
        return fewest_parts(period, MAX_PART)

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
        g = self.transmitted(q)
        speed = self.slope(q) * velocity
        # A rising gear pushes the joint at the lower end of its play, a falling one at the upper end.
        driven = np.where(speed > 0.0, x <= g - self.backlash, x >= g + self.backlash)
        return np.where(driven, speed, 0.0)

    def swung(self, tool: Tool, before: Motion, after: Motion, time: float) -> Tool:
        """Return a flexible tool a time [s] later, in closed form for ṗ that is a parabola with the right distance.

        With p̈ = α + 2 β t, δ is c₀ + c₁ t, c₁ = −2 β/ω², c₀ = −α/ω² − 2 ζ c₁/ω, and a decaying oscillation of
        frequency ω_d = √(ω² − σ²), σ = ζ ω, that begins with d = δ − c₀ and ḋ = w − ṗ − c₁:

            e^(−σt) ((cos ω_d t + σ sin(ω_d t)/ω_d) d + sin(ω_d t)/ω_d ḋ)
        """
        omega = self.tool_frequency
        sigma = self.tool_damping * self.tool_frequency
        damped = math.sqrt(omega**2 - sigma**2)
        decay = math.exp(-sigma * time)
        c = math.cos(damped * time)
        s = math.sin(damped * time) / damped
        p0, v0 = before
        p1, v1 = after
        # The bend is β T²: p₁ − p₀ = v₀ T + α T²/2 + β T³/3 and v₁ = v₀ + α T + β T².
        bend = 3.0 * (v0 + v1) - 6.0 * (p1 - p0) / time
        c1 = -2.0 * bend / (time**2 * omega**2)
        c0 = (v0 - v1 + bend) / (time * omega**2) - 2.0 * sigma * c1 / omega**2
        d = tool.deflection - c0
        d_rate = tool.velocity - v0 - c1
        deflection = c0 + c1 * time + decay * ((c + sigma * s) * d + s * d_rate)
        swing_rate = decay * ((c - sigma * s) * d_rate - omega**2 * s * d)
        return Tool(deflection, v1 + c1 + swing_rate)

    def check(self, model: RobotModel) -> None:
        """Refuse a flexible tool where the features are not the place of the ball.

        Raises:
            ValueError: a flexible tool under another sensing.
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
    """A Jacobian by reported joint positions, made of one by the joints behind gears without play."""

    function: JacobianFunction
    mechanics: MechanicsConfig

    def __call__(self, joint_position: FloatArray) -> FloatArray:
        """Return J(g(q)) ∂g/∂q, (..., m, n), at (..., n) rad."""
        slope = self.mechanics.slope(joint_position)[..., None, :]
        J = self.function(self.mechanics.transmitted(joint_position))
        return J * slope


MECHANICS_AXES = {
    "backlash": SensorAxis(ANGLE, "2deg", "backlash"),
    "ripple": SensorAxis(ANGLE, "0.03rad", "ripple"),
    "flexible_tool": SensorAxis(NUMBER, "12", "tool_frequency"),
}
