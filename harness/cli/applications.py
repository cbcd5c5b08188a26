"""The commands by their modules, and the applications: abilities that only their commands reach.

The core stands without the applications, and nothing in it imports one: the command line finds a command here by its
name and imports no other. A further application is a folder of `harness/apps` with `commands.py`, and a section of
`applications.json`.
"""

import json
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import typer

from servobench.harness.cli.options import command

HARNESS = "servobench.harness"
HELP_NAMES = ["-h", "--help"]


class Application(NamedTuple):
    """An application: a room of the house that only its commands lead to."""

    purpose: str
    commands: Sequence[str] = ()
    extra: str = ""
    """the extra of pyproject.toml that it needs; empty for none"""
    package: str = ""
    """where it lies elsewhere than in `harness/apps`"""
    further: Sequence[str] = ()
    """packages beside it that nothing else imports"""


# JSON, as a help page does without the time to import a reader of TOML
_FILE = Path(__file__).with_name("applications.json")
APPLICATIONS = {
    name: Application(**row) for name, row in json.loads(_FILE.read_text("utf-8")).items()
}
CORE = {  # module of harness/cli -> its commands
    "runs": ("run", "compare", "sweep", "train", "merge"),
    "results": ("statistics", "collect"),
    "lists": ("plants", "controllers", "tasks", "sensing", "init"),
}
PANELS = {  # title on the help page -> commands, in the order of first use
    "First steps": ("run", "compare", "statistics", "report", "figures", "record", "play"),
    "Your own controller": ("new", "check", "shadow", "identify", "serve"),
    "What there is": ("plants", "controllers", "tasks", "sensing", "init"),
    "Studies": ("sweep", "analyse", "robustness", "suite", "tune"),
    "Results that others check": ("selftest", "verify", "submit", "leaderboard"),
    "Tools": ("train", "collect", "merge", "export", "fmu"),
}


def home_of(name: str) -> str:
    """Return the module that holds a command."""
    homes = {each: f"{HARNESS}.cli.{module}" for module, names in CORE.items() for each in names}
    for application, row in APPLICATIONS.items():
        package = row.package or f"{HARNESS}.apps.{application}"
        homes.update(dict.fromkeys(row.commands, f"{package}.commands"))
    return homes[name]


def find_function(command: str, name: str) -> Any:  # noqa: ANN401 - of any kind
    """Return a function beside a command, for another command; its module is imported."""
    return getattr(import_module(home_of(command)), name)


def find_command(name: str) -> Any:  # noqa: ANN401 - a function, or a group of typer
    """Return the function of a command, or the group of commands of this name; its module is imported."""
    return find_function(name, name)


def assemble(called: str, callback: Callable[..., None]) -> typer.Typer:
    """Return the command line with the command that is called alone, or with all where there is none of this name.

    Args:
        called: first word of the call.
        callback: takes the options that stand before a command.
    """
    names = {"help_option_names": HELP_NAMES}
    app = typer.Typer(context_settings=names, pretty_exceptions_enable=False)
    app.callback()(callback)
    known = {name for commands in PANELS.values() for name in commands}
    for title, commands in PANELS.items():
        for name in commands:
            if called in known and name != called:
                continue
            found = find_command(name)
            if isinstance(found, typer.Typer):
                app.add_typer(found, name=name, rich_help_panel=title)
            else:
                app.command(rich_help_panel=title)(command(found))
    return app
