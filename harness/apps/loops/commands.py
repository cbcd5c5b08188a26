"""The command `servobench analyse`: loops at rest."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import option, switch
from servobench.harness.cli.terminal import console, print_tables, say
from servobench.plant.contract.faults import ConfigurationError, RunFault

if TYPE_CHECKING:
    from servobench.harness.config.settings import Settings
    from servobench.harness.run.resolution import ResolvedRun

TABLE = "analyse.csv"


def analyse(
    controllers: Annotated[
        list[str], typer.Argument(metavar="CONTROLLER", help="Names of controllers.")
    ],
    *,
    mismatch: options.MismatchOption = "none",
    seed: Annotated[int, option("INTEGER", "Seed of the warm-up move and of the robot.")] = 0,
    robot: options.RobotOption = "ur5",
    jacobian: Annotated[
        Literal["true", "nominal", "estimated"],
        option("NAME", "Jacobian that estimators are fixed at: true, nominal or estimated."),
    ] = "true",
    identify: Annotated[
        bool,
        switch(
            "--identify",
            "Identify all loops from logged small motions, while estimators go on learning.",
        ),
    ] = False,
    overrides: options.Overrides,
    out: Annotated[Path, option("FOLDER", "Folder for table, pictures and page.")] = Path("results")
    / "analyse",
) -> None:
    """Analyse the loop at rest: margins, Bode, Nyquist, step.

    Also sensitivity, and stability over gain and latency.
    """
    from servobench.harness.apps.loops.loop_analysis import (
        LEGEND,
        analyse_loop,
        loop_table,
        printed,
    )
    from servobench.harness.apps.loops.loop_pictures import write_pictures
    from servobench.plant.contract.files import accessing, write_csv, writing_together

    loops = []
    for run in _resolved(controllers, mismatch, seed, robot, overrides.settings()):
        with console.status(f"analysing {run.request.controller}"):
            try:
                loops.append(analyse_loop(run, jacobian, identify=identify))
            except RunFault as fault:
                say(f"{run.request.controller}: {fault}")
    if not loops:
        raise ConfigurationError("no loop is left to analyse")
    table = loop_table(loops)
    text = printed(table)
    with accessing(out), writing_together(out) as partial:
        write_csv(table, partial / TABLE)
        page = out / write_pictures(partial, loops, text, LEGEND)[0].name
    identified = ", ".join(loop.name for loop in loops if loop.model == "identified")
    title = f"Loops at rest, estimators frozen at the {jacobian} Jacobian"
    if identified:
        title += f"; identified in small motions: {identified}"
    if identify:
        title = "Loops identified in small motions"
    print_tables([(title, text)], LEGEND)
    say(f"table in {out / TABLE}, pictures in {page}")


def _resolved(
    controllers: list[str], mismatch: str, seed: int, robot: str, settings: Settings
) -> list[ResolvedRun]:
    """Return a run for each controller on the kinematic plant."""
    from servobench.harness.apps.loops.equilibrium import PLANT, TASK
    from servobench.harness.run.request import RunRequest
    from servobench.harness.run.resolution import check_settings, resolve
    from servobench.plant.robot.mismatch import Mismatch

    names = selection.split("controllers", ",".join(controllers), robot=robot)
    check_settings(settings, [PLANT, TASK, *names])
    drawn = Mismatch.parse(mismatch)
    return [
        resolve(RunRequest(PLANT, name, TASK, drawn, seed, robot=robot), settings) for name in names
    ]
