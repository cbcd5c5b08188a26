"""The contract of a controller: reset, step, diagnostics, save, restore; and its knowledge of the robot.

A controller never sees a plant, a simulator, a file or the truth. One of your own is a subclass of `Controller` in a
file, constructed as `Mine(knowledge)` or as `Mine(config, knowledge)` with an annotated frozen dataclass of settings.
One that is published has a `ControllerEntry` under the entry-point group `servobench.controllers`. Most controllers are
a Jacobian estimator and a control law composed by `servobench.controllers.servo.ServoController`; one that is not
derives from `Controller`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray, is_finite
from servobench.plant.contract.features import FeatureModel
from servobench.plant.contract.settings import Section
from servobench.plant.contract.signals import (
    Command,
    JacobianFunction,
    Observation,
    PlantSpec,
    SymbolicFeature,
)

Diagnostics: TypeAlias = Mapping[str, npt.ArrayLike]


@dataclass(frozen=True)
class Delays:
    """Delays of commands and features."""

    latency: float  # s, from an exposure of the camera to its feature
    command_delay: float  # s, from a command to its first effect
    lag: float  # s, time constant of the joints' velocity loops
    latency_spread: float = 0.0  # s, by which a frame may be later than the latency


@dataclass(frozen=True)
class RobotKnowledge:
    """The knowledge of the robot that a controller gets through its constructor.

    Attributes:
        spec: sizes, limits and control period of the plant.
        preview: number of future rows that `reference` has after row 0.
        nominal_jacobian: (n,) rad -> (m, n), the Jacobian of the nominal model; vectorised over leading axes. None
            where no model exists.
        nominal_model: the features of the nominal robot by its parameters; None where no model exists.
        true_jacobian: the same of the true robot; given only to a controller whose entry needs the truth.
        true_symbolic: a CasADi expression (MX) q, (n, 1) rad -> the expression of the true robot's feature, (m, 1);
            under the same condition.
        true_delays: of the true robot and its camera; under the same condition.
        true_camera_turn: rad/s, with which the first camera turns about its optical axis; under the same condition.
        true_tool: natural frequency [rad/s] and damping ratio of a flexible tool, 0 for a rigid one; likewise.
        region: lower and upper joint positions, (n,) rad each, of the box in which the robot will work; networks are
            trained there.
        train: runs an offline training for its settings, or returns an earlier result for the same ones; the part that
            needs the training defines both types. None: it is run when the controller is built.
        unit: one unit of the features here in units of the plant's; see `servobench.controllers.units`.
    """

    spec: PlantSpec
    preview: int
    nominal_jacobian: JacobianFunction | None = None
    nominal_model: FeatureModel | None = None
    true_jacobian: JacobianFunction | None = None
    true_symbolic: SymbolicFeature | None = None
    true_delays: Delays | None = None
    true_camera_turn: float = 0.0
    true_tool: tuple[float, float] = (0.0, 0.0)
    region: tuple[FloatArray, FloatArray] | None = None
    train: Callable[[Any], Any] | None = None
    unit: float = 1.0

    def check(self, observation: Observation, reference: FloatArray | None = None) -> None:
        """Check the sizes of an observation and a reference.

        Raises:
            ValueError: an observation or a reference of the wrong size, or a reference that is not finite.
        """
        for name, size in (("joint_position", self.spec.n), ("feature", self.spec.m)):
            shape = getattr(observation, name).shape
            if shape != (size,):
                raise ValueError(f"observation.{name} must have shape {(size,)}, got {shape}")
        if reference is None:
            return
        wanted = (1 + self.preview, self.spec.m)
        shape = np.shape(reference)
        if shape != wanted:
            raise ValueError(
                f"reference must have shape {wanted} for a preview of {self.preview}, got {shape}"
            )
        if not is_finite(reference):
            raise ValueError(f"reference must be finite, got {np.asarray(reference).tolist()}")


class Controller(ABC):
    """A discrete-time controller: one observation and the reference in, one command out.

    Attributes:
        aids: `servobench.EQUIPPED` in a class of your own gives it the aids of the methods of the bench; None for none.
        in_model_frame: whether it was trained on the nominal model, so that with aids it works in that model's frame.
    """

    aids: ClassVar[Section | None] = None
    in_model_frame: ClassVar[bool] = False

    @abstractmethod
    def reset(self, observation: Observation, seed: int) -> None:
        """Forget everything and prepare for a run that starts with `observation`.

        Args:
            observation: that of the first `step`.
            seed: for controllers that draw random numbers.
        """

    @abstractmethod
    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the command for the period that begins now.

        Args:
            observation: of this instant.
            reference: (1 + preview, m): row 0 is now, the rest are the next control instants.

        Returns:
            The joint-velocity command, within the joint-speed limits.
        """

    def diagnostics(self) -> Diagnostics:
        """Return named numbers about the last step, for the log only; by default none."""
        return {}

    def save(self) -> object:
        """Return the state, for `restore`."""
        return self._copy(self.__dict__)

    def restore(self, state: object) -> None:
        """Go back to a state that `save` of this controller returned; the state may be restored again.

        Raises:
            TypeError: not such a state.
        """
        if not isinstance(state, dict):
            raise TypeError(f"state must come from save, got {type(state).__name__}")
        self.__dict__ = self._copy(state)

    def _shared(self) -> Iterable[object]:
        """Return the objects that `save` and `restore` keep uncopied: models and handles, which never change."""
        return ()

    def _copy(self, state: dict[str, Any]) -> dict[str, Any]:
        return deepcopy(state, {id(thing): thing for thing in self._shared()})

    def estimated_jacobian(self) -> FloatArray | None:
        """Return the Jacobian (m, n) that the last step used, or None where the method has none; for the log only."""
        return None


@dataclass(frozen=True)
class ControllerEntry:
    """A controller as the registry lists it.

    Attributes:
        name: the word on the command line.
        summary: one line for `servobench controllers`.
        config: returns the default settings, a frozen dataclass; a dataclass with a default for every field does.
        build: makes the controller from its settings and its knowledge of the robot.
        needs_truth: whether it is given the true Jacobian and kinematics: a bound, not a competitor.
        side_by_side: whether `build` returns a `ServoController`, whose parts take many runs at once.
        tuned: tuned values, nested, that replace defaults; of a controller of a user, from the file beside its code.
    """

    name: str
    summary: str
    config: Callable[[], Any]
    build: Callable[[Any, RobotKnowledge], Controller]
    needs_truth: bool = False
    side_by_side: bool = False
    tuned: Section = field(default_factory=dict, compare=False)
