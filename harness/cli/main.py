"""The command `servobench`."""

import contextlib
import errno
import faulthandler
import io
import os
import signal
import sys
from collections.abc import Iterator
from typing import Annotated, Any, NoReturn

import typer
import typer.main
from rich.markup import escape

from servobench.harness.cli.applications import HELP_NAMES, assemble
from servobench.harness.cli.options import ABSENT
from servobench.harness.cli.terminal import FAILED, INPUT_ERROR, INTERRUPTED, ending_alike
from servobench.plant.contract.faults import ConfigurationError, one_line
from servobench.plant.contract.files import harmless

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.EACCES, errno.EPERM, errno.ESTALE,
        errno.ENAMETOOLONG)  # fmt: skip
NO_THREAD = "can't start new thread"  # message of Python
# And the reverse
PLURALS = (("s", ""), ("", "s"), ("es", ""), ("", "es"), ("axes", "axis"), ("axis", "axes"))
COMPLETION_REQUEST = (
    "_SERVOBENCH_COMPLETE"  # environment variable of a shell that wants completions
)
BASH = "complete_bash"
# At which bash splits a word, though names of methods and settings have them
WORD_BREAKS = frozenset(":=")


def _print_version(wanted: bool) -> None:
    if wanted:
        from servobench.harness.config.installation import version_line

        typer.echo(version_line())
        raise typer.Exit


def servobench(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print version and commit."
        ),
    ] = False,
) -> None:
    """Compare uncalibrated visual-servoing controllers: servobench COMMAND --help says more."""


def command_line(called: str = "") -> Any:  # noqa: ANN401 - typer's own classes have no public name
    """Return the command with all subcommands, or with that which is called: typer takes long to build them all."""
    root = typer.main.get_command(assemble(called, servobench))
    _hide_types(root)
    return root


def _hide_types(root: Any) -> None:  # noqa: ANN401 - typer's own classes have no public name
    """Let help pages name values by words such as FOLDER instead of types in Python, and print brackets of units."""
    help_option = root.get_help_option(typer.Context(root, help_option_names=HELP_NAMES))
    for each in (*root.params, help_option):
        each.help = escape(each.help or "")
        if each.param_type_name == "argument":
            each.metavar = each.metavar or each.name.upper()
            each.display_type_rich = lambda ctx: None  # the help of an argument says enough
        elif each.is_flag:
            each.metavar = ""
    for subcommand in getattr(root, "commands", {}).values():
        _hide_types(subcommand)


def in_known_number(root: Any, words: list[str]) -> list[str]:  # noqa: ANN401 - typer's own classes
    """Return the words of a call with options that the command has in the plural or the singular only called so.

    One `--seed 7` is the list of this seed where the command takes `--seeds`, whose plain number is a count.
    """
    called = root
    for word in words[:2]:  # a group such as fmu has commands of its own
        called = getattr(called, "commands", {}).get(word, called)
    name, known = called.name, {option for each in called.params for option in each.opts}
    for k, word in enumerate(words):
        option, equals, value = word.partition("=")
        others = [option.removesuffix(old) + new for old, new in PLURALS if option.endswith(old)]
        if (
            not option.startswith("--")
            or option in known
            or (name, option) in ABSENT
            or not known.intersection(others)
        ):
            continue
        other = next(each for each in others if each in known)
        words = [*words[:k], other + equals + value, *words[k + 1 :]]
        at = k if equals else k + 1
        if option == "--seed" and at < len(words) and words[at].rpartition("=")[2].isdigit():
            words[at] += ","
        elif option == "--seeds":
            from servobench.plant.contract.settings import remark

            remark(f"{name} has one seed, the number of --seed; compare and sweep take several")
    return words


def main() -> None:
    """Run the command line; a bad input is one line on standard error and exit code 2."""
    with ending_alike() as caught:
        _carry_out(caught)


def _carry_out(caught: list[int]) -> None:
    """Run the command line; `caught` gets the signals that end it."""
    if sys.__stderr__ is not None:
        with contextlib.suppress(OSError, ValueError):  # it may be closed, or no file
            # A segmentation fault, as of a plug-in, prints the line that it was in
            faulthandler.enable(sys.__stderr__)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # `µ` where the encoding of the terminal lacks it
        sys.stdout.reconfigure(errors="backslashreplace")
    # Nothing is drawn in a window, and Matplotlib takes no unknown one
    os.environ.pop("MPLBACKEND", None)
    if not (epoch := os.environ.get("SOURCE_DATE_EPOCH") or "0").isdecimal():
        _end(
            f"SOURCE_DATE_EPOCH must be a whole number of seconds since 1970, got {epoch!r}; unset it"
        )
    if not hasattr(os, "fork"):
        _end("runs on Linux and macOS; on Windows use the Windows Subsystem for Linux (WSL)")
    try:
        with rejoining_words():
            root = command_line("".join(sys.argv[1:2]))
            words = in_known_number(root, sys.argv[1:]) or ["--help"]
            code = root(words, prog_name="servobench", standalone_mode=False)
    except KeyboardInterrupt:  # before the command began
        code = INTERRUPTED
    except typer.TyperException as error:
        _end(_usage_line(error))
    except (ValueError, ImportError, RecursionError, MemoryError) as error:
        line = _line_for_user(error)
        if line is None:
            raise
        _end(line)
    except (OSError, RuntimeError) as error:
        line = _line_of_system(error)
        if line is None or "--debug" in sys.argv:
            raise
        sys.stderr.write(f"servobench: {line}{_resuming()}\n")
        code = FAILED
    if (
        code == INTERRUPTED
    ):  # typer's word for KeyboardInterrupt; commands that keep something say so by themselves
        sys.stderr.write(
            f"servobench: {'terminated' if signal.SIGTERM in caught else 'interrupted'}\n"
        )
    sys.exit(code)


