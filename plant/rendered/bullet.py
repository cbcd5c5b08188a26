"""PyBullet: a scene for the cameras, rendered by TinyRenderer, and the moving arm as rigid bodies.

The world frame W is the arm's base frame B. The drives of `servobench.plant.rendered.drives` integrate the motion;
PyBullet gives inertia, gravity torques and contact, in a physics world without visual shapes: the arm with its true
load, the arm as the drives assume it, and the table, the floor and the boxes around it.

PyBullet's C library prints a banner, past `sys.stderr`, so the file descriptor is redirected during the import. All
other output that is written to it in the meantime is passed on afterwards.
"""

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.detection import Window, whole
from servobench.plant.rendered.drives import Drives, DriveState, RigidBody
from servobench.plant.rendered.engine import (
    MIN_OVERLAP,
    Engine,
    Image,
    Machine,
    Overlap,
    Scene,
    Simulation,
)
from servobench.plant.rendered.room import Room
from servobench.plant.rendered.urdf import arm_mechanics, boxes_urdf, room_boxes
from servobench.plant.robot.camera import PinholeCamera, view_matrix
from servobench.plant.robot.robot import GRAVITY

BANNER = b"pybullet build time:"  # the beginning of the line
STANDARD_ERROR = 2  # file descriptor
# Place of the distance in a contact point of PyBullet; it is negative where bodies overlap.
CONTACT_DISTANCE = 8


@contextlib.contextmanager
def without_banner(descriptor: int = STANDARD_ERROR) -> Iterator[None]:
    """Hold back the output to a file descriptor within the context, and write it afterwards without the banner."""
    try:
        kept = os.dup(descriptor)
    except OSError:  # The descriptor is closed, so nothing can be printed.
        yield
        return
    with tempfile.TemporaryFile() as aside:
        os.dup2(aside.fileno(), descriptor)
        try:
            yield
        finally:
            os.dup2(kept, descriptor)
            os.close(kept)
            aside.seek(0)
            others = b"".join(line for line in aside if not line.startswith(BANNER))
            while others:
                others = others[os.write(descriptor, others) :]


with without_banner():
    import pybullet


def describe_renderer() -> str:
    """Return the engine that renders images, its version, and a note if its images arrive slowly."""
    line = f"PyBullet {version('pybullet')}, software renderer TinyRenderer"
    if pybullet.isNumpyEnabled():
        return line
    return f"{line}, built without numpy: images arrive as tuples, which is slower"


class PhysicsWorld:
    """A world of PyBullet.

    Attributes:
        client: its number in all calls; -1 once it is closed.
    """

    def __init__(self, mode: int = pybullet.DIRECT) -> None:
        """Open a world.

        Raises:
            ConnectionError: PyBullet opens no world, as too many are open.
        """
        self.client: int = pybullet.connect(mode)
        if self.client < 0:
            raise ConnectionError("PyBullet could not open a physics world")
        # With file caching PyBullet keeps every mesh that it loaded, so memory would grow with each plant.
        pybullet.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=self.client)

    def load(self, files: Mapping[str, str], flags: int = 0) -> int:
        """Load the URDFs among files, text by name, with the meshes they name, and return the number of the first."""
        with tempfile.TemporaryDirectory(prefix="servobench-") as folder:
            for name, text in files.items():
                (Path(folder) / name).write_text(text, encoding="utf-8")
            bodies = []
            for name in files:
                if not name.endswith(".urdf"):
                    continue
                body = pybullet.loadURDF(
                    str(Path(folder) / name),
                    useFixedBase=True,
                    flags=pybullet.URDF_USE_INERTIA_FROM_FILE | flags,
                    physicsClientId=self.client,
                )
                bodies.append(body)
        return int(bodies[0])

    def place(self, body: int, angles: FloatArray) -> None:
        """Put the joints of a body at angles (n,) rad."""
        for joint, angle in enumerate(angles.tolist()):
            pybullet.resetJointState(body, joint, angle, physicsClientId=self.client)

    def close(self) -> None:
        """Close the world; calling it twice is allowed."""
        client = self.client
        self.client = -1
        if client >= 0 and pybullet.isConnected(client):
            pybullet.disconnect(client)


class BulletScene(Scene):
    """An arm with a ball on its flange in a PyBullet world of its own; joint angles here are the true ones, θ."""

    def __init__(self, room: Room, *, window: bool = False) -> None:
        """Open a world and load the room; see `Scene`.

        Raises:
            ValueError: a robot with another number of joints, or a window is wanted where there is no display.
            ConnectionError: PyBullet opens no world, as too many are open.
        """
        if window and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
            raise ValueError(
                "view needs a display, but the environment variable DISPLAY is not set"
            )
        self._world = PhysicsWorld(pybullet.GUI if window else pybullet.DIRECT)
        try:
            self._arm = self._world.load(room.files())
            if window:
                # The window shows the arm from the front right, without PyBullet's side panels.
                client = self._world.client
                pybullet.configureDebugVisualizer(
                    pybullet.COV_ENABLE_GUI, 0, physicsClientId=client
                )
                pybullet.resetDebugVisualizerCamera(
                    1.9, 50.0, -30.0, (0.3, 0.0, 0.15), physicsClientId=client
                )
        except BaseException:
            self.close()
            raise
        self._ball_link = room.arm.n + 1

    def place(self, theta: FloatArray) -> None:
        """See `Scene.place`."""
        self._world.place(self._arm, theta)

    def ball_position(self) -> FloatArray:
        """See `Scene.ball_position`; from the simulator's own link state."""
        client = self._world.client
        state = pybullet.getLinkState(
            self._arm, self._ball_link, computeForwardKinematics=1, physicsClientId=client
        )
        return np.array(state[4])

    def render(
        self, camera: PinholeCamera, X_BC: FloatArray, window: Window | None = None
    ) -> Image:
        """See `Scene.render`; the projection is magnified so that the window fills the picture of TinyRenderer."""
        window = window or whole(camera)
        height, width = window.shape
        view = view_matrix(X_BC)
        projection = magnification(camera, window) @ camera.projection_matrix()
        # PyBullet takes matrices column by column.
        _, _, rgba, depth, _ = pybullet.getCameraImage(
            width,
            height,
            view.T.ravel().tolist(),
            projection.T.ravel().tolist(),
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._world.client,
        )
        # A PyBullet built without numpy returns tuples.
        colours = np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)
        return colours, np.asarray(depth).reshape(height, width)

    def close(self) -> None:
        """See `Scene.close`."""
        self._world.close()


