"""The contract of a Jacobian estimator: what it learns from, and the estimate that it returns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from servobench.controllers.controller import Diagnostics
from servobench.controllers.estimate import Estimate
from servobench.plant.checks import FloatArray


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

    _J: FloatArray  # of an estimator of one matrix, (m, n), m/rad

    def jacobian(self, joint_position: FloatArray) -> FloatArray:
        """Return Ĵ at `joint_position` (n,), rad, as an (m, n) array in m/rad that the caller may keep.

        An estimator of one matrix, kept as `_J`, returns it wherever the arm is; any other overrides this.
        """
        return self._J.copy()

    def estimate(self, joint_position: FloatArray) -> Estimate:
        """Return what the law needs to know; an estimator of delay or noise overrides this."""
        return Estimate(self.jacobian(joint_position))

    def diagnostics(self) -> Diagnostics:
        """Return named numbers about the last update, if there are any; for the log only."""
        return {}
