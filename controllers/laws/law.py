"""The contract of a control law: estimate, observation and reference in, joint velocity out.

Laws are pure, as estimators are: the state goes in and comes out, a tree of arrays with leading axes
(`servobench.plant.lanes`), and no array of it is ever changed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Generic, Literal, TypeAlias, TypeVar

from servobench.controllers.controller import Diagnostics
from servobench.controllers.estimate import Estimate
from servobench.plant.checks import FloatArray
from servobench.plant.signals import Observation

Stage: TypeAlias = Literal["predict", "posture", "limit"]
State = TypeVar("State")


class Law(ABC, Generic[State]):
    """Turns the error into a joint velocity with the help of an estimate; any law works with any estimator.

    Attributes:
        owns: the stages of the chain that the law brings itself, so that a controller may not add another one.
    """

    owns: ClassVar[frozenset[Stage]] = frozenset({"limit"})

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
            estimate: the Jacobian, and delay and noise where they are identified.
            observation: what is seen now.
            reference: (..., 1 + preview, m): row 0 is now, the rest are the next control instants.

        Returns:
            The state, and the wanted joint velocity (..., n), rad/s. It is within the joint-speed limits where the law
            owns the stage "limit"; the stages that follow may change it, see `noted`.

        Raises:
            RunFault: it cannot go on in at least one lane.
        """

    def noted(self, state: State, joint_velocity: FloatArray) -> State:
        """Return the state after a velocity left the chain; a law that remembers its commands overrides this.

        Args:
            state: after the command of this period.
            joint_velocity: what is sent to the robot, after all stages, (..., n), rad/s.
        """
        del joint_velocity
        return state

    @abstractmethod
    def diagnostics(self, state: State) -> Diagnostics:
        """Return named numbers (...) about the last command; for the log only."""
