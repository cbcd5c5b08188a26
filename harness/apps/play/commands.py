"""The command `servobench play`: a page on which runs are steered while they go on."""

from __future__ import annotations

from typing import Annotated

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import CONTROLLER, PLANT, option
from servobench.harness.cli.terminal import say

OFFERED = (
    "calibrating_mfac,regression_mfac,ukf_mfac,ukf_mpc,rbfnn_mfac,rbf_pid,rls,broyden,cfdl_mfac,"
    "constant,calibrated,nmpc_calibrated"
)


def play(
    *,
    plant: Annotated[str, option(PLANT, "The plant that is played with.")] = "kinematic",
    controllers: Annotated[
        str | None,
        option(
            CONTROLLER.several(),
            "Comma-separated names or files to choose from; default: equipped methods and bounds.",
        ),
    ] = None,
    robot: options.RobotOption = "ur5",
    task: options.TaskOption = "circle",
    mismatch: options.MismatchOption = options.DEFAULT_MISMATCH,
    overrides: options.Overrides,
    host: Annotated[
        str, option("ADDRESS", "One address of this machine to listen on.")
    ] = "127.0.0.1",
    port: Annotated[int, option("PORT", "Of the page.", min=1)] = 8090,
) -> None:
    """Steer runs on a page: drag the target, knock the camera.

    Only this machine reaches the page, unless --host says otherwise. Ctrl-C ends it.
    """
    from servobench.harness.apps.play.guard import open_server
    from servobench.harness.apps.play.page import Page
    from servobench.harness.apps.play.session import Session
    from servobench.harness.run.loop import careful
    from servobench.harness.run.request import RunRequest
    from servobench.harness.run.resolution import check_settings
    from servobench.harness.run.tasks import choose_task
    from servobench.plant.robot.mismatch import Mismatch

    names = selection.split("controllers", controllers or OFFERED, robot=robot)
    chosen = selection.choose("plants", plant), names[0], choose_task(task)
    request = RunRequest(*chosen, Mismatch.parse(mismatch), 0, robot=robot)
    settings = overrides.settings()
    check_settings(settings, [chosen[0], *names, chosen[2]])
    with careful():
        session = Session(request, names[:1], settings)
        server = open_server(host, port)
        page = Page(server, session, names, settings)
        say(f"playing at http://{host}:{port}; Ctrl-C ends it")
        try:
            page.run()
        finally:
            page.session.close()
            server.stop()
