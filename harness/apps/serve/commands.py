"""The command `servobench serve`: a plant on the ports of a UR, or as a robot of ROS 2."""

from __future__ import annotations

import ipaddress
import os
from typing import TYPE_CHECKING, Annotated, Literal

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import PLANT, option, switch
from servobench.harness.cli.terminal import interrupting_as_usual, say
from servobench.plant.contract.faults import ConfigurationError, RunFault, configuration_errors

if TYPE_CHECKING:
    from servobench.harness.config.settings import Settings
    from servobench.harness.run.request import RunRequest

LOOPBACK = "127.0.0.1"


def serve(
    *,
    protocol: Annotated[
        Literal["rtde", "ros2"], option("NAME", "rtde: that of a UR; ros2: messages of ROS 2.")
    ] = "rtde",
    plant: Annotated[str, option(PLANT, "The plant that is served.")] = "kinematic",
    robot: options.RobotOption = "ur5e",
    task: options.TaskOption = "exp2",
    mismatch: options.MismatchOption = options.DEFAULT_MISMATCH,
    sensing: options.SensingOption = "position",
    seed: Annotated[int, option("INTEGER", "Seed of the plant.")] = 0,
    overrides: options.Overrides,
    address: Annotated[
        str, option("ADDRESS", "Of the network interface that rtde listens on.")
    ] = LOOPBACK,
    lockstep: Annotated[
        bool, switch("--lockstep", "Let the clock wait for the command of each period.")
    ] = False,
) -> None:
    """Serve a plant on the ports of a UR, or as a robot of ROS 2.

    For the client ur-rtde 1.6.5, or for a node that commands joint velocities. Conformance with these is checked;
    nothing here makes a robot safe. Ctrl-C ends it.
    """
    from servobench.harness.run.loop import careful
    from servobench.harness.run.request import RunRequest
    from servobench.harness.run.tasks import choose_task
    from servobench.plant.robot.mismatch import Mismatch

    with configuration_errors("--address: "):
        ipaddress.ip_address(address)
    names = selection.choose("plants", plant), "constant", choose_task(task)
    request = RunRequest(*names, Mismatch.parse(mismatch), seed, robot=robot, sensing=sensing)
    settings = overrides.settings()

    with careful():
        try:
            if protocol == "rtde":
                _serve_rtde(request, settings, address, lockstep=lockstep)
            elif address == LOOPBACK:
                _serve_ros2(request, settings, lockstep=lockstep)
            else:
                raise ConfigurationError(
                    "--address is one of rtde; for ros2 set the variable ROS_AUTOMATIC_DISCOVERY_RANGE"
                )
        except RunFault as fault:
            raise ConfigurationError(f"plant {plant}: {fault}") from fault


def _serve_rtde(request: RunRequest, settings: Settings, address: str, *, lockstep: bool) -> None:
    import asyncio

    from servobench.harness.apps.serve.server import Server

    served = Server(request, settings, say, lockstep=lockstep)
    try:
        with interrupting_as_usual():
            asyncio.run(served.serve(address))
    finally:
        served.rollout.plant.close()


def _serve_ros2(request: RunRequest, settings: Settings, *, lockstep: bool) -> None:
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    try:
        from servobench.harness.apps.serve.ros2 import Robot
    except ImportError as error:
        raise ConfigurationError(
            f"--protocol ros2 needs rclpy ({error}): on Python 3.12 pip install 'servobench[ros2]', on others "
            "source an installed ROS 2"
        ) from error
    from servobench.harness.apps.serve.served import Served

    served = Served(request, settings, say, lockstep=lockstep, stamps=True)
    try:
        robot = Robot(served, say, lockstep=lockstep)
        with interrupting_as_usual():
            robot.serve()
    finally:
        served.plant.close()
