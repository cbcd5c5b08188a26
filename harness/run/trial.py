"""Controllers and plants of third parties tried on an arm: one that cannot be built is told before a batch begins."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Final, NoReturn

from servobench.controllers.controller import ControllerEntry
from servobench.harness.config.registry import find_controller, installed_plant, is_published
from servobench.harness.config.robots import DEFAULT_ROBOT, find_robot
from servobench.harness.config.settings import ConfigurationError, Settings
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest, RunSettings, read_mismatch
from servobench.harness.run.resolved import resolve
from servobench.harness.run.tasks import TASKS
from servobench.plant.faults import RunFault
from servobench.plant.plant import PlantEntry, PlantSetup

PLANT: Final = "kinematic"  # on which controllers are tried
TASK: Final = "exp1"
ANSWER_LIMIT = 30.0  # [s] to load and build one: slow imports are allowed, a list that never comes is not


class _Trains(BaseException):
    """A controller begins to train its networks: it can be built. No `Exception`, which would count as its error."""


def usable_controller(name: str, robot: str = DEFAULT_ROBOT) -> ControllerEntry:
    """Return the controller called `name`; a third party's is built once for a robot and thrown away.

    Raises:
        ConfigurationError: it cannot be found, loaded or built, in one line.
    """
    if not is_published(ControllerEntry, name):
        return find_controller(name)
    with _answering_within(ANSWER_LIMIT):
        entry = find_controller(name)
        _refuse_task(name, "controller")
        request = RunRequest(PLANT, name, TASK, read_mismatch("none"), 0, robot=robot)
        with contextlib.suppress(RunFault, _Trains):  # of a fault the run's row will tell
            build(resolve(request, Settings()), progress=_stop).plant.close()
    return entry


def usable_plant(name: str, robot: str = DEFAULT_ROBOT) -> PlantEntry:
    """Return the plant called `name` if all that it needs is installed; a third party's is built and thrown away.

    Raises:
        ConfigurationError: it cannot be found, loaded or built, in one line.
    """
    if not is_published(PlantEntry, name):
        return installed_plant(name)
    with _answering_within(ANSWER_LIMIT):
        entry = installed_plant(name)
        _refuse_task(name, "plant")
        try:
            with contextlib.suppress(RunFault):
                _try(entry, robot)
        except ValueError as error:
            raise ConfigurationError(f"plant {name}: {error}") from error
    return entry


def _try(entry: PlantEntry, robot_name: str) -> None:
    robot, period = find_robot(robot_name), RunSettings().period
    setup = PlantSetup(robot.nominal, robot.workspace.home, period, robot)
    if entry.own_robot:
        setup = PlantSetup(None, None, period)
    config = entry.config() if entry.config_for is None else entry.config_for(robot)
    plant = entry.build(config, setup)
    with contextlib.suppress(Exception):  # `servobench check plant` tells of it
        plant.close()


@contextlib.contextmanager
def _answering_within(limit: float) -> Iterator[None]:
    """Raise a TimeoutError in code that takes longer than a limit [s]; only where a signal can interrupt it."""
    if not hasattr(signal, "SIGALRM") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_number: int, _frame: object) -> NoReturn:
        raise TimeoutError(f"no answer after {limit:g} s")

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, limit)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _refuse_task(name: str, what: str) -> None:
    if name in TASKS:
        raise ConfigurationError(f"a task is called {name!r}, too; give the {what} another name")


def _stop(_share: float, _what: str) -> None:
    raise _Trains
