"""Code of users that builds controllers and plants, wrapped so that its errors are one line with their place."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

from servobench.controllers.controller import Controller, RobotKnowledge
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.config.source import describe_at
from servobench.harness.config.watched import WatchedWorld, missing_spec
from servobench.plant.bench.bench import Bench, build_bench
from servobench.plant.bench.plant import Plant, PlantSetup, World
from servobench.plant.contract.faults import RunFault
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import NonNegative, nested, settings
from servobench.plant.contract.signals import PlantSpec


@settings
class NoSettings:
    """The settings of what is given as a class without a dataclass of settings: none."""


@settings
class BenchSettings:
    """The settings of a world that is given as a class without a dataclass of settings: those of its bench."""

    command_delay: NonNegative = 0.0
    """[s] between a command and its first effect"""
    sensing: SensingConfig = nested(SensingConfig)
    """noise, latency and lost frames"""


@dataclass(frozen=True, eq=False)
class Guarded:
    """A function of a user, whose errors are one line."""

    make: Callable[..., Any]

    def __call__(self, *arguments: object) -> Any:  # noqa: ANN401 - whatever the function returns
        """Call it.

        Raises:
            ConfigurationError: the code raises anything but a `RunFault`; one line with its place.
        """
        try:
            return self.make(*arguments)
        except (RunFault, ConfigurationError):
            raise
        except (Exception, SystemExit) as error:
            raise ConfigurationError(describe_at(error, folder_of(self.make))) from error


@dataclass(frozen=True, eq=False)
class Build(Guarded):
    """Builds a controller or a plant by code of a user.

    Attributes:
        make: called with the settings and with what the harness tells: `RobotKnowledge` or `PlantSetup`.
        kind: of what it has to return.
        with_config: whether it takes the settings.
    """

    kind: type[Controller] | type[Plant] = Controller
    with_config: bool = True

    def __call__(self, *arguments: object) -> Any:  # noqa: ANN401 - an object of `kind`
        """Return the controller or plant, given settings and knowledge or setup.

        Raises:
            ConfigurationError: the code raises anything but a `RunFault`, or returns something else.
        """
        made = super().__call__(*arguments[0 if self.with_config else 1 :])
        if not isinstance(made, self.kind):
            raise ConfigurationError(f"it is built as {type(made).__name__}, wanted a servobench.{self.kind.__name__}")
        if isinstance(made, Plant) and not isinstance(getattr(made, "spec", None), PlantSpec):
            raise ConfigurationError(missing_spec(made))
        return made


@dataclass(frozen=True, eq=False)
class Copy:
    """Builds a controller from one that is there."""

    original: Controller

    def __call__(self, _knowledge: RobotKnowledge) -> Controller:
        """Return a copy, so that no run sees what another left behind."""
        return deepcopy(self.original)


@dataclass(frozen=True, eq=False)
class OnBench:
    """Builds a plant from a class of worlds.

    Attributes:
        original: a subclass of `World`.
        with_config: whether its constructor takes the settings.
    """

    original: type[World]
    with_config: bool

    def __call__(self, config: Any, setup: PlantSetup) -> Bench:  # noqa: ANN401 - any settings
        """Return the bench around the world, with delay and sensing of the settings where they have these fields."""
        names = {each.name for each in fields(config)}
        delay = config.command_delay if "command_delay" in names else 0.0
        sensing = config.sensing if "sensing" in names else SensingConfig()
        return build_bench(partial(self._world, config), setup, delay, sensing)

    def _world(self, config: object, setup: PlantSetup) -> World:
        make: Callable[..., World] = self.original
        return WatchedWorld(make(config, setup) if self.with_config else make(setup))


def folder_of(code: object) -> Path:
    """Return the folder of the file that holds a class, a function or an object's class; that of none is the root."""
    code = getattr(code, "original", code)
    try:
        return Path(inspect.getfile(code if isinstance(code, type) or inspect.isroutine(code) else type(code))).parent
    except (TypeError, OSError):
        return Path.cwd()
