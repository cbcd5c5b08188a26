"""Trials of the code of users in an isolated process: imported or built before it is relied on.

Code that ends its process, hangs or leaks memory costs one line, with its place where that is known.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

from servobench.harness.config.registry import (
    FILES,
    REGISTRIES,
    Registry,
    find_controller,
    installed_plant,
)
from servobench.harness.config.source import count_as_users, find_place, place_in_trace
from servobench.harness.run.result import LOST, TIMED_OUT, Ending
from servobench.plant.contract.faults import ConfigurationError

if TYPE_CHECKING:
    from servobench.harness.batch.isolation import Tell

IMPORT_LIMIT = 120.0  # [s] to import code that a user names: large libraries are allowed
TRIAL_LIMIT = 30.0  # [s] to load and build one of many: slow imports are allowed

PLACES = frozenset(("axis", "magnitude", "unit"))  # columns of sweeps

Word: TypeAlias = Literal["controller", "plant", "metric"]


class Tried(NamedTuple):
    """A controller or plant with the result of its trial."""

    name: str  # by which it is found
    summary: str = ""  # a line on it; empty where it cannot be used
    fault: str = ""  # why it cannot be used, in one line; empty where it can


def explain(end: Ending, limit: float) -> str:
    """Return why code of a user did not return within its limit [s], with the place in it where that is known."""
    place = place_in_trace(end.trace)
    if end.status == TIMED_OUT:
        return f"{place}no answer after {limit:g} s; is there a loop without an end, or something that waits?"
    how = end.reason.removeprefix(f"{LOST}: ")
    if how.startswith("SIG"):
        return f"{place}it killed the process by {how}; compiled code wrote or read outside of its memory"
    if how.startswith("exit code"):
        return f"{place}it ended the process with {how}; raise an error instead, so that the other runs go on"
    return place + end.reason.replace("the run", "it", 1)


def attempt(
    function: Callable[..., Any],
    *arguments: object,
    limit: float,
    why: Callable[[Ending, float], str] = explain,
    hear: Tell | None = None,
    quiet: bool = True,
) -> tuple[Any, str]:
    """Call a function with code of users in an isolated process.

    Args:
        function: takes the arguments, and `tell` before them if it is heard, and returns JSON values.
        arguments: can be pickled.
        limit: [s] from one message to the next.
        why: says why the function did not return, from the end of its process.
        hear: receives the values that the function passes to `tell`.
        quiet: discard the output; where it is wanted, the code is called a second time.

    Returns:
        Its answer, None where it gave none, and why it did not return, in one line; empty if it did.

    Raises:
        ConfigurationError: that of the function.
    """
    from servobench.harness.batch import isolation, processes  # noqa: PLC0415 - lists of our own items need neither

    found = {}

    def receive(message: object) -> None:
        match message:
            case ["told", told] if hear is not None:
                hear(told)
            case ["answer" | "refusal" | "failure" as part, value]:
                found[part] = value

    limits = processes.Bounds(limit).limits(1, foreign=True)
    end = isolation.call(
        _attempt_here, (function, arguments, quiet, hear is not None), limits, receive
    )
    if "refusal" in found:
        raise ConfigurationError(str(found["refusal"]))
    return found.get("answer"), str(found.get("failure", "")) if end is None else why(end, limit)


def _attempt_here(
    argument: tuple[Callable[..., Any], tuple[object, ...], bool, bool], tell: Tell
) -> None:
    """Call a function in this process."""
    function, arguments, quiet, heard = argument
    if quiet:
        nothing = Path(os.devnull).open("w")  # noqa: SIM115 - open as long as the process lives
        for descriptor in (1, 2):  # standard output and error
            os.dup2(nothing.fileno(), descriptor)
        sys.stdout = sys.stderr = nothing
    tell(None)  # its time begins
    try:
        tell(["answer", function(*[lambda told: tell(["told", told])] * heard, *arguments)])
    except ConfigurationError as error:
        tell(["refusal", str(error)])
    except BaseException as error:  # noqa: BLE001 - code of users may raise anything
        tell(["failure", Ending.of(error).reason])


def choose(word: Word, given: str) -> str:
    """Return the name of a controller, plant or metric; code of users is imported in an isolated process first.

    Args:
        word: the kind.
        given: its name or place, such as ./mine.py:Mine.

    Raises:
        ConfigurationError: there is none, or it cannot be used; one line with file and line number.
    """
    registry = _registry(word)
    place = None if given.startswith(FILES) or given in registry.names() else find_place(given)
    if place is not None and place["module"]:
        count_as_users(place["module"])
    if place is not None or registry.published(given) is not None:
        _, failure = attempt(_choose, word, given, limit=IMPORT_LIMIT)
        if failure:
            raise ConfigurationError(f"{given} cannot be imported: {failure}")
    name = registry.choose(given)
    if word == "metric":
        from servobench.harness.batch.tables import NUMBERS, TEXTS  # noqa: PLC0415 - as above

        if name in NUMBERS | TEXTS | PLACES:
            raise ConfigurationError(
                f"--metric: the table of runs has a column {name} already; give yours another name, such as "
                f"my_{name}={given}"
            )
    return name


def _choose(word: Word, given: str) -> str:
    return _registry(word).choose(given)


def _registry(word: Word) -> Registry[Any]:
    if word == "metric":
        from servobench.harness.run.own_metrics import METRIC_REGISTRY  # noqa: PLC0415 - pandas

        return METRIC_REGISTRY
    return REGISTRIES[word]


def try_all(word: Word, robot: str) -> list[Tried]:
    """Return all controllers or plants, with missing packages.

    Those of third parties are built once for a robot and thrown away, each in an isolated process.
    """
    registry = REGISTRIES[word]
    points = {
        name: point for name in registry.names() if (point := registry.published(name)) is not None
    }
    if points:
        # Once, and not in each isolated process
        import servobench.harness.run.experiment  # noqa: PLC0415
        import servobench.plant.kinematic  # noqa: F401, PLC0415
    return [
        _try(word, points[name], robot) if name in points else _try_here(word, name)
        for name in registry.names()
    ]


def _try(word: Word, point: EntryPoint, robot: str) -> Tried:
    """Try one in an isolated process."""
    try:
        answer, why = attempt(_try_here, word, point.name, robot, limit=TRIAL_LIMIT)
    except ConfigurationError as error:  # which such code may falsify
        answer, why = None, str(error)
    match answer:
        case [_, str(summary), str(fault)]:
            return Tried(point.name, summary, fault)
    why = why or "it gave no answer"
    return Tried(point.name, fault=f"{word} {point.name!r} ({point.value}) cannot be used: {why}")


def _try_here(word: Word, name: str, robot: str | None = None) -> Tried:
    """Return the result of a trial; it is built for a robot if there is one."""
    try:
        entry = (
            find_controller(name)
            if word == "controller"
            else installed_plant(name, load=robot is not None)
        )
        if robot is not None:
            from servobench.harness.run.rehearsal import try_to_build  # noqa: PLC0415 - lists load no runner

            try_to_build(word, name, robot)
    except ConfigurationError as error:
        return Tried(name, fault=str(error))
    return Tried(name, str(entry.summary))
