"""Controllers and plants of third parties, each tried on an arm: what cannot be built is known before a batch begins.

They are imported and built in a process of their own, behind a guard, so that one that ends its process, hangs or leaks
is a line like any other.
"""

from __future__ import annotations

import contextlib
import os
import pickle
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Final, TypeAlias

from servobench.controllers.controller import ControllerEntry
from servobench.harness.batch.apart import explain
from servobench.harness.batch.guard import Task, Tell
from servobench.harness.batch.pool import Answer, Pool
from servobench.harness.batch.workers import Bounds
from servobench.harness.config.registry import (
    controller_names,
    find_controller,
    installed_plant,
    plant_names,
    published,
)
from servobench.harness.config.robots import DEFAULT_ROBOT, find_robot
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.harness.config.source import folder_of_module, is_below
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest, RunSettings, read_mismatch
from servobench.harness.run.resolution import resolve
from servobench.harness.run.result import Ending
from servobench.harness.run.tasks import TASKS
from servobench.plant.bench.plant import PlantEntry, PlantSetup
from servobench.plant.contract.faults import RunFault

PLANT: Final = "kinematic"  # on which controllers are tried
TASK: Final = "exp1"
ANSWER_LIMIT = 30.0  # [s] to load and build one: slow imports are allowed, a list that never comes is not
MODULES: Final = ("servobench.harness.batch.trial", "servobench.plant.kinematic")  # that every trial needs
STANDARD_OUTPUT: Final = 1  # its descriptor

AnyEntry: TypeAlias = ControllerEntry | PlantEntry


@dataclass(frozen=True)
class Tried:
    """A controller or plant, and what came of a trial.

    Attributes:
        name: by which it is found.
        summary: what it is; empty where it cannot be used.
        fault: why it cannot be used, in one line; empty where it can.
    """

    name: str
    summary: str = ""
    fault: str = ""


class _Trains(BaseException):
    """A controller begins to train its networks: it can be built. No `Exception`, which would count as its error."""


def try_controllers(robot: str = DEFAULT_ROBOT) -> list[Tried]:
    """Return all controllers; those of third parties are built once for a robot and thrown away."""
    return _try_all(_Kind("controller", ControllerEntry, find_controller, _build_controller), controller_names(), robot)


def try_plants(robot: str = DEFAULT_ROBOT) -> list[Tried]:
    """Return all plants, looked at for what they need; those of third parties are built once and thrown away."""
    return _try_all(_Kind("plant", PlantEntry, installed_plant, _build_plant), plant_names(), robot)


@dataclass(frozen=True)
class _Kind:
    word: str
    entry: type[AnyEntry]
    find: Callable[[str], AnyEntry]
    build: Callable[[str, str], None]  # takes the names of what is tried and of a robot

    def try_one(self, name: str, robot: str | None = None) -> Tried:
        """Return what can be said of one; built for a robot if there is one."""
        try:
            entry = self.find(name)
            if robot is not None and name not in TASKS:
                with contextlib.suppress(RunFault, _Trains):  # of a fault the run's row will tell
                    self.build(name, robot)
        except ConfigurationError as error:
            return Tried(name, fault=str(error))
        if name in TASKS:
            return Tried(name, fault=f"a task is called {name!r}, too; give the {self.word} another name")
        return Tried(name, str(entry.summary))


def _try_all(kind: _Kind, names: Sequence[str], robot: str) -> list[Tried]:
    """Try what third parties publish in a guarded process, and look the others up here."""
    pool = Pool(1, Bounds(ANSWER_LIMIT).limits(1, foreign=True), MODULES)  # it starts with the first task
    try:
        waiting: list[tuple[str, EntryPoint, Task, Future[Answer]]] = []
        for name in names:
            point = published(kind.entry, name)
            if point is not None:
                task = Task(_try_packed, pickle.dumps((kind, name, robot)), point.module.partition(".")[0])
                waiting.append((name, point, task, pool.submit(task)))
        found = {name: _outcome(kind.word, point, task, future, pool) for name, point, task, future in waiting}
    finally:
        pool.stop()
    return [found.get(name) or kind.try_one(name) for name in names]


def _try_packed(argument: bytes, tell: Tell) -> None:
    """Try one in this process, which is a guard's."""
    kind, name, robot = pickle.loads(argument)
    with Path(os.devnull).open("w") as nothing:
        os.dup2(nothing.fileno(), STANDARD_OUTPUT)  # where the list appears
    tell(None)  # its time begins
    try:
        tell(kind.try_one(name, robot))
    except BaseException as error:  # noqa: BLE001 - code of users may raise anything
        tell(Tried(name, fault=f"{kind.word} {name}: {Ending.of(error).reason}"))


def _outcome(word: str, point: EntryPoint, task: Task, future: Future[Answer], pool: Pool) -> Tried:
    """Return what came of a trial; one that ended its process is tried again if an earlier one may have done it."""
    answer = future.result()
    if not answer.items and answer.end is not None and not answer.end.certain:
        answer = pool.submit(Task(task.function, task.argument, task.owner, fresh=True)).result()
    if answer.items:
        tried: Tried = answer.items[0]
        return tried
    folder = folder_of_module(point.module)
    why = "it gave no answer"
    if answer.end is not None:
        why = explain(answer.end, lambda path: is_below(path, folder), ANSWER_LIMIT)
    return Tried(point.name, fault=f"{word} {point.name!r} ({point.value}) cannot be used: {why}")


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
    with contextlib.suppress(Exception):  # `servobench check plant` tells of it
        plant.close()


def _stop(_share: float, _what: str) -> None:
    raise _Trains
