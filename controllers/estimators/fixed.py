"""The estimators that learn nothing, the bounds of every comparison: the first Jacobian, and the true one."""

from __future__ import annotations

from typing import final

import numpy as np

from servobench.controllers.controller import RobotKnowledge
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


@settings
class TrueConfig:
    """The true Jacobian has no settings."""


@final
class TrueEstimator(Estimator):
    """Ĵ(k) = J(q(k)), the Jacobian of the true robot."""

    def __init__(self, config: TrueConfig, knowledge: RobotKnowledge) -> None:
        """Take the true Jacobian.

        Raises:
            ValueError: it is not known.
        """
        if knowledge.true_jacobian is None:
            raise ValueError("true_jacobian must be known for the estimator 'true'; this plant does not provide it")
        self._true_jacobian = knowledge.true_jacobian

    def reset(self, jacobian: FloatArray) -> None:
        """Ignore Ĵ₀: the truth is known."""

    def update(self, motion: Motion) -> None:
        """Learn nothing: there is nothing to learn."""

    def jacobian(self, joint_position: FloatArray) -> FloatArray:
        """Return J(q), (m, n), m/rad."""
        return np.array(self._true_jacobian(joint_position), dtype=np.float64)
