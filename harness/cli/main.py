"""The command `servobench`."""

from __future__ import annotations

import sys

import typer

from servobench.harness.cli import runs, show, studies
from servobench.harness.cli.analyse import analyse
from servobench.harness.cli.fmu import fmu_app
from servobench.harness.cli.options import INTERRUPTED, grouped
from servobench.harness.cli.sweep import sweep

INPUT_ERROR = 2  # exit code

app = typer.Typer(
    help="The bench on which uncalibrated visual-servoing controllers are compared.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (
    show.plants,
    show.controllers,
    show.tasks,
    runs.run,
    runs.compare,
    sweep,
    show.statistics,
    show.report,
    show.record,
    analyse,
    studies.robustness,
    studies.claims,
    studies.tune,
    runs.train,
    runs.collect,
):
    app.command()(grouped(command))
app.add_typer(fmu_app, name="fmu")


def main() -> None:
    """Run the command line; a bad input is one line on standard error and exit code 2."""
    try:
        app()
    except KeyboardInterrupt:
        sys.stderr.write("servobench: interrupted\n")
        sys.exit(INTERRUPTED)
    except (ValueError, ImportError) as error:
        line = _line_for_user(error)
        if line is None:
            raise
        sys.stderr.write(f"servobench: {line}\n")
        sys.exit(INPUT_ERROR)


def _line_for_user(error: ValueError | ImportError) -> str | None:
    """Return what a bad input or a missing extra is told with; None for a defect."""
    from servobench.harness.config.extras import missing_extra
    from servobench.harness.config.settings import ConfigurationError

    if isinstance(error, ImportError):
        return missing_extra(error, "this command")
    return str(error) if isinstance(error, ConfigurationError) else None


if __name__ == "__main__":
    main()
