"""Projection updates of the Jacobian: Broyden's rank-one update and compact-form dynamic linearisation (CFDL).

    broyden   Ĵ ← Ĵ + η (Δy − ĴΔq) Δqᵀ / ‖Δq‖²,          0 < η ≤ 1
    cfdl      Φ ← Φ + η (Δy − ΦΔq) Δqᵀ / (μ + ‖Δq‖²),    0 < η < 2,  μ > 0

Broyden's is the smallest change of Ĵ that explains the last motion; η = 1 satisfies ĴΔq = Δy exactly, and so takes all
of the noise in. η = 1 and μ → 0 make the compact form Broyden's update; μ keeps it steady at rest and under noise.

Sources: C. G. Broyden, "A class of methods for solving nonlinear simultaneous equations", 1965; for visual servoing
M. Jägersand, O. Fuentes, R. Nelson, 1997. Z. Hou, S. Jin, "Model Free Adaptive Control: Theory and Applications", 2013,
pseudo-Jacobian by the projection algorithm with reset.
"""

from typing import Annotated, NamedTuple, final

import numpy as np
from annotated_types import Le, Lt

from servobench.controllers.controller import Diagnostics
from servobench.controllers.estimators.estimator import GatedEstimator, Motion
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.dependence import Only
from servobench.plant.contract.lanes import branch, entries, outer
from servobench.plant.contract.settings import NonNegative, Positive, settings
from servobench.plant.contract.signals import BoolArray


@settings
class BroydenConfig:
    """Settings of Broyden's update."""

    step_factor: Annotated[Positive, Le(1.0)] = 0.2
    """[1] η; below 1, as noise is not modelled."""
    min_joint_step: Positive = 0.01
    """[rad] smaller motions are skipped as noise."""


@settings
class CfdlConfig:
    """Settings of the compact-form estimate."""

    step_factor: Annotated[Positive, Lt(2.0)] = 0.5
    """[1] η; half of the fastest rate."""
    regularisation: Positive = 1e-3
    """[rad²] μ, the square of 0.03 rad; smaller motions change Φ little."""
    min_joint_step: NonNegative = 0.005
    """[rad] smaller motions are skipped as noise."""
    reset: bool = True
    """Return to Φ₀ when Φ loses its sign or vanishes."""
    reset_norm: Annotated[NonNegative, Only(reset=True)] = 1e-2
    """[m/rad] ‖Φ‖ below which Φ counts as vanished."""


def projection_update(
    J: FloatArray,
    joint_step: FloatArray,
    feature_step: FloatArray,
    *,
    step_factor: float,
    regularisation: float,
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
    return J + outer(feature_step - np.matvec(J, joint_step), gain)


class ProjectionState(NamedTuple):
    """Ĵ and Ĵ₀, (..., m, n), m/rad; whether the last motion was used and how often Ĵ was reset, (...)."""

    J: FloatArray
    J0: FloatArray
    updated: BoolArray
    resets: FloatArray


@final
class ProjectionEstimator(GatedEstimator[ProjectionState]):
    """Ĵ ← Ĵ + η (Δy − ĴΔq) Δqᵀ / (μ + ‖Δq‖²) for every motion above a minimum ‖Δq‖; Broyden's update has μ = 0.

    Φ of the compact form goes back to Φ₀ when sign(Φ) ≠ sign(Φ₀) or ‖Φ‖ vanishes.

    Departures: the book's sign is that of a scalar or of each diagonal entry of a square Φ. A turned camera rightly
    changes the sign of single entries, so the sign of the whole is taken: ⟨Φ, Φ₀⟩ = trace(ΦᵀΦ₀) ≤ 0 counts as changed.
    The book's reset at small ‖Δq‖ is the minimum joint step here: such a motion is left out, and Φ stays.
    """

    _config: BroydenConfig | CfdlConfig

    def start(self, jacobian: FloatArray) -> ProjectionState:
        """Start from Ĵ₀, (..., m, n), m/rad."""
        lead = jacobian.shape[:-2]
        return ProjectionState(jacobian, jacobian, np.full(lead, False), np.zeros(lead))

    def _correct(self, state: ProjectionState, motion: Motion) -> ProjectionState:
        config = self._config
        regularisation = config.regularisation if isinstance(config, CfdlConfig) else 0.0
        J = projection_update(
            state.J,
            motion.joint_step,
            motion.feature_step,
            step_factor=config.step_factor,
            regularisation=regularisation,
        )
        state = state._replace(J=J)
        if isinstance(config, BroydenConfig) or not config.reset:
            return state
        flat = entries(J)
        first = entries(state.J0)
        turned = np.vecdot(flat, first) <= 0.0
        vanished = np.vecdot(flat, flat) < config.reset_norm**2
        return branch(turned | vanished, _reset, state)

    def diagnostics(self, state: ProjectionState) -> Diagnostics:
        """Return whether the last motion was used and, of the compact form, how often Φ was reset in this run."""
        resets = {"jacobian_resets": state.resets} if isinstance(self._config, CfdlConfig) else {}
        return {"estimator_updated": state.updated, **resets}


def _reset(state: ProjectionState) -> ProjectionState:
    """Return the state with Φ₀ in place of Φ."""
    return state._replace(J=state.J0, resets=state.resets + 1.0)
