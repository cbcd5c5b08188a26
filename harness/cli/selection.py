"""Names that a user gives, alone or as a list: split, looked up, and refused at once where they are mistyped."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from servobench.controllers.controller import ControllerEntry
    from servobench.harness.batch.trial import Tried
    from servobench.plant.bench.plant import PlantEntry


def known_robot(name: str) -> str:
    """Return the name of a robot that can be found, and print what was assumed about it."""
    from servobench.harness.cli.terminal import say
    from servobench.harness.config.robots import find_robot

    note = find_robot(name).note
    if note:
        say(note)
    return name


def split_words(text: str) -> tuple[str, ...]:
    """Split a comma-separated list."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def split_names(kind: str, text: str, known: Sequence[str], find: Callable[[str], Any]) -> tuple[str, ...]:
    """Split a comma-separated list of names, each of which `find` accepts; `all` stands for those in `known`."""
    from servobench.harness.config.settings import ConfigurationError

    if text.strip() == "all":
        return tuple(known)
    names = split_words(text)
    if not names:
        raise ConfigurationError(f"--{kind} is empty; valid: {', '.join(known)}")
    for name in names:
        find(name)
    refuse_repetition(kind, names)
    return names


def refuse_repetition(option: str, values: Sequence[object]) -> None:
    """Refuse a list that names something twice."""
    from servobench.harness.config.settings import ConfigurationError

    for value in values:
        if values.count(value) > 1:
            raise ConfigurationError(f"--{option} names {value} twice")


def split_mismatches(text: str) -> tuple[str, ...]:
    """Return the mismatches that a user named; each is read, so that a mistyped one is refused at once."""
    from servobench.harness.run.request import read_mismatch
    from servobench.plant.robot.mismatch_axes import PROFILES

    return split_names("mismatch", text, tuple(PROFILES), read_mismatch) if text.strip() != "all" else (text,)


def one_sensing(word: str) -> str:
    """Return the sensing set-up that a user named; it is looked up, so that a mistyped one is refused at once."""
    from servobench.harness.config.robots import find_sensing

    find_sensing(word)
    return word


def split_sensings(text: str) -> tuple[str, ...]:
    """Return the sensing set-ups that a user named; each is looked up, so that a mistyped one is refused at once."""
    from servobench.harness.config.robots import find_sensing, sensing_names

    return split_names("sensing", text, sensing_names(), find_sensing)


def default_plant() -> str:
    """Return the plant of a run for which none is named; a line says if it is not the first choice, and why."""
    from servobench.harness.cli.terminal import say
    from servobench.harness.config.registry import default_plant

    name, why = default_plant()
    if why:
        say(f"no plant is named, so this run is on {name}: {why}")
    return name


def tell_unused(entry: type[ControllerEntry | PlantEntry], named: Sequence[str]) -> None:
    """Print a line for each entry point that is not used though a user named it, or all."""
    from servobench.harness.config.registry import ALL, unused_points

    for name, line in unused_points(entry):
        if name in named or ALL in named:
            sys.stderr.write(f"servobench: note: {line}\n")


def _usable(all_of_them: Sequence[Tried]) -> list[str]:
    """Return the names of those that can be used, with a line for each other."""
    for each in all_of_them:
        if each.fault:
            sys.stderr.write(f"servobench: left out: {each.fault}\n")
    return [each.name for each in all_of_them if not each.fault]


def split_plants(text: str, option: str = "plants", robot: str = "ur5") -> tuple[str, ...]:
    """Return the names of the plants that a user named, or whose place was given, such as ./cell.py:Cell."""
    from servobench.harness.batch.apart import choose_plants
    from servobench.harness.batch.trial import try_plants
    from servobench.harness.config.registry import ALL, find_plant, plant_names
    from servobench.plant.bench.plant import PlantEntry

    known, names = plant_names(), list[str]()
    for word in split_words(text):
        names += _usable(try_plants(robot)) if word == ALL else choose_plants([word])
    tell_unused(PlantEntry, split_words(text))
    return split_names(option, ",".join(names), known, find_plant)


def split_controllers(text: str, robot: str = "ur5") -> tuple[str, ...]:
    """Return the names of the controllers that a user named, or whose place was given, such as ./mine.py:Mine."""
    from servobench.controllers.controller import ControllerEntry
    from servobench.harness.batch.apart import choose_controllers
    from servobench.harness.batch.trial import try_controllers
    from servobench.harness.config.registry import ALL, controller_names, find_controller

    known, names = controller_names(), list[str]()
    for word in split_words(text):
        names += _usable(try_controllers(robot)) if word == ALL else choose_controllers([word])
    tell_unused(ControllerEntry, split_words(text))
    return split_names("controllers", ",".join(names), known, find_controller)


def split_tasks(text: str) -> tuple[str, ...]:
    """Return the tasks that a user named."""
    from servobench.harness.run.tasks import TASKS, find_task

    return split_names("tasks", text, list(TASKS), find_task)
