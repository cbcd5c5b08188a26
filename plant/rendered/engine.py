"""The contract of a physics engine under a rendered plant: it renders an arm, and it moves one.

Joint angles here are the true ones, θ; the world frame W is the arm's base frame B.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import NamedTuple

from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.detection import ByteArray, Window
from servobench.plant.rendered.drives import PHYSICS_STEP, DriveState
from servobench.plant.rendered.room import Room
from servobench.plant.rendered.settings import Box, DriveConfig
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.camera import PinholeCamera
from servobench.plant.robot.robot import Robot

Image = tuple[ByteArray, FloatArray]  # colours and depths
MIN_OVERLAP = 0.01  # [m] less is no contact, as the shapes are schematic


class Scene(ABC):
    """An arm with a ball on its flange, for rendering only."""

    @abstractmethod
    def __init__(self, room: Room, *, window: bool = False) -> None:
        """Open a world and load the room.

        Args:
            room: the bodies.
            window: whether to open the engine's window.

        Raises:
            ValueError: a robot with another number of joints, or a window is wanted where there is no display.
        """

    @abstractmethod
    def place(self, theta: FloatArray) -> None:
        """Put the arm at joint angles `theta` (n,) rad."""

    @abstractmethod
    def ball_position(self) -> FloatArray:
        """Return the ball's centre in the base frame, (3,) m, from the engine's own kinematics."""

    @abstractmethod
    def render(
        self, camera: PinholeCamera, X_BC: FloatArray, window: Window | None = None
    ) -> Image:
        """Return the image of a camera at X_BC (4, 4): colours (h, w, 3 or 4) uint8, OpenGL depths (h, w) in [0, 1].

        With a window only this part of the image; its pixels are those of the whole image, but for rounding.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the engine's world; calling it twice is allowed."""


class Machine(NamedTuple):
    """The parts that a simulation is built from."""

    arm: SerialArm  # the true kinematics
    robot: Robot  # by its maker's description, for masses and shapes
    boxes: tuple[Box, ...]  # obstacles other than table and floor
    drives: DriveConfig  # loops, torque limits, friction and load of the joints
    lag: float  # [s] time constant by which the drives smooth commanded velocities, 0 for none
    start: FloatArray  # (n,) [rad], joint angles at which the loops are tuned
    stops: tuple[
        FloatArray, FloatArray
    ]  # (n,) and (n,) [rad], lower and upper stop of the joint angles
    physics_step: float = PHYSICS_STEP  # [s]


class Overlap(NamedTuple):
    """Two bodies that overlap by `MIN_OVERLAP` or more."""

    link: int  # number of a link, counted from the base, which is 0; flange, tool and ball belong to the last one
    other: int | str  # number of another link, or the name of a box in the room


class Simulation(ABC):
    """An arm with mass and drives among obstacles; methods take its state and return a new one."""

    @abstractmethod
    def start(self, angle: FloatArray) -> DriveState:
        """Return joints at rest at `angle` (n,) [rad] with drives that carry the arm's weight."""

    @abstractmethod
    def advance(self, joints: DriveState, speed: FloatArray, steps: int) -> DriveState:
        """Return the joints some physics steps later.

        Args:
            joints: the present state.
            speed: (n,) [rad/s], commanded, of the joint angles.
            steps: how many steps of the machine's `physics_step`.
        """

    @abstractmethod
    def overlaps(self, angle: FloatArray) -> Iterable[Overlap]:
        """Return the bodies that overlap at joint angles (n,) [rad]."""

    @abstractmethod
    def close(self) -> None:
        """Free the engine's world; calling it twice is allowed."""


class Engine(NamedTuple):
    """A physics engine."""

    scene: type[Scene]  # for the camera
    simulation: Callable[[Machine], Simulation]  # for the motion
    # Returns one line about the engine and the library that renders its images.
    describe: Callable[[], str]
    # Returns one line about missing parts of this machine; empty if nothing is missing.
    lacking: Callable[[], str] = str
