"""The bench of `check`: an arm of any size, y = A (q + 0.02 q³), and a driver that steps a controller on it."""

import contextlib
import random
import sys
import traceback
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Self

import numpy as np

from servobench.controllers.controller import Controller, Delays, RobotKnowledge
from servobench.controllers.networks.config import TrainingConfig
from servobench.controllers.networks.file import TrainedNetworks
from servobench.harness.config.source import is_users, show
from servobench.harness.run.contract import HeldController
from servobench.harness.run.loop import LoopSettings, begin, periods
from servobench.plant.bench.plant import Plant
from servobench.plant.contract.checks import FloatArray, Shape
from servobench.plant.contract.features import (
    Derivatives,
    FeatureModel,
    ModelState,
    parameters_of_joints,
)
from servobench.plant.contract.signals import Command, Observation, PlantSpec, Truth
from servobench.plant.robot.twin import CAMERA, POSE

PERIOD = 0.05  # [s]
PREVIEW = 10  # [rows]
MAX_PERIODS = 1000  # length of a run in periods
BEND = 0.02  # [1/rad²]
MODEL_ERROR = 1.05  # nominal over true Jacobian
NOISE = 1e-3  # [m] noise of the feature
SMALL_TRAINING = {"samples": 40, "width_scales": (1.0,), "regularisations": (1e-6,)}


@dataclass
class Conditions:
    """The conditions of a run on the arm."""

    preview: int = PREVIEW  # [rows]
    scale: float = 1.0  # factor on features and reference
    lost: range = range(0)  # periods in which the feature is lost
    at_goal: bool = False  # whether the arm stands at its goal and is not moved


class Rig(Plant):
    """An arm of n joints whose camera measures m features; the same numbers for the same sizes.

    Attributes:
        conditions: of the runs.
        farthest: largest joint position at which the model was asked for its Jacobian [rad].
    """

    def __init__(self, n: int, m: int, period: float = PERIOD) -> None:
        """Make the arm.

        Args:
            n: number of joints.
            m: number of features.
            period: [s] between two commands.
        """
        self.conditions = Conditions()
        self.farthest = 0.0
        rng = np.random.default_rng([n, m, 0])
        left, _, right = np.linalg.svd(rng.normal(size=(m, n)), full_matrices=False)
        sizes = np.linspace(0.4, 0.8, min(n, m))
        self.A = left * sizes @ right  # [m/rad], well conditioned
        self.places = rng.uniform(-0.5, 0.5, (2, 2, n))  # start and goal [rad] of each seed
        self.start, self.goal = self.places[0]
        joints = tuple(f"q{i}" for i in range(n))
        features = tuple(f"y{i}" for i in range(m))
        speeds = np.full(n, 1.0)  # [rad/s]
        range_ = np.full(n, 6.0)  # [rad] to either side
        self.spec = PlantSpec.of_joints(joints, features, speeds, -range_, range_, period)

    def feature(self, q: FloatArray) -> FloatArray:
        """Return the true feature (..., m) [m] at joint positions (..., n) [rad]."""
        return np.matvec(self.A, q + BEND * q**3)

    def jacobian(self, q: FloatArray) -> FloatArray:
        """Return the true Jacobian (..., m, n) [m/rad] at joint positions (..., n) [rad]."""
        return self.A * (1.0 + 3.0 * BEND * q**2)[..., None, :]

    def model_jacobian(self, q: FloatArray) -> FloatArray:
        """Return the Jacobian of the nominal model, as `jacobian`."""
        self.farthest = max(self.farthest, float(np.abs(q).max()))
        return MODEL_ERROR * self.jacobian(q)

    def knowledge(self, *, truth: bool = False) -> RobotKnowledge:
        """Return the knowledge of a controller; with `truth` also that of an upper bound."""
        side = np.ones(self.spec.n)
        known = RobotKnowledge(
            self.spec,
            self.conditions.preview,
            self.model_jacobian,
            RigModel(self),
            region=(-side, side),
            train=self._train,
        )
        if not truth:
            return known
        return replace(
            known,
            true_jacobian=self.jacobian,
            true_symbolic=self._symbolic,
            true_delays=Delays(0.0, 0.0, 0.0),
        )

    def reset(self, seed: int) -> Observation:
        """See `Plant.reset`; the arm stands at its start, or at its goal."""
        self._rng = np.random.default_rng(seed)
        self._k = 0
        self.q = self.goal if self.conditions.at_goal else self.start
        return self._observe()

    def step(self, command: Command) -> Observation:
        """See `Plant.step`; an arm at its goal stays there."""
        if not self.conditions.at_goal:
            limit = self.spec.joint_velocity_limit
            moved = self.q + np.clip(command.joint_velocity, -limit, limit) * self.spec.period
            self.q = np.clip(moved, self.spec.joint_lower, self.spec.joint_upper)
        self._k += 1
        return self._observe()

    def _observe(self) -> Observation:
        feature = self.feature(self.q)
        time = self._k * self.spec.period
        if self.conditions.at_goal:
            return Observation(time, self.q, feature)
        noisy = feature + self._rng.normal(scale=NOISE, size=self.spec.m)
        measured = self.conditions.scale * noisy
        valid = self._k not in self.conditions.lost
        return Observation(time, self.q, measured, valid)

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


