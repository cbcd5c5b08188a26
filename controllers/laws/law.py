"""The contract of a control law: estimate, observation and reference in, joint velocity out."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from servobench.controllers.controller import Diagnostics
from servobench.controllers.estimate import Estimate
from servobench.plant.checks import FloatArray
from servobench.plant.signals import Observation


class Law(ABC):
    """Turns the error into a joint velocity with the help of an estimate; any law works with any estimator."""

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


def largest_excess(joint_velocity: FloatArray, limit: FloatArray) -> float:
    """Return the largest |u_i| / limit_i of a joint velocity (n,); above 1 some joint exceeds its limit."""
    return float(np.maximum.reduce(np.abs(joint_velocity) / limit))


def scale_to_limit(joint_velocity: FloatArray, limit: FloatArray) -> FloatArray:
    """Shrink a joint velocity until every joint keeps its limit; the direction stays, and so does the path.

    Args:
        joint_velocity: (..., n), rad/s.
        limit: (n,), rad/s, positive.

    Returns:
        (..., n), rad/s.
    """
    excess = np.maximum.reduce(np.abs(joint_velocity) / limit, axis=-1, keepdims=True)
    return np.asarray(joint_velocity / np.maximum(excess, 1.0))
