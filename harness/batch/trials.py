"""Trials of the code of users in a sandbox: imported, built, checked or validated before it is relied on.

Code that ends its process, hangs or leaks memory costs one line, with its place where that is known.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from servobench.controllers.controller import ControllerEntry
from servobench.harness.batch.processes import Bounds
from servobench.harness.batch.sandbox import LOST, Tell, call
from servobench.harness.check.report import Finding
from servobench.harness.config.registry import (
    MAPPED,
    choose_controller,
    choose_plant,
    controller_names,
    find_controller,
    installed_plant,
    plant_names,
    published,
    unused_points,
)
from servobench.harness.config.robots import DEFAULT_ROBOT, find_robot
from servobench.harness.config.settings import Settings
from servobench.harness.config.source import PACKAGES, PLACE, folder_of_module, is_below, place_in_trace
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest, RunSettings, read_mismatch
from servobench.harness.run.resolution import resolve
from servobench.harness.run.result import TIMED_OUT, Ending
from servobench.harness.run.tasks import task_names
from servobench.plant.bench.plant import PlantEntry, PlantSetup
from servobench.plant.contract.faults import ConfigurationError, FmuError, RunFault
from servobench.plant.contract.files import user_path

if TYPE_CHECKING:
    from servobench.fmus.inspection import Validation

PLANT: Final = "kinematic"  # on which controllers are tried
TASK: Final = "exp1"
IMPORT_LIMIT = 120.0  # [s] to import code that a user names: large libraries are allowed
TRIAL_LIMIT = 30.0  # [s] to load and build one of many: slow imports are allowed
LOADING: Final = "loading"  # the step before the first check
ENGINE: Final = Path(__file__).parents[2]  # whose own lines are not the place of a defect
OUTPUTS: Final = (1, 2)  # descriptors of standard output and error

AnyEntry: TypeAlias = ControllerEntry | PlantEntry
Choose: TypeAlias = Callable[[str], str]
Checks: TypeAlias = Callable[..., Any]


@dataclass(frozen=True)
class Tried:
    """A controller or plant with the result of its trial.

    Attributes:
        name: by which it is found.
        summary: a line on it; empty where it cannot be used.
        fault: why it cannot be used, in one line; empty where it can.
    """

    name: str
    summary: str = ""
    fault: str = ""


class _Trains(BaseException):
    """A controller begins to train its networks: it can be built. No `Exception`, which would count as its error."""


def run_checks(checks: Checks, subject: str, limit: float, hear: Callable[[Finding], None]) -> None:
    """Carry checks out and hand over the findings; a check that ends or hangs the process is the last.

    Args:
        checks: `check_controller` or `check_plant`.
        subject: the controller or plant, as text.
        limit: [s] time limit of one check.
        hear: receives the findings.

    Raises:
        ConfigurationError: the subject cannot be loaded.
    """
    current, refusals = [LOADING], list[str]()

    def receive(item: object) -> None:
        match item:
            case ["found", [str(check), "ok" | "failed" | "note" as verdict, str(text)]]:
                hear(Finding(check, verdict, text))
            case ["begin", str(check)]:
                current.append(check)
            case ["refused", str(text)]:
                refusals.append(text)

    end = call(_check, (checks, subject), Bounds(limit).limits(1, foreign=True), receive)
    if refusals:
        raise ConfigurationError(refusals[0])
    if end is not None:
        hear(Finding(current[-1], "failed", explain(end, _is_users, limit)))


def validate(path: Path) -> Validation:
    """Check the FMU at `path`; an FMU that ends its process has a problem.

    Raises:
        ConfigurationError: it is not a co-simulation FMU of FMI 2 or 3.
    """
    from servobench.fmus.inspection import Validation  # noqa: PLC0415 - FMPy takes time to import

    answers: list[Any] = []
    end = call(_validate, path, Bounds().limits(1, foreign=True), answers.append)
    match answers:
        case [str(refusal), *_]:
            raise ConfigurationError(refusal)
        case [[list(problems), float() | None as deviation], *_]:
            return Validation(tuple(map(str, problems)), deviation)
    reason = "it gave no answer" if end is None else end.reason
    return Validation((f"the reference run ended: {reason}",), None)


def explain(end: Ending, is_users: Callable[[Path], bool], limit: float) -> str:
    """Return why code of a user did not return, with the place in it where that is known.

    Args:
        end: of its process.
        is_users: whether a file is the user's.
        limit: [s] that it had.
    """
    place = place_in_trace(end.trace, is_users)
    if end.status == TIMED_OUT:
        return f"{place}no answer after {limit:g} s; is there a loop without an end, or something that waits?"
    how = end.reason.removeprefix(f"{LOST}: ")
    if how.startswith("SIG"):
        return f"{place}it killed the process by {how}; compiled code wrote or read outside of its memory"
    if how.startswith("exit code"):
        return f"{place}it ended the process with {how}; raise an error instead, so that the other runs go on"
    return place + end.reason.replace("the run", "it", 1)


def _folder(entry: type[AnyEntry], word: str, known: Sequence[str]) -> Path | None:
    """Return the folder of the code that a word names; None for a name of this package, and for an unknown one.

    Raises:
        ConfigurationError: a path in a home folder that is not known.
    """
    point = published(entry, word)
    if point is not None:
        return folder_of_module(point.module)
    found = None if word in known or word.startswith(MAPPED) else PLACE.fullmatch(word)
    if found is None:
        return None
    try:
        return user_path(found["file"]).resolve().parent if found["file"] else folder_of_module(found["module"])
    except ValueError as error:
        raise ConfigurationError(str(error)) from error


@dataclass(frozen=True)
class Kind:
    """Controllers, or plants.

    Attributes:
        word: for one of them.
        entry: its class.
        names: returns all names.
        find: returns the entry of a name, if all that it needs is installed.
        offer: returns the name of a word, and lets one whose place is given be found by its name.
        build: takes the names of a controller or plant and of a robot.
    """

    word: str
    entry: type[AnyEntry]
    names: Callable[[], list[str]]
    find: Callable[[str], AnyEntry]
    offer: Choose
    build: Callable[[str, str], None]

    def choose(self, word: str) -> str:
        """Return the name of one that a user names, or whose place is given, such as ./mine.py:Mine.

        Code of users is imported in a sandbox first.

        Raises:
            ConfigurationError: there is no such one, or it cannot be used; one line with file and line number.
        """
        folder = _folder(self.entry, word, self.names())
        if folder is None:
            return self.offer(word)
        refusals: list[Any] = []
        end = call(_import, (self.offer, word), Bounds(IMPORT_LIMIT).limits(1, foreign=True), refusals.append)
        if refusals:
            raise ConfigurationError(str(refusals[0]))
        if end is not None:
            why = explain(end, lambda path: is_below(path, folder), IMPORT_LIMIT)
            raise ConfigurationError(f"{word} cannot be imported: {why}")
        return self.offer(word)

    def unused(self) -> list[tuple[str, str]]:
        """Return the names of entry points that are not used, each with a line that says why."""
        return unused_points(self.entry)

    def try_all(self, robot: str = DEFAULT_ROBOT) -> list[Tried]:
        """Return all of them; those of third parties are built once for a robot and thrown away in a sandbox."""
        names = self.names()
        points = {name: point for name in names if (point := published(self.entry, name)) is not None}
        if points:
            import servobench.plant.kinematic  # noqa: F401, PLC0415 - once, and not in each sandbox
        return [_try(self, points[name], robot) if name in points else self.try_one(name) for name in names]

    def try_one(self, name: str, robot: str | None = None) -> Tried:
        """Return the result of a trial; it is built for a robot if there is one."""
        try:
            entry = self.find(name)
            if robot is not None and name not in task_names():
                with contextlib.suppress(RunFault, _Trains):  # the run's row will report a fault
                    self.build(name, robot)
        except ConfigurationError as error:
            return Tried(name, fault=str(error))
        if name in task_names():
            return Tried(name, fault=f"a task is called {name!r}, too; give the {self.word} another name")
        return Tried(name, str(entry.summary))


def _try(kind: Kind, point: EntryPoint, robot: str) -> Tried:
    """Try one in a sandbox."""
    answers: list[Any] = []
    end = call(_try_here, (kind, point.name, robot), Bounds(TRIAL_LIMIT).limits(1, foreign=True), answers.append)
    match answers:
        case [[str(summary), str(fault)], *_]:
            return Tried(point.name, summary, fault)
    folder = folder_of_module(point.module)
    why = "it gave no answer" if end is None else explain(end, lambda path: is_below(path, folder), TRIAL_LIMIT)
    return Tried(point.name, fault=f"{kind.word} {point.name!r} ({point.value}) cannot be used: {why}")


def _try_here(argument: tuple[Kind, str, str], tell: Tell) -> None:
    """Try one in this process."""
    kind, name, robot = argument
    _print_nowhere()
    tell(None)  # its time begins
    try:
        tried = kind.try_one(name, robot)
    except BaseException as error:  # noqa: BLE001 - code of users may raise anything
        tried = Tried(name, fault=f"{kind.word} {name}: {Ending.of(error).reason}")
    tell([tried.summary, tried.fault])


def _import(argument: tuple[Choose, str], tell: Tell) -> None:
    """Choose a controller or plant in this process."""
    choose, word = argument
    _print_nowhere()
    tell(None)
    try:
        choose(word)
    except ConfigurationError as error:
        tell(str(error))
    except BaseException as error:  # noqa: BLE001 - code of users may raise anything
        tell(f"{word} cannot be imported: {Ending.of(error).reason}")


def _check(argument: tuple[Checks, str], tell: Tell) -> None:
    """Carry checks out in this process."""
    checks, subject = argument
    _print_nowhere()
    tell(["begin", LOADING])
    try:
        checks(subject, lambda name: tell(["begin", name]), lambda finding: tell(["found", list(finding)]))
    except ConfigurationError as error:
        tell(["refused", str(error)])


def _validate(path: Path, tell: Tell) -> None:
    """Check an FMU in this process."""
    from servobench.fmus.inspection import validate_fmu  # noqa: PLC0415 - as above

    tell(None)
    try:
        found = validate_fmu(path)
    except (ValueError, FmuError) as error:
        tell(str(error))
    else:
        tell([found.problems, found.deviation])


def _build_controller(name: str, robot: str) -> None:
    """Build the run of a controller and throw it away.

    Raises:
        ConfigurationError: it cannot be built, in one line.
    """
    request = RunRequest(PLANT, name, TASK, read_mismatch("none"), 0, robot=robot)
    build(resolve(request, Settings()), progress=_stop).plant.close()


def _build_plant(name: str, robot_name: str) -> None:
    """Build a plant and throw it away.

    Raises:
        ConfigurationError: it cannot be built, in one line.
    """
    entry, robot, period = installed_plant(name), find_robot(robot_name), RunSettings().period
    setup = PlantSetup(robot.nominal, robot.workspace.home, period, robot)
    if entry.own_robot:
        setup = PlantSetup(None, None, period)
    try:
        plant = entry.build(entry.config() if entry.config_for is None else entry.config_for(robot), setup)
    except ValueError as error:
        raise ConfigurationError(f"plant {name}: {error}") from error
    with contextlib.suppress(Exception):  # `servobench check plant` reports it
        plant.close()


def _stop(_share: float, _what: str) -> None:
    raise _Trains


def _print_nowhere() -> None:
    """Discard the output of code of a user here: where it is wanted, it is printed a second time."""
    nothing = Path(os.devnull).open("w")  # noqa: SIM115 - open as long as the process lives
    for descriptor in OUTPUTS:
        os.dup2(nothing.fileno(), descriptor)
    sys.stdout = sys.stderr = nothing


def _is_users(path: Path) -> bool:
    inside = any(path.is_relative_to(folder) for folder in (Path(os.__file__).parent, ENGINE))
    return not (inside or PACKAGES in path.parts or str(path).startswith("<"))


CONTROLLERS: Final = Kind(
    "controller", ControllerEntry, controller_names, find_controller, choose_controller, _build_controller
)
PLANTS: Final = Kind("plant", PlantEntry, plant_names, installed_plant, choose_plant, _build_plant)
