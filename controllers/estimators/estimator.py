"""The contract of a Jacobian estimator: the motions that it learns from, and the estimate that it returns.

Estimators are pure: the state goes in and comes out, a tree of arrays with leading axes (`plant.contract.lanes`), and
no array of it is ever changed. One run has no leading axis; a thousand runs have one.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, norm

State = TypeVar("State")
# [s] Shortest motion at any control period, so that as much is learned per second.
MOTION_TIME = 0.05


@dataclass(frozen=True, eq=False, slots=True)
class Motion:
    """One observed motion, from the last valid feature to the newest one."""

    joint_position: FloatArray  # (..., n), rad, where the motion began.
    joint_step: FloatArray  # Δq, (..., n), rad.
    feature_step: FloatArray  # Δy, (..., m), m.
    error: FloatArray  # e = y_ref − y at the end of the motion, (..., m), m.
    duration: FloatArray  # (...), s.
    # (...), standard deviation of the feature per axis, m; None where it is not identified.
    noise: FloatArray | None = None


class Estimator(ABC, Generic[State]):
    """Estimates J = ∂y/∂q from motions; any estimator works with any law."""

    # Whether it knows a Jacobian for every joint position by itself, so that no other model is added.
    brings_model: ClassVar[bool] = False

    @abstractmethod
    def start(self, jacobian: FloatArray) -> State:
        """Return the state before any motion, starting from Ĵ₀, (..., m, n), m/rad."""

    @abstractmethod
    def update(self, state: State, motion: Motion) -> State:
        """Return the state after one more observed motion.

        Raises:
            RunFault: it cannot go on in at least one lane.
        """

    def jacobian(self, state: State, joint_position: FloatArray) -> FloatArray:
        """Return Ĵ at `joint_position` (..., n), rad, as (..., m, n) in m/rad.

        An estimator of one matrix, which its state has as `J`, returns it wherever the arm is; any other overrides
        this.
        """
        one_matrix: Any = state
        return one_matrix.J

    def deviation(
        self, state: State, first: State | None, joint_position: FloatArray
    ) -> FloatArray:
        """Return Ĵ − Ĵ_first at `joint_position` (..., n), rad; Ĵ where there is no first state."""
        jacobian = self.jacobian(state, joint_position)
        if first is None:
            return jacobian
        return jacobian - self.jacobian(first, joint_position)

    def diagnostics(self, state: State) -> Diagnostics:
        """Return named numbers (...) about the last update, if there are any; for the log only."""
        return {}


class GatedEstimator(Estimator[State]):
    """An estimator whose settings have a minimum ‖Δq‖, below which motions are left out; its state says `updated`."""

    def __init__(self, config: Any, knowledge: RobotKnowledge | None = None) -> None:  # noqa: ANN401 - its settings
        """Take the settings; nothing about the robot is needed."""
        self._config = config

    def update(self, state: State, motion: Motion) -> State:
        """Correct by one motion if it is large enough; see `Estimator.update`."""
        known: Any = state
        large = norm(motion.joint_step) >= self._config.min_joint_step
        return branch(large, self._correct, known._replace(updated=large), motion)

    @abstractmethod
    def _correct(self, state: State, motion: Motion) -> State:
        """Return the state after a motion that is large enough."""
