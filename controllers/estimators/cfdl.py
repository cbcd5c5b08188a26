"""Compact-form dynamic linearisation: the pseudo-Jacobian estimate of model-free adaptive control.

    Φ ← Φ + η (Δy − ΦΔq) Δqᵀ / (μ + ‖Δq‖²),      0 < η < 2,  μ > 0

Source: Z. Hou, S. Jin, "Model Free Adaptive Control: Theory and Applications", 2013, projection algorithm with reset.
η = 1 and μ → 0 are Broyden's update; μ is what makes it bear rest and noise.
"""

from __future__ import annotations

from typing import Annotated, final

import numpy as np
from annotated_types import Lt

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.broyden import projection_update
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.plant.checks import FloatArray
from servobench.plant.settings import NonNegative, Positive, settings


@settings
class CfdlConfig:
    """Settings of the compact-form estimate."""

    step_factor: Annotated[Positive, Lt(2.0)] = 0.5
    """[1] η; half of the fastest rate."""
    regularisation: Positive = 1e-3
    """[rad²] μ, the square of 0.03 rad: smaller motions change Φ little."""
    min_joint_step: NonNegative = 0.005
    """[rad] smaller motions are left out: 1 mm of noise hides them."""
    reset: bool = True
    """Return to Φ₀ when Φ loses its sign or vanishes."""
    reset_norm: NonNegative = 1e-2
    """[m/rad] ‖Φ‖ below which Φ counts as vanished."""


@final
class CfdlEstimator(Estimator):
    """Φ ← Φ + η (Δy − ΦΔq) Δqᵀ / (μ + ‖Δq‖²), back to Φ₀ when sign(Φ) ≠ sign(Φ₀) or ‖Φ‖ vanishes.

    Departures: the book's sign is that of a scalar or of each diagonal entry of a square Φ. A turned camera rightly
    changes the sign of single entries, so the sign of the whole is taken: ⟨Φ, Φ₀⟩ = trace(ΦᵀΦ₀) ≤ 0 counts as changed.
    The book's reset at small ‖Δq‖ is the minimum joint step here: such a motion is left out, what was learnt stays.
    """

    def __init__(self, config: CfdlConfig, knowledge: RobotKnowledge | None = None) -> None:
        """Take the settings; nothing about the robot is needed."""
        self._config = config

    def reset(self, jacobian: FloatArray) -> None:
        """Start from Φ₀, (m, n), m/rad."""
        self._J0 = jacobian.copy()
        self._J = jacobian.copy()
        self._updated = False
        self._resets = 0

    def update(self, motion: Motion) -> None:
        """Correct by one motion."""
        config, dq = self._config, motion.joint_step
        self._updated = bool(np.linalg.norm(dq) >= config.min_joint_step)
        if not self._updated:
            return
        self._J = projection_update(
            self._J, dq, motion.feature_step, step_factor=config.step_factor, regularisation=config.regularisation
        )
        lost = np.sum(self._J * self._J0) <= 0.0 or np.linalg.norm(self._J) < config.reset_norm
        if config.reset and lost:
            self._J = self._J0.copy()
            self._resets += 1

    def diagnostics(self) -> Diagnostics:
        """Return whether the last motion was used and how often Φ was reset in this run."""
        return {"estimator_updated": float(self._updated), "jacobian_resets": float(self._resets)}
