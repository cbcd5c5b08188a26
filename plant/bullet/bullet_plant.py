"""The rendered plant: a UR5 with dynamics in PyBullet, seen by an RGB-D camera in whose image the ball is searched.

At every physics step h = 1/240 s the joints' velocity motors get the target of a first-order lag, discretised exactly,

    v₊ = v + (1 − exp(−h/τ)) (u(t − d) − v),        θ̇_target = g ⊙ v,

because PyBullet's motors alone reach any target within a step. Controllers see and command reported positions q, which
are (θ − o)/g of the simulator's angles θ. The feature is the ball's centre as fitted to noisy depths, late by the
camera's latency; it is missing where the ball is hidden, out of sight or cut by the image's border.
"""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from servobench.plant.bullet.detection import (
    ByteArray,
    Detection,
    draw_detection,
    find_ball,
)
from servobench.plant.bullet.urdf import ArmBody
from servobench.plant.checks import FloatArray, as_vector, check_number
from servobench.plant.faults import FeatureLost, PlantDiverged
from servobench.plant.plant import Plant, PlantEntry, PlantSetup, whole_steps
from servobench.plant.robot import ur5
from servobench.plant.robot.camera import DepthNoise, PinholeCamera
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.seeds import named_generator
from servobench.plant.sensing import FeatureChannel, vary_sensing
from servobench.plant.signals import Command, Observation, PlantSpec, Truth

if TYPE_CHECKING:
    from servobench.plant.bullet.scene import Scene

PHYSICS_STEP = 1.0 / 240.0  # s


