"""The bench around a robot: clipped and delayed commands, noisy, late and lost features, the same for every world.

    u(k) = clip(command(k), limits),        the world advances under u(k − d)
    frame(k) = see(k) + σ N(0, 1),          the observation at k holds frame(k − l), or the last valid one if it is lost

with the command delay d and the latency l. Command delay, latency and frame period are physical times. Where they are
no multiples of the control period T, the world advances in N equal sub-steps h = T/N, the longest of which all of them
are multiples, so that the physical world is the same at every control rate. Where there is none of half a millisecond
or more, h is at most 1 ms, delays are rounded to it, and each frame is exposed after the sub-step that is nearest to
its time, so that a camera keeps its mean rate. The command of period k − ⌈(d − j)/N⌉ acts in sub-step j of period k,
for a delay of d sub-steps.

Other disturbances of a frame are in `plant.bench.sensor`. Many runs side by side share one bench: their arrays have a
leading axis, and each run has random streams of its own.
"""

import copy
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import count
from typing import Any, NamedTuple, Self, final

import numpy as np

from servobench.plant.bench.plant import ImageArray, Plant, PlantSetup, TrueModel, World
from servobench.plant.bench.sensor import TIME_TOLERANCE, Sensor
from servobench.plant.contract.checks import FloatArray, IntArray, check_number, fewest_parts
from servobench.plant.contract.faults import FeatureLost, RunFault
from servobench.plant.contract.lanes import take
from servobench.plant.contract.seeds import Seeds
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import (
    BoolArray,
    Command,
    JacobianFunction,
    Observation,
    Truth,
    trusted_observation,
)
from servobench.plant.robot.mechanics import RippledJacobian

MAX_STEP = 1e-3  # [s] longest sub-step to which times are rounded
NEGLIGIBLE = 1e-6  # [s] by which a time may be rounded without a remark


