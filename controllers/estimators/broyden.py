"""Broyden's rank-one update: the smallest change of Ĵ that explains the last motion.

    Ĵ ← Ĵ + η (Δy − ĴΔq) Δqᵀ / ‖Δq‖²,      0 < η ≤ 1

Source: C. G. Broyden, "A class of methods for solving nonlinear simultaneous equations", 1965; for visual servoing
M. Jägersand, O. Fuentes, R. Nelson, 1997. η = 1 satisfies ĴΔq = Δy exactly, and so takes all of the noise in.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple, final

import numpy as np
from annotated_types import Le

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, norm, outer
from servobench.plant.contract.settings import Positive, settings
from servobench.plant.contract.signals import BoolArray


@settings
class BroydenConfig:
    """Settings of Broyden's update."""

    step_factor: Annotated[Positive, Le(1.0)] = 0.2
    """[1] η; the rule has no model of noise, so a part of each motion's misfit is left for the next ones."""
    min_joint_step: Positive = 0.01
    """[rad] smaller motions are left out; 1.4 mm of noise in Δy is then at most 0.14 m/rad."""


def projection_update(
    J: FloatArray, joint_step: FloatArray, feature_step: FloatArray, *, step_factor: float, regularisation: float
) -> FloatArray:
    """Return J + η (Δy − JΔq) Δqᵀ / (μ + ‖Δq‖²); Broyden's update for μ = 0, the compact-form one for μ > 0.

    Args:
        J: (..., m, n), m/rad.
        joint_step: Δq, (..., n), rad.
        feature_step: Δy, (..., m), m.
        step_factor: η.
        regularisation: μ, rad².
    """
    square = np.vecdot(joint_step, joint_step)
    gain = step_factor * joint_step / (regularisation + square)[..., None]
    return np.asarray(J + outer(feature_step - np.matvec(J, joint_step), gain))


class BroydenState(NamedTuple):
    """Ĵ, (..., m, n), m/rad, and whether the last motion was used, (...)."""

    J: FloatArray
    updated: BoolArray


@final
class BroydenEstimator(Estimator[BroydenState]):
    """Ĵ ← Ĵ + η (Δy − ĴΔq) Δqᵀ / ‖Δq‖² for every motion above a minimum ‖Δq‖."""

    def __init__(self, config: BroydenConfig, knowledge: RobotKnowledge | None = None) -> None:
        """Take the settings; nothing about the robot is needed."""
        self._config = config

    def start(self, jacobian: FloatArray) -> BroydenState:
        """Start from Ĵ₀, (..., m, n), m/rad."""
        return BroydenState(jacobian, np.full(jacobian.shape[:-2], False))

    def update(self, state: BroydenState, motion: Motion) -> BroydenState:
        """Correct by one motion."""
        large = norm(motion.joint_step) >= self._config.min_joint_step
        return branch(large, self._correct, state._replace(updated=large), motion)

    def _correct(self, state: BroydenState, motion: Motion) -> BroydenState:
        dq, dy = motion.joint_step, motion.feature_step
        return state._replace(
            J=projection_update(state.J, dq, dy, step_factor=self._config.step_factor, regularisation=0.0)
        )

    def diagnostics(self, state: BroydenState) -> Diagnostics:
        """Return whether the last motion was used."""
        return {"estimator_updated": state.updated}
