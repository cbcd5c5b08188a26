"""The numpy plant: exact, fast, and the oracle of the tests.

Each joint follows its velocity command through a first-order lag, discretised exactly (zero-order hold):

    q̇ = v,   v̇ = (u − v) / τ

or, with `overshoot`, through one of second order: v̈ = ω² (u − v) − 2ζω v̇ with ω = 1/τ.

Delay, noise, latency and lost frames are those of `servobench.plant.bench.bench`.
"""

import math
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from servobench.plant.bench.bench import Bench, build_bench
from servobench.plant.bench.plant import PlantEntry, PlantSetup, World
from servobench.plant.contract.checks import FloatArray, IntArray, is_finite
from servobench.plant.contract.faults import PlantDiverged
from servobench.plant.contract.lanes import take, where
from servobench.plant.contract.seeds import Seeds
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import (
    Delay,
    ShareBelowOne,
    nested,
    settings,
)
from servobench.plant.contract.signals import BoolArray, Truth
from servobench.plant.robot.hand_eye import JointsConfig, RobotModel, hand_eye_spec
from servobench.plant.robot.mechanics import MechanicsConfig, Motion, Tool


@settings
class ArmConfig(JointsConfig):
    """Settings of this plant and of the exported arm; defaults are those of an arm under a stereo camera."""

    lag: Delay = 0.05
    """[s] τ, time constant of the joints' velocity loops; 0 means none."""
    command_delay: Delay = 0.05
    """[s] from command to first effect; rounded by at most 0.5 ms to fit the period."""
    sensing: SensingConfig = nested(SensingConfig)
    """Noise, latency, frame period and lost frames."""
    mechanics: MechanicsConfig = nested(MechanicsConfig)
    """Backlash and ripple of the gears, and a flexible tool."""


@settings
class KinematicConfig(ArmConfig):
    """Settings of the kinematic plant."""

    overshoot: ShareBelowOne = 0.0
    """[1] of a velocity step; above 0 the velocity loops oscillate at 1/τ."""

    def __post_init__(self) -> None:
        """Check across fields."""
        if self.overshoot > 0.0 == self.lag:
            raise ValueError("lag must be above 0 for velocity loops with overshoot, got 0")


@lru_cache(maxsize=64)
def discretise_lag(lag: float, period: float) -> tuple[FloatArray, FloatArray]:
    """Return the exact zero-order-hold discretisation of (q̇, v̇) = (v, (u − v)/lag).

    Args:
        lag: s; 0 means that the joint has the commanded velocity at once.
        period: s.

    Returns:
        A (2, 2) and B (2,) of [q, v]₊ = A [q, v] + B u.
    """
    if lag == 0.0:
        return np.array([[1.0, 0.0], [0.0, 0.0]]), np.array([period, 1.0])
    gone = -math.expm1(-period / lag)  # share of a velocity step that is reached after a period
    return np.array([[1.0, lag * gone], [0.0, 1.0 - gone]]), np.array([period - lag * gone, gone])


