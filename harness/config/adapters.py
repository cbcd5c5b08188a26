"""Adapters around controllers and plants of users: errors become one line with their place, answers are checked."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np

from servobench.controllers.controller import Controller, RobotKnowledge
from servobench.harness.config.source import describe_at
from servobench.plant.bench.bench import Bench, build_bench
from servobench.plant.bench.plant import ImageArray, Plant, PlantSetup, TrueModel, World
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, PlantDiverged, RunFault
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import NonNegative, nested, settings
from servobench.plant.contract.signals import PlantSpec, Truth


@settings
class NoSettings:
    """The settings of a controller or plant that is a class without a dataclass of settings: none."""


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

    def __call__(self, *arguments: object) -> Any:  # noqa: ANN401 - any result
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
        make: called with the settings and a `RobotKnowledge` or `PlantSetup`.
        kind: class of the result.
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
        """Return a copy, so that no run sees the state of another."""
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


@final
class WatchedWorld(World):
    """A world that carries out one run, with joint positions and features copied, checked and as float64."""

    def __init__(self, world: World) -> None:
        """Watch a world.

        Raises:
            ConfigurationError: its constructor left out its sizes, limits and period.
        """
        self._world, self._name = world, type(world).__name__
        spec: object = getattr(world, "spec", None)
        if not isinstance(spec, PlantSpec):
            raise ConfigurationError(missing_spec(world))
        self.spec, self.lag = spec, world.lag

    def reset(self, seed: int) -> FloatArray:
        """See `World.reset`."""
        return self._checked("reset", self._world.reset(seed), self.spec.n, "joint positions")

    def advance(self, joint_velocity: FloatArray) -> FloatArray:
        """See `World.advance`."""
        return self._checked("advance", self._world.advance(joint_velocity), self.spec.n, "joint positions")

    def see(self) -> FloatArray | None:
        """See `World.see`."""
        seen = self._world.see()
        return None if seen is None else self._checked("see", seen, self.spec.m, "features, or None")

    def _checked(self, method: str, answer: object, size: int, what: str) -> FloatArray:
        """Return an answer as an array (size,) that nobody else holds.

        Raises:
            ValueError: it is no such array.
            PlantDiverged: a number in it is not finite.
        """
        wanted = f"{self._name}.{method} must return {size} {what}"
        try:
            values = np.array(answer, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{wanted}, got {answer!r}") from error
        if values.shape != (size,):
            raise ValueError(f"{wanted}, got shape {values.shape}")
        if not np.isfinite(values).all():
            raise PlantDiverged(f"{self._name}.{method} returned {values.tolist()}, which is not finite")
        return values

    def why_unseen(self) -> str:
        """See `World.why_unseen`."""
        return self._world.why_unseen()

    def truth(self) -> Truth:
        """See `Plant.truth`."""
        return self._world.truth()

    def save(self) -> Any:  # noqa: ANN401 - as `Plant.save`
        """See `Plant.save`."""
        return self._world.save()

    def restore(self, state: Any) -> None:  # noqa: ANN401 - as `Plant.restore`
        """See `Plant.restore`."""
        self._world.restore(state)

    def true_model(self) -> TrueModel:
        """See `Plant.true_model`."""
        return self._world.true_model()

    def nominal_jacobian(self) -> Callable[[FloatArray], FloatArray] | None:
        """See `Plant.nominal_jacobian`."""
        return self._world.nominal_jacobian()

    def picture(self) -> ImageArray | None:
        """See `Plant.picture`."""
        return self._world.picture()

    def move_camera(self, X_BC: FloatArray) -> None:
        """See `Plant.move_camera`."""
        self._world.move_camera(X_BC)

    def close(self) -> None:
        """See `Plant.close`."""
        self._world.close()


def missing_spec(made: object) -> str:
    """Return the message about a plant or world whose constructor left out its spec."""
    spec, name = getattr(made, "spec", None), type(made).__name__
    came = "nothing" if spec is None else type(spec).__name__
    return (
        f"{name}.__init__ must set self.spec to a servobench.PlantSpec, got {came}; PlantSpec.of_joints(...) makes one"
    )
