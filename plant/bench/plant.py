"""The contract of a plant: a spec, reset, step, save and restore, close, and the truth for the log.

A plant never sees a target. A plant that is added is a `World` on the `Bench` of `plant.bench.bench`, or a class
of its own below `Plant`; a settings class; and a `PlantEntry` that is named in `harness.config.registry` or
published under the entry-point group `servobench.plants`.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray, IntArray, Shape, as_array
from servobench.plant.contract.faults import RunFault
from servobench.plant.contract.signals import (
    BoolArray,
    Command,
    JacobianFunction,
    Observation,
    PlantSpec,
    SymbolicFeature,
    Truth,
)
from servobench.plant.robot.arm import JointLimits
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.mechanics import MechanicsConfig
from servobench.plant.robot.robot import Robot

ImageArray: TypeAlias = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class TrueModel:
    """The kinematics of the true robot and the delays of commands and features; for upper bounds only."""

    jacobian: JacobianFunction
    symbolic: SymbolicFeature
    latency: float = 0.0  # between exposure and delivery of a frame, s
    command_delay: float = 0.0  # between a command and its first effect, s
    lag: float | None = (
        None  # time constant of the joints' velocity loops, s; None where it is unknown
    )
    latency_spread: float = 0.0  # by which a frame may be later than the latency, s
    camera_turn: float = 0.0  # with which the first camera turns about its optical axis, rad/s
    # natural frequency [rad/s] and damping ratio of a flexible tool; frequency 0 for a rigid one
    tool: tuple[float, float] = (0.0, 0.0)


class Abilities(ABC):
    """Abilities that plants and worlds share; the optional ones have a default."""

    spec: PlantSpec
    """Sizes, names, limits and period; set on construction."""
    own_robot: ClassVar[bool] = False
    """Whether it brings a robot and a start of its own, of a class that is given without a `PlantEntry`."""
    stamps: bool = False
    """Whether observations have a time of capture."""
    faults: Mapping[int, RunFault] = MappingProxyType({})
    """Of runs side by side: the lanes that failed, which `keep` has to drop. A single run raises instead."""

    @abstractmethod
    def truth(self) -> Truth:
        """Return the present true feature and Jacobian; for evaluation only."""

    def save(self) -> Any:  # noqa: ANN401 - each plant has a state of its own
        """Return the present state as a value; after `restore` the run continues from it with the same bits.

        By default it is a deep copy of the attributes; a plant that holds handles overrides both methods.

        Raises:
            ValueError: the plant cannot save its state.
        """
        return copy.deepcopy(vars(self))

    def restore(self, state: Any) -> None:  # noqa: ANN401 - as returned by `save`
        """Return to a saved state of a plant with the same robot and settings; a state can be used repeatedly."""
        vars(self).update(copy.deepcopy(state))

    def true_model(self) -> TrueModel:
        """Return the kinematics of a robot that the plant brings itself; for upper bounds only.

        The model lives as long as the plant.

        Raises:
            ValueError: the plant does not know them; says why.
        """
        raise ValueError(
            "this plant does not know the kinematics of its robot, which an upper bound needs"
        )

    def with_delays(self, model: TrueModel) -> TrueModel:
        """Return the kinematics of the plant's robot with the plant's own delays, as far as it knows them."""
        return model

    def nominal_jacobian(self) -> JacobianFunction | None:
        """Return the public nominal Jacobian of a robot that the plant brings, (..., n) -> (..., m, n); or None."""
        return None

    def picture(self) -> ImageArray | None:
        """Return the present image of the camera, (h, w, 3) RGB with the detection drawn in; None without a camera.

        Taking it disturbs neither the run nor its random streams.
        """
        return None

    def move_camera(self, X_BC: FloatArray) -> None:
        """Move the camera from the next measurement on, until `reset`: a camera displaced during the run.

        Args:
            X_BC: (4, 4), the camera's new pose in the base frame; (..., 4, 4) for runs side by side.

        Raises:
            ValueError: a plant without a camera that could be moved.
        """
        raise ValueError(
            "the plant has no camera that could be moved; leave camera_move and camera_turn out, or define "
            "move_camera(self, X_BC) in its class"
        )

    def keep(self, lanes: IntArray) -> None:
        """Keep only some of the runs side by side and drop the others permanently.

        Args:
            lanes: (k,), indices of the lanes that stay, in their new order.

        Raises:
            ValueError: a plant that carries out one run only.
        """
        raise ValueError("the plant carries out one run only, so none can be dropped")

    @abstractmethod
    def close(self) -> None:
        """Free all resources of the plant; calling it twice is allowed."""


class Plant(Abilities):
    """A discrete-time plant: `step` holds the command for one period and returns the observation after it."""

    @abstractmethod
    def reset(self, seed: int) -> Observation:
        """Return to the start at time 0 and draw all randomness from `seed`.

        Args:
            seed: non-negative; the same seed gives the same run, bit for bit.

        Returns:
            The observation at time 0.

        Raises:
            FeatureLost: the feature cannot be seen from the start.
        """

    @abstractmethod
    def step(self, command: Command) -> Observation:
        """Apply `command` for one period.

        Args:
            command: joint velocities, shape (n,), rad/s; beyond the limit they are clipped.

        Returns:
            The observation at the end of the period.

        Raises:
            ValueError: a command of the wrong size.
            PlantDiverged: the state is no longer finite.
        """


@dataclass(frozen=True)
class PlantSetup:
    """The arguments with which the harness builds a plant.

    Attributes:
        model: the true arm and cameras, mismatch included; None for a plant that brings a robot of its own. For runs
            side by side its arrays have a leading axis.
        start: (..., n), rad, reported joint positions at time 0; None for a plant that brings its own start.
        period: control period, s.
        nominal: the robot by its maker's description: limits, links and bench; None for a plant that brings its own,
            or where only the model is known.
    """

    model: RobotModel | None
    start: FloatArray | None
    period: float
    nominal: Robot | None = None

    @property
    def limits(self) -> JointLimits | None:
        """The maker's joint limits, where they are known."""
        if self.nominal is None:
            return None
        return self.nominal.limits

    def robot(self) -> tuple[RobotModel, FloatArray]:
        """Return model and start, (..., n), for a plant that needs them.

        Raises:
            ValueError: there are none, or a start of the wrong shape.
        """
        if self.model is None or self.start is None:
            raise ValueError(
                "the setup has no robot: a plant with own_robot = True brings its arm, start and limits"
            )
        return self.model, as_array("start", self.start, (*self.model.lead, self.model.arm.n))