@dataclass(frozen=True)
class Timing:
    """Times of the bench in sub-steps of length h; sub-step i ends at the time i h."""

    steps: int  # in a control period, N
    # [periods] Age of the command that acts in each of the N sub-steps of a period.
    delays: tuple[int, ...]
    latency: int  # between exposure and delivery of a frame
    frames: (
        float  # between two exposures; a fraction where frames take no whole number of sub-steps
    )
    phase: int  # exposures happen after the sub-steps nearest to `phase` + j `frames`, j whole

    @classmethod
    def of(cls, period: float, step: float, command_delay: float, sensing: SensingConfig) -> Self:
        """Return the times of a bench in sub-steps.

        Args:
            period: control period, s.
            step: sub-step, s.
            command_delay: between a command and its first effect, s.
            sensing: latency and frame period.

        Raises:
            ValueError: a time that is no multiple of the sub-step, but for a frame period in steps of 1 ms or less.
        """
        times = {"period": period, **delays_of(command_delay, sensing)}
        for name, value in times.items():
            fits = _is_multiple(value, step)
            # A camera keeps its mean rate: its frames are exposed after the nearest of short sub-steps.
            if name == "frame_period" and step < MAX_STEP + TIME_TOLERANCE:
                fits = True
            if not fits:
                raise ValueError(
                    f"{name} must be a multiple of the world's period of {step:g} s, got {value:g} s"
                )
        steps, delay, latency, whole_frames = (round(value / step) for value in times.values())
        # ⌈(d − j)/N⌉
        delays = tuple(max(0, -((j - delay) // steps)) for j in range(steps))
        if sensing.frame_period == 0.0:
            # One frame a period, delivered at a control instant.
            return cls(steps, delays, latency, frames=steps, phase=-latency % steps)
        if _is_multiple(sensing.frame_period, step):
            return cls(steps, delays, latency, frames=whole_frames or steps, phase=0)
        return cls(steps, delays, latency, frames=sensing.frame_period / step, phase=0)

    def exposes(self, step: int) -> bool:
        """Return whether a frame is exposed after sub-step number `step`."""
        since = step - self.phase
        return math.floor((since + 0.5) / self.frames) > math.floor((since - 0.5) / self.frames)


def delays_of(command_delay: float, sensing: SensingConfig) -> dict[str, float]:
    """Return the times [s] that a bench adds to a world, by the name of the setting."""
    return {
        "command_delay": command_delay,
        "latency": sensing.latency,
        "frame_period": sensing.frame_period,
    }


def common_step(period: float, command_delay: float, sensing: SensingConfig) -> float:
    """Return the longest sub-step [s] of which the control period and all times of the bench are multiples.

    It is the control period itself where all others are multiples of it, whole milliseconds where all are, and else a
    whole part of the control period. Where none of `MAX_STEP`/2 or more fits, it is the longest one up to `MAX_STEP`.

    Raises:
        ValueError: a control period that is not positive.
    """
    check_number("period", period, above=0.0)
    times = delays_of(command_delay, sensing).values()
    if all(_is_multiple(value, period) for value in times):
        return period
    if all(_is_multiple(value, 1e-3) for value in (period, *times)):
        milliseconds = [round(1000.0 * value) for value in (period, *times)]
        return math.gcd(*milliseconds) / 1000.0
    fewest = fewest_parts(period, MAX_STEP)
    for parts in range(1, 2 * fewest + 1):
        step = period / parts
        if all(_is_multiple(value, step, NEGLIGIBLE) for value in times):
            return step
    return period / fewest


def rounded_to(
    step: float, period: float, command_delay: float, sensing: SensingConfig
) -> tuple[float, SensingConfig]:
    """Return command delay and sensing with times that are multiples of a sub-step; remark on those that change.

    A frame period that is no multiple of it stays, as frames are exposed after the nearest sub-steps.
    """
    times = delays_of(command_delay, sensing)
    odd = [name for name, value in times.items() if not _is_multiple(value, step)]
    far = [name for name in odd if not _is_multiple(times[name], step, NEGLIGIBLE)]
    if far:
        named = ", ".join(far).replace("frame_period", "exposures")
        remark(
            f"{named}: rounded to multiples of {1e3 * step:.6g} ms, 1/{round(period / step)} of the control "
            f"period of {period:.6g} s"
        )
    for name in odd:
        if name not in far or name != "frame_period":
            times[name] = round(times[name] / step) * step
    if odd:
        sensing = replace(sensing, latency=times["latency"], frame_period=times["frame_period"])
    return times["command_delay"], sensing


def _is_multiple(value: float, step: float, tolerance: float = TIME_TOLERANCE) -> bool:
    return abs(round(value / step) * step - value) < tolerance


class Frame(NamedTuple):
    """A frame on its way to the controller."""

    # Number of the sub-step after which it is delivered; with jitter, (...) and no whole number.
    due: int | FloatArray
    feature: FloatArray  # (..., m)
    valid: BoolArray  # (..., m), which features are measured and will arrive
    captured: FloatArray  # (...), exposure by the camera's clock [s]; NaN where it tells none


class Shown(NamedTuple):
    """What the controller sees of the frames that arrived up to a control instant."""

    feature: FloatArray  # (..., m), the last valid one
    valid: BoolArray  # (..., m), which features arrived for this instant
    captured: FloatArray  # (...), as that of the `Frame` of the last valid feature

    def newer(self, frame: Frame, arrived: BoolArray) -> Self:
        """Return what is seen after a frame of which some features `arrived`, (..., m)."""
        captured = self.captured
        if captured is not frame.captured:
            some = np.logical_or.reduce(arrived, axis=-1)
            captured = np.where(some, frame.captured, captured)[()]
        feature = np.where(arrived, frame.feature, self.feature)
        return type(self)(feature, np.logical_or(self.valid, arrived), captured)


class BenchState(NamedTuple):
    """A saved state of a bench; it can be pickled if that of its world can."""

    period: int  # number of control periods since the reset
    commands: tuple[FloatArray, ...]  # commands under way, oldest first, one a control period
    frames: tuple[Frame, ...]  # frames under way, oldest first
    held: FloatArray  # (..., m), the last valid feature
    captured: FloatArray  # (...), exposure of its frame by the camera's clock [s]
    sensor: Sensor  # its random streams, and the outliers and occlusions that last
    # (..., 4, 4), pose at the start of a camera that turns; None for others.
    camera: FloatArray | None
    world: Any  # the saved state of the world


@final
class Bench(Plant):
    """A plant: a world under clipped and delayed commands, measured with noise, latency and lost frames."""

    def __init__(
        self,
        world: World,
        command_delay: float,
        sensing: SensingConfig,
        period: float | None = None,
        camera: FloatArray | None = None,
    ) -> None:
        """Take a world, which the bench closes; `reset` begins a run. `build_bench` also builds the world.

        Args:
            world: the robot and its camera.
            command_delay: between a command and its first effect, s, 0 or above.
            sensing: noise, latency, frame period and lost frames.
            period: control period, s; None: that of the world.
            camera: (..., 4, 4), pose of the first camera in the frame of its mount; None where it is unknown.

        Raises:
            ValueError: the control period, the delay, the latency or the frame period is no multiple of the world's
                period, a camera that is to turn cannot be moved, or noise is in pixels and the features are not.
        """
        self.world = world
        self._sensing = sensing
        self.stamps = sensing.stamps or world.stamps
        self._command_delay = command_delay
        spec = world.spec
        self._extents = sensing.extents(spec.feature.unit, world.noise_unit)
        self._period = spec.period if period is None else period
        self._step = spec.period
        self._timing = Timing.of(self._period, spec.period, command_delay, sensing)
        self.spec = spec if self._timing.steps == 1 else replace(spec, period=self._period)
        self._lower = spec.command.lower
        self._upper = spec.command.upper
        self._k = -1
        self._size_masks()
        # Poses of a camera that turns: at the start, and there after a command moved it; None for others.
        self._first_camera: FloatArray | None = None
        if sensing.camera_turn > 0.0:
            self._first_camera = camera
        self._camera = self._first_camera
        if sensing.camera_turn > 0.0:
            if camera is None:
                raise ValueError(
                    "camera_turn needs a camera whose pose is known; leave it at 0 for this plant"
                )
            world.move_camera(camera)  # refuses it where it cannot be moved

    def _size_masks(self) -> None:
        """Set the shapes of commands and masks by the leading axis of the world."""
        self._shape = (*self.world.lead, self.spec.n)
        self._whole = np.ones(self.world.lead, dtype=np.bool_)[()]
        self._all_valid = np.ones((*self.world.lead, self.spec.m), dtype=np.bool_)
        self._none_valid = np.logical_not(self._all_valid)
        for mask in (self._whole, self._all_valid, self._none_valid):
            mask.setflags(write=False)

    def reset(self, seed: Seeds) -> Observation:
        """Return to the start, with new random streams for the sensor. See `Plant.reset`.

        Args:
            seed: non-negative; a sequence of one for each of the runs side by side.

        Raises:
            ValueError: a negative seed, or not one for each run.
        """
        if np.shape(seed) != self.world.lead:
            raise ValueError(f"seed must have shape {self.world.lead}, got {np.shape(seed)}")
        interval = self._timing.frames * self._step
        self._sensor = Sensor(
            self._sensing, self._extents, self.spec.m, interval, seed, self.world.lead
        )
        joints = self.world.reset(seed)
        first = self._expose()
        if first is None:
            raise FeatureLost(self.world.why_unseen())
        unseen = self._unseen()
        if unseen is not None:
            for lane in np.flatnonzero(unseen.any(axis=-1)).tolist():
                self.world.fail(lane, FeatureLost(self.world.why_unseen()))
        rest = np.zeros(self._shape)
        rest.setflags(write=False)
        self._commands = deque([rest] * self._timing.delays[0])
        latency = self._timing.latency
        # Frames that were exposed before the start and are due after it.
        exposed = filter(self._timing.exposes, range(1 - latency, 1))
        self._frames = deque(
            Frame(step + latency, first, self._all_valid, self._stamp(step)) for step in exposed
        )
        # The frame that is seen at the start was exposed before it, as those that follow were before their instants.
        seen = next(filter(self._timing.exposes, count(-latency, -1)))
        self._k = 0
        self._camera = self._first_camera
        return self._observation(joints, Shown(first, self._all_valid, self._stamp(seen)))

    def step(self, command: Command) -> Observation:
        """Apply `command` for one period; see `Plant.step`."""
        wanted = command.joint_velocity
        if wanted.shape != self._shape:
            raise ValueError(f"joint_velocity must have shape {self._shape}, got {wanted.shape}")
        if self._k < 0:
            raise ValueError("reset must be called before the first step")
        u: FloatArray = np.minimum(wanted, self._upper)
        np.maximum(u, self._lower, out=u)
        self._commands.append(u)
        timing = self._timing
        for i, delay in enumerate(timing.delays, self._k * timing.steps + 1):
            if self._camera is not None:
                angle = self._sensing.camera_turn * i * self._step
                self.world.move_camera(turned_about_axis(self._camera, angle))
            joints = self.world.advance(self._commands[-1 - delay])
            if timing.exposes(i):
                self._frames.append(self._sent(i))
        self._commands.popleft()
        self._k += 1
        return self._observation(joints, self._delivered(self._k * timing.steps))

    def _delivered(self, now: int) -> Shown:
        """Return the newest features that arrived since the last control instant, and which of them did."""
        if self._sensor.jitters:
            return self._delivered_by_lane(now)
        shown = Shown(self._held, self._none_valid, self._captured)
        while self._frames and self._frames[0].due <= now:
            frame = self._frames.popleft()
            if frame.valid is self._all_valid:
                shown = Shown(frame.feature, frame.valid, frame.captured)
            else:
                shown = shown.newer(frame, frame.valid)
        return shown

    def _delivered_by_lane(self, now: int) -> Shown:
        """Return the same as `_delivered` for lanes whose frames are due at different times."""
        shown = Shown(self._held, self._none_valid, self._captured)
        before = now - self._timing.steps
        for frame in self._frames:
            arrives = np.asarray(np.logical_and(before < frame.due, frame.due <= now))
            shown = shown.newer(frame, np.logical_and(frame.valid, arrives[..., None]))
        while self._frames and np.all(self._frames[0].due <= now):
            self._frames.popleft()
        return shown

    def _observation(self, joints: FloatArray, shown: Shown) -> Observation:
        """Return the observation of the present period; features that do not arrive are held."""
        feature, valid, captured = shown
        time = self._k * self._period
        whole = self._whole
        if valid is not self._all_valid:
            whole = np.logical_and.reduce(valid, axis=-1)
            valid.setflags(write=False)
        joints.setflags(write=False)
        feature.setflags(write=False)
        np.asarray(captured).setflags(write=False)
        self._held = feature
        self._captured = captured
        return trusted_observation(time, joints, feature, whole, valid, captured)

    def _stamp(self, step: int) -> FloatArray:
        """Return the camera's clock, (...) [s], as a frame is exposed after a sub-step; NaN where it is unknown."""
        captured = self.world.captured()
        if captured is not None:
            return captured
        return self._sensor.stamp(step * self._step)

    def _expose(self) -> FloatArray | None:
        """Return the feature as measured now, (..., m), with the sensor's disturbances; None if it is not found."""
        feature = self.world.see()
        if feature is None:
            return None
        unit = self.world.noise_unit
        if unit == 1.0:
            return self._sensor.measured(feature)
        return unit * self._sensor.measured(feature / unit)

    def _unseen(self) -> BoolArray | None:
        """Return which features are not valid now, (..., m); None if all are valid."""
        seen = self.world.visible()
        if seen is None or seen.all():
            return None
        return np.logical_not(seen)

    def _sent(self, step: int) -> Frame:
        """Return the frame that is exposed after a sub-step, with which of its features will arrive."""
        feature = self._expose()
        missing = self._sensor.missing(step * self._step)
        unseen = self._unseen()
        valid = self._all_valid
        if feature is None:
            feature = self._held
            valid = self._none_valid
        if missing is not None:
            valid = np.logical_and(valid, np.logical_not(missing)[..., None])
        if unseen is not None:
            valid = np.logical_and(valid, np.logical_not(unseen))
        due: int | FloatArray = step + self._timing.latency
        if self._sensor.jitters:
            due = self._sensor.due(step, self._timing.latency, self._step)
        return Frame(due, feature, valid, self._stamp(step))

    def truth(self) -> Truth:
        """See `Plant.truth`."""
        return self.world.truth()

    def save(self) -> BenchState:
        """See `Plant.save`."""
        sensor = copy.deepcopy(self._sensor)
        return BenchState(
            period=self._k,
            commands=tuple(self._commands),
            frames=tuple(self._frames),
            held=self._held,
            captured=self._captured,
            sensor=sensor,
            camera=self._camera,
            world=self.world.save(),
        )

    def restore(self, state: BenchState) -> None:
        """See `Plant.restore`.

        Raises:
            ValueError: a state of another number of runs side by side.
        """
        if state.held.shape != self._all_valid.shape:
            raise ValueError(
                f"state must be of runs of shape {self.world.lead}, got {state.held.shape[:-1]}"
            )
        self.world.restore(state.world)
        self._k = state.period
        self._held = state.held
        self._captured = state.captured
        self._camera = state.camera
        self._commands = deque(state.commands)
        self._frames = deque(state.frames)
        self._sensor = copy.deepcopy(state.sensor)

    @property
    def faults(self) -> Mapping[int, RunFault]:  # type: ignore[override]
        """See `Plant.faults`."""
        return self.world.faults

    def keep(self, lanes: IntArray) -> None:
        """See `Plant.keep`."""
        if not self.world.lead:
            super().keep(lanes)
        self.world.keep(lanes)
        self._size_masks()
        self._sensor.keep(lanes)
        self._commands = deque(take(tuple(self._commands), lanes))
        self._frames = deque(take(tuple(self._frames), lanes))
        self._held = take(self._held, lanes)
        self._captured = take(self._captured, lanes)
        if self._camera is not None and self._first_camera is not None:
            self._camera = self._camera[lanes]
            self._first_camera = self._first_camera[lanes]

    def true_model(self) -> TrueModel:
        """See `Plant.true_model`."""
        return self.with_delays(self.world.true_model())

    def with_delays(self, model: TrueModel) -> TrueModel:
        """See `Plant.with_delays`."""
        sensing = self._sensing
        mechanics = self.world.mechanics
        if mechanics.ripple > 0.0:
            a = mechanics.ripple
            k = mechanics.ripple_order
            symbolic = model.symbolic
            model = replace(
                model,
                jacobian=RippledJacobian(model.jacobian, mechanics),
                symbolic=lambda q: symbolic(q + a * (k * q).sin()),
            )
        return replace(
            model,
            latency=sensing.latency,
            # From no jitter to all of it, and from the least swing to the largest.
            latency_spread=sensing.jitter + 2.0 * sensing.latency_swing,
            command_delay=self._command_delay,
            lag=self.world.lag,
            camera_turn=sensing.camera_turn,
            tool=(mechanics.tool_frequency, mechanics.tool_damping),
        )

    def nominal_jacobian(self) -> JacobianFunction | None:
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
        pose = np.broadcast_to(X_BC, shape)
        if self._camera is not None:
            self._camera = pose
        self.world.move_camera(pose)

    def close(self) -> None:
        """See `Plant.close`."""
        self.world.close()


def turned_about_axis(pose: FloatArray, angle: float) -> FloatArray:
    """Return poses (..., 4, 4) turned about their own z axis by an angle [rad]."""
    c = math.cos(angle)
    s = math.sin(angle)
    x_axis = pose[..., 0]
    y_axis = pose[..., 1]
    turned = np.array(pose)
    turned[..., 0] = c * x_axis + s * y_axis
    turned[..., 1] = c * y_axis - s * x_axis
    return turned


def build_bench(
    make: Callable[[PlantSetup], World],
    setup: PlantSetup,
    command_delay: float,
    sensing: SensingConfig,
) -> Bench:
    """Return a bench around a world with the sub-steps that the delays need.

    Args:
        make: builds the world from a setup whose period is the sub-step.
        setup: of the plant, with the control period.
        command_delay: between a command and its first effect, s.
        sensing: noise, latency, frame period and lost frames.

    Raises:
        ValueError: a control period that is not positive, or arguments that `make` refuses.
    """
    step = common_step(setup.period, command_delay, sensing)
    try:
        world = make(replace(setup, period=step))
    except ValueError as error:
        if step == setup.period:
            raise
        raise ValueError(
            f"in sub-steps of {step:g} s, which the delays and the period need: {error}; run.period, "
            "command_delay and latency that are multiples of its own step help"
        ) from error
    command_delay, sensing = rounded_to(step, setup.period, command_delay, sensing)
    camera = None if setup.model is None else setup.model.camera
    return Bench(world, command_delay, sensing, setup.period, camera)
