"""The commands that show what there is, `plants | controllers | tasks`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any

import typer

from servobench.harness.cli.terminal import console

NameArgument = Annotated[str | None, typer.Argument(help="Show the settings of this one.")]


def plants(name: NameArgument = None) -> None:
    """List the plants, or show the settings of one."""
    from servobench.harness.config.registry import find_plant, installed_plant, plant_names

    _show("plants", name, plant_names(), find_plant if name else installed_plant, lambda entry: entry.config())


def controllers(name: NameArgument = None) -> None:
    """List the controllers, or show the settings of one."""
    from servobench.controllers.parts import ESTIMATORS, LAWS
    from servobench.harness.config.defaults import default_config
    from servobench.harness.config.registry import choose_controller, controller_names, find_controller

    name = choose_controller(name) if name else None
    _show("controllers", name, controller_names(), find_controller, default_config)
    if not name:
        console.print(f"or any law with any estimator, such as mfac+rls: laws {', '.join(LAWS)};", soft_wrap=True)
        console.print(f"estimators {', '.join(ESTIMATORS)}", soft_wrap=True)


def tasks(name: NameArgument = None) -> None:
    """List the tasks, or show the settings of one."""
    from servobench.harness.run.tasks import TASKS, find_task

    _show("tasks", name, list(TASKS), find_task, lambda entry: entry.default)


def _show(
    kind: str, name: str | None, names: Sequence[str], find: Callable[[str], Any], default: Callable[[Any], Any]
) -> None:
    """Print names with their summaries, or the settings of one with their defaults."""
    from rich.markup import escape
    from rich.table import Table

    from servobench.harness.config.settings import ConfigurationError, flatten

    table = Table("setting", "default") if name else Table(kind, "")
    if name:
        for key, value in flatten(default(find(name))).items():
            table.add_row(f"{name}.{key}", str(value))
    for known in () if name else names:
        try:
            table.add_row(known, find(known).summary)
        except ConfigurationError as error:  # an extra is missing, or a plug-in is broken; the others are usable
            table.add_row(known, escape(str(error)))
    console.print(table)
