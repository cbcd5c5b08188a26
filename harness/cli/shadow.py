"""The command `servobench shadow`: a controller beside a logged run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servobench.harness.cli import completion, options
from servobench.harness.cli.named import known_robot, one_sensing
from servobench.harness.cli.terminal import console, print_tables, say

LEGEND = "The log does not answer to the controller, so that this does not say how well it would have done."


def shadow(
    log: Annotated[
        Path,
        typer.Argument(help="Results folder, or a table (.csv, .parquet) with the columns of its steps."),
    ],
    controller: Annotated[
        str | None,
        typer.Option(
            help="Name or file of the controller; default: that of the run.", autocompletion=completion.controllers
        ),
    ] = None,
    run: Annotated[str | None, typer.Option(help="The run_id, where the folder has more than one run.")] = None,
    robot: options.RobotOption = "ur5",
    sensing: options.SensingOption = "position",
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="CSV file for what it would have commanded at each instant.")
    ] = None,
) -> None:
    """Show a controller a logged run and compare commands.

    Nothing is simulated: it sees what was logged, whatever it commands.
    """
    from servobench.harness.batch.logged import logged_in_file, logged_in_folder
    from servobench.harness.config.registry import choose_controller
    from servobench.harness.config.settings import ConfigurationError
    from servobench.harness.run.shadow import differences, has_commands
    from servobench.harness.run.shadow import shadow as see
    from servobench.plant.contract.files import reason

    if not log.exists():
        raise ConfigurationError(f"{log} does not exist; wanted a results folder or a table")
    chosen = None if controller is None else choose_controller(controller)
    if log.is_dir():
        resolved, table = logged_in_folder(log, run, chosen)
    elif chosen is None:
        raise ConfigurationError(f"{log} does not say which controller to show it to; name one with --controller")
    else:
        resolved, table = logged_in_file(log, chosen, known_robot(robot), one_sensing(sensing))
    with console.status(f"showing {len(table)} rows to {resolved.request.controller}"):
        seen = see(resolved, table)
    if out is not None:
        try:
            seen.to_csv(out, index=False)
        except OSError as error:
            raise ConfigurationError(f"{out} cannot be written: {reason(error)}") from error
        say(f"table in {out}")
    elif not has_commands(seen):
        raise ConfigurationError(f"{log} has no commands to compare with; --out FILE.csv keeps those of the controller")
    if has_commands(seen):
        rows = differences(seen).map(lambda each: each if isinstance(each, str) else f"{each:.3g}")
        print_tables([(f"{resolved.request.controller} beside the log", rows)], LEGEND)
