"""Code of users, tried in a process of its own: if it ends the process, hangs or leaks, that costs a line.

The process is a copy of this one behind a guard, which takes milliseconds on Linux; elsewhere it is started anew.
"""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, TypeAlias

from servobench.controllers.controller import ControllerEntry
from servobench.harness.batch.guard import LOST, End, Task, Tell
from servobench.harness.batch.pool import Guarded
from servobench.harness.batch.workers import Bounds
from servobench.harness.check.report import Finding
from servobench.harness.config.registry import (
    MAPPED,
    choose_controller,
    choose_plant,
    controller_names,
    plant_names,
    published,
)
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.config.source import PACKAGES, PLACE, folder_of_module, is_below, place_in_trace
from servobench.harness.run.result import TIMED_OUT, Ending
from servobench.plant.bench.plant import PlantEntry
from servobench.plant.contract.files import user_path

IMPORT_LIMIT = 120.0  # [s] to import what a user names: large libraries are allowed
LOADING: Final = "loading"  # what a check is at before the first one
ENGINE: Final = Path(__file__).parents[2]  # whose own lines are not the place of a defect
OUTPUTS: Final = (1, 2)  # descriptors of what a process prints

Choose: TypeAlias = Callable[[str], str]
Checks: TypeAlias = Callable[..., Any]


def choose_plants(words: Sequence[str]) -> list[str]:
    """Return the names of plants that a user names, or whose places are given, such as ./cell.py:Cell.

    Raises:
        ConfigurationError: there is no such plant, or it cannot be used; one line with file and line number.
    """
    known = {*plant_names(), *(word for word in words if word.startswith(MAPPED))}
    return [_choose(choose_plant, PlantEntry, word, word in known) for word in words]


def choose_controllers(words: Sequence[str]) -> list[str]:
    """Return the names of controllers that a user names, or whose places are given, such as ./mine.py:Mine.

    Raises:
        ConfigurationError: there is no such controller, or it cannot be used; one line with file and line number.
    """
    known = controller_names()
    return [_choose(choose_controller, ControllerEntry, word, word in known) for word in words]


def check_apart(checks: Checks, subject: str, limit: float, hear: Callable[[Finding], None]) -> None:
    """Carry checks out and hand over what each finds; one that ends or hangs the process is the last.

    Args:
        checks: `check_controller` or `check_plant`.
        subject: what is checked, as text.
        limit: [s] time limit of one check.
        hear: receives the findings.

    Raises:
        ConfigurationError: the subject cannot be loaded.
    """
    current, refusals = [LOADING], list[str]()

    def receive(item: tuple[str, Any]) -> None:
        kind, content = item
        if kind == "found":
            hear(content)
        else:
            (current if kind == "begin" else refusals).append(content)

    end = _carry_out(Task(_check, pickle.dumps((checks, subject)), subject), Bounds(limit), receive)
    if refusals:
        raise ConfigurationError(refusals[0])
    if end is not None:
        hear(Finding(current[-1], "failed", explain(end, _is_users, limit)))


def explain(end: End, is_users: Callable[[Path], bool], limit: float) -> str:
    """Return why code of a user did not come to its end, with the place in it where that is known.

    Args:
        end: of its task.
        is_users: whether a file is the user's.
        limit: [s] that it had.
    """
    place = place_in_trace(end.ending.trace, is_users)
    if end.ending.status == TIMED_OUT:
        return f"{place}no answer after {limit:g} s; is there a loop without an end, or something that waits?"
    how = end.ending.reason.removeprefix(f"{LOST}: ")
    if how.startswith("SIG"):
        return f"{place}it killed the process by {how}; compiled code wrote or read outside of its memory"
    if how.startswith("exit code"):
        return f"{place}it ended the process with {how}; raise an error instead, so that the other runs go on"
    return place + end.ending.reason.replace("the run", "it", 1)


def _choose(choose: Choose, entry: type[ControllerEntry | PlantEntry], word: str, known: bool) -> str:
    """Choose what a user names; code of theirs is imported apart first."""
    folder = _folder(entry, word, known)
    if folder is None:
        return choose(word)
    refusals = list[str]()
    end = _carry_out(Task(_import, pickle.dumps((choose, word)), word), Bounds(IMPORT_LIMIT), refusals.append)
    if refusals:
        raise ConfigurationError(refusals[0])
    if end is not None:
        why = explain(end, lambda path: is_below(path, folder), IMPORT_LIMIT)
        raise ConfigurationError(f"{word} cannot be imported: {why}")
    return choose(word)


def _folder(entry: type[ControllerEntry | PlantEntry], word: str, known: bool) -> Path | None:
    """Return the folder of the code that a word names; None for what is of this package, and for what is nothing.

    Raises:
        ConfigurationError: a path in a home folder that is not known.
    """
    point = published(entry, word)
    if point is not None:
        return folder_of_module(point.module)
    found = None if known else PLACE.fullmatch(word)
    if found is None:
        return None
    try:
        return user_path(found["file"]).resolve().parent if found["file"] else folder_of_module(found["module"])
    except ValueError as error:
        raise ConfigurationError(str(error)) from error


def _carry_out(task: Task, bounds: Bounds, hear: Callable[[Any], None]) -> End | None:
    """Carry a task out behind a guard of its own; return how it ended if it did not come to its end."""
    guard = Guarded(bounds.limits(1, foreign=True), (), copied=True)
    try:
        return guard.carry_out(task, hear).end
    finally:
        guard.ask_to_end()
        guard.end()


def _import(argument: bytes, tell: Tell) -> None:
    """Choose what a user names, in a process that ends after it."""
    choose, word = pickle.loads(argument)
    _print_nowhere()
    tell(None)  # its time begins
    try:
        choose(word)
    except ConfigurationError as error:
        tell(str(error))
    except BaseException as error:  # noqa: BLE001 - code of users may raise anything
        tell(f"{word} cannot be imported: {Ending.of(error).reason}")


def _check(argument: bytes, tell: Tell) -> None:
    """Carry the checks out."""
    checks, subject = pickle.loads(argument)
    _print_nowhere()
    tell(("begin", LOADING))
    try:
        checks(subject, lambda name: tell(("begin", name)), lambda finding: tell(("found", finding)))
    except ConfigurationError as error:
        tell(("refused", str(error)))


def _print_nowhere() -> None:
    """Let nothing appear that code of a user prints here: where it is wanted, it is printed a second time."""
    nothing = Path(os.devnull).open("w")  # noqa: SIM115 - open as long as the process lives
    for descriptor in OUTPUTS:
        os.dup2(nothing.fileno(), descriptor)
    sys.stdout = sys.stderr = nothing


def _is_users(path: Path) -> bool:
    inside = any(path.is_relative_to(folder) for folder in (Path(os.__file__).parent, ENGINE))
    return not (inside or PACKAGES in path.parts or str(path).startswith("<"))
