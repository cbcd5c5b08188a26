"""Runs that are built and thrown away: what cannot be built is refused before a batch begins or a list is printed."""

import contextlib

from servobench.controllers.networks.fit import Progress
from servobench.harness.config.registry import find_plant
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import chosen_controller
from servobench.harness.run.experiment import build
from servobench.harness.run.feasibility import check_features, check_possible
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.resolution import ResolvedRun, resolve
from servobench.harness.run.result import ends_batch
from servobench.harness.run.tasks import task_names
from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.faults import ConfigurationError, RunFault, configuration_errors
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import Mismatch


def build_once(run: ResolvedRun, progress: Progress | None = None) -> None:
    """Build a run and discard it, which refuses a wrong configuration and trains networks.

    Other errors are left to the run, whose row names them. Arguments and errors are those of `build`.
    """
    try:
        experiment = build(run, progress=progress)
        chosen_controller(run, experiment)
        drawn = experiment.drawn
        spec = experiment.plant.spec
        with contextlib.closing(experiment.plant) as plant:
            with configuration_errors(f"task {run.request.task}: "):
                desired = experiment.desired()
            check_features(run, drawn, spec, desired)
            if isinstance(plant, Bench):
                plant.world.rehearse()
    except BaseException as error:
        if isinstance(error, ConfigurationError) or ends_batch(error):
            raise
        return  # The error is one of a plug-in; its run will fail in the same way.
    check_possible(run, drawn, spec)


def try_to_build(word: str, name: str, robot_name: str) -> None:
    """Build a controller or plant for a robot and throw it away.

    Raises:
        ConfigurationError: it cannot be built, or a task has its name; one line.
    """
    if name in task_names():
        raise ConfigurationError(f"a task is called {name!r}, too; give the {word} another name")
    robot = find_robot(robot_name)
    if word == "controller":
        request = RunRequest("kinematic", name, "exp1", Mismatch(), 0, robot=robot_name)
        with contextlib.suppress(RunFault, _Trains):  # the run's row will report a fault
            build(resolve(request, Settings()), progress=_stop).plant.close()
        return
    entry = find_plant(name)
    period = RunSettings().period
    if entry.own_robot:
        setup = PlantSetup(None, None, period)
    else:
        setup = PlantSetup(robot.nominal, robot.workspace.home, period, robot)
    with configuration_errors(f"plant {name}: "), contextlib.suppress(RunFault):
        plant = entry.build(entry.settings_for(robot), setup)
        with contextlib.suppress(Exception):  # `servobench check plant` reports it
            plant.close()


class _Trains(BaseException):
    """A controller begins to train its networks: it can be built. No `Exception`, which would count as its error."""


def _stop(_share: float, _what: str) -> None:
    raise _Trains