@dataclass(frozen=True)
class BulletConfig:
    """Settings of the rendered plant; defaults are those of a UR5 under a stereo depth camera."""

    max_joint_speed: float = 1.0  # rad/s, a cautious share of the vendor's limit of π
    joint_range: float = 2 * np.pi  # rad each way, vendor's range
    lag: float = 0.05  # s, time constant of the joints' velocity loops; 0 = none
    command_delay_periods: int = 0  # periods between a command and its first effect
    width: int = 320  # px
    height: int = 240  # px
    vertical_fov: float = 60.0  # deg, sees the workspace and a margin
    depth_noise: str = "stereo"  # none, stereo or structured_light
    depth_subpixel: float = 0.08  # px, RMS disparity error of a stereo match, vendor's white paper
    depth_baseline: float = 0.05  # m, between the two imagers, RealSense D435
    native_width: int = 848  # px, width at which the depth sensor matches, RealSense D435's optimum
    depth_quantisation: float = 0.001  # m, depth unit of the sensor; 0 = none
    depth_noise_factor: float = 1.0  # on the depth noise, for a study of it
    latency_periods: int = 1  # periods between exposure and delivery of the feature
    drop_probability: float = 0.002  # chance that a frame is lost
    scenery: bool = True  # draw the table and the floor; without them a frame costs a fifth
    view: bool = False  # open PyBullet's window and run in real time

    def __post_init__(self) -> None:
        """Check every number; the parts check theirs."""
        check_number("max_joint_speed", self.max_joint_speed, above=0.0)
        check_number("joint_range", self.joint_range, above=0.0)
        check_number("lag", self.lag, at_least=0.0)
        check_number("command_delay_periods", self.command_delay_periods, at_least=0)
        FeatureChannel(self.latency_periods, self.drop_probability)
        self.camera()
        self.noise()

    def camera(self) -> PinholeCamera:
        """Return the camera's intrinsics."""
        return PinholeCamera(self.width, self.height, self.vertical_fov)

    def noise(self) -> DepthNoise:
        """Return the depth sensor's noise."""
        return DepthNoise(
            self.depth_noise,
            self.depth_subpixel,
            self.depth_baseline,
            self.native_width,
            self.depth_quantisation,
            self.depth_noise_factor,
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """What the camera sees at an instant.

    Attributes:
        rgb: (h, w, 3).
        depth: (h, w), m, without noise.
        detection: the ball as found in the noise-free image, or None.
    """

    rgb: ByteArray
    depth: FloatArray
    detection: Detection | None


def ur5_body() -> ArmBody:
    """Return masses, torques and looks of the UR5."""
    return ArmBody(
        mass=np.array(ur5.MASS),
        centre_of_mass=np.array(ur5.CENTRE_OF_MASS),
        inertia=np.array(ur5.INERTIA),
        max_torque=np.array(ur5.MAX_TORQUE),
        tube_radius=np.array(ur5.TUBE_RADIUS),
        side_step=np.array(ur5.SIDE_STEP),
        ball_radius=ur5.BALL_RADIUS,
    )


def velocity_targets(
    v: FloatArray, u: FloatArray, decay: float, steps: int, room: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Return the joints' target velocities for the physics steps of a period.

    Args:
        v: (n,), rad/s, velocity at the start.
        u: (n,), rad/s, commanded velocity.
        decay: exp(−h/τ), what is left of a deviation after a physics step; 0 = no lag.
        steps: number of physics steps.
        room: (n,) and (n,), rad, how far the joints may move down (≤ 0) and up (≥ 0).

    Returns:
        (steps, n), rad/s; a joint that would leave its range stops at the limit.
    """
    with np.errstate(under="ignore"):  # under a short lag nothing is left
        left = decay ** np.arange(1, steps + 1)[:, None]
        targets = u + left * (v - u)
    moved = PHYSICS_STEP * np.cumsum(targets, axis=0)
    if (moved < room[0]).any() or (moved > room[1]).any():
        moved = np.clip(moved, *room)
        targets = np.diff(moved, axis=0, prepend=np.zeros((1, len(u)))) / PHYSICS_STEP
    return np.asarray(targets)


class BulletPlant(Plant):
    """A UR5 in PyBullet under a fixed RGB-D camera: v₊ = v + (1 − e^(−h/τ))(u − v), y = centre of the ball it sees."""

    def __init__(self, config: BulletConfig, setup: PlantSetup) -> None:
        """Open a world of its own and load the arm.

        Raises:
            ValueError: a start of the wrong size, a period that physics steps do not divide, an arm that is not like a
                UR5, a gear ratio of 0, or a window without a display.
        """
        from servobench.plant.bullet.scene import Scene, view_of  # noqa: PLC0415 - PyBullet prints a banner when it is imported

        model, start = setup.robot()
        self._config, self._model = config, model
        self._spec = hand_eye_spec(model, setup.period, config.max_joint_speed, config.joint_range)
        self._start = as_vector("start", start, self._spec.n)
        self._steps = whole_steps(setup.period, PHYSICS_STEP)
        if not model.arm.gear_ratio.all():
            raise ValueError(f"gear_ratio must not be zero, got {model.arm.gear_ratio.tolist()}")
        self._decay = math.exp(-PHYSICS_STEP / config.lag) if config.lag > 0.0 else 0.0
        self._channel = FeatureChannel(config.latency_periods, config.drop_probability)
        self._camera, self._depth_noise = config.camera(), config.noise()
        self._X_BC, self._view_of = model.X_BC, view_of
        self.move_camera(model.X_BC)
        self._scene: Scene = Scene(
            model.arm, ur5_body(), physics_step=PHYSICS_STEP, scenery=config.scenery, window=config.view
        )

    @property
    def spec(self) -> PlantSpec:
        """Sizes, names, limits and period."""
        return self._spec

    def reset(self, seed: int) -> Observation:
        """Return to the start at rest; depth noise and lost frames get streams of their own. See `Plant.reset`."""
        self._noise = named_generator(seed, "depth_noise")
        self.move_camera(self._X_BC)
        self._v = np.zeros(self._spec.n)
        self._commands: deque[FloatArray] = deque([np.zeros(self._spec.n)] * self._config.command_delay_periods)
        self._k = 0
        self._scene.place(self._model.arm.joint_angle(self._start))
        first = self._measure()
        if first is None:
            true = self._model.to_camera(self._scene.ball_position())
            raise FeatureLost(
                f"the ball is not visible at the start {self._start.tolist()}: it is at {true.round(3).tolist()} m in "
                f"the camera frame, column and row {self._camera.project(true).round(1).tolist()} of an image of "
                f"{self._camera.width} x {self._camera.height}; it is hidden, out of sight, too small or cut "
                "by the border"
            )
        self._channel.reset(first, named_generator(seed, "dropped_frames"))
        self._started = time.perf_counter()
        return Observation(0.0, self._joint_position(), first)

    def step(self, command: Command) -> Observation:
        """Apply `command` for one period; see `Plant.step`."""
        limit = self._spec.joint_velocity_limit
        wanted = as_vector("joint_velocity", command.joint_velocity, self._spec.n)
        self._commands.append(np.clip(wanted, -limit, limit))
        u, q = self._commands.popleft(), self._joint_position()
        room = np.minimum(self._spec.joint_lower - q, 0.0), np.maximum(self._spec.joint_upper - q, 0.0)
        targets = velocity_targets(self._v, u, self._decay, self._steps, room)
        self._v = targets[-1]
        self._scene.advance((targets * self._model.arm.gear_ratio).tolist())
        q = self._joint_position()
        if not np.isfinite(q).all():
            raise PlantDiverged(f"joint positions are not finite: {q.tolist()}")
        self._k += 1
        feature, valid = self._channel.deliver(self._measure())
        if self._config.view:
            self._keep_pace()
        return Observation(self._k * self._spec.period, q, feature, valid)

    def move_camera(self, X_BC: FloatArray) -> None:
        """See `Plant.move_camera`."""
        self._model = replace(self._model, X_BC=X_BC)
        self._view = self._view_of(self._camera, X_BC)

    def truth(self) -> Truth:
        """Return the feature by the simulator's own ball, and the Jacobian of the true model at the present joints."""
        feature = self._model.to_camera(self._scene.ball_position())
        return Truth(feature, self._model.jacobian(self._joint_position()))

    def frame(self) -> Frame:
        """Return what the camera sees now, without noise; the run and its random streams stay as they are."""
        rgba, buffer = self._scene.render(self._view)
        found = find_ball(rgba, buffer, self._camera, ur5.BALL_RADIUS)
        return Frame(rgba[..., :3].copy(), self._camera.metric_depth(buffer), found)

    def picture(self) -> ByteArray:
        """Return what the camera sees now with the detected ball marked, (h, w, 3)."""
        frame = self.frame()
        return draw_detection(frame.rgb, frame.detection, self._camera, ur5.BALL_RADIUS)

    def close(self) -> None:
        """Leave PyBullet's world."""
        self._scene.close()

    def _joint_position(self) -> FloatArray:
        """Return the reported joint positions q = (θ − o)/g, (n,) rad."""
        arm = self._model.arm
        return (self._scene.joint_angles() - arm.joint_offset) / arm.gear_ratio

    def _measure(self) -> FloatArray | None:
        """Return the ball's centre as the sensor sees it, or None; noise is drawn only where the ball's colour is."""
        found = find_ball(*self._scene.render(self._view), self._camera, ur5.BALL_RADIUS, self._sense)
        return None if found is None else found.centre

    def _sense(self, depth: FloatArray) -> FloatArray:
        return self._depth_noise.apply(depth, self._camera, self._noise)

    def _keep_pace(self) -> None:
        """Wait until the wall clock has come as far as the run; only with a window."""
        time.sleep(max(0.0, self._started + self._k * self._spec.period - time.perf_counter()))


ENTRY = PlantEntry(
    name="bullet",
    summary="PyBullet arm with dynamics; the ball is found in the rendered images of a depth camera",
    config=BulletConfig,
    build=BulletPlant,
    sense=partial(vary_sensing, noise="depth_noise_factor"),
)