class RigModel(FeatureModel):
    """The nominal arm of a rig by gears and zeros of its joints, y(g q + o), with a camera that changes nothing."""

    def __init__(self, rig: Rig) -> None:
        """Take the rig, whose arm has the same features and Jacobian but for `MODEL_ERROR`."""
        self._rig = rig
        self._names = (*parameters_of_joints(rig.spec.joint_names), *CAMERA)

    @property
    def names(self) -> tuple[str, ...]:
        """See `FeatureModel.names`."""
        return self._names

    def start(self, lead: Shape) -> ModelState:
        """See `FeatureModel.start`."""
        cameras = np.broadcast_to(np.eye(4), (*lead, 1, 4, 4))
        return np.zeros((*lead, len(self.names))), cameras

    def moved(self, theta: FloatArray, cameras: FloatArray, step: FloatArray) -> ModelState:
        """See `FeatureModel.moved`."""
        theta = theta + step
        theta[..., self.pose_columns] = 0.0
        return theta, cameras

    def derivatives(
        self,
        theta: FloatArray,
        cameras: FloatArray,
        joints: FloatArray,
        turn: FloatArray | None = None,
    ) -> Derivatives:
        """See `FeatureModel.derivatives`."""
        del cameras, turn
        gear = 1.0 + theta[..., None, self.columns("gear_")]
        angle = gear * joints + theta[..., None, self.columns("zero_")]
        slope = MODEL_ERROR * self._rig.jacobian(angle)
        none = np.zeros((*slope.shape[:-1], len(POSE)))
        by_parameter = np.concatenate([slope * joints[..., None, :], slope, none], axis=-1)
        feature = MODEL_ERROR * self._rig.feature(angle)
        return Derivatives(feature, slope * gear[..., None, :], by_parameter)


class Driver:
    """Drives a controller on a rig; a run can be continued after a part of its periods."""

    def __init__(self, controller: Controller, rig: Rig, seed: int = 0) -> None:
        """Take controller, rig, and the seed of start, goal and noise, which `reset` gets, too."""
        self.controller, self.rig, self.seed = controller, rig, seed
        self._held = HeldController(controller, rig.spec)
        self.times: list[float] = []  # [s] duration of each step

    def begin(self) -> Self:
        """Reset the controller."""
        conditions, rig = self.rig.conditions, self.rig
        rig.start, rig.goal = rig.places[self.seed % len(rig.places)]
        desired = conditions.scale * np.tile(
            rig.feature(rig.goal), (MAX_PERIODS + conditions.preview, 1)
        )
        desired.flags.writeable = False
        length = LoopSettings(MAX_PERIODS, conditions.preview)
        self.rollout = begin(rig, self._held, desired, length, (self.seed, self.seed))
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
    found = []
    source: Any = np.random.bit_generator
    original = source.randbits

    def noted(bits: int) -> int:
        for frame in reversed(traceback.extract_stack()):
            if is_users(frame.filename):
                found.append(
                    f"{show(Path(frame.filename))}:{frame.lineno}: a generator of random numbers is made without "
                    "a seed"
                )
                break
        return int(original(bits))

    before = _states()
    source.randbits = noted
    try:
        yield found
    finally:
        source.randbits = original
        shared = [name for name, state in _states().items() if state != before[name]]
        found += [
            f"it draws from the generator of {name}, which no seed of a run sets" for name in shared
        ]


def _states() -> dict[str, object]:
    shared = np.random.get_state(legacy=False)  # noqa: NPY002 - it is compared, not used
    return {
        "numpy.random": (shared["state"]["key"].tobytes(), shared["state"]["pos"]),
        "random": random.getstate(),
    }


def attributes(thing: object) -> dict[str, Any]:
    """Return copies of the plain attributes of an object as they are now."""
    plain = int, float, str, list, tuple, dict, set, np.ndarray, np.generic, type(None)
    found = {}
    for name, value in vars(thing).items():
        with contextlib.suppress(Exception):  # objects in a list that cannot be copied
            if (
                isinstance(value, plain)
                and not name.startswith("__")
                and _same(copy := deepcopy(value), value)
            ):
                found[name] = copy
    return found


def differing(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Return the names of attributes that are not in both, or of different value."""
    return sorted(name for name in {*one, *other}
                  if name not in one or name not in other or not _same(one[name], other[name]))  # fmt: skip


def _same(one: object, other: object) -> bool:
    try:
        np.testing.assert_equal(one, other)
    except (AssertionError, ValueError):
        return False
    return True


class Shared:
    """The variables that all controllers of a class share, those of the class and its module, in code of users."""

    def __init__(self, kind: type) -> None:
        """Keep their values."""
        modules = {}
        classes = {}
        for each in kind.__mro__:
            name = each.__module__
            module = sys.modules.get(name)
            file = getattr(module, "__file__", None) or "<"
            if is_users(file):
                modules[name] = module
                classes[each.__name__] = each
        self._owners = modules | classes
        self._before = {name: attributes(each) for name, each in self._owners.items()}
        self._known = {name: {*vars(each)} for name, each in self._owners.items()}

    def restore(self) -> list[str]:
        """Give them back the values that were kept, and return the names of those that had changed."""
        changed = []
        for place, owner in self._owners.items():
            before = self._before[place]
            for name in differing(before, attributes(owner)):
                if name in before:
                    setattr(owner, name, deepcopy(before[name]))
                elif name not in self._known[place]:
                    delattr(owner, name)
                changed.append(name)
        return changed
