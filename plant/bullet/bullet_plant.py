"""The rendered plant: an arm with dynamics in PyBullet, seen by an RGB-D camera in whose image the ball is found.

The drives of `servobench.plant.bullet.drives` turn joints that have inertia, load and friction, at 1 kHz. Controllers
see and command reported positions q, which are (θ − o)/g of the simulator's angles θ, in steps of the encoders. A link
that meets another one, the table, the floor or an obstacle ends the run. The feature is the ball's centre as fitted to
noisy depths; it is missing where the ball is hidden, out of sight or cut by the image's border. Delay, latency and lost
frames are those of `servobench.plant.bench`.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Len

from servobench.plant.bench import Bench, build_bench
from servobench.plant.bullet.detection import ByteArray, Patch, add_colour_noise, draw_detection, find_ball
from servobench.plant.bullet.drives import PHYSICS_STEP, DriveConfig, Drives, DriveState, drives_for
from servobench.plant.bullet.urdf import Box
from servobench.plant.checks import FloatArray, as_vector, whole_steps
from servobench.plant.faults import Collision, PlantDiverged
from servobench.plant.plant import PlantEntry, PlantSetup
from servobench.plant.robot.camera import DepthNoise, FieldOfView, PinholeCamera
from servobench.plant.robot.catalogue import UR5, find_robot
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.robot.robot import Robot
from servobench.plant.seeds import named_generator
from servobench.plant.sensing import SensingConfig
from servobench.plant.settings import Count, NonNegative, Number, Positive, nested, settings
from servobench.plant.signals import Truth
from servobench.plant.timing import RENAMED_DELAY
from servobench.plant.world import World

if TYPE_CHECKING:
    from servobench.plant.bullet.mechanics import Mechanics
    from servobench.plant.bullet.scene import Scene

CONTACT_STEPS = 10  # physics steps between two looks for contact, 10 mm at 1 m/s; and at the end of a period
BoxNumbers = Annotated[tuple[Number, ...], Len(6, 6)]


@settings
class BulletConfig:
    """Settings of the rendered plant; those of masses, loads and drives are a UR5's, and change with the robot."""

    max_joint_speed: Positive = 1.0
    """[rad/s] limit of every joint, beside its maker's; a cautious share of a UR5's π."""
    joint_range: Positive = 2 * math.pi
    """[rad] largest joint position each way, beside its maker's limits; a UR5's range."""
    lag: NonNegative = 0.05
    """[s] τ, by which the drives smooth the commanded velocity; 0 means none."""
    drives: DriveConfig = nested(DriveConfig)
    """Loops, torque limits, friction and load of the joints."""
    encoder_resolution: NonNegative = 2 * math.pi / 2**17
    """[rad] step of reported positions, 0 for none; 17 bits, 0.04 mm at the reach of 0.85 m, below the UR5's 0.1 mm."""
    room_contact: bool = True
    """End the run, as `collision`, when the arm meets the table, the floor or an obstacle."""
    self_contact: bool = False
    """The same when the arm meets itself; off, as the task `circle` leads the wrist 70 mm into the upper arm."""
    obstacles: tuple[BoxNumbers, ...] = ()
    """[m] boxes that hide the ball and stand in the way: x, y, z of the centre in the base frame, and three sides."""
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
    depth_patch: NonNegative = 9.0
    """[px] side of the matched patch at `native_width`, over which depths share their error; 0 means white noise."""
    depth_quantisation: NonNegative = 0.001
    """[m] depth unit of the sensor; 0 means none."""
    colour_noise: NonNegative = 2.5
    """[of 255] deviation of each channel of each pixel: shot noise of a pixel with a full well of 10,000 electrons."""
    scenery: bool = True
    """Draw the table and the floor; without them a frame costs a fifth."""
    view: bool = False
    """Open PyBullet's window and run in real time."""

    RENAMED: ClassVar[Mapping[str, str]] = RENAMED_DELAY

    def boxes(self) -> tuple[Box, ...]:
        """Return the obstacles."""
        return tuple(
            Box(f"obstacle {k}", (x, y, z), (dx, dy, dz)) for k, (x, y, z, dx, dy, dz) in enumerate(self.obstacles, 1)
        )

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
            self.depth_patch,
            self.depth_quantisation,
            self.sensing.noise_factor,
        )


