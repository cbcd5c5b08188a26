"""A controller driven on a made-up arm, period by period, and what it does on the way."""

from __future__ import annotations

import contextlib
import inspect
import random
import traceback
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from servobench.controllers.controller import Controller
from servobench.harness.check.report import CheckFailed
from servobench.harness.check.rig import PREVIEW, Rig
from servobench.harness.config.source import PACKAGES, show
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import Command, Observation


@dataclass
class Conditions:
    """What a run on the made-up arm meets."""

    seed: int = 0  # of the noise, and what `reset` is given
    preview: int = PREVIEW  # [rows]
    scale: float = 1.0  # of features and reference
    lost: range = range(0)  # periods in which the feature is not seen
    at_goal: bool = False  # whether the arm stands at its goal and is not moved


@dataclass
class Driver:
    """Drives a controller; a run can be continued after a part of its periods."""

    controller: Controller
    rig: Rig
    conditions: Conditions = field(default_factory=Conditions)
    k: int = 0
    times: list[float] = field(default_factory=list)  # [s] of each step

    def begin(self) -> Driver:
        """Reset the controller."""
        self.rng = np.random.default_rng(self.conditions.seed)
        self.q = self.rig.goal if self.conditions.at_goal else self.rig.start
        self.k = 0
        self.observation = self._observe()
        self.controller.reset(self.observation, self.conditions.seed)
        return self

    def run(self, periods: int) -> FloatArray:
        """Return the commands (periods, n) [rad/s] of the next periods."""
        return np.array([self.step() for _ in range(periods)])

    def step(self) -> FloatArray:
        """Return the command (n,) [rad/s] of a period, and go on to the next.

        Raises:
            CheckFailed: it is no command of n finite numbers, or `step` changed what it was given.
        """
        reference = self.conditions.scale * self.rig.reference(self.conditions.preview)
        reference.flags.writeable = False
        given = _bytes(self.observation, reference)
        began = perf_counter()
        command = self.controller.step(self.observation, reference)
        self.times.append(perf_counter() - began)
        u = _velocity(command, self.controller, self.rig.spec.n)
        if _bytes(self.observation, reference) != given:
            raise CheckFailed(f"{at(self.controller.step)}: step changes what it is given; work on a copy")
        if not self.conditions.at_goal:
            self.q = self.rig.move(self.q, u)
        self.k += 1
        self.observation = self._observe()
        return u

    def error(self) -> float:
        """Return the true distance from the goal [m]."""
        return float(np.linalg.norm(self.rig.feature(self.rig.goal) - self.rig.feature(self.q)))

    def _observe(self) -> Observation:
        if self.conditions.at_goal:
            return Observation(self.k * self.rig.spec.period, self.q, self.rig.feature(self.q))
        seen = self.rig.seen(self.q, self.k, self.rng, valid=self.k not in self.conditions.lost)
        return Observation(seen.time, seen.joint_position, self.conditions.scale * seen.feature, seen.feature_valid)


def at(method: Any) -> str:  # noqa: ANN401 - a method or a function
    """Return `FILE:LINE` of a method."""
    code = getattr(inspect.unwrap(getattr(method, "__func__", method)), "__code__", None)
    return f"{show(Path(code.co_filename))}:{code.co_firstlineno}" if code else "step"


def _bytes(observation: Observation, reference: FloatArray) -> tuple[bytes, ...]:
    return observation.joint_position.tobytes(), observation.feature.tobytes(), reference.tobytes()


def _velocity(command: object, controller: Controller, n: int) -> FloatArray:
    where = at(controller.step)
    if not isinstance(command, Command):
        raise CheckFailed(
            f"{where}: step must return a servobench.Command, got {type(command).__name__}; "
            "end it with return servobench.Command(u)"
        )
    if command.joint_velocity.shape != (n,):
        raise CheckFailed(
            f"{where}: the command must have shape ({n},), a number for each joint, got {command.joint_velocity.shape}"
        )
    return command.joint_velocity


@dataclass
class Draws:
    """Random numbers that came from no seed."""

    places: list[str] = field(default_factory=list)  # where generators without a seed were made
    shared: list[str] = field(default_factory=list)  # modules whose common generator was used


@contextlib.contextmanager
def watching_draws(folder: Path) -> Iterator[Draws]:
    """Yield what is drawn without a seed within the context.

    Args:
        folder: that of the user's code.
    """
    found = Draws()
    source: Any = np.random.bit_generator
    original = source.randbits

    def noted(bits: int) -> int:
        for frame in reversed(traceback.extract_stack()):
            path = Path(frame.filename)
            if path.is_relative_to(folder) and PACKAGES not in path.parts:
                found.places.append(f"{show(path)}:{frame.lineno}")
                break
        return int(original(bits))

    before = _states()
    source.randbits = noted
    try:
        yield found
    finally:
        source.randbits = original
        found.shared += [name for name, state in _states().items() if state != before[name]]


def _states() -> dict[str, object]:
    shared: Any = np.random.get_state(legacy=False)  # noqa: NPY002 - it is looked at, not used
    return {"numpy.random": (shared["state"]["key"].tobytes(), shared["state"]["pos"]), "random": random.getstate()}


def attributes(thing: object) -> dict[str, Any]:
    """Return the attributes of an object as they are now; those of which there is no copy as they are."""
    found = dict(getattr(thing, "__dict__", {}))
    for name, value in found.items():
        with contextlib.suppress(Exception):
            found[name] = deepcopy(value)
    return found


def differing(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Return the names of attributes that are not in both, or of different value."""
    return sorted(name for name in {*one, *other}
                  if name not in one or name not in other or not _same(one[name], other[name]))  # fmt: skip


def _same(one: object, other: object) -> bool:
    try:
        if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
            return bool(np.array_equal(one, other, equal_nan=one.dtype.kind == "f"))
        if isinstance(one, int | float | str | bool | list | tuple | dict | type(None)):
            return bool(one == other)
    except ValueError:  # arrays within
        return repr(one) == repr(other)
    return True  # nothing can be told of objects of other kinds
