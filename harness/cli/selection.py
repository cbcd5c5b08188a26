"""Names of plants, controllers, tasks, robots, sensing and mismatches: completed by shells, split and looked up."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from servobench.harness.cli.terminal import refuse, say

if TYPE_CHECKING:
    from servobench.harness.batch.trials import Tried, Word


def complete_plants(incomplete: str) -> list[str]:
    """Return the plants whose names begin so."""
    from servobench.harness.config.registry import plant_names

    return _matching(incomplete, plant_names())


def complete_controllers(incomplete: str) -> list[str]:
    """Return the controllers whose names begin so; after `law+` the pairs with this law."""
    from servobench.controllers.parts import ESTIMATORS
    from servobench.harness.config.registry import controller_names

    law, plus, _ = incomplete.partition("+")
    return _matching(incomplete, [f"{law}+{name}" for name in ESTIMATORS] if plus else controller_names())


def complete_tasks(incomplete: str) -> list[str]:
    """Return the tasks whose names begin so."""
    from servobench.harness.run.tasks import task_names

    return _matching(incomplete, task_names())


def complete_sensings(incomplete: str) -> list[str]:
    """Return the sensing set-ups whose names begin so."""
    from servobench.harness.config.robots import sensing_names

    return _matching(incomplete, sensing_names())


def complete_estimators(incomplete: str) -> list[str]:
    """Return the estimators whose names begin so."""
    from servobench.controllers.parts import ESTIMATORS

    return _matching(incomplete, ESTIMATORS)


def complete_mismatches(incomplete: str) -> list[str]:
    """Return the profiles and axes of mismatch whose names begin so; after a `+` the axes."""
    from servobench.plant.robot.mismatch import AXES, PROFILES

    before, plus, last = incomplete.rpartition("+")
    axes = [f"{axis}=" for axis in AXES]
    return [before + plus + name for name in _matching(last, axes if plus else [*PROFILES, *axes])]


def complete_robots(incomplete: str) -> list[str]:
    """Return the robots whose names begin so."""
    from servobench.harness.config.robots import robot_names

    return _matching(incomplete, robot_names())


def completing_lists(complete: Callable[[str], list[str]]) -> Callable[[str], list[str]]:
    """Return a function that completes the last name of a comma-separated list."""

    def complete_last(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        words = complete(last) + _matching(last, ["all"] * (not comma))
        return [before + comma + word for word in words]

    return complete_last


def _matching(incomplete: str, names: Iterable[str]) -> list[str]:
    return [name for name in names if name.startswith(incomplete)]


def known_robot(name: str) -> str:
    """Return the name of a robot that can be found, and print the assumptions made about it."""
    from servobench.harness.config.robots import find_robot

    note = find_robot(name).note
    if note:
        say(note)
    return name


def known_sensing(name: str) -> str:
    """Return the name of a sensing set-up that can be found; a mistyped one is refused."""
    from servobench.harness.config.robots import find_sensing

    find_sensing(name)
    return name


def known_plant(text: str | None) -> str:
    """Return the name of the plant of a run, given by name or file; for None the default, with a line if second choice.

    The default is the first of bullet, mujoco and kinematic that is installed.
    """
    from servobench.harness.config.registry import default_plant

    if text is not None:
        return known("plant", text)
    name, why = default_plant()
    if why:
        say(f"no plant is named, so this run is on {name}: {why}")
    tell_unused("plant", [name])
    return name


def known(word: Word, text: str) -> str:
    """Return the name of the plant or controller of a run, given by name or file."""
    from servobench.harness.batch.trials import choose

    name = choose(word, text)
    tell_unused(word, [name])
    return name


def tell_unused(word: Word, named: Sequence[str]) -> None:
    """Print a line for each entry point that is not used though a user named it, or all."""
    from servobench.harness.config.registry import ALL, REGISTRIES

    for name, line in REGISTRIES[word].unused_points():
        if name in named or ALL in named:
            sys.stderr.write(f"servobench: note: {line}\n")


def split_words(text: str) -> tuple[str, ...]:
    """Split a comma-separated list."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def split_names(kind: str, text: str, known: Sequence[str], find: Callable[[str], Any]) -> tuple[str, ...]:
    """Split a comma-separated list of names, each of which `find` accepts; `all` stands for those in `known`."""
    if text.strip() == "all":
        return tuple(known)
    names = split_words(text)
    if not names:
        refuse(f"--{kind} is empty; valid: {', '.join(known)}")
    for name in names:
        find(name)
    refuse_repetition(kind, names)
    return names


def refuse_repetition(option: str, values: Sequence[object]) -> None:
    """Refuse a list that names something twice."""
    for value in values:
        if values.count(value) > 1:
            refuse(f"--{option} names {value} twice")


def split_plants(text: str, option: str = "plants", robot: str = "ur5") -> tuple[str, ...]:
    """Return the names of plants given by name or by file, such as ./cell.py:Cell."""
    return _split_entries("plant", text, option, robot)


def split_controllers(text: str, robot: str = "ur5") -> tuple[str, ...]:
    """Return the names of controllers given by name or by file, such as ./mine.py:Mine."""
    return _split_entries("controller", text, "controllers", robot)


def _split_entries(word: Word, text: str, option: str, robot: str) -> tuple[str, ...]:
    from servobench.harness.batch.trials import choose, try_all
    from servobench.harness.config.registry import ALL, REGISTRIES

    registry, names = REGISTRIES[word], list[str]()
    for part in split_words(text):
        names += _usable(try_all(word, robot)) if part == ALL else [choose(word, part)]
    tell_unused(word, split_words(text))
    return split_names(option, ",".join(names), registry.names(), registry.find)


def _usable(all_of_them: Sequence[Tried]) -> list[str]:
    """Return the names of those that can be used; print a line for each other."""
    for each in all_of_them:
        if each.fault:
            sys.stderr.write(f"servobench: left out: {each.fault}\n")
    return [each.name for each in all_of_them if not each.fault]


def split_tasks(text: str) -> tuple[str, ...]:
    """Return the names of tasks, each looked up."""
    from servobench.harness.run.tasks import choose_task, find_task, task_names

    words = [word if word == "all" else choose_task(word) for word in split_words(text)]
    return split_names("tasks", ",".join(words), task_names(), find_task)


def split_mismatches(text: str) -> tuple[str, ...]:
    """Return mismatches, each read, so that a mistyped one is refused at once."""
    from servobench.harness.run.request import read_mismatch
    from servobench.plant.robot.mismatch import PROFILES

    return split_names("mismatch", text, tuple(PROFILES), read_mismatch) if text.strip() != "all" else (text,)


def split_sensings(text: str) -> tuple[str, ...]:
    """Return the names of sensing set-ups, each looked up."""
    from servobench.harness.config.robots import find_sensing, sensing_names

    return split_names("sensing", text, sensing_names(), find_sensing)
