"""Settings of plants that render images, the same for every engine; so are their defaults."""

import math
from dataclasses import field
from typing import Annotated, Literal, NamedTuple

import numpy as np
from annotated_types import Len

from servobench.plant.contract.checks import Triple
from servobench.plant.contract.dependence import Only
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import (
    Count,
    Delay,
    NonNegative,
    Number,
    Positive,
    Share,
    Usual,
    nested,
    settings,
)  # fmt: skip
from servobench.plant.robot import ur5
from servobench.plant.robot.hand_eye import JointsConfig
from servobench.plant.robot.robot import Robot

RATED_PAYLOAD = 5.0  # [kg] a UR5's, by its maker
BoxNumbers = Annotated[tuple[Annotated[Number, Usual(20.0)], ...], Len(6, 6)]
Load = Annotated[NonNegative, Usual(100.0)]
Losses = Annotated[tuple[NonNegative, ...], Only(dynamics=True)]


class Box(NamedTuple):
    """A box in the room, parallel to the axes of the base frame."""

    name: str  # in error messages
    centre: Triple  # (3,) [m], base frame
    size: Triple  # (3,) [m], its three sides


@settings
class DriveConfig:
    """Settings of the joints' drives: lists have one number for all joints or one for each."""

    dynamics: bool = True
    """Torque-driven joints; false: joints follow the lag exactly."""
    velocity_bandwidth: Annotated[tuple[Positive, ...], Only(dynamics=True)] = (
        15.0,
        15.0,
        15.0,
        20.0,
        20.0,
        20.0,
    )
    """[Hz] of each velocity loop; rises in about 50 ms."""
    torque_limit: Annotated[tuple[Positive, ...], Only(dynamics=True)] = ur5.MAX_TORQUE
    """[Nm] of each joint; Universal Robots, "Max. joint torques"."""
    rotor_inertia: Losses = (0.1,)
    """[kg m²] seen at the joint (rotor times gear ratio squared); UR5e in MuJoCo Menagerie."""
    coulomb_friction: Losses = (
        7.5,
        7.5,
        7.5,
        1.4,
        1.4,
        1.4,
    )
    """[Nm] 5 % of the torque limit; order of magnitude for strain-wave gears."""
    viscous_friction: Losses = (
        7.5,
        7.5,
        7.5,
        1.4,
        1.4,
        1.4,
    )
    """[Nm s/rad] at 1 rad/s as much as Coulomb friction."""
    friction_compensation: Annotated[Share, Only(dynamics=True)] = 0.8
    """[1] share of the friction, by the reference's speed; 0.7 to 0.9 in Universal Robots' torque control."""
    payload: Annotated[Load, Only(dynamics=True)] = 2.5
    """[kg] true load, a point mass at the ball; half of the UR5's rated 5 kg."""
    assumed_payload: Annotated[Load, Only(dynamics=True)] = 0.9
    """[kg] load assumed in gravity compensation: the gripper alone (Robotiq 2F-85)."""

    def check(self, n: int) -> None:
        """Refuse lists that do not fit `n` joints.

        Raises:
            ValueError: a list of another length.
        """
        for name, values in vars(self).items():
            if isinstance(values, tuple) and len(values) not in {1, n}:
                raise ValueError(f"{name} must have 1 or {n} numbers, got {len(values)}")


def drives_for(robot: Robot) -> DriveConfig:
    """Return the settings of the drives of an arm: those of the UR5, in proportion to its joints' torques and its load.

    Joints of at least half the torque of the strongest one have the bandwidth of a shoulder, the others of a wrist.
    """
    default = DriveConfig()
    torque = robot.links.torque
    strong = torque >= torque.max() / 2.0
    shoulder = default.velocity_bandwidth[0]
    wrist = default.velocity_bandwidth[-1]
    bandwidth = np.where(strong, shoulder, wrist)
    torque_ratio = torque / ur5.MAX_TORQUE[0]
    rotor_inertia = default.rotor_inertia[0] * float(torque_ratio.max())
    friction = tuple((default.coulomb_friction[0] * torque_ratio).tolist())
    load_ratio = robot.links.payload / RATED_PAYLOAD
    return DriveConfig(
        velocity_bandwidth=tuple(bandwidth.tolist()),
        torque_limit=tuple(torque.tolist()),
        rotor_inertia=(rotor_inertia,),
        coulomb_friction=friction,
        viscous_friction=friction,
        payload=default.payload * load_ratio,
        assumed_payload=default.assumed_payload * load_ratio,
    )


@settings
class RenderedConfig(JointsConfig):
    """Settings of a rendered plant; the defaults of loads and drives are a UR5's, and change with the robot."""

    lag: Delay = 0.05
    """[s] τ, by which the drives smooth the commanded velocity; 0: none."""
    drives: DriveConfig = nested(DriveConfig)
    """Loops, torque limits, friction and load of the joints."""
    encoder_resolution: NonNegative = 2 * math.pi / 2**17
    """[rad] step of reported positions, 0: exact; 17 bits."""
    room_contact: bool = True
    """End the run (`collision`) when the arm meets table, floor or obstacle."""
    self_contact: bool = False
    """The same when the arm meets itself."""
    obstacles: tuple[BoxNumbers, ...] = ()
    """[m] boxes that occlude and collide: centre x, y, z in the base frame, and three sides."""
    command_delay: Delay = 0.0
    """[s] from command to first effect; rounded by at most 0.5 ms to fit the period."""
    sensing: SensingConfig = field(default_factory=lambda: SensingConfig(0.0, 0.05, 0.002))
    """Latency, lost frames, noise on top of the depth noise; `noise_factor` scales both."""
    depth_noise: Literal["none", "stereo", "structured_light"] = "stereo"
    """Model of the depth noise."""
    depth_subpixel: Annotated[NonNegative, Only(depth_noise="stereo")] = 0.08
    """[px] RMS disparity error of a stereo match; vendor's figure."""
    depth_baseline: Annotated[Positive, Only(depth_noise="stereo")] = 0.05
    """[m] between the two imagers; RealSense D435."""
    native_width: Annotated[Count, Only(depth_noise=("stereo", "structured_light"))] = 848
    """[px] image width of the stereo match; RealSense D435."""
    depth_patch: Annotated[NonNegative, Only(depth_noise=("stereo", "structured_light"))] = 9.0
    """[px] patch at `native_width` over which depths share their error; 0: white noise."""
    depth_quantisation: NonNegative = 0.001
    """[m] depth unit; 0: none."""
    colour_noise: NonNegative = 2.5
    """[of 255] deviation of each channel: shot noise with a full well of 10,000 electrons."""
    scenery: bool = True
    """Draw table and floor; without them a frame costs a fifth."""
    view: bool = False
    """Open a window and run in real time; PyBullet only."""

    def boxes(self) -> tuple[Box, ...]:
        """Return the obstacles."""
        boxes = []
        for number, (x, y, z, dx, dy, dz) in enumerate(self.obstacles, 1):
            boxes.append(Box(f"obstacle {number}", (x, y, z), (dx, dy, dz)))
        return tuple(boxes)


def rendered_config(robot: Robot) -> RenderedConfig:
    """Return the default settings for a robot: drives and load in proportion to its own."""
    if robot.name == ur5.UR5:
        return RenderedConfig()
    return RenderedConfig(drives=drives_for(robot))
