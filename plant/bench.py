"""The bench around a robot: clipped and delayed commands, noisy, late and lost features, for every world alike.

    u(k) = clip(command(k), limits),        the world advances under u(k − d)
    frame(k) = see(k) + σ N(0, 1),          the observation at k holds frame(k − l), or the last valid one if it is lost

with the command delay d and the latency l in control periods.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar, final

import numpy as np

from servobench.plant.checks import FloatArray
from servobench.plant.faults import FeatureLost
from servobench.plant.plant import Abilities, ImageArray, Plant, TrueModel
from servobench.plant.seeds import named_generator
from servobench.plant.settings import NonNegative, Periods, ShareBelowOne, settings
from servobench.plant.signals import Command, Observation, Truth, trusted_observation

Config = TypeVar("Config")


@settings
class SensingConfig:
    """Settings of the path from the true feature to the observation."""

    feature_noise: NonNegative = 0.001
    """[unit of the feature] standard deviation of the white noise of each component."""
    latency_periods: Periods = 0
    """[periods] between exposure and delivery of the feature."""
    drop_probability: ShareBelowOne = 0.0
    """[1] chance that a frame is lost, independently of the others."""
    noise_factor: NonNegative = 1.0
    """[1] factor on all noise of the sensor, for studies of noise."""


def can_vary_sensing(config: object) -> bool:
    """Return whether a plant with these settings has a nested section `sensing`."""
    return isinstance(getattr(config, "sensing", None), SensingConfig)


def vary_sensing(config: Config, noise_factor: float, latency_periods: int | None) -> Config:
    """Return a plant's settings with noise multiplied by a factor and, unless it is None, another latency.

    Raises:
        ValueError: the plant has no section `sensing`, or a number is out of its bounds.
    """
    if not can_vary_sensing(config):
        raise ValueError("its noise and latency cannot be varied")
    values: Any = config
    latency = values.sensing.latency_periods if latency_periods is None else latency_periods
    factor = noise_factor * values.sensing.noise_factor
    changed: Config = replace(values, sensing=replace(values.sensing, noise_factor=factor, latency_periods=latency))
    return changed


class World(Abilities):
    """A robot and its camera, which only advance and see; `Bench` makes a plant of it.

    Arrays that a world returns are fresh or never changed again, finite, float64 and read-only.
    """

    @abstractmethod
    def reset(self, seed: int) -> FloatArray:
        """Go back to the start, at rest, and draw all randomness from `seed`; return the joint positions, (n,) rad."""

    @abstractmethod
    def advance(self, joint_velocity: FloatArray) -> FloatArray:
        """Hold a command for one period.

        Args:
            joint_velocity: (n,), rad/s, within the limits.

        Returns:
            The joint positions after it, (n,) rad, as reported.

        Raises:
            PlantDiverged: they are not finite.
        """

    @abstractmethod
    def see(self) -> FloatArray | None:
        """Return the feature as the sensor sees it now, (m,); None if it is not found."""

    def why_unseen(self) -> str:
        """Return why `see` found nothing, with evidence, for an error message."""
        return "the feature is not visible at the start"


@dataclass(frozen=True, eq=False)
class BenchState:
    """A saved state of a bench; it can be pickled if that of its world can.

    Attributes:
        period: number of periods since the reset.
        commands: commands under way, oldest first.
        frames: frames under way, oldest first.
        held: (m,), the last valid feature.
        generators: of the noise and of the lost frames.
        world: what the world saved.
    """

    period: int
    commands: tuple[FloatArray, ...]
    frames: tuple[FloatArray | None, ...]
    held: FloatArray
    generators: tuple[np.random.Generator, np.random.Generator]
    world: Any


@final
class Bench(Plant):
    """A plant: a world under clipped and delayed commands, seen through noise, latency and lost frames."""

    def __init__(self, world: World, command_delay_periods: int, sensing: SensingConfig) -> None:
        """Put a world on the bench, which closes it; `reset` begins a run.

        Args:
            world: the robot and its camera.
            command_delay_periods: periods between a command and its first effect, 0 or above.
            sensing: noise, latency and lost frames.
        """
        self.world = world
        self._delay, self._sensing = command_delay_periods, sensing
        self._noise_scale = sensing.noise_factor * sensing.feature_noise
        spec = self.spec = world.spec
        self._shape, self._period = (spec.n,), spec.period
        self._lower, self._upper = spec.command.lower, spec.command.upper
        self._all_valid, self._none_valid = np.ones(spec.m, dtype=np.bool_), np.zeros(spec.m, dtype=np.bool_)
        for mask in (self._all_valid, self._none_valid):
            mask.setflags(write=False)
        self._k = -1

    def reset(self, seed: int) -> Observation:
        """Return to the start; feature noise and lost frames get random streams of their own. See `Plant.reset`."""
        self._noise = named_generator(seed, "feature_noise")
        self._drops = named_generator(seed, "dropped_frames")
        joints = self.world.reset(seed)
        first = self._expose()
        if first is None:
            raise FeatureLost(self.world.why_unseen())
        rest = np.zeros(self.spec.n)
        rest.setflags(write=False)
        self._commands = deque([rest] * self._delay)
        self._frames: deque[FloatArray | None] = deque([first] * self._sensing.latency_periods)
        self._held, self._k = first, 0
        return trusted_observation(0.0, joints, first, True, self._all_valid)

    def step(self, command: Command) -> Observation:
        """Apply `command` for one period; see `Plant.step`."""
        wanted = command.joint_velocity
        if wanted.shape != self._shape:
            raise ValueError(f"joint_velocity must have shape {self._shape}, got {wanted.shape}")
        if self._k < 0:
            raise ValueError("reset must be called before the first step")
        u: FloatArray = np.minimum(wanted, self._upper)
        np.maximum(u, self._lower, out=u)
        if self._delay:
            self._commands.append(u)
            u = self._commands.popleft()
        joints = self.world.advance(u)
        self._k += 1
        self._frames.append(self._deliverable())
        delivered = self._frames.popleft()
        time = self._k * self._period
        if delivered is None:
            return trusted_observation(time, joints, self._held, False, self._none_valid)
        self._held = delivered
        return trusted_observation(time, joints, delivered, True, self._all_valid)

    def _expose(self) -> FloatArray | None:
        """Return a frame: the feature as seen now, (m,), with the bench's noise; None if it is not found."""
        feature = self.world.see()
        if feature is not None and self._noise_scale > 0.0:
            feature = feature + self._noise.normal(scale=self._noise_scale, size=feature.size)
            feature.setflags(write=False)
        return feature

    def _deliverable(self) -> FloatArray | None:
        """Return a frame, or None if it is lost on its way."""
        frame = self._expose()
        probability = self._sensing.drop_probability
        return None if probability > 0.0 and self._drops.random() < probability else frame

    def truth(self) -> Truth:
        """See `Plant.truth`."""
        return self.world.truth()

    def save(self) -> BenchState:
        """See `Plant.save`."""
        generators = copy.deepcopy((self._noise, self._drops))
        return BenchState(
            self._k, tuple(self._commands), tuple(self._frames), self._held, generators, self.world.save()
        )

    def restore(self, state: BenchState) -> None:
        """See `Plant.restore`."""
        self.world.restore(state.world)
        self._k, self._held = state.period, state.held
        self._commands, self._frames = deque(state.commands), deque(state.frames)
        self._noise, self._drops = copy.deepcopy(state.generators)

    def true_model(self) -> TrueModel:
        """See `Plant.true_model`."""
        return self.world.true_model()

    def nominal_jacobian(self) -> Callable[[FloatArray], FloatArray] | None:
        """See `Plant.nominal_jacobian`."""
        return self.world.nominal_jacobian()

    def picture(self) -> ImageArray | None:
        """See `Plant.picture`."""
        return self.world.picture()

    def move_camera(self, X_BC: FloatArray) -> None:
        """See `Plant.move_camera`."""
        self.world.move_camera(X_BC)

    def close(self) -> None:
        """See `Plant.close`."""
        self.world.close()
