"""The contract of a Jacobian estimator: what it is told after each period, and the Jacobian it answers with."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from servobench.controllers.controller import Diagnostics
from servobench.plant.checks import FloatArray

LONGEST_DELAY = 14  # periods: no estimator tells of a longer one, so that laws know how much past to keep


@dataclass(frozen=True, slots=True)
class Motion:
    """One observed motion, from the last valid feature to the newest one.

    Attributes:
        joint_position: (n,), rad, where the motion began.
        joint_step: Δq, (n,), rad.
        feature_step: Δy, (m,), m.
        error: e = y_ref − y at the end of the motion, (m,), m.
        duration: s.
    """

    joint_position: FloatArray
    joint_step: FloatArray
    feature_step: FloatArray
    error: FloatArray
    duration: float


class Estimator(ABC):
    """Estimates J = ∂y/∂q from motions; any estimator works with any law."""

    @abstractmethod
    def reset(self, jacobian: FloatArray) -> None:
        """Forget everything and start from the initial Jacobian Ĵ₀, (m, n), m/rad."""

    @abstractmethod
    def update(self, motion: Motion) -> None:
        """Learn from one observed motion."""

    @abstractmethod
    def jacobian(self, joint_position: FloatArray) -> FloatArray:
        """Return Ĵ at `joint_position` (n,), rad, as an (m, n) array in m/rad that the caller may keep."""

    def delay(self) -> int:
        """Return by how many periods features are late, at most `LONGEST_DELAY`; 0 where that is not estimated."""
        return 0

    @abstractmethod
    def diagnostics(self) -> Diagnostics:
        """Return named numbers about the last update; for the log only."""
