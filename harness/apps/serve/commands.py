"""The command `servobench serve`: a plant on the ports of a UR."""

from __future__ import annotations

import ipaddress
from typing import Annotated

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import PLANT, option, switch
from servobench.harness.cli.terminal import interrupting_as_usual, say
from servobench.plant.contract.faults import ConfigurationError, RunFault, configuration_errors


def serve(
    *,
    plant: Annotated[str, option(PLANT, "The plant that is served.")] = "kinematic",
    robot: options.RobotOption = "ur5e",
    task: options.TaskOption = "exp2",
    mismatch: options.MismatchOption = options.DEFAULT_MISMATCH,
    sensing: options.SensingOption = "position",
    seed: Annotated[int, option("INTEGER", "Seed of the plant.")] = 0,
    overrides: options.Overrides,
    address: Annotated[
        str, option("ADDRESS", "Of the network interface to listen on.")
    ] = "127.0.0.1",
    lockstep: Annotated[
        bool, switch("--lockstep", "Let the clock wait for the command of each period.")
    ] = False,
) -> None:
    """Serve a plant on the ports of a UR.

    For the client ur-rtde 1.6.5. Conformance with it is checked; nothing here makes a robot safe. Ctrl-C ends it.
    """
    import asyncio

    from servobench.harness.apps.serve import server
    from servobench.harness.run.loop import careful
    from servobench.harness.run.request import RunRequest
    from servobench.harness.run.tasks import choose_task
    from servobench.plant.robot.mismatch import Mismatch

    with configuration_errors("--address: "):
        ipaddress.ip_address(address)
    names = selection.choose("plants", plant), "constant", choose_task(task)
    request = RunRequest(*names, Mismatch.parse(mismatch), seed, robot=robot, sensing=sensing)

    with careful():
        try:
            served = server.Server(request, overrides.settings(), say, lockstep=lockstep)
        except RunFault as fault:
            raise ConfigurationError(f"plant {plant}: {fault}") from fault
        try:
            with interrupting_as_usual():
                asyncio.run(served.serve(address))
        finally:
            served.rollout.plant.close()
