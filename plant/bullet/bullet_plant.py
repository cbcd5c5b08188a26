"""The rendered plant: a UR5 with dynamics in PyBullet, seen by an RGB-D camera in whose image the ball is found.

At every physics step h = 1/240 s the joints' velocity motors get the target of a first-order lag, discretised exactly,

    v₊ = v + (1 − exp(−h/τ)) (u − v),        θ̇_target = g ⊙ v,

because PyBullet's motors alone reach any target within a step. Controllers see and command reported positions q, which
are (θ − o)/g of the simulator's angles θ. The feature is the ball's centre as fitted to noisy depths; it is missing
where the ball is hidden, out of sight or cut by the image's border. Delay, latency and lost frames are those of
`servobench.plant.bench`.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from servobench.plant.bench import Bench, build_bench
from servobench.plant.bullet.detection import ByteArray, draw_detection, find_ball
from servobench.plant.checks import FloatArray, as_vector, whole_steps
from servobench.plant.faults import PlantDiverged
from servobench.plant.plant import PlantEntry, PlantSetup
from servobench.plant.robot import ur5
from servobench.plant.robot.camera import DepthNoise, FieldOfView, PinholeCamera
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.seeds import named_generator
from servobench.plant.sensing import SensingConfig
from servobench.plant.settings import Count, NonNegative, Positive, settings
from servobench.plant.signals import Truth
from servobench.plant.timing import RENAMED_DELAY
from servobench.plant.world import World

if TYPE_CHECKING:
    from servobench.plant.bullet.scene import Scene

PHYSICS_STEP = 1.0 / 240.0  # s


@settings
class BulletConfig:
    """Settings of the rendered plant; defaults are those of a UR5 under a stereo depth camera."""

    max_joint_speed: Positive = 1.0
    """[rad/s] limit of every joint; a cautious share of the vendor's limit of π."""
    joint_range: Positive = 2 * math.pi
    """[rad] largest joint position each way; the vendor's range."""
    lag: NonNegative = 0.05
    """[s] τ, time constant of the joints' velocity loops; 0 means none."""
    command_delay: NonNegative = 0.0
    """[s] between a command and its first effect; a multiple of the control period, or whole milliseconds."""
    sensing: SensingConfig = field(default_factory=lambda: SensingConfig(0.0, 0.05, 0.002))
    """Latency, lost frames, noise on top of the depth noise; `noise_factor` scales both."""
    width: Count = 320
    """[px] width of the image."""
    height: Count = 240
    """[px] height of the image."""
    vertical_fov: FieldOfView = 60.0
    """[deg] vertical field of view; it covers the workspace and a margin."""
    depth_noise: Literal["none", "stereo", "structured_light"] = "stereo"
    """Model of the depth noise."""
    depth_subpixel: NonNegative = 0.08
    """[px] RMS disparity error of a stereo match; vendor's white paper."""
    depth_baseline: Positive = 0.05
    """[m] between the two imagers; RealSense D435."""
    native_width: Count = 848
    """[px] width at which the depth sensor matches; optimum of the RealSense D435."""
    depth_quantisation: NonNegative = 0.001
    """[m] depth unit of the sensor; 0 means none."""
    scenery: bool = True
    """Draw the table and the floor; without them a frame costs a fifth."""
    view: bool = False
    """Open PyBullet's window and run in real time."""

    RENAMED: ClassVar[Mapping[str, str]] = RENAMED_DELAY

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
            self.sensing.noise_factor,
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


@dataclass(frozen=True, eq=False)
class BulletState:
    """A saved state of the world, without handles: any world with the same robot and settings can restore it.

    Attributes:
        angles: (n,), rad, of the simulator.
        speeds: (n,), rad/s, of the simulator.
        v: (n,), rad/s, present target of the motors.
        X_BC: (4, 4), pose of the camera.
        noise: generator of the depth noise.
    """

    angles: FloatArray
    speeds: FloatArray
    v: FloatArray
    X_BC: FloatArray
    noise: np.random.Generator


