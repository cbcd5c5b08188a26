"""The commands that list names and settings, `plants | controllers | tasks | sensing | init`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import JsonOption
from servobench.harness.cli.terminal import console, print_json, say
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import accessing, write_text

if TYPE_CHECKING:
    from servobench.harness.batch.trials import Word

DEFAULT_ROBOT = "ur5"
STANDARD_OUTPUT = Path("-")
HELP = "Name whose settings to show."


def plants(
    name: Annotated[
        str | None, typer.Argument(help=HELP, autocompletion=options.PLANT.complete)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the plants, or show the settings of one."""
    _list_or_show("plant", name, as_json=as_json)


def controllers(
    name: Annotated[
        str | None, typer.Argument(help=HELP, autocompletion=options.CONTROLLER.complete)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the controllers, or show the settings of one."""
    from servobench.controllers.methods import ESTIMATORS, LAWS

    _list_or_show("controller", name, as_json=as_json)
    if not (name or as_json):
        console.print(
            "\nOr any law with any estimator, such as mfac+rls, or a file of your own, such as ./mine.py:"
        )
        console.print(
            f"Laws: {', '.join(LAWS)}. Estimators: {', '.join(ESTIMATORS)}.", highlight=False
        )


def tasks(
    name: Annotated[
        str | None, typer.Argument(help=HELP, autocompletion=options.TASK.complete)
    ] = None,
    robot: Annotated[
        str, options.option(options.ROBOT._replace(check=None), options.ROBOT_WORDS)
    ] = DEFAULT_ROBOT,
    as_json: JsonOption = False,
) -> None:
    """List the tasks, or show the settings of one."""
    from servobench.harness.run.tasks import choose_task, find_task, fitted, task_names
    from servobench.plant.robot.catalogue import find_robot

    if name:
        name = choose_task(name)
        _show_settings(name, fitted(name, find_robot(robot)), as_json=as_json)
    elif robot != DEFAULT_ROBOT:
        raise ConfigurationError(
            "--robot shows the settings of one task for that arm; name the task, such as exp1"
        )
    else:
        _show_names(
            [_described(name, find_task(name).summary) for name in task_names()], as_json=as_json
        )


def sensing(as_json: JsonOption = False) -> None:
    """List the sensing set-ups: features that cameras measure."""
    from servobench.plant.cameras.registry import SETUPS

    _show_names(
        [_described(name, entry.summary) for name, entry in SETUPS.items()], as_json=as_json
    )
    if not as_json:
        console.print(
            "\nEach with fixed cameras or with cameras on the hand, as pixel:hand; or a file of your own."
        )


def init(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The new file; - prints it.")] = Path(
        "bench.toml"
    ),
    *,
    plants: options.PlantsOption = "kinematic,bullet",
    controllers: options.ControllersOption = "ukf_mfac",
    tasks: options.TasksOption = "exp2",
    robot: options.RobotOption = "ur5",
    overrides: options.Overrides,
) -> None:
    """Write a configuration file with all settings, explained.

    Each has its value, and as a comment its meaning, unit, range and default. No file is overwritten.
    """
    from servobench.harness.config.description import configuration_file
    from servobench.harness.config.registry import find_controller, find_plant
    from servobench.harness.config.settings import Settings
    from servobench.harness.run.request import RunRequest
    from servobench.harness.run.resolution import check_settings, resolve_sections
    from servobench.harness.run.tasks import find_task
    from servobench.plant.robot.mismatch import Mismatch

    split = selection.split
    names = split("plants", plants), split("controllers", controllers), split("tasks", tasks)
    requests = [RunRequest(*each, Mismatch(), 0, robot=robot) for each in product(*names)]
    settings = overrides.settings()
    check_settings(settings, chain.from_iterable(names))
    finds: dict[str, Callable[[str], Any]] = {
        "plant": find_plant,
        "controller": find_controller,
        "task": find_task,
    }
    titles = {"run": "common to all plants, controllers and tasks"}
    for (kind, find), each in zip(finds.items(), names, strict=True):
        titles |= {name: f"{kind}: {find(name).summary}" for name in each}
    sections, defaults = (
        resolve_sections(requests, each, to_run=False) for each in (settings, Settings())
    )
    shown = "FILE" if file == STANDARD_OUTPUT else file.name
    text = configuration_file(sections, defaults, titles, f"run --config {shown}")
    if file == STANDARD_OUTPUT:
        sys.stdout.write(text)
        return
    if file.exists():
        raise ConfigurationError(f"{file} exists already and is left as it is; name another file")
    with accessing(file):
        write_text(file, text)
    say(f"{file}: {', '.join(sections)}")


def _described(name: str, summary: str) -> dict[str, str]:
    return {"name": name, "summary": summary}


def _list_or_show(word: Word, name: str | None, *, as_json: bool) -> None:
    """Show the settings of one, or all names with their summaries or the faults of those that cannot be used."""
    from servobench.harness.batch.trials import choose, try_all
    from servobench.harness.config.registry import REGISTRIES
    from servobench.harness.config.settings import default_config

    registry = REGISTRIES[word]
    if name:
        name = choose(word, name)
        entry = registry.find(name)
        config = entry.config() if word == "plant" else default_config(entry)
        _show_settings(name, config, as_json=as_json)
        return
    found = [
        {"name": each.name, "error": each.fault}
        if each.fault
        else _described(each.name, each.summary)
        for each in try_all(word, DEFAULT_ROBOT)
    ]
    _show_names(
        found + [{"name": name, "error": line} for name, line in registry.unused_points()],
        as_json=as_json,
    )


def _show_names(found: Sequence[dict[str, str]], *, as_json: bool) -> None:
    """Print names with their summaries or errors."""
    from rich.table import Table
    from rich.text import Text

    if as_json:
        print_json(found)
        return
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True, style="bold")
    table.add_column()
    summaries = {each["name"]: each["summary"] for each in found if "summary" in each}
    for each in found:
        base = summaries.get(each["name"].partition(":")[0], "")
        words = each.get("summary", "")
        if base and words != base:  # a variant: only the difference
            words = words.removeprefix(base).lstrip("; ")
        table.add_row(
            Text(each["name"]), Text(words) if words else Text(each.get("error", ""), style="red")
        )
    console.print(table)


def _show_settings(section: str, config: object, *, as_json: bool) -> None:
    """Print each setting with its default and its meaning."""
    from rich.padding import Padding
    from rich.text import Text

    from servobench.harness.config.description import describe_settings, plain, toml

    found = list(describe_settings(config))
    if as_json:
        rows = []
        for each in found:
            facts = {"unit": each.unit, "allowed": each.allowed, "meaning": each.meaning}
            rows.append({"setting": f"{section}.{each.key}", "default": plain(each.value), **facts})
        print_json(rows)
        return
    if not found:
        say(f"{section} has no settings")
    for each in found:
        line = Text(f"{section}.{each.key}", style="bold").append(
            f" = {toml(each.value) or 'unset'}", style="not bold"
        )
        console.print(line, soft_wrap=True)
        unit = f"[{each.unit}] " if each.unit else ""
        words = f"{unit}{each.meaning.rstrip('.')}{f' ({each.allowed})' if each.allowed else ''}"
        if words:
            console.print(Padding(Text(words, style="dim"), (0, 0, 0, 4)))
