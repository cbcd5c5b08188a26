"""The command `servobench init`: a configuration file to begin with."""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import typer

from servobench.harness.cli import named, options
from servobench.harness.cli.terminal import say

PRINTED = Path("-")


def init(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The new file; - prints it.")] = Path("bench.toml"),
    plants: options.PlantsOption = "kinematic,bullet",
    controllers: options.ControllersOption = "ukf_mfac",
    tasks: options.TasksOption = "exp2",
    robot: options.RobotOption = "ur5",
    overrides: options.Overrides = options.OVERRIDES,
) -> None:
    """Write a configuration file with all settings, explained.

    Each has its value, and as a comment its meaning, unit, range and default. No file is overwritten.
    """
    from servobench.harness.config.registry import find_controller, find_plant
    from servobench.harness.config.settings import ConfigurationError, Settings
    from servobench.harness.config.template import configuration_file
    from servobench.harness.run.request import RunRequest, read_mismatch
    from servobench.harness.run.resolved import known_sections, resolve_sections
    from servobench.harness.run.tasks import find_task

    names = named.split_plants(plants), named.split_controllers(controllers), named.split_tasks(tasks)
    arm, nominal = named.known_robot(robot), read_mismatch("none")
    requests = [RunRequest(*each, nominal, 0, robot=arm) for each in product(*names)]
    settings = overrides.settings()
    settings.check_sections([*known_sections(), *names[0], *names[1]])
    finds: dict[str, Callable[[str], Any]] = {"plant": find_plant, "controller": find_controller, "task": find_task}
    titles = {"run": "common to all plants, controllers and tasks"} | {
        name: f"{kind}: {find(name).summary}"
        for (kind, find), each in zip(finds.items(), names, strict=True)
        for name in each
    }
    sections, defaults = (resolve_sections(requests, each, to_run=False) for each in (settings, Settings()))
    text = configuration_file(sections, defaults, titles, f"run --config {'FILE' if file == PRINTED else file.name}")
    if file == PRINTED:
        sys.stdout.write(text)
        return
    try:
        with file.open("x", encoding="utf-8") as new:
            new.write(text)
    except FileExistsError:
        raise ConfigurationError(f"{file} exists already and is left as it is; name another file") from None
    except OSError as error:
        raise ConfigurationError(f"{file} cannot be written: {error.strerror}") from error
    say(f"{file}: {', '.join(sections)}")
