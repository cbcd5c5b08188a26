"""The command `servobench`."""

from __future__ import annotations

import contextlib
import errno
import faulthandler
import os
import sys
from collections.abc import Callable
from typing import Annotated, Any, NoReturn

import typer
import typer.main

from servobench.harness.cli import authoring, completion, lists, results, runs, studies
from servobench.harness.cli.films import record
from servobench.harness.cli.fmu import fmu_app
from servobench.harness.cli.loops import analyse
from servobench.harness.cli.options import FAILED, HELP_NAMES, INTERRUPTED, grouped, word

INPUT_ERROR = 2  # exit code
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.EACCES, errno.EPERM, errno.ESTALE)
WITHOUT: dict[tuple[object, object], str] = {  # why a command does not have an option that others have
    ("claims", "--robot"): "the claims are those of the paper, which are about a UR5",
    ("tune", "--robot"): "methods are tuned on the UR5 alone, and other arms take these settings; compare shows how "
    "they do",
    ("claims", "--sensing"): "the claims are those of the paper, which are about the ball in 3-D",
    ("tune", "--sensing"): "methods are tuned on the ball in 3-D, and other sensing takes these settings in natural "
    "units; compare shows how they do",
    (
        "analyse",
        "--sensing",
    ): "its loops are those of the ball in 3-D; compare shows how a method does by pixels",
    ("record", "--sensing"): "films show the ball's way through space; figures of run --sensing show pixels",
    ("controllers", "--sensing"): "settings of a controller are the same under all sensing",
}
PANELS: dict[str, tuple[Callable[..., None], ...]] = {  # title -> commands, in the order of first use
    "First steps": (runs.run, runs.compare, results.statistics, results.report, record),
    "Your own controller": (authoring.new, authoring.check, authoring.shadow),
    "What there is": (lists.plants, lists.controllers, lists.tasks, lists.sensing, lists.init),
    "Studies": (studies.sweep, analyse, studies.robustness, studies.claims, studies.tune),
    "Tools": (runs.train, runs.collect, results.export, results.verify),
}

app = typer.Typer(context_settings={"help_option_names": HELP_NAMES}, pretty_exceptions_enable=False)
for panel, commands in PANELS.items():
    for command in commands:
        app.command(rich_help_panel=panel)(grouped(command))
app.add_typer(fmu_app, name="fmu", rich_help_panel="Tools")


def _print_version(wanted: bool) -> None:
    from servobench.harness.config.installation import version_line

    if wanted:
        typer.echo(version_line())
        raise typer.Exit


@app.callback()
def servobench(
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print version and commit.")
    ] = False,
) -> None:
    """Compare uncalibrated visual-servoing controllers: servobench COMMAND --help says more."""


def command_line() -> Any:  # noqa: ANN401 - typer's own classes have no public name
    """Return the command with all subcommands."""
    root = typer.main.get_command(app)
    word(root)
    return root


def main() -> None:
    """Run the command line; a bad input is one line on standard error and exit code 2."""
    _say_where_a_signal_strikes()
    try:
        with completion.rejoining_words():
            code = command_line()(sys.argv[1:] or ["--help"], prog_name="servobench", standalone_mode=False)
    except KeyboardInterrupt:  # before the command began
        code = INTERRUPTED
    except typer.TyperException as error:
        _refuse(_usage_line(error))
    except (ValueError, ImportError) as error:
        line = _line_for_user(error)
        if line is None:
            raise
        _refuse(line)
    except OSError as error:
        line = _line_of_system(error)
        if line is None or "--debug" in sys.argv:
            raise
        sys.stderr.write(f"servobench: {line}{_resuming()}\n")
        code = FAILED
    if code == INTERRUPTED:  # typer's word for KeyboardInterrupt; commands that say more end by themselves
        sys.stderr.write("servobench: interrupted\n")
    sys.exit(code)


def _resuming() -> str:
    """Return how the command goes on after an error of the system, if it has finished runs to keep."""
    command = command_line().commands.get("".join(sys.argv[1:2]))
    kept = command is not None and any(option.name == "resume" for option in command.params)
    return "; finished runs are kept, --resume continues" if kept else ""


def _say_where_a_signal_strikes() -> None:
    """Let a process that ends by a segmentation fault, as of a plug-in, print the line that it was in."""
    if sys.__stderr__ is not None:
        with contextlib.suppress(OSError, ValueError):  # it may be closed, or no file
            faulthandler.enable(sys.__stderr__)


def _refuse(line: str) -> NoReturn:
    if line:
        sys.stderr.write(f"servobench: {line}\n")
    sys.exit(INPUT_ERROR)


def _usage_line(error: typer.TyperException) -> str:
    """Return what a command that cannot be understood is told with; nothing where its help was printed."""
    context = getattr(error, "ctx", None)
    option = getattr(error, "option_name", None)
    if context and (context.info_name, option) in WITHOUT:
        return f"{context.info_name} has no {option}: {WITHOUT[context.info_name, option]}"
    help_ = f"; see {context.command_path} --help" if context else ""
    words = " ".join(error.format_message().split())
    return f"{words[0].lower()}{words[1:].rstrip('.')}{help_}" if words else ""


def _line_of_system(error: OSError) -> str | None:
    """Return what a folder that takes no more files is told with; None for a defect."""
    from servobench.harness.batch.checksums import UnwritableFolder

    if isinstance(error, UnwritableFolder):
        return str(error.strerror)
    if error.errno not in FULL:
        return None
    return f"{os.strerror(error.errno)}{f' ({error.filename})' if error.filename else ''}"


def _line_for_user(error: ValueError | ImportError) -> str | None:
    """Return what a bad input or a missing extra is told with; None for a defect."""
    from servobench.harness.config.installation import missing_extra
    from servobench.harness.config.settings import ConfigurationError

    if isinstance(error, ImportError):
        return missing_extra(error, "this command")
    return str(error) if isinstance(error, ConfigurationError) else None


if __name__ == "__main__":
    main()
