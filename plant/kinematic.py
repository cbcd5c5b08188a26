"""The numpy plant: exact, fast, and the oracle of the tests.

Each joint follows its velocity command through a first-order lag, discretised exactly (zero-order hold):

    q̇ = v,   v̇ = (u(t − d) − v) / τ

The command arrives d periods late; the feature is the true one plus white noise, late by the camera's latency.
"""

from __future__ import annotations

import warnings
from collections import deque
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from servobench.plant.checks import FloatArray, as_vector, check_number
from servobench.plant.faults import PlantDiverged
from servobench.plant.plant import Plant, PlantEntry, PlantSetup
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.seeds import named_generator
from servobench.plant.sensing import FeatureChannel, vary_sensing
from servobench.plant.signals import Command, Observation, PlantSpec, Truth


@dataclass(frozen=True)
class KinematicConfig:
    """Settings of the kinematic plant; defaults are those of a UR5 under a stereo camera."""

    max_joint_speed: float = 1.0  # rad/s, a cautious share of the vendor's limit of π
    joint_range: float = 2 * np.pi  # rad each way, vendor's range
    lag: float = 0.05  # s, time constant of the joints' velocity loops; 0 = none
    command_delay_periods: int = 1  # periods between a command and its first effect
    feature_noise: float = 0.001  # m, standard deviation an axis
    latency_periods: int = 0  # periods between exposure and delivery of the feature
    drop_probability: float = 0.0  # chance that a frame is lost

    def __post_init__(self) -> None:
        """Check the numbers that no part below checks."""
        check_number("lag", self.lag, at_least=0.0)
        check_number("command_delay_periods", self.command_delay_periods, at_least=0)
        check_number("feature_noise", self.feature_noise, at_least=0.0)


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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import control  # noqa: PLC0415 - costs a second, so it is imported where it is used

    continuous = control.ss([[0.0, 1.0], [0.0, -1.0 / lag]], [[0.0], [1.0 / lag]], np.eye(2), np.zeros((2, 1)))
    discrete = control.sample_system(continuous, period, method="zoh")
    return np.asarray(discrete.A), np.asarray(discrete.B)[:, 0]


class KinematicPlant(Plant):
    """A serial arm under a fixed camera, in closed form: [q, v]₊ = A [q, v] + B u(k − d), y = h(q) + noise."""

    def __init__(self, config: KinematicConfig, setup: PlantSetup) -> None:
        """Build the plant.

        Raises:
            ValueError: a setting out of its bounds, or a start of the wrong size.
        """
        self._config = config
        self._model, start = setup.robot()
        self._X_BC = self._model.X_BC
        self._spec = hand_eye_spec(self._model, setup.period, config.max_joint_speed, config.joint_range)
        self._start = as_vector("start", start, self._spec.n)
        self._A, self._B = discretise_lag(config.lag, setup.period)
        self._channel = FeatureChannel(config.latency_periods, config.drop_probability)
        self.reset(0)

    @property
    def spec(self) -> PlantSpec:
        """Sizes, names, limits and period."""
        return self._spec

    def reset(self, seed: int) -> Observation:
        """Return to the start at rest; feature noise and lost frames get streams of their own."""
        self._noise = named_generator(seed, "feature_noise")
        self.move_camera(self._X_BC)
        self._q = self._start.copy()
        self._v = np.zeros(self._spec.n)
        self._commands: deque[FloatArray] = deque([np.zeros(self._spec.n)] * self._config.command_delay_periods)
        self._k = 0
        first = self._measure()
        self._channel.reset(first, named_generator(seed, "dropped_frames"))
        return Observation(0.0, self._q, first)

    def step(self, command: Command) -> Observation:
        """Apply `command` for one period; see `Plant.step`."""
        limit = self._spec.joint_velocity_limit
        wanted = as_vector("joint_velocity", command.joint_velocity, self._spec.n)
        self._commands.append(np.clip(wanted, -limit, limit))
        u = self._commands.popleft()
        q = self._q + self._A[0, 1] * self._v + self._B[0] * u
        v = self._A[1, 1] * self._v + self._B[1] * u
        self._q = np.clip(q, self._spec.joint_lower, self._spec.joint_upper)
        self._v = np.where(self._q == q, v, 0.0)
        if not np.isfinite(self._q).all():
            raise PlantDiverged(f"joint positions are not finite: {self._q.tolist()}")
        self._k += 1
        feature, valid = self._channel.deliver(self._measure())
        return Observation(self._k * self._spec.period, self._q, feature, valid)

    def move_camera(self, X_BC: FloatArray) -> None:
        """See `Plant.move_camera`."""
        self._model = replace(self._model, X_BC=X_BC)

    def truth(self) -> Truth:
        """Return the noise-free feature and the Jacobian of the true model."""
        return Truth(self._model.feature(self._q), self._model.jacobian(self._q))

    def close(self) -> None:
        """Nothing is held."""

    def _measure(self) -> FloatArray:
        noise = self._noise.normal(scale=self._config.feature_noise, size=self._spec.m)
        return np.asarray(self._model.feature(self._q) + noise)


ENTRY = PlantEntry(
    name="kinematic",
    summary="numpy arm with joint lag, command delay and feature noise: exact and fast",
    config=KinematicConfig,
    build=KinematicPlant,
    sense=vary_sensing,
)
