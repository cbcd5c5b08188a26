"""The world of a rendered plant: an arm with dynamics, seen by an RGB-D camera in whose image the ball is found.

A physics engine (`servobench.plant.rendered.engine`) moves the arm under the drives of
`servobench.plant.rendered.drives`, at 1 kHz, and renders it. Controllers see and command reported positions q, which
are (θ − o)/g of the simulator's angles θ, in steps of the encoders. A link that meets another one, the table, the floor
or an obstacle ends the run. The feature is the ball's centre as fitted to noisy depths; it is missing where the ball is
hidden, out of sight or cut by the image's border. Delay, latency and lost frames are those of `servobench.plant.bench`.
"""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from servobench.plant.bench import Bench, build_bench
from servobench.plant.checks import FloatArray, as_vector, whole_steps
from servobench.plant.faults import Collision, PlantDiverged
from servobench.plant.plant import PlantSetup
from servobench.plant.rendered.contact import Contacts
from servobench.plant.rendered.detection import ByteArray, Patch, add_colour_noise, draw_detection, find_ball
from servobench.plant.rendered.drives import PHYSICS_STEP
from servobench.plant.rendered.engine import Engine, Joints, Machine
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.robot.catalogue import UR5, find_robot
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.seeds import named_generator
from servobench.plant.signals import Truth
from servobench.plant.world import World

CONTACT_STEPS = 10  # physics steps between two looks for contact, 10 mm at 1 m/s; and at the end of a period


@dataclass(frozen=True, eq=False)
class RenderedState:
    """A saved state of the world, without handles: any world with the same robot and settings can restore it.

    Attributes:
        joints: angles, speeds and loops of the joints.
        periods: number of periods since the reset.
        X_BC: (4, 4), pose of the camera.
        noise: generators of the depth and the colour noise.
    """

    joints: Joints
    periods: int
    X_BC: FloatArray
    noise: tuple[np.random.Generator, np.random.Generator]


class RenderedWorld(World):
    """An arm with drives under a fixed RGB-D camera; y = centre of the ball it sees."""

    def __init__(self, engine: Engine, config: RenderedConfig, setup: PlantSetup) -> None:
        """Open worlds of its own and load the arm.

        Raises:
            ValueError: a start of the wrong size, a period that physics steps do not divide, a list that does not
                fit the joints, a gear ratio of 0, or a window without a display.
        """
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
        boxes, robot = config.boxes(), setup.nominal or find_robot(UR5)
        self._ball_radius = robot.workspace.ball_radius
        self._scene = engine.scene(arm, scenery=config.scenery, window=config.view, boxes=boxes, robot=robot)
        stops = arm.joint_angle(self.spec.joint_lower), arm.joint_angle(self.spec.joint_upper)
        ordered = np.minimum(*stops), np.maximum(*stops)
        angle = arm.joint_angle(self._start)
        try:
            self._simulation = engine.simulation(Machine(arm, robot, boxes, config.drives, config.lag, angle, ordered))
        except BaseException:
            self._scene.close()
            raise
        self._contacts = Contacts(self._simulation.overlaps, arm, robot)

    def reset(self, seed: int) -> FloatArray:
        """Go back to the start at rest; depth and colour noise get random streams of their own. See `World.reset`.

        Raises:
            Collision: the arm overlaps with itself or the room at the start.
        """
        self._noise, self._colour_noise = named_generator(seed, "depth_noise"), named_generator(seed, "colour_noise")
        self.move_camera(self._X_BC)
        self._periods = 0
        angle = self._model.arm.joint_angle(self._start)
        self._joints = self._simulation.start(angle)
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
        for first in range(0, self._steps, CONTACT_STEPS):
            last = min(first + CONTACT_STEPS, self._steps)
            self._joints = self._simulation.advance(self._joints, speed, last - first)
            self._check_state(last)
        self._scene.place(self._joints.angle)
        self._periods += 1
        if self._config.view:
            self._keep_pace()
        return self._reported()

    def _check_state(self, step: int) -> None:
        """Raise the fault of joints that are not finite or of an arm that touches something, at a physics step."""
        if not np.isfinite(self._joints.angle).all():
            raise PlantDiverged(f"joint positions are not finite: {self._joints.angle.tolist()}")
        self._check_contact(step)

    def _check_contact(self, step: int) -> None:
        room, own = self._config.room_contact, self._config.self_contact
        touching = self._contacts.find(self._joints.angle, room=room, own=own) if room or own else None
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

    def save(self) -> RenderedState:
        """See `Plant.save`; measured: joints, detections and images continue with the same bits."""
        return RenderedState(
            self._joints, self._periods, self._model.X_BC, copy.deepcopy((self._noise, self._colour_noise))
        )

    def restore(self, state: RenderedState) -> None:
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
        """Leave the engine's worlds."""
        self._scene.close()
        self._simulation.close()

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


def build_rendered(engine: Engine, config: RenderedConfig, setup: PlantSetup) -> Bench:
    """Return the rendered plant on a physics engine.

    Raises:
        ValueError: see `RenderedWorld`.
    """
    return build_bench(partial(RenderedWorld, engine, config), setup, config.command_delay, config.sensing)