@dataclass(frozen=True)
class PlantEntry:
    """A plant as the registry knows it.

    Attributes:
        name: the word on the command line.
        summary: one line for `servobench plants`.
        config: settings class with a default for every field; its noise and latency can be varied if it has a field
            `sensing` of class `servobench.plant.contract.sensing.SensingConfig`.
        build: makes the plant from its settings and the setup.
        own_robot: it brings a robot and a start of its own: taught tasks, `--robot` and mismatches do not apply, and
            no nominal model is known.
        config_for: returns the default settings for a robot, where they depend on it; None: those of `config`.
        side_by_side: `build` also takes a setup of many runs, whose arrays have a leading axis, and returns a `Bench`.
        needs: top-level modules that only an extra brings.
        lacking: returns one line about missing parts of this machine other than packages; empty if nothing is missing.
        engine: returns one line about the software that computes or renders it, for the terminal and the manifest.
        any_sensing: it takes every sensing set-up; else only the ball that a fixed camera sees in 3-D.
        no_model: it brings a robot of its own of which controllers get no nominal model: they probe the first Jacobian
            and have no posture aid, unless told otherwise.
    """

    name: str
    summary: str
    config: type[Any]
    build: Callable[[Any, PlantSetup], Plant]
    own_robot: bool = False
    side_by_side: bool = False
    needs: tuple[str, ...] = ()
    lacking: Callable[[], str] | None = None
    engine: Callable[[], str] | None = None
    config_for: Callable[[Robot], Any] | None = None
    any_sensing: bool = False
    no_model: bool = False

    def settings_for(self, robot: Robot) -> Any:  # noqa: ANN401 - of any plant
        """Return the default settings for a robot."""
        if self.config_for is None:
            return self.config()
        return self.config_for(robot)


class World(Abilities):
    """A robot and its camera, which only advance and measure; `Bench` makes a plant of it.

    Arrays that a world returns are never changed again, finite and float64; the bench makes them read-only. Those of a
    world that carries out runs side by side have the leading axis `lead`.
    """

    lead: Shape = ()
    """Number of runs side by side, as the shape of the leading axis; () for a single run."""

    lag: float | None = None
    """[s] time constant of the joints' velocity loops; None where it is unknown."""

    def fail(self, lane: int, fault: RunFault) -> None:
        """Record the fault of a lane, of which the first one counts, or raise that of a single run."""
        if not self.lead:
            raise fault
        self.faults = {lane: fault, **self.faults}

    mechanics: MechanicsConfig = MechanicsConfig()
    """Gears and tool."""

    noise_unit: float = 1.0
    """A metre of noise in the unit of the features."""

    @abstractmethod
    def reset(self, seed: Any) -> FloatArray:  # noqa: ANN401 - narrowed by worlds that carry out one run only
        """Go back to the start, at rest, and draw all randomness from `seed`.

        Args:
            seed: one, or a sequence of one for each of the runs side by side.

        Returns:
            The joint positions, (..., n) rad.
        """

    @abstractmethod
    def advance(self, joint_velocity: FloatArray) -> FloatArray:
        """Hold a command for one period of the world, `spec.period`.

        Args:
            joint_velocity: (..., n), rad/s, within the limits.

        Returns:
            The joint positions after it, (..., n) rad, as reported; of a lane that failed, those before.

        Raises:
            PlantDiverged: they are not finite.
        """

    @abstractmethod
    def see(self) -> FloatArray | None:
        """Return the feature as measured now, (..., m); None if that of a single run is not found."""

    def visible(self) -> BoolArray | None:
        """Return which features of the last measurement are valid, (..., m); None for all of them."""
        return None

    def captured(self) -> FloatArray | None:
        """Return when the last measurement was exposed, by the camera's own clock, (...) [s]; None where unknown."""
        return None

    def rehearse(self) -> None:
        """Remark on unlikely things at the start of a run; the world has just been built and is closed afterwards.

        Raises:
            RunFault: a step failed.
        """

    def why_unseen(self) -> str:
        """Return why `see` found nothing, with evidence, for an error message."""
        return "the feature is not visible at the start"
