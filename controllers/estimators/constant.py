"""The estimator that learns nothing: the lower bound of every comparison."""

from __future__ import annotations

from typing import final

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.plant.checks import FloatArray
from servobench.plant.settings import settings


@settings
class ConstantConfig:
    """The constant estimator has no settings; its Ĵ₀ is set under `initial`."""


@final
class ConstantEstimator(Estimator):
    """Ĵ(k) = Ĵ₀ for ever."""

    def __init__(self, config: ConstantConfig | None = None, knowledge: RobotKnowledge | None = None) -> None:
        """Take nothing: there are no settings, and nothing about the robot is needed."""

    def reset(self, jacobian: FloatArray) -> None:
        """Keep Ĵ₀, (m, n), m/rad."""
        self._J = jacobian.copy()

    def update(self, motion: Motion) -> None:
        """Learn nothing."""

    def jacobian(self, joint_position: FloatArray) -> FloatArray:
        """Return Ĵ₀, wherever the arm is."""
        return self._J.copy()

    def diagnostics(self) -> Diagnostics:
        """Return nothing: nothing changes."""
        return {}
