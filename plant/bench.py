"""The bench around a robot: clipped and delayed commands, noisy, late and lost features, for every world alike.

    u(k) = clip(command(k), limits),        the world advances under u(k − d)
    frame(k) = see(k) + σ N(0, 1),          the observation at k holds frame(k − l), or the last valid one if it is lost

with the command delay d and the latency l in control periods. Many runs side by side share one bench: their arrays have
a leading axis, and each run has random streams of its own.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, TypeVar, final

import numpy as np
import numpy.typing as npt

from servobench.plant.checks import FloatArray
from servobench.plant.faults import FeatureLost, RunFault
from servobench.plant.lanes import take, where
from servobench.plant.plant import Abilities, ImageArray, Plant, TrueModel
from servobench.plant.seeds import Seeds, Stream
from servobench.plant.settings import NonNegative, Periods, ShareBelowOne, settings
from servobench.plant.signals import BoolArray, Command, Observation, Truth, trusted_observation

Config = TypeVar("Config")
Frame: TypeAlias = tuple[FloatArray, BoolArray]
"""The feature on its way to the controller, (..., m), and whether it will arrive, (...)."""


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

    Arrays that a world returns are never changed again, finite and float64; the bench makes them read-only. Those of a
    world that carries out runs side by side have the leading axis `lead`.
    """

    lead: tuple[int, ...] = ()
    """Number of runs side by side, as the shape of the leading axis; () for a single run."""

    def fail(self, lane: int, fault: RunFault) -> None:
        """Take the fault of a lane, or raise that of a single run; of a lane the first one counts."""
        if not self.lead:
            raise fault
        self.faults = {lane: fault, **self.faults}

    @abstractmethod
    def reset(self, seed: Any) -> FloatArray:  # noqa: ANN401 - narrowed by worlds that carry out one run only
        """Go back to the start, at rest, and draw all randomness from `seed`.

        Args:
            seed: one, or a sequence of one for each of the runs side by side.

        Returns:
            The joint positions, (..., n) rad.
        """

    @abstractmethod
    def advance(self, joint_velocity: FloatArray) -> FloatArray:
        """Hold a command for one period.

        Args:
            joint_velocity: (..., n), rad/s, within the limits.

        Returns:
            The joint positions after it, (..., n) rad, as reported; of a lane that failed, those before.

        Raises:
            PlantDiverged: they are not finite.
        """

    @abstractmethod
    def see(self) -> FloatArray | None:
        """Return the feature as the sensor sees it now, (..., m); None if a single run's is not found."""

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
        held: (..., m), the last valid feature.
        streams: of the noise and of the lost frames.
        world: what the world saved.
    """

    period: int
    commands: tuple[FloatArray, ...]
    frames: tuple[Frame, ...]
    held: FloatArray
    streams: tuple[Stream, Stream]
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
        self._period = spec.period
        self._lower, self._upper = spec.command.lower, spec.command.upper
        self._k = -1
        self._size_masks()

    def _size_masks(self) -> None:
        """Take the leading axis from the world."""
        self._shape = (*self.world.lead, self.spec.n)
        self._all_arrive = np.ones(self.world.lead, dtype=np.bool_)[()]
        self._all_valid = np.ones((*self.world.lead, self.spec.m), dtype=np.bool_)
        for mask in (self._all_arrive, self._all_valid):
            mask.setflags(write=False)

    def reset(self, seed: Seeds) -> Observation:
        """Return to the start; feature noise and lost frames get random streams of their own. See `Plant.reset`.

        Args:
            seed: non-negative; a sequence of one for each of the runs side by side.

        Raises:
            ValueError: a negative seed, or not one for each run.
        """
        if np.shape(seed) != self.world.lead:
            raise ValueError(f"seed must have shape {self.world.lead}, got {np.shape(seed)}")
        self._noise = Stream(seed, "feature_noise", "standard_normal", (self.spec.m,), self._noise_scale)
        self._losses = Stream(seed, "dropped_frames", "random")
        joints = self.world.reset(seed)
        first = self._expose()
        if first is None:
            raise FeatureLost(self.world.why_unseen())
        rest = np.zeros(self._shape)
        rest.setflags(write=False)
        self._commands = deque([rest] * self._delay)
        self._frames = deque([(first, self._all_arrive)] * self._sensing.latency_periods)
        self._held, self._k = first, 0
        return self._observation(joints, first, self._all_arrive)

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
        self._frames.append(self._sent())
        return self._observation(joints, *self._frames.popleft())

    def _observation(self, joints: FloatArray, feature: FloatArray, arrives: BoolArray) -> Observation:
        """Return what is seen at the present period; the feature is held for frames that do not arrive."""
        time, valid = self._k * self._period, self._all_valid
        if arrives is not self._all_arrive:
            feature, valid = where(arrives, feature, self._held), np.logical_and(valid, arrives[..., None])
            valid.setflags(write=False)
        joints.setflags(write=False)
        feature.setflags(write=False)
        self._held = feature
        return trusted_observation(time, joints, feature, arrives, valid)

    def _expose(self) -> FloatArray | None:
        """Return the feature as seen now, (..., m), with the bench's noise; None if it is not found."""
        feature = self.world.see()
        if feature is not None and self._noise_scale > 0.0:
            feature = feature + self._noise.next()
        return feature

    def _sent(self) -> Frame:
        """Return the frame that is exposed now and whether it will arrive."""
        feature, arrives, probability = self._expose(), self._all_arrive, self._sensing.drop_probability
        if probability > 0.0:
            lost = self._losses.next() < probability
            arrives = np.logical_not(lost) if lost.any() else arrives
        return (self._held, np.logical_not(self._all_arrive)) if feature is None else (feature, arrives)

    def truth(self) -> Truth:
        """See `Plant.truth`."""
        return self.world.truth()

    def save(self) -> BenchState:
        """See `Plant.save`."""
        streams = copy.deepcopy((self._noise, self._losses))
        return BenchState(self._k, tuple(self._commands), tuple(self._frames), self._held, streams, self.world.save())

    def restore(self, state: BenchState) -> None:
        """See `Plant.restore`.

        Raises:
            ValueError: a state of another number of runs side by side.
        """
        if state.held.shape != self._all_valid.shape:
            raise ValueError(f"state must be of runs of shape {self.world.lead}, got {state.held.shape[:-1]}")
        self.world.restore(state.world)
        self._k, self._held = state.period, state.held
        self._commands, self._frames = deque(state.commands), deque(state.frames)
        self._noise, self._losses = copy.deepcopy(state.streams)

    @property
    def faults(self) -> Mapping[int, RunFault]:  # type: ignore[override]
        """See `Plant.faults`."""
        return self.world.faults

    def keep(self, lanes: npt.NDArray[np.intp]) -> None:
        """See `Plant.keep`."""
        if not self.world.lead:
            super().keep(lanes)
        self.world.keep(lanes)
        self._size_masks()
        self._noise.keep(lanes)
        self._losses.keep(lanes)
        commands, frames, self._held = take((tuple(self._commands), tuple(self._frames), self._held), lanes)
        self._commands, self._frames = deque(commands), deque(frames)

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
        shape = (*self.world.lead, 4, 4)
        if X_BC.shape not in (shape, (4, 4)):
            raise ValueError(f"X_BC must have shape {shape}, got {X_BC.shape}")
        self.world.move_camera(np.broadcast_to(X_BC, shape))

    def close(self) -> None:
        """See `Plant.close`."""
        self.world.close()
