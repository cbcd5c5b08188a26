"""The contract of a control law: estimate, observation and reference in, joint velocity out.

Laws are pure, as estimators are: the state goes in and comes out, a tree of arrays with leading axes
(`servobench.plant.contract.lanes`), and no array of it is ever changed.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, Literal, TypeAlias, TypeVar

from servobench.controllers.controller import Diagnostics
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import BoolArray, Observation

Stage: TypeAlias = Literal["predict", "preview", "limit"]
State = TypeVar("State")


@dataclass(frozen=True, eq=False, slots=True)
class Estimate:
    """The message from the estimator to the law in each period."""

    jacobian: FloatArray  # Ĵ, (..., m, n), m/rad, at the present joint position.


class Law(ABC, Generic[State]):
    """Turns the error into a joint velocity with the help of an estimate; any law works with any estimator."""

    # The stages of the chain that the law brings itself, so that a controller may not add another one; "preview": it
    # looks at more of the reference than the present row.
    owns: frozenset[Stage] = frozenset()
    # Whether it was trained on the nominal model, so that it works in that model's frame.
    in_model_frame: bool = False

    @abstractmethod
    def start(self, observation: Observation) -> State:
        """Return the state at the start of a run that begins with `observation`."""

    @abstractmethod
    def command(
        self, state: State, estimate: Estimate, observation: Observation, reference: FloatArray
    ) -> tuple[State, FloatArray]:
        """Return the new state and the joint velocity for the period that begins now.

        Args:
            state: after the last command.
            estimate: the Jacobian.
            observation: of this instant, or predicted.
            reference: (..., 1 + preview, m): row 0 is now, the rest are the next control instants.

        Returns:
            The state, and the wanted joint velocity (..., n), rad/s. It is within the joint-speed limits where the law
            owns the stage "limit"; the stages that follow may change it, see `noted`.

        Raises:
            RunFault: it cannot go on in at least one lane.
        """

    def restrained(
        self, state: State, wanted: FloatArray, joint_velocity: FloatArray
    ) -> FloatArray:
        """Return the velocity to send, (..., n), rad/s; a law that limits the change of its commands overrides this.

        Args:
            state: after the command of this period.
            wanted: that command, (..., n), rad/s.
            joint_velocity: the output of the stages that follow, (..., n), rad/s.
        """
        del state, wanted
        return joint_velocity

    def noted(self, state: State, joint_velocity: FloatArray, limited: BoolArray) -> State:
        """Return the state after a velocity left the chain; a law that remembers its commands overrides this.

        Args:
            state: after the command of this period.
            joint_velocity: command sent to the robot, after all stages, (..., n), rad/s.
            limited: (...), whether it had to be limited.
        """
        del joint_velocity, limited
        return state

    def diagnostics(self, state: State) -> Diagnostics:
        """Return named numbers (...) about the last command, if there are any; for the log only."""
        return {}