@dataclass(frozen=True, eq=False)
class BulletState:
    """A saved state of the world, without handles: any world with the same robot and settings can restore it.

    Attributes:
        joints: angles, speeds and loops of the joints.
        periods: number of periods since the reset.
        X_BC: (4, 4), pose of the camera.
        noise: generators of the depth and the colour noise.
    """

    joints: DriveState
    periods: int
    X_BC: FloatArray
    noise: tuple[np.random.Generator, np.random.Generator]


class BulletWorld(World):
    """An arm with drives under a fixed RGB-D camera; y = centre of the ball it sees."""

    def __init__(self, config: BulletConfig, setup: PlantSetup) -> None:
        """Open worlds of its own and load the arm.

        Raises:
            ValueError: a start of the wrong size, a period that physics steps do not divide, a list that does not
                fit the joints, a gear ratio of 0, or a window without a display.
        """
        # PyBullet loads slowly.
        from servobench.plant.bullet.mechanics import Mechanics  # noqa: PLC0415
        from servobench.plant.bullet.scene import Scene  # noqa: PLC0415

        model, start = setup.ball_robot()
        self._config, self._model, arm = config, model, model.arm
        self.lag = config.lag
        self.spec = hand_eye_spec(model, setup.period, config.max_joint_speed, config.joint_range, setup.limits)
        self._start = as_vector("start", start, self.spec.n)
        self._steps = whole_steps(setup.period, PHYSICS_STEP)
        if not arm.gear_ratio.all():
            raise ValueError(f"gear_ratio must not be zero, got {arm.gear_ratio.tolist()}")
        self._camera, self._depth_noise = config.camera(), config.noise()
        self._X_BC = model.X_BC
        boxes, load = config.boxes(), config.drives
        robot = setup.nominal or find_robot(UR5)
        self._ball_radius = robot.workspace.ball_radius
        self._scene: Scene = Scene(arm, scenery=config.scenery, window=config.view, boxes=boxes, robot=robot)
        try:
            self._mechanics: Mechanics = Mechanics(
                arm, payload=load.payload, assumed_payload=load.assumed_payload, boxes=boxes, robot=robot
            )
        except BaseException:
            self._scene.close()
            raise
        stops = arm.joint_angle(self.spec.joint_lower), arm.joint_angle(self.spec.joint_upper)
        assumed = self._mechanics.assumed_inertia(arm.joint_angle(self._start))
        self._drives = Drives(load, config.lag, assumed, (np.minimum(*stops), np.maximum(*stops)))

    def reset(self, seed: int) -> FloatArray:
        """Go back to the start at rest; depth and colour noise get random streams of their own. See `World.reset`.

        Raises:
            Collision: the arm overlaps with itself or the room at the start.
        """
        self._noise, self._colour_noise = named_generator(seed, "depth_noise"), named_generator(seed, "colour_noise")
        self.move_camera(self._X_BC)
        self._periods = 0
        angle = self._model.arm.joint_angle(self._start)
        self._joints = self._drives.start(angle, self._mechanics.body(angle, np.zeros(self.spec.n)))
        self._scene.place(angle)
        self._check_contact(0)
        self._started = time.perf_counter()
        return self._reported()

    def advance(self, joint_velocity: FloatArray) -> FloatArray:
        """Hold a command for one period; see `World.advance`.

        Raises:
            Collision: the arm has met itself or the room.
        """
        speed = self._model.arm.gear_ratio * joint_velocity
        for step in range(1, self._steps + 1):
            self._joints = self._turn(self._drives.follow(self._joints, speed))
            if step % CONTACT_STEPS == 0 or step == self._steps:
                self._check_state(step)
        self._scene.place(self._joints.angle)
        self._periods += 1
        if self._config.view:
            self._keep_pace()
        return self._reported()

    def _turn(self, joints: DriveState) -> DriveState:
        """Return the joints one physics step later."""
        if not self._config.drives.dynamics:
            return self._drives.track(joints)
        return self._drives.drive(joints, self._mechanics.body(joints.angle, joints.speed))

    def _check_state(self, step: int) -> None:
        """Raise the fault of joints that are not finite or of an arm that touches something, at a physics step."""
        if not np.isfinite(self._joints.angle).all():
            raise PlantDiverged(f"joint positions are not finite: {self._joints.angle.tolist()}")
        self._check_contact(step)

    def _check_contact(self, step: int) -> None:
        room, own = self._config.room_contact, self._config.self_contact
        touching = self._mechanics.contact(self._joints.angle, room=room, own=own) if room or own else None
        if touching is not None:
            seconds = self._periods * self.spec.period + step * PHYSICS_STEP
            raise Collision(f"{touching[0]} meets {touching[1]} at {seconds:.3f} s")

    def see(self) -> FloatArray | None:
        """Return the ball's centre as the sensor sees it, or None; noise is drawn only where the ball's colour is."""
        rgba, buffer = self._render()
        deviation = self._config.colour_noise * self._config.sensing.noise_factor
        if deviation > 0.0:
            rgba = add_colour_noise(rgba, deviation, self._colour_noise)
        found = find_ball(rgba, buffer, self._camera, self._ball_radius, self._sense)
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
        return BulletState(
            self._joints, self._periods, self._model.X_BC, copy.deepcopy((self._noise, self._colour_noise))
        )

    def restore(self, state: BulletState) -> None:
        """See `Plant.restore`."""
        self._joints, self._periods = state.joints, state.periods
        self._scene.place(state.joints.angle)
        self.move_camera(state.X_BC)
        self._noise, self._colour_noise = copy.deepcopy(state.noise)

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
        found = find_ball(rgba, buffer, self._camera, self._ball_radius)
        return draw_detection(rgba[..., :3], found, self._camera, self._ball_radius)

    def close(self) -> None:
        """Leave PyBullet's worlds."""
        self._scene.close()
        self._mechanics.close()

    def _joint_position(self) -> FloatArray:
        """Return the exact joint positions q = (θ − o)/g, (n,) rad."""
        arm = self._model.arm
        q: FloatArray = (self._joints.angle - arm.joint_offset) / arm.gear_ratio
        return q

    def _reported(self) -> FloatArray:
        """Return the joint positions in steps of the encoders, (n,) rad; a stop is the end of the scale."""
        q, resolution = self._joint_position(), self._config.encoder_resolution
        if resolution == 0.0:
            return q
        lower, upper, half = self.spec.joint_lower, self.spec.joint_upper, resolution / 2.0
        steps = np.where(q >= upper - half, upper, np.round(q / resolution) * resolution)
        return np.where(q <= lower + half, lower, steps)

    def _render(self) -> tuple[ByteArray, FloatArray]:
        return self._scene.render(self._camera, self._model.X_BC)

    def _sense(self, depth: FloatArray, patch: Patch) -> FloatArray:
        return self._depth_noise.apply(depth, (patch.rows, patch.columns), self._camera, self._noise)

    def _keep_pace(self) -> None:
        """Wait until the wall clock has come as far as the run; only with a window."""
        time.sleep(max(0.0, self._started + self._periods * self.spec.period - time.perf_counter()))


def bullet_config(robot: Robot) -> BulletConfig:
    """Return the default settings for a robot: drives and load in proportion to its own."""
    return BulletConfig() if robot.name == UR5 else BulletConfig(drives=drives_for(robot))


def build_bullet(config: BulletConfig, setup: PlantSetup) -> Bench:
    """Return the rendered plant.

    Raises:
        ValueError: see `BulletWorld`.
    """
    return build_bench(partial(BulletWorld, config), setup, config.command_delay, config.sensing)


def rendering_engine() -> str:
    """Return which engine renders the images, and how they arrive."""
    from servobench.plant.bullet.scene import describe_renderer  # noqa: PLC0415

    return describe_renderer()


ENTRY = PlantEntry(
    name="bullet",
    summary="PyBullet arm with dynamics; the ball is found in the rendered images of a depth camera",
    config=BulletConfig,
    build=build_bullet,
    needs=("pybullet",),
    engine=rendering_engine,
    config_for=bullet_config,
)