def magnification(camera: PinholeCamera, window: Window) -> FloatArray:
    """Return the matrix, (4, 4), that scales and shifts clip coordinates so that a window fills the picture.

    Clip coordinates x to the right and y upwards run from −1 to 1 over the whole image of w × h pixels:

        x' = (w x + w − left − right) / (right − left),        y' = (h y − h + top + bottom) / (bottom − top)
    """
    matrix = np.eye(4)
    height, width = window.shape
    matrix[0, 0] = camera.width / width
    matrix[1, 1] = camera.height / height
    matrix[0, 3] = (camera.width - window.left - window.right) / width
    matrix[1, 3] = (window.top + window.bottom - camera.height) / height
    return matrix


class BulletSimulation(Simulation):
    """The cascade of `servobench.plant.rendered.drives`, stepped at 1 kHz or faster on PyBullet's rigid bodies."""

    def __init__(self, machine: Machine) -> None:
        """Open a world without visual shapes and load the arm twice, with the true and with the assumed load.

        Raises:
            ValueError: a list of the drives that does not fit the joints.
            ConnectionError: PyBullet opens no world, as too many are open.
        """
        arm = machine.arm
        robot = machine.robot
        drives = machine.drives
        self._world = PhysicsWorld()
        client = self._world.client
        try:
            pybullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
            true_urdf = arm_mechanics(arm, drives.payload, shapes=True, robot=robot)
            self._arm = self._load(true_urdf, pybullet.URDF_USE_SELF_COLLISION)
            assumed_urdf = arm_mechanics(arm, drives.assumed_payload, shapes=False, robot=robot)
            self._assumed = self._load(assumed_urdf)
            self._boxes = {}
            for box in (*room_boxes(robot.workspace.scale), *machine.boxes):
                body = self._load(boxes_urdf((box,)))
                self._boxes[body] = box.name
            start = machine.start.tolist()
            mass_matrix = pybullet.calculateMassMatrix(self._assumed, start, physicsClientId=client)
            inertia = np.array(mass_matrix)
            self._drives = Drives(
                drives, machine.lag, inertia, machine.stops, physics_step=machine.physics_step
            )
        except BaseException:
            self.close()
            raise
        self._dynamics = drives.dynamics
        self._rest = [0.0] * arm.n

    def _load(self, urdf: str, flags: int = 0) -> int:
        return self._world.load({"body.urdf": urdf}, flags)

    def start(self, angle: FloatArray) -> DriveState:
        """See `Simulation.start`."""
        return self._drives.start(angle, self.body(angle, np.zeros(len(angle))))

    def advance(self, joints: DriveState, speed: FloatArray, steps: int) -> DriveState:
        """See `Simulation.advance`."""
        drives = self._drives
        drives.take(joints, speed)
        for _ in range(steps):
            if self._dynamics:
                drives.drive(self.body(drives.angle, drives.speed))
            else:
                drives.track()
        return drives.give()

    def body(self, angle: FloatArray, speed: FloatArray) -> RigidBody:
        """Return inertia and torques at joint angles (n,) [rad] and speeds (n,) [rad/s]."""
        client = self._world.client
        theta = angle.tolist()
        omega = speed.tolist()
        rest = self._rest
        torques = pybullet.calculateInverseDynamics
        inertia = pybullet.calculateMassMatrix(self._arm, theta, physicsClientId=client)
        # Without acceleration, inverse dynamics give b(θ, ω); without speed, the gravity torque alone.
        bias = torques(self._arm, theta, omega, rest, physicsClientId=client)
        assumed_gravity = torques(self._assumed, theta, rest, rest, physicsClientId=client)
        return RigidBody(np.array(inertia), np.array(bias), np.array(assumed_gravity))

    def overlaps(self, angle: FloatArray) -> Iterator[Overlap]:
        """See `Simulation.overlaps`."""
        client = self._world.client
        last = len(angle) - 1
        self._world.place(self._arm, angle)
        pybullet.performCollisionDetection(physicsClientId=client)
        for point in pybullet.getContactPoints(bodyA=self._arm, physicsClientId=client):
            if point[CONTACT_DISTANCE] <= -MIN_OVERLAP:
                # PyBullet counts the base as -1. Flange, tool and ball are beyond the last link and count as it.
                _, _, body, link, other = point[:5]
                other_link = min(other, last) + 1
                yield Overlap(min(link, last) + 1, self._boxes.get(body, other_link))

    def close(self) -> None:
        """See `Simulation.close`."""
        self._world.close()


ENGINE = Engine(BulletScene, BulletSimulation, describe_renderer)
