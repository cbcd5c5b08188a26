"""How help pages name the values of options and arguments."""

from __future__ import annotations

from typing import Any

import typer
from rich.markup import escape

VALUES = {  # what a value is -> the long names of the options that take it
    "NAME": "controller division estimator format jacobian mismatch plant robot sensing task",
    "NAMES": "axes controllers kinds plants platforms tasks",
    "SEEDS": "seeds",
    "INTEGER": "fmi offset seed study-seed",
    "COUNT": "robots search studies trials workers",
    "NUMBER": "never",
    "NUMBERS": "noise",
    "SECONDS": "begin latency length limit period run-timeout",
    "SIZE": "run-memory",
    "KEY=VALUE": "set",
    "AXIS=VALUES": "vary",
    "FILE": "config output",
    "FOLDER": "folder out",
    "RUN_ID": "run",
    "COLUMN": "metric",
    "ADDRESS": "scheduler",
}
WORDS = {option: word for word, options in VALUES.items() for option in options.split()}
HELP_NAMES = ["-h", "--help"]
COMPLETION_HELP = {  # by the option that typer adds
    "install_completion": "Let this shell complete names.",
    "show_completion": "Print the completion script instead of installing it.",
}


def word(root: Any) -> None:  # noqa: ANN401 - typer's own classes have no public name
    """Name the values in the help of a command and its subcommands, instead of their types in Python.

    Help texts are taken as they stand: `[s]` is a unit and no markup.
    """
    waiting = [root]
    while waiting:
        each = waiting.pop()
        waiting += getattr(each, "commands", {}).values()
        for option in (*each.params, each.get_help_option(typer.Context(each, help_option_names=HELP_NAMES))):
            option.help = COMPLETION_HELP.get(option.name) or escape(option.help or "")
            if option.param_type_name == "argument":
                option.metavar = option.metavar or option.name.upper()
                option.display_type_rich = _untyped
            elif option.is_flag:
                option.metavar = ""
            else:
                option.metavar = option.metavar or WORDS[option.opts[0].removeprefix("--")]


def _untyped(ctx: object) -> None:
    """Return no type: the help of an argument says what it is."""