def follow_with_overshoot(
    joints: tuple[FloatArray, FloatArray, FloatArray],
    u: FloatArray,
    config: KinematicConfig,
    period: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return q, v and v̇ after a period of v̈ = ω² (u − v) − 2ζω v̇ with a held command, in closed form.

    Args:
        joints: q, v, v̇, (..., n) each [rad, rad/s, rad/s²].
        u: (..., n) [rad/s].
        config: its lag is 1/ω; its overshoot, that of a step of u, is exp(−πζ / √(1 − ζ²)), above 0.
        period: [s].
    """
    q, v, a = joints
    omega = 1.0 / config.lag
    decrement = -math.log(config.overshoot)
    sigma = omega * decrement / math.hypot(math.pi, decrement)  # ζω
    damped = math.sqrt(omega**2 - sigma**2)
    decay = math.exp(-sigma * period)
    cosine = decay * math.cos(damped * period)
    sine = decay * math.sin(damped * period)
    # w = v − u swings to 0; its end and slope give the way by integrating v̈ = −ω² w − 2σ v̇.
    w = v - u
    later = (cosine + sigma / damped * sine) * w + sine / damped * a
    slope = (cosine - sigma / damped * sine) * a - omega**2 / damped * sine * w
    way = period * u + (a - slope + 2.0 * sigma * (w - later)) / omega**2
    return q + way, u + later, slope


class KinematicState(NamedTuple):
    """The state of the world, whose arrays never change."""

    model: RobotModel  # arm and camera as they are now
    q: FloatArray  # (..., n), rad
    v: FloatArray  # (..., n), rad/s
    a: FloatArray  # (..., n), rad/s², of joints with overshoot; else 0
    x: FloatArray  # (..., n), rad, behind the gears
    tool: Tool  # deflection and velocity of a flexible tool


class KinematicWorld(World):
    """A serial arm and its cameras, in closed form: [q, v]₊ = A [q, v] + B u, y = h(q), or h(x, δ) with mechanics."""

    def __init__(self, config: KinematicConfig, setup: PlantSetup) -> None:
        """Build the world.

        Raises:
            ValueError: a start of the wrong size, a period that is not positive, or a flexible tool
                without a ball.
        """
        model, start = setup.robot()
        mechanics = config.mechanics
        self.mechanics = mechanics
        self.spec = hand_eye_spec(
            model, setup.period, config.max_joint_speed, config.joint_range, setup.limits
        )
        rest = np.zeros(start.shape)
        undeflected = np.zeros((*model.lead, 3))
        x = mechanics.transmitted(start) if mechanics.geared else start
        self.lead = model.lead
        self._first = KinematicState(
            model, q=start, v=rest, a=rest, x=x, tool=Tool(undeflected, undeflected)
        )
        self._model, self._q, self._v, self._a, self._x, self._tool = self._first
        self._flexible = mechanics.tool_frequency > 0.0
        self._parts = mechanics.parts(setup.period)
        self._part = setup.period / self._parts
        mechanics.check(model)
        self._config = config
        self._truth: Truth | None = None
        self._seen: BoolArray | None = None
        self.lag = config.lag
        self.noise_unit = model.noise_unit
        A, B = discretise_lag(config.lag, self._part)
        self._coefficients = (float(A[0, 1]), float(A[1, 1]), float(B[0]), float(B[1]))

    def reset(self, seed: Seeds) -> FloatArray:
        """Go back to the start at rest; nothing here is random."""
        self.restore(self._first)
        return self._q

    def advance(self, joint_velocity: FloatArray) -> FloatArray:
        """Hold a command for one period of the world; see `World.advance`."""
        after = self._carried() if self._flexible else None
        for _ in range(self._parts):
            self._follow(joint_velocity)
            self._x = self.mechanics.driven(self._x, self._q) if self.mechanics.geared else self._q
            if after is not None:
                before = after
                after = self._carried()
                self._tool = self.mechanics.swung(self._tool, before, after, self._part)
        self._truth = None
        return self._q

    def _carried(self) -> Motion:
        """Return the motion of the ball of a rigid tool."""
        ball, jacobian = self._model.arm.ball_and_jacobian(self._x)
        speed = self.mechanics.driven_velocity(self._x, self._q, self._v)
        return ball, np.matvec(jacobian, speed)

    def _follow(self, joint_velocity: FloatArray) -> None:
        """Move the reported joints under a command (..., n), rad/s, for a part of the period."""
        from_v, kept, to_q, to_v = self._coefficients
        q = self._q + from_v * self._v + to_q * joint_velocity
        v = kept * self._v + to_v * joint_velocity
        a = self._a
        swings = self._config.overshoot > 0.0
        if swings:
            joints = (self._q, self._v, a)
            q, v, a = follow_with_overshoot(joints, joint_velocity, self._config, self._part)
        if not is_finite(q):
            q, v = self._rest(q, v)
        self._q = np.minimum(np.maximum(q, self.spec.joint_lower), self.spec.joint_upper)
        self._v = np.where(self._q == q, v, 0.0)
        if swings:
            self._a = np.where(self._q == q, a, 0.0)

    def see(self) -> FloatArray:
        """Return the true feature."""
        return self.truth().feature

    def visible(self) -> BoolArray | None:
        """Return which features are valid; see `World.visible`."""
        self.truth()
        return self._seen

    def truth(self) -> Truth:
        """Return feature and Jacobian of the true model, computed once a period."""
        if self._truth is None:
            feature, jacobian, self._seen = self._model.observe(self._x)
            if self._flexible:
                R_BC = self._model.camera[..., :3, :3]
                feature = feature + np.vecmat(self._tool.deflection, R_BC)
            if self.mechanics.ripple > 0.0:
                slope = self.mechanics.slope(self._q)
                jacobian = jacobian * slope[..., None, :]
            self._truth = Truth(feature, jacobian)
        return self._truth

    def move_camera(self, X_BC: FloatArray) -> None:
        """See `Plant.move_camera`."""
        self._model = self._model.with_camera(X_BC)
        self._truth = None

    def save(self) -> KinematicState:
        """See `Plant.save`."""
        return KinematicState(self._model, self._q, self._v, self._a, self._x, self._tool)

    def restore(self, state: KinematicState) -> None:
        """See `Plant.restore`."""
        self._model, self._q, self._v, self._a, self._x, self._tool = state
        self._truth = None
        self.faults = {}

    def keep(self, lanes: IntArray) -> None:
        """See `Plant.keep`."""
        self.lead = (len(lanes),)
        self._first = take(self._first, lanes)
        self.restore(take(self.save(), lanes))

    def _rest(self, q: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Stop the lanes whose new joint positions, (..., n) rad, are not finite."""
        bad = ~np.isfinite(q).all(axis=-1)
        for lane in np.flatnonzero(bad).tolist():
            reached = q.reshape(-1, self.spec.n)[lane]
            self.fail(lane, PlantDiverged(f"joint positions are not finite: {reached.tolist()}"))
        return where(bad, self._q, q), where(bad, np.zeros_like(v), v)

    def close(self) -> None:
        """There are no resources to free."""


def build_kinematic(config: KinematicConfig, setup: PlantSetup) -> Bench:
    """Return the kinematic plant.

    Raises:
        ValueError: see `KinematicWorld`.
    """
    return build_bench(partial(KinematicWorld, config), setup, config.command_delay, config.sensing)


ENTRY = PlantEntry(
    name="kinematic",
    summary="numpy arm with joint lag, command delay and feature noise: exact and fast",
    config=KinematicConfig,
    build=build_kinematic,
    side_by_side=True,
    any_sensing=True,
)
