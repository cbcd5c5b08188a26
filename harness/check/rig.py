"""The bench of `check`: an arm of any size, y = A (q + 0.02 q³), and a driver that steps a controller on it."""

from __future__ import annotations

import contextlib
import inspect
import random
import traceback
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any, Final

import numpy as np

from servobench.controllers.controller import Controller, Delays, RobotKnowledge
from servobench.controllers.networks.config import TrainingConfig
from servobench.controllers.networks.file import TrainedNetworks
from servobench.harness.check.report import CheckFailed
from servobench.harness.config.source import PACKAGES, show
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import Command, Observation, PlantSpec

PERIOD: Final = 0.05  # [s]
PREVIEW: Final = 10  # [rows]
BEND: Final = 0.02  # [1/rad²]
MODEL_ERROR: Final = 1.05  # nominal over true Jacobian
NOISE: Final = 1e-3  # [m] of the feature
SMALL_TRAINING: Final = {"samples": 40, "width_scales": (1.0,), "regularisations": (1e-6,)}


class Rig:
    """An arm of n joints whose camera sees m features; the same numbers for the same sizes."""

    def __init__(self, n: int, m: int, seed: int = 0) -> None:
        """Make the arm.

        Args:
            n: number of joints.
            m: number of features.
            seed: of the arm's numbers.
        """
        rng = np.random.default_rng([n, m, seed])
        left, _, right = np.linalg.svd(rng.normal(size=(m, n)), full_matrices=False)
        self.A = left * np.linspace(0.4, 0.8, min(n, m)) @ right  # [m/rad], well conditioned
        self.start, self.goal = rng.uniform(-0.5, 0.5, (2, n))
        joints, features = (tuple(f"{letter}{i}" for i in range(size)) for letter, size in (("q", n), ("y", m)))
        self.spec = PlantSpec.of_joints(joints, features, np.full(n, 1.0), np.full(n, -6.0), np.full(n, 6.0), PERIOD)

    def feature(self, q: FloatArray) -> FloatArray:
        """Return the true feature (..., m) [m] at joint positions (..., n) [rad]."""
        return np.asarray(np.matvec(self.A, q + BEND * q**3))

    def jacobian(self, q: FloatArray) -> FloatArray:
        """Return the true Jacobian (..., m, n) [m/rad] at joint positions (..., n) [rad]."""
        return np.asarray(self.A * (1.0 + 3.0 * BEND * q**2)[..., None, :])

    def nominal_jacobian(self, q: FloatArray) -> FloatArray:
        """Return the Jacobian of the nominal model, as `jacobian`."""
        return MODEL_ERROR * self.jacobian(q)

    def knowledge(self, *, truth: bool = False, preview: int = PREVIEW) -> RobotKnowledge:
        """Return what a controller may know; with `truth` also what only an upper bound may."""
        n = self.spec.n
        known = RobotKnowledge(
            self.spec, preview, self.nominal_jacobian, region=(np.full(n, -1.0), np.full(n, 1.0)), train=self._train
        )
        if not truth:
            return known
        return replace(
            known, true_jacobian=self.jacobian, true_symbolic=self._symbolic, true_delays=Delays(0.0, 0.0, 0.0)
        )

    def seen(self, q: FloatArray, k: int, rng: np.random.Generator, *, valid: bool = True) -> Observation:
        """Return what is observed in period k at joint positions q (n,) [rad]."""
        noisy = self.feature(q) + rng.normal(scale=NOISE, size=self.spec.m)
        return Observation(k * PERIOD, q, noisy, valid)

    def move(self, q: FloatArray, joint_velocity: FloatArray) -> FloatArray:
        """Return the joint positions a period later, (n,) [rad]."""
        limit = self.spec.joint_velocity_limit
        moved = q + np.clip(joint_velocity, -limit, limit) * PERIOD
        return np.asarray(np.clip(moved, self.spec.joint_lower, self.spec.joint_upper))

    def reference(self, preview: int = PREVIEW) -> FloatArray:
        """Return the reference (1 + preview, m) [m] of a target at rest; it cannot be written."""
        rows = np.tile(self.feature(self.goal), (1 + preview, 1))
        rows.flags.writeable = False
        return rows

    def _train(self, config: TrainingConfig) -> TrainedNetworks:
        from servobench.controllers.networks.config import ControllerTraining, JacobianTraining  # noqa: PLC0415
        from servobench.controllers.networks.fit import train  # noqa: PLC0415 - scipy is slow to import

        parts: dict[str, Any] = {
            "jacobian": JacobianTraining(centres=6, **SMALL_TRAINING),  # type: ignore[arg-type]
            "controller": ControllerTraining(hidden=6, **SMALL_TRAINING),  # type: ignore[arg-type]
        }
        return train(replace(config, **parts), self.nominal_jacobian, self.spec)

    def _symbolic(self, q: Any) -> Any:  # noqa: ANN401 - expressions of CasADi
        return type(q)(self.A) @ (q + BEND * q * q * q)


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
