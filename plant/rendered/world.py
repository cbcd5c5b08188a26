"""The world of a rendered plant: an arm with dynamics, and cameras in whose rendered images the target is detected.

A physics engine (`servobench.plant.rendered.engine`) moves the arm under the drives of
`servobench.plant.rendered.drives`, at 1 kHz or slightly faster, and renders it. Controllers get and command reported
positions q, which are (θ − o)/g of the simulator's angles θ, in steps of the encoders. A link that meets another one,
the table, the floor or an obstacle ends the run. Features are measured by `servobench.plant.rendered.detectors`.
Delay, latency and lost frames are those of `servobench.plant.bench.bench`.
"""

import math
import time
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from servobench.plant.bench.plant import PlantSetup, World
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.contract.checks import FloatArray, as_array, fewest_parts
from servobench.plant.contract.faults import Collision, PlantDiverged
from servobench.plant.contract.signals import BoolArray, Truth
from servobench.plant.rendered.detection import ByteArray
from servobench.plant.rendered.detectors import ImageNoise, open_detector
from servobench.plant.rendered.drives import PHYSICS_STEP, DriveState
from servobench.plant.rendered.engine import Engine, Machine, Overlap
from servobench.plant.rendered.room import Room
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.ur5 import UR5

# Physics steps between two checks for contact, 10 mm at 1 m/s; the end of a period is checked, too.
CONTACT_STEPS = 10
LAST_ON_TABLE = 1  # base and shoulder stand on the table
# Base and upper arm, whose housings meet inside the shoulder in every pose.
BUILT_INTO_EACH_OTHER: set[int | str] = {0, 2}


class Contacts:
    """The contact of one arm; neighbouring links never count, nor do base and shoulder on their table."""

    def __init__(
        self,
        overlaps: Callable[[FloatArray], Iterable[Overlap]],
        arm: SerialArm,
        robot: Robot,
        config: RenderedConfig,
    ) -> None:
        """Find the links that are built into each other.

        Args:
            overlaps: from joint angles (n,) [rad] to the bodies that overlap.
            arm: the true kinematics.
            robot: by its maker's description; its home is free of contact.
            config: whether contact counts.
        """
        self._room = config.room_contact
        self._own = config.self_contact
        self._overlaps = overlaps
        self._names = ["base", *arm.joint_names]
        self._built_in = [BUILT_INTO_EACH_OTHER]
        if robot.name != UR5:
            self._built_in += map(set, overlaps(arm.joint_angle(robot.workspace.home)))

    def find(self, angle: FloatArray) -> tuple[str, str] | None:
        """Return the names of two bodies whose contact counts at joint angles (n,) [rad], or None."""
        if not self._room and not self._own:
            return None
        for link, other in self._overlaps(angle):
            if isinstance(other, str):
                if self._room and link > LAST_ON_TABLE:
                    return self._names[link], other
            elif self._own and abs(link - other) > 1 and {link, other} not in self._built_in:
                return self._names[min(link, other)], self._names[max(link, other)]
        return None


class RenderedState(NamedTuple):
    """A saved state of the world, without handles: any world with the same robot and settings can restore it."""

    joints: DriveState  # angles, speeds and loops of the joints
    periods: int  # number of periods since the reset
    camera: FloatArray  # (4, 4), pose of the first camera
    noise: ImageNoise  # noise of the next frame


