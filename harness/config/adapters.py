"""Adapters around controllers and plants of users: errors become one line with their place, answers are checked."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from servobench.controllers.controller import Controller, RobotKnowledge
from servobench.harness.config.source import describe_at
from servobench.plant.bench.bench import Bench, build_bench
from servobench.plant.bench.plant import Plant, PlantSetup, World
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, PlantDiverged, RunFault
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import NonNegative, nested, settings
from servobench.plant.contract.signals import PlantSpec


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
    """A function of a user, whose errors are one line and whose result is of a known kind.

    Attributes:
        make: called with the settings and a `RobotKnowledge` or `PlantSetup`.
        kind: class of the result; None for any.
        with_config: whether it takes the settings.
    """

    make: Callable[..., Any]
    kind: type[Controller] | type[Plant] | None = None
    with_config: bool = True

    def __call__(self, *arguments: object) -> Any:  # noqa: ANN401 - an object of `kind`
        """Return the result.

        Raises:
            ConfigurationError: the code raises anything but a `RunFault`, or returns something else.
        """
        try:
            made = self.make(*arguments[0 if self.with_config else 1 :])
        except (RunFault, ConfigurationError):
            raise
        except (Exception, SystemExit) as error:
            raise ConfigurationError(describe_at(error, folder_of(self.make))) from error
        if self.kind is not None and not isinstance(made, self.kind):
            raise ConfigurationError(f"it is built as {type(made).__name__}, wanted a servobench.{self.kind.__name__}")
        if isinstance(made, Plant):
            _check_spec(made)
        return made


def folder_of(code: object) -> Path:
    """Return the folder of the file that holds a class, a function or an object's class; that of none is the root."""
    if isinstance(code, Guarded):
        return folder_of(code.make)
    if isinstance(code, partial):
        return folder_of(code.args[0] if code.func in (copy_of, on_bench) else code.func)
    try:
        return Path(inspect.getfile(code if isinstance(code, type) or inspect.isroutine(code) else type(code))).parent
    except (TypeError, OSError):
        return Path.cwd()


def copy_of(original: Controller, _knowledge: RobotKnowledge) -> Controller:
    """Return a copy of a controller that is there, so that no run sees the state of another."""
    return deepcopy(original)


def on_bench(
    world: type[World],
    with_config: bool,
    config: Any,  # noqa: ANN401 - any settings
    setup: PlantSetup,
) -> Bench:
    """Return the bench around a world, with delay and sensing of the settings where they have these fields.

    Args:
        world: its class.
        with_config: whether its constructor takes the settings.
        config: the settings.
        setup: of the plant.
    """

    def build(own: PlantSetup) -> World:
        make: Callable[..., World] = checked(world)
        made = make(config, own) if with_config else make(own)
        _check_spec(made)
        return made

    delay, sensing = getattr(config, "command_delay", 0.0), getattr(config, "sensing", SensingConfig())
    return build_bench(build, setup, delay, sensing)


def checked(world: type[World]) -> type[World]:
    """Return a class of worlds whose joint positions and features are copied, checked and float64.

    Its methods raise a `ValueError` about an answer that is no such array, and `PlantDiverged` about one that is not
    finite.
    """

    class Checked(world):  # type: ignore[misc, valid-type] # a class of a user
        def reset(self, seed: int) -> FloatArray:
            return as_answer("reset", super().reset(seed), self.spec.n, "joint positions")

        def advance(self, joint_velocity: FloatArray) -> FloatArray:
            return as_answer("advance", super().advance(joint_velocity), self.spec.n, "joint positions")

        def see(self) -> FloatArray | None:
            seen = super().see()
            return None if seen is None else as_answer("see", seen, self.spec.m, "features, or None")

    def as_answer(method: str, answer: object, size: int, content: str) -> FloatArray:
        wanted = f"{world.__name__}.{method} must return {size} {content}"
        try:
            values = np.array(answer, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{wanted}, got {answer!r}") from error
        if values.shape != (size,):
            raise ValueError(f"{wanted}, got shape {values.shape}")
        if not np.isfinite(values).all():
            raise PlantDiverged(f"{world.__name__}.{method} returned {values.tolist()}, which is not finite")
        return values

    Checked.__name__ = world.__name__
    return Checked


def _check_spec(made: Plant | World) -> None:
    """Refuse a plant or world whose constructor left out its sizes, limits and period."""
    spec, name = getattr(made, "spec", None), type(made).__name__
    if not isinstance(spec, PlantSpec):
        came = "nothing" if spec is None else type(spec).__name__
        raise ConfigurationError(
            f"{name}.__init__ must set self.spec to a servobench.PlantSpec, got {came}; PlantSpec.of_joints(...) "
            "makes one"
        )
