"""The bench of `check`: an arm of any size, y = A (q + 0.02 q³), and a driver that steps a controller on it."""

import contextlib
import random
import traceback
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from servobench.controllers.controller import Controller, Delays, RobotKnowledge
from servobench.controllers.networks.config import TrainingConfig
from servobench.controllers.networks.file import TrainedNetworks
from servobench.harness.config.source import is_users, show
from servobench.harness.run.contract import HeldController
from servobench.harness.run.loop import LoopSettings, begin, periods
from servobench.plant.bench.plant import Plant
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import Command, Observation, PlantSpec, Truth

PERIOD: Final = 0.05  # [s]
PREVIEW: Final = 10  # [rows]
MAX_PERIODS: Final = 1000  # of a run
BEND: Final = 0.02  # [1/rad²]
MODEL_ERROR: Final = 1.05  # nominal over true Jacobian
NOISE: Final = 1e-3  # [m] of the feature
SMALL_TRAINING: Final = {"samples": 40, "width_scales": (1.0,), "regularisations": (1e-6,)}


@dataclass
class Conditions:
    """The conditions of a run on the arm."""

    preview: int = PREVIEW  # [rows]
    scale: float = 1.0  # of features and reference
    lost: range = range(0)  # periods in which the feature is lost
    at_goal: bool = False  # whether the arm stands at its goal and is not moved


class Rig(Plant):
    """An arm of n joints whose camera measures m features; the same numbers for the same sizes.

    Attributes:
        conditions: of the runs.
        farthest: largest joint position at which the model was asked for its Jacobian [rad].
    """

    def __init__(self, n: int, m: int) -> None:
        """Make the arm.

        Args:
            n: number of joints.
            m: number of features.
        """
        self.conditions, self.farthest = Conditions(), 0.0
        rng = np.random.default_rng([n, m, 0])
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

    def model_jacobian(self, q: FloatArray) -> FloatArray:
        """Return the Jacobian of the nominal model, as `jacobian`."""
        self.farthest = max(self.farthest, float(np.abs(q).max()))
        return MODEL_ERROR * self.jacobian(q)

    def knowledge(self, *, truth: bool = False, preview: int = PREVIEW) -> RobotKnowledge:
        """Return the knowledge of a controller; with `truth` also that of an upper bound."""
        side, delays = np.ones(self.spec.n), Delays(0.0, 0.0, 0.0)
        known = RobotKnowledge(self.spec, preview, self.model_jacobian, region=(-side, side), train=self._train)
        if not truth:
            return known
        return replace(known, true_jacobian=self.jacobian, true_symbolic=self._symbolic, true_delays=delays)

    def reset(self, seed: int) -> Observation:
        """See `Plant.reset`; the arm stands at its start, or at its goal."""
        self._rng, self._k = np.random.default_rng(seed), 0
        self.q = self.goal if self.conditions.at_goal else self.start
        return self._observe()

    def step(self, command: Command) -> Observation:
        """See `Plant.step`; an arm at its goal stays there."""
        if not self.conditions.at_goal:
            limit = self.spec.joint_velocity_limit
            moved = self.q + np.clip(command.joint_velocity, -limit, limit) * PERIOD
            self.q = np.clip(moved, self.spec.joint_lower, self.spec.joint_upper)
        self._k += 1
        return self._observe()

    def _observe(self) -> Observation:
        feature, time = self.feature(self.q), self._k * PERIOD
        if self.conditions.at_goal:
            return Observation(time, self.q, feature)
        noisy = feature + self._rng.normal(scale=NOISE, size=self.spec.m)
        return Observation(time, self.q, self.conditions.scale * noisy, self._k not in self.conditions.lost)

    def truth(self) -> Truth:
        """See `Plant.truth`."""
        return Truth(self.feature(self.q), self.jacobian(self.q))

    def close(self) -> None:
        """See `Plant.close`; nothing is held."""

    def error(self) -> float:
        """Return the true distance from the goal [m]."""
        return float(np.linalg.norm(self.feature(self.goal) - self.feature(self.q)))

    def _train(self, config: TrainingConfig) -> TrainedNetworks:
        from servobench.controllers.networks.config import ControllerTraining, JacobianTraining  # noqa: PLC0415
        from servobench.controllers.networks.fit import train  # noqa: PLC0415 - scipy is slow to import

        parts: dict[str, Any] = {
            "jacobian": JacobianTraining(centres=6, **SMALL_TRAINING),  # type: ignore[arg-type]
            "controller": ControllerTraining(hidden=6, **SMALL_TRAINING),  # type: ignore[arg-type]
        }
        return train(replace(config, **parts), self.model_jacobian, self.spec)

    def _symbolic(self, q: Any) -> Any:  # noqa: ANN401 - expressions of CasADi
        return type(q)(self.A) @ (q + BEND * q * q * q)


class Driver:
    """Drives a controller on a rig; a run can be continued after a part of its periods."""

    def __init__(self, controller: Controller, rig: Rig, seed: int = 0) -> None:
        """Take controller, rig, and the seed of the noise, which `reset` gets, too."""
        self.controller, self.rig, self.seed = controller, rig, seed
        self._held = HeldController(controller, rig.spec)
        self.times: list[float] = []  # [s] of each step

    def begin(self) -> Self:
        """Reset the controller."""
        conditions, goal = self.rig.conditions, self.rig.feature(self.rig.goal)
        desired = conditions.scale * np.tile(goal, (MAX_PERIODS + conditions.preview, 1))
        desired.flags.writeable = False
        length = LoopSettings(MAX_PERIODS, conditions.preview)
        self.rollout = begin(self.rig, self._held, desired, length, (self.seed, self.seed))
        return self

    def run(self, count: int) -> FloatArray:
        """Return the commands (count, n) [rad/s] of the next periods.

        Raises:
            WrongAnswer: `step` returned no command of n finite numbers, or changed its arguments.
        """
        commands = []
        for period in islice(periods(self.rollout, self._held), count):
            self.times.append(1e-9 * period.nanoseconds[0])
            commands.append(period.command.joint_velocity)
        return np.array(commands)


@contextlib.contextmanager
def watching_draws() -> Iterator[list[str]]:
    """Yield a list that gets a sentence on each draw without a seed by code of users within the context."""
    found: list[str] = []
    source: Any = np.random.bit_generator
    original = source.randbits

    def noted(bits: int) -> int:
        for frame in reversed(traceback.extract_stack()):
            if is_users(frame.filename):
                place = f"{show(Path(frame.filename))}:{frame.lineno}"
                found.append(f"{place}: a generator of random numbers is made without a seed")
                break
        return int(original(bits))

    before = _states()
    source.randbits = noted
    try:
        yield found
    finally:
        source.randbits = original
        shared = [name for name, state in _states().items() if state != before[name]]
        found += [f"it draws from the generator of {name}, which no seed of a run sets" for name in shared]


def _states() -> dict[str, object]:
    shared: Any = np.random.get_state(legacy=False)  # noqa: NPY002 - it is compared, not used
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
    return True  # objects of other kinds cannot be compared