class RenderedWorld(World):
    """An arm with drives and its cameras."""

    def __init__(self, engine: Engine, config: RenderedConfig, setup: PlantSetup) -> None:
        """Open a scene and a simulation with the arm.

        Raises:
            ValueError: a start of the wrong size, a list that does not fit the joints, a gear ratio of 0, masses that
                no body has, or a window without a display.
        """
        robot = setup.nominal or find_robot(UR5)
        if robot.flaw:
            raise ValueError(f"robot {robot.name}: {robot.flaw}")
        model, start = setup.robot()
        arm = model.arm
        self._config = config
        self._model = model
        self.lag = config.lag
        self.spec = hand_eye_spec(
            model, setup.period, config.max_joint_speed, config.joint_range, setup.limits
        )
        extents = config.sensing.extents(self.spec.feature.unit)
        # Without noise, features keep their bits.
        if extents.feature_noise or extents.quantum or config.sensing.outliers > 0.0:
            self.noise_unit = model.noise_unit
        self._start = as_array("start", start, (self.spec.n,))
        self._steps = fewest_parts(setup.period, PHYSICS_STEP)
        self._physics_step = PHYSICS_STEP
        if not math.isclose(self._steps * PHYSICS_STEP, setup.period, rel_tol=0.0, abs_tol=1e-9):
            self._physics_step = setup.period / self._steps
        if not arm.gear_ratio.all():
            raise ValueError(f"gear_ratio must not be zero, got {arm.gear_ratio.tolist()}")
        self._camera = model.camera
        self._valid: BoolArray | None = None
        boxes = config.boxes()
        target = model if isinstance(model, SetupModel) else None
        room = Room(arm, config.scenery, robot, boxes, target)
        self._scene = engine.scene(room, window=config.view)
        # A negative gear ratio makes the lower stop of a joint position the upper one of its angle.
        one_stop = arm.joint_angle(self.spec.joint_lower)
        other_stop = arm.joint_angle(self.spec.joint_upper)
        stops = (np.minimum(one_stop, other_stop), np.maximum(one_stop, other_stop))
        try:
            self._detector = open_detector(model, self._scene, config, robot)
            machine = Machine(
                arm=arm,
                robot=robot,
                boxes=boxes,
                drives=config.drives,
                lag=config.lag,
                start=arm.joint_angle(self._start),
                stops=stops,
                physics_step=self._physics_step,
            )
            self._simulation = engine.simulation(machine)
        except BaseException:
            self._scene.close()
            raise
        self._contacts = Contacts(self._simulation.overlaps, arm, robot, config)

    def reset(self, seed: int) -> FloatArray:
        """Go back to the start at rest. See `World.reset`.

        Raises:
            Collision: the arm overlaps with itself or the room at the start.
        """
        self._noise = ImageNoise(seed)
        self.move_camera(self._camera)
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
            if not np.isfinite(self._joints.angle).all():
                raise PlantDiverged(
                    f"joint positions are not finite: {self._joints.angle.tolist()}"
                )
            self._check_contact(last)
        self._scene.place(self._joints.angle)
        self._periods += 1
        if self._config.view:
            # The window shows the run at the pace of the wall clock.
            end = self._started + self._periods * self.spec.period
            time.sleep(max(0.0, end - time.perf_counter()))
        return self._reported()

    def _check_contact(self, step: int) -> None:
        touching = self._contacts.find(self._joints.angle)
        if touching is not None:
            seconds = self._periods * self.spec.period + step * self._physics_step
            raise Collision(f"{touching[0]} meets {touching[1]} at {seconds:.3f} s")

    def see(self) -> FloatArray | None:
        """Return the features as measured now, (m,); None if nothing is found."""
        feature, self._valid = self._detector.measure(
            self._model, self._joint_position(), self._noise
        )
        self._noise = self._noise.next()
        return feature

    def visible(self) -> BoolArray | None:
        """See `World.visible`."""
        return self._valid

    def why_unseen(self) -> str:
        """Return where the target is and would appear."""
        return self._detector.why_missing(self._model, self._joint_position(), self._valid)

    def save(self) -> RenderedState:
        """See `Plant.save`; measured: joints, detections and images continue with the same bits."""
        return RenderedState(self._joints, self._periods, self._model.camera, self._noise)

    def restore(self, state: RenderedState) -> None:
        """See `Plant.restore`."""
        self._joints = state.joints
        self._periods = state.periods
        self._scene.place(state.joints.angle)
        self.move_camera(state.camera)
        self._noise = state.noise

    def move_camera(self, X_BC: FloatArray) -> None:
        """See `Plant.move_camera`."""
        self._model = self._model.with_camera(X_BC)

    def truth(self) -> Truth:
        """Return true features and Jacobian at the present joints."""
        return self._detector.truth(self._model, self._joint_position())

    def picture(self) -> ByteArray:
        """Return the present images of the cameras with the detected points marked, (h, w, 3)."""
        return self._detector.picture(self._model, self._joint_position())

    def close(self) -> None:
        """Close the scene and the simulation."""
        self._scene.close()
        self._simulation.close()

    def _joint_position(self) -> FloatArray:
        """Return the exact joint positions q = (θ − o)/g, (n,) rad."""
        arm = self._model.arm
        return (self._joints.angle - arm.joint_offset) / arm.gear_ratio

    def _reported(self) -> FloatArray:
        """Return the joint positions in steps of the encoders, (n,) rad; the scale ends at the stops."""
        q = self._joint_position()
        resolution = self._config.encoder_resolution
        if resolution == 0.0:
            return q
        half = resolution / 2.0
        lower = self.spec.joint_lower
        upper = self.spec.joint_upper
        steps = np.round(q / resolution) * resolution
        below_upper = np.where(q >= upper - half, upper, steps)
        return np.where(q <= lower + half, lower, below_upper)
