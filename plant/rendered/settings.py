"""Settings of plants that render images, the same for every engine; so are their defaults."""

import math
from dataclasses import field
from typing import Annotated, Literal

from annotated_types import Len

from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import (
    Count,
    Delay,
    JointSpeed,
    NonNegative,
    Number,
    Positive,
    Usual,
    nested,
    settings,
)  # fmt: skip
from servobench.plant.rendered.drives import DriveConfig, drives_for
from servobench.plant.rendered.urdf import Box
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.ur5 import UR5

BoxNumbers = Annotated[tuple[Number, ...], Len(6, 6)]


@settings
class RenderedConfig:
    """Settings of a rendered plant; the defaults of loads and drives are a UR5's, and change with the robot."""

    max_joint_speed: JointSpeed = 1.0
    """[rad/s] limit of every joint, in addition to its maker's; a cautious share of a UR5's π."""
    joint_range: Annotated[Positive, Usual(4 * math.pi)] = 2 * math.pi
    """[rad] largest joint position each way, in addition to its maker's limits; a UR5's range."""
    lag: Delay = 0.05
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
    command_delay: Delay = 0.0
    """[s] between a command and its first effect; a multiple of the control period, or whole milliseconds."""
    sensing: SensingConfig = field(default_factory=lambda: SensingConfig(0.0, 0.05, 0.002))
    """Latency, lost frames, noise on top of the depth noise; `noise_factor` scales both."""
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
    """Open a window and run in real time; with PyBullet only."""

    def boxes(self) -> tuple[Box, ...]:
        """Return the obstacles."""
        return tuple(
            Box(f"obstacle {k}", (x, y, z), (dx, dy, dz)) for k, (x, y, z, dx, dy, dz) in enumerate(self.obstacles, 1)
        )


def rendered_config(robot: Robot) -> RenderedConfig:
    """Return the default settings for a robot: drives and load in proportion to its own."""
    return RenderedConfig() if robot.name == UR5 else RenderedConfig(drives=drives_for(robot))