def _resuming() -> str:
    """Return how the command goes on after an error of the system, if it has finished runs to keep."""
    name = "".join(sys.argv[1:2])
    called = command_line(name).commands.get(name)
    kept = called is not None and any(option.name == "resume" for option in called.params)
    if kept:
        return "; finished runs are kept, --resume continues"
    return ""


def _end(line: str) -> NoReturn:
    if line:
        sys.stderr.write(f"servobench: {harmless(line)}\n")
    sys.exit(INPUT_ERROR)


def _usage_line(error: typer.TyperException) -> str:
    """Return the one-line usage error; empty if the help page was printed."""
    context = getattr(error, "ctx", None)
    option = getattr(error, "option_name", None)
    if context and (reason := ABSENT.get((context.info_name, option))):
        return f"{context.info_name} has no {option}: {reason}"
    if context and option and (key := short_key(option)):
        return f"{context.info_name} has no {option}: it is a setting, --set {key}=...; sweep varies it by {option}"
    help_ = f"; see {context.command_path} --help" if context else ""
    words = one_line(error.format_message())
    if words:
        return f"{words[0].lower()}{words[1:].rstrip('.')}{help_}"
    return ""


def short_key(option: str) -> str:
    """Return the setting for which an option of sweep is short, for the default plant; empty for other options."""
    from servobench.harness.run.variations import SHORT_NAMES

    short = SHORT_NAMES.get(option.removeprefix("--"))
    if short is None:
        return ""
    return short.key.replace("plant.", "kinematic.")


def _line_of_system(error: OSError | RuntimeError) -> str | None:
    """Return the one-line error for a folder in which no file can be written, or no thread; None for a defect."""
    from servobench.harness.batch.tables import UnwritableFolder

    if isinstance(error, RuntimeError):
        if str(error) != NO_THREAD:
            return None
        return "no more threads or processes may be started here: ulimit -u"
    if isinstance(error, UnwritableFolder):
        return str(error.strerror)
    if error.errno == errno.ENOENT and "temporary directory" in str(error):  # an error of tempfile
        return "no temporary folder takes a file; free room in one, or name another: TMPDIR=FOLDER servobench ..."
    if error.errno not in FULL:
        return None
    return f"{os.strerror(error.errno)} ({error.filename or 'in the temporary folder or in the one that is written'})"


def _line_for_user(error: ValueError | ImportError | RecursionError | MemoryError) -> str | None:
    """Return the one-line error for a bad input or a missing extra; None for a defect."""
    from servobench.harness.config.installation import missing_extra

    if isinstance(error, ImportError):
        return missing_extra(error, "this command")
    if isinstance(error, RecursionError) and "--debug" not in sys.argv:
        return "the input is nested too deeply"
    if isinstance(error, MemoryError) and "--debug" not in sys.argv:
        shortage = str(error) or "no more is free"
        return f"the memory is not enough: {shortage}; make the work smaller, or use fewer workers"
    if isinstance(error, ConfigurationError):
        return str(error)
    return None


@contextlib.contextmanager
def rejoining_words() -> Iterator[None]:
    """Let bash complete within a word that it splits at a colon or an equals sign; it wants the part behind it."""
    if os.environ.get(COMPLETION_REQUEST) != BASH:
        yield
        return
    words, index = os.environ["COMP_WORDS"].split("\n"), int(os.environ["COMP_CWORD"])
    joined, before = join_words(words, index)
    os.environ.update(COMP_WORDS="\n".join(joined), COMP_CWORD=str(len(joined) - 1))
    answer = io.StringIO()
    try:
        with contextlib.redirect_stdout(answer):
            yield
    finally:
        for line in answer.getvalue().splitlines():
            sys.stdout.write(line.removeprefix(before) + "\n")


def join_words(words: list[str], index: int) -> tuple[list[str], str]:
    """Return the words up to that of `index` as they were typed, and the part of the last one before its last break."""
    joined, before, after_break = list[str](), "", False
    for word in words[: index + 1]:
        is_break = bool(word) and WORD_BREAKS.issuperset(word)
        if len(joined) > 1 and (is_break or after_break):
            before = joined[-1] + (word if is_break else "")
            joined[-1] += word
        else:
            before = ""
            joined.append(word)
        after_break = is_break
    return joined, before


if __name__ == "__main__":
    main()
