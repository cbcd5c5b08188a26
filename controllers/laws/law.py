"""The contract of a control law: estimate, observation and reference in, joint velocity out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Literal, TypeAlias

from servobench.controllers.controller import Diagnostics
from servobench.controllers.estimate import Estimate
from servobench.plant.checks import FloatArray
from servobench.plant.signals import Observation

Stage: TypeAlias = Literal["predict", "posture", "limit"]


class Law(ABC):
    """Turns the error into a joint velocity with the help of an estimate; any law works with any estimator.

    Attributes:
        owns: the stages of the chain that the law brings itself, so that a controller may not add another one.
    """

    owns: ClassVar[frozenset[Stage]] = frozenset({"limit"})

    @abstractmethod
    def reset(self, observation: Observation) -> None:
        """Forget everything and prepare for a run that starts with `observation`."""

    @abstractmethod
    def command(self, estimate: Estimate, observation: Observation, reference: FloatArray) -> FloatArray:
        """Return the joint velocity for the period that begins now.

        Args:
            estimate: the Jacobian, and delay and noise where they are identified.
            observation: what is seen now.
            reference: (1 + preview, m): row 0 is now, the rest are the next control instants.

        Returns:
            (n,), rad/s, within the joint-speed limits.
        """

    @abstractmethod
    def diagnostics(self) -> Diagnostics:
        """Return named numbers about the last command; for the log only."""
