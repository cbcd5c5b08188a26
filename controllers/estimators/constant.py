"""The estimators that learn nothing, the bounds of every comparison: the first Jacobian, and the true one."""

from typing import Any, NamedTuple, final

import numpy as np

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.settings import settings


@settings
class ConstantConfig:
    """The constant estimator has no settings; its Ĵ₀ is set under `initial`."""


class ConstantState(NamedTuple):
    """Ĵ₀, (..., m, n), m/rad."""

    J: FloatArray


@final
class ConstantEstimator(Estimator[ConstantState]):
    """Ĵ(k) = Ĵ₀ at all times."""

    def __init__(
        self, config: ConstantConfig | None = None, knowledge: RobotKnowledge | None = None
    ) -> None:
        """Accept the arguments of every estimator; none of them is needed."""

    def start(self, jacobian: FloatArray) -> ConstantState:
        """Keep Ĵ₀, (..., m, n), m/rad."""
        return ConstantState(jacobian)

    def update(self, state: ConstantState, motion: Motion) -> ConstantState:
        """Learn nothing."""
        return state


@settings
class TrueConfig:
    """The true Jacobian has no settings."""


class TrueState(NamedTuple):
    """The true robot, whose arrays have the leading axes; it is called with joint positions (..., n), rad."""

    true_jacobian: Any


@final
class TrueEstimator(Estimator[TrueState]):
    """Ĵ(k) = J(q(k)), the Jacobian of the true robot."""

    brings_model = True

    def __init__(self, config: TrueConfig, knowledge: RobotKnowledge) -> None:
        """Take the true Jacobian.

        Raises:
            ValueError: it is not known.
        """
        if knowledge.true_jacobian is None:
            raise ValueError(
                "true_jacobian must be known for the estimator 'true'; this plant does not provide it"
            )
        self._true_jacobian = knowledge.true_jacobian

    def start(self, jacobian: FloatArray) -> TrueState:
        """Ignore Ĵ₀: the truth is known."""
        return TrueState(self._true_jacobian)

    def update(self, state: TrueState, motion: Motion) -> TrueState:
        """Learn nothing: there is nothing to learn."""
        return state

    def jacobian(self, state: TrueState, joint_position: FloatArray) -> FloatArray:
        """Return J(q), (..., m, n), m/rad."""
        return np.asarray(state.true_jacobian(joint_position), dtype=np.float64)
