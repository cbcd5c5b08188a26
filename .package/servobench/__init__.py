"""A bench on which uncalibrated visual-servoing controllers are compared.

    import servobench

    result = servobench.run("ukf_mfac", seed=3)
    table = servobench.compare(["ukf_mfac", MyController], seeds=5)

`run` and `compare` take controllers by name or as objects, `load` reads a results folder. A controller of your own is a
subclass of `Controller`: `step` gets an `Observation` and the reference and returns a `Command`.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from servobench.controllers.aids import EQUIPPED, Tuned
    from servobench.controllers.controller import Controller, ControllerEntry, RobotKnowledge
    from servobench.harness.apps.check.controllers import check_controller
    from servobench.harness.apps.check.plants import check_plant
    from servobench.harness.batch.api import Results, compare, load, run
    from servobench.harness.run.own_metrics import metric
    from servobench.harness.run.scenario import Scenario, Task, TaskEntry, TaskSetting
    from servobench.plant.bench.plant import Plant, PlantEntry, PlantSetup, World
    from servobench.plant.contract.signals import Command, Observation, PlantSpec, Truth

__all__ = [
    "EQUIPPED",
    "Command",
    "Controller",
    "ControllerEntry",
    "Observation",
    "Plant",
    "PlantEntry",
    "PlantSetup",
    "PlantSpec",
    "Results",
    "RobotKnowledge",
    "Scenario",
    "Task",
    "TaskEntry",
    "TaskSetting",
    "Truth",
    "Tuned",
    "World",
    "check_controller",
    "check_plant",
    "compare",
    "load",
    "metric",
    "run",
]

_HOMES = {
    "servobench.controllers.aids": ("EQUIPPED", "Tuned"),
    "servobench.controllers.controller": ("Controller", "ControllerEntry", "RobotKnowledge"),
    "servobench.harness.batch.api": ("Results", "compare", "load", "run"),
    "servobench.harness.apps.check.controllers": ("check_controller",),
    "servobench.harness.apps.check.plants": ("check_plant",),
    "servobench.harness.run.own_metrics": ("metric",),
    "servobench.harness.run.scenario": ("Scenario", "Task", "TaskEntry", "TaskSetting"),
    "servobench.plant.bench.plant": ("Plant", "PlantEntry", "PlantSetup", "World"),
    "servobench.plant.contract.signals": ("Command", "Observation", "PlantSpec", "Truth"),
}


def __getattr__(name: str) -> object:
    """Import a name of the public interface when it is first used."""
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(home), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
