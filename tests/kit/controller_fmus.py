"""Exported controllers: each is compiled once for a version of FMI, by whichever process needs it first."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np

from servobench.fmus.compiler import this_platform
from servobench.fmus.controllers.export import ControllerModel
from servobench.harness.apps.fmu.products import controller_model
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import Experiment, build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.contract.cache import cached
from servobench.plant.contract.signals import Command, Observation

PERIODS = 120
TASKS = {"rbfnn_mfac:published": "random"}
"""Instead of a circle, on which the original itself makes 3e-6 rad/s of an error of 1e-16 in what it sees."""


@cache
def recorded(name: str) -> ControllerModel:
    """Return a controller, recorded for another robot and another run than those below."""
    return controller_model(RunRequest("kinematic", name, "target", "moderate", 3), Settings())


@cache
def exported(name: str, version: int) -> Path:
    """Return a controller as an FMU."""
    file = f"{name.replace(':', '_')}_{version}"

    def make(folder: Path) -> None:
        recorded(name).product(version).write(folder / f"{file}.fmu", (this_platform(),))

    return cached("controllers_of_tests", file, make) / f"{file}.fmu"


def experiment(name: str, sensing: str = "position", **settings: object) -> Experiment:
    """Return a run, mostly on a circle, with noise, latency, delay, lost frames and a camera that is turned."""
    lossy = {"sensing": {"drop_probability": 0.05}} | settings
    request = RunRequest("kinematic", name, TASKS.get(name, "circle"), "severe", 8, sensing=sensing)
    return build(resolve(request, Settings({"kinematic": lossy})))


def periods(run: Experiment) -> Iterator[tuple[Observation, np.ndarray, Command]]:
    """Yield what the controller of a run sees, its reference and its answer in each period."""
    rows = 1 + run.run.preview_rows
    desired = run.scenario.reference.sampled(run.plant.spec.period, PERIODS + rows)
    observation = run.plant.reset(0)
    run.controller.reset(observation, 0)
    for k in range(PERIODS):
        command = run.controller.step(observation, desired[k : k + rows])
        yield observation, desired[k : k + rows], command
        observation = run.plant.step(command)


def inputs_of(observation: Observation, reference: np.ndarray) -> np.ndarray:
    """Return the inputs of an exported controller, in the order of its variables."""
    rows = observation.joint_position, observation.feature, observation.valid, reference
    return np.concatenate([np.ravel(row).astype(np.float64) for row in rows])
