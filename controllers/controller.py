"""The contract of a controller: reset, step, diagnostics; and what it may know about the robot.

A controller never sees a plant, a simulator, a file or the truth. Adding one: a frozen configuration dataclass, a
builder, and a `ControllerEntry` that is named in `harness.config.registry` or published under the entry-point group
`servobench.controllers`. Most controllers are a Jacobian estimator and a control law composed by
`servobench.controllers.servo.ServoController`; one that is not derives from `Controller`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from servobench.plant.checks import FloatArray
from servobench.plant.signals import Command, Observation, PlantSpec

if TYPE_CHECKING:
    from servobench.controllers.networks.config import TrainingConfig
    from servobench.controllers.networks.file import TrainedNetworks

JacobianFunction: TypeAlias = Callable[[FloatArray], FloatArray]
SymbolicFeature: TypeAlias = Callable[[Any], Any]
Diagnostics: TypeAlias = Mapping[str, float]


@dataclass(frozen=True)
class RobotKnowledge:
    """What a controller is told about the robot, through its constructor.

    Attributes:
        spec: sizes, limits and control period of the plant.
        preview: how many future rows `reference` has besides row 0.
        nominal_jacobian: (n,) rad -> (m, n), the Jacobian of the nominal model; vectorised over leading axes. None
            where no model exists.
        true_jacobian: the same of the true robot; only handed to a controller whose entry asks for the truth.
        true_symbolic: a CasADi expression (MX) q, (n, 1) rad -> the expression of the true robot's feature, (m, 1);
            under the same condition.
        region: lower and upper joint positions, (n,) rad each, of the box in which the robot will work; networks are
            trained there.
        train: returns trained networks, from a cache where it has them; None: networks are trained on the spot.
    """

    spec: PlantSpec
    preview: int
    nominal_jacobian: JacobianFunction | None = None
    true_jacobian: JacobianFunction | None = None
    true_symbolic: SymbolicFeature | None = None
    region: tuple[FloatArray, FloatArray] | None = None
    train: Callable[[TrainingConfig], TrainedNetworks] | None = None


class Controller(ABC):
    """A discrete-time controller: one observation and the reference in, one command out."""

    @abstractmethod
    def reset(self, observation: Observation, seed: int) -> None:
        """Forget everything and prepare for a run that starts with `observation`.

        Args:
            observation: what the first `step` will see.
            seed: for controllers that draw random numbers.
        """

    @abstractmethod
    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the command for the period that begins now.

        Args:
            observation: what is seen now.
            reference: (1 + preview, m): row 0 is now, the rest are the next control instants.

        Returns:
            The joint-velocity command, within the joint-speed limits.
        """

    @abstractmethod
    def diagnostics(self) -> Diagnostics:
        """Return named numbers about the last step; for the log only."""

    def estimated_jacobian(self) -> FloatArray | None:
        """Return the Jacobian (m, n) that the last step used, or None where the method has none; for the log only."""
        return None


@dataclass(frozen=True)
class ControllerEntry:
    """A controller as the registry knows it.

    Attributes:
        name: the word on the command line.
        summary: one line for `servobench controllers`.
        config: frozen dataclass with a default for every field.
        build: makes the controller from its configuration and what it may know.
        needs_truth: it is told the true Jacobian and kinematics: a bound, not a competitor.
    """

    name: str
    summary: str
    config: type[Any]
    build: Callable[[Any, RobotKnowledge], Controller]
    needs_truth: bool = False