class BulletWorld(World):
    """A UR5 in PyBullet under a fixed RGB-D camera: v₊ = v + (1 − e^(−h/τ))(u − v), y = centre of the ball it sees."""

    def __init__(self, config: BulletConfig, setup: PlantSetup) -> None:
        """Open a world of its own and load the arm.

        Raises:
            ValueError: a start of the wrong size, a period that physics steps do not divide, an arm that is not like a
                UR5, a gear ratio of 0, or a window without a display.
        """
        from servobench.plant.bullet.scene import Scene  # noqa: PLC0415 - PyBullet prints a banner when it is imported

        model, start = setup.robot()
        self._config, self._model = config, model
        self.spec = hand_eye_spec(model, setup.period, config.max_joint_speed, config.joint_range)
        self._start = as_vector("start", start, self.spec.n)
        self._steps = whole_steps(setup.period, PHYSICS_STEP)
        if not model.arm.gear_ratio.all():
            raise ValueError(f"gear_ratio must not be zero, got {model.arm.gear_ratio.tolist()}")
        self._decay = math.exp(-PHYSICS_STEP / config.lag) if config.lag > 0.0 else 0.0
        self._camera, self._depth_noise = config.camera(), config.noise()
        self._X_BC = model.X_BC
        self._scene: Scene = Scene(model.arm, physics_step=PHYSICS_STEP, scenery=config.scenery, window=config.view)

    def reset(self, seed: int) -> FloatArray:
        """Go back to the start at rest; the depth noise gets a random stream of its own. See `World.reset`."""
        self._noise = named_generator(seed, "depth_noise")
        self.move_camera(self._X_BC)
        self._v = np.zeros(self.spec.n)
        self._periods = 0
        self._scene.place(self._model.arm.joint_angle(self._start))
        self._started = time.perf_counter()
        return self._joint_position()

    def advance(self, joint_velocity: FloatArray) -> FloatArray:
        """Hold a command for one period; see `World.advance`."""
        q = self._joint_position()
        room = np.minimum(self.spec.joint_lower - q, 0.0), np.maximum(self.spec.joint_upper - q, 0.0)
        targets = velocity_targets(self._v, joint_velocity, self._decay, self._steps, room)
        self._v = targets[-1]
        self._scene.advance((targets * self._model.arm.gear_ratio).tolist())
        q = self._joint_position()
        if not np.isfinite(q).all():
            raise PlantDiverged(f"joint positions are not finite: {q.tolist()}")
        self._periods += 1
        if self._config.view:
            self._keep_pace()
        return q

    def see(self) -> FloatArray | None:
        """Return the ball's centre as the sensor sees it, or None; noise is drawn only where the ball's colour is."""
        found = find_ball(*self._render(), self._camera, ur5.BALL_RADIUS, self._sense)
        if found is None:
            return None
        found.centre.setflags(write=False)
        return found.centre

    def why_unseen(self) -> str:
        """Return where the ball is and would appear."""
        true = self._model.to_camera(self._scene.ball_position())
        return (
            f"the ball is not visible at the start {self._start.tolist()}: it is at {true.round(3).tolist()} m in "
            f"the camera frame, column and row {self._camera.project(true).round(1).tolist()} of an image of "
            f"{self._camera.width} x {self._camera.height}; it is hidden, out of sight, too small or cut "
            "by the border"
        )

    def save(self) -> BulletState:
        """See `Plant.save`; measured: joints, detections and images continue with the same bits."""
        angles, speeds = self._scene.joint_state()
        return BulletState(angles, speeds, self._v, self._model.X_BC, copy.deepcopy(self._noise))

    def restore(self, state: BulletState) -> None:
        """See `Plant.restore`."""
        self._scene.place(state.angles, state.speeds)
        self.move_camera(state.X_BC)
        self._v, self._noise = state.v, copy.deepcopy(state.noise)

    def move_camera(self, X_BC: FloatArray) -> None:
        """See `Plant.move_camera`."""
        self._model = replace(self._model, X_BC=X_BC)

    def truth(self) -> Truth:
        """Return the feature by the simulator's own ball, and the Jacobian of the true model at the present joints."""
        feature = self._model.to_camera(self._scene.ball_position())
        return Truth(feature, self._model.jacobian(self._joint_position()))

    def picture(self) -> ByteArray:
        """Return what the camera sees now with the detected ball marked, (h, w, 3)."""
        rgba, buffer = self._render()
        found = find_ball(rgba, buffer, self._camera, ur5.BALL_RADIUS)
        return draw_detection(rgba[..., :3], found, self._camera, ur5.BALL_RADIUS)

    def close(self) -> None:
        """Leave PyBullet's world."""
        self._scene.close()

    def _joint_position(self) -> FloatArray:
        """Return the reported joint positions q = (θ − o)/g, (n,) rad."""
        arm = self._model.arm
        q: FloatArray = (self._scene.joint_state()[0] - arm.joint_offset) / arm.gear_ratio
        q.setflags(write=False)
        return q

    def _render(self) -> tuple[ByteArray, FloatArray]:
        return self._scene.render(self._camera, self._model.X_BC)

    def _sense(self, depth: FloatArray) -> FloatArray:
        return self._depth_noise.apply(depth, self._camera, self._noise)

    def _keep_pace(self) -> None:
        """Wait until the wall clock has come as far as the run; only with a window."""
        time.sleep(max(0.0, self._started + self._periods * self.spec.period - time.perf_counter()))


def build_bullet(config: BulletConfig, setup: PlantSetup) -> Bench:
    """Return the rendered plant.

    Raises:
        ValueError: see `BulletWorld`.
    """
    return build_bench(partial(BulletWorld, config), setup, config.command_delay, config.sensing)


ENTRY = PlantEntry(
    name="bullet",
    summary="PyBullet arm with dynamics; the ball is found in the rendered images of a depth camera",
    config=BulletConfig,
    build=build_bullet,
)
