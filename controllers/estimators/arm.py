"""The structure of the arm, estimated online: gear ratios and joint offsets of the nominal model.

    Ĵ(q) = J_n(g ⊙ q + δ) diag(g)

The state x = [g, δ], (2n,), starts at g = 1, δ = 0 with a diagonal covariance. An extended Kalman filter corrects it by
the motion of the feature between two poses that are at least `min_joint_step` apart:

    Δy = B ∫ J_n dq' from q'₀ to q'₁ + v,   q' = g ⊙ q + δ,   v ~ N(0, (2σ² + c² ‖Δy‖²) I)
    H = B [J_n(q'₁) diag(q₁) − J_n(q'₀) diag(q₀),  J_n(q'₁) − J_n(q'₀)]

B is 1, or with a camera model the change of the features with the places of the points, of which J_n is the nominal
motion.

The integral is that of a position, so that it does not depend on the path: Gauss-Legendre quadrature along the straight
line. A map of the feature cannot correct gear ratios and zeros (`controllers.stages.estimation`).
"""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.estimators.kalman import cholesky_of, kalman_update
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, norm
from servobench.plant.contract.settings import NonNegative, Positive, settings
from servobench.plant.contract.signals import BoolArray

NODES, WEIGHTS = np.polynomial.legendre.leggauss(3)
SHARES = np.concatenate([[0.0], (1.0 + NODES) / 2.0, [1.0]])  # of a segment, both ends included
HALVES = WEIGHTS / 2.0
CONTACT_TOLERANCE = 1e-9  # [rad] largest gap between two motions that join


@settings
class ArmConfig:
    """Settings of the structured estimate."""

    gear_deviation: Positive = 0.1
    """[1] of a gear ratio from 1 at first."""
    offset_deviation: Positive = 0.1
    """[rad] of a joint's zero from the nominal one at first."""
    walk: NonNegative = 0.0
    """[1/√s] deviation of an entry, 1 or rad, after a second of motion; 0: the arm does not change."""
    model_error: NonNegative = 0.05
    """[1] c, share of a motion that gear ratios and offsets do not explain."""
    feature_noise: Positive = 0.001
    """[m] standard deviation σ of the feature per axis, unless it is identified."""
    min_joint_step: Positive = 0.1
    """[rad] between the two poses of a segment: over a longer one noise counts for less."""


class ArmState(NamedTuple):
    """The state of the estimate.

    Attributes:
        x: [g, δ], (..., 2n), 1 and rad.
        P: its covariance, (..., 2n, 2n).
        begin: q₀, (..., n), rad, where the present segment began; NaN before the first motion.
        joint_step: of the segment so far, (..., n), rad.
        feature_step: that of the feature, (..., m).
        duration: (...), s.
        updated: (...), whether the last motion ended a segment.
    """

    x: FloatArray
    P: FloatArray
    begin: FloatArray
    joint_step: FloatArray
    feature_step: FloatArray
    duration: FloatArray
    updated: BoolArray


@final
class ArmEstimator(Estimator[ArmState]):
    """Ĵ(q) = J_n(g ⊙ q + δ) diag(g) as above; where motions do not join, as after lost frames, a new segment begins."""

    brings_model = True

    def __init__(self, config: ArmConfig, knowledge: RobotKnowledge) -> None:
        """Take settings and the nominal model.

        Raises:
            ValueError: there is no nominal model.
        """
        if knowledge.nominal_jacobian is None:
            raise ValueError("nominal_jacobian must be known for the estimator 'arm'; this plant has none")
        self._config, self._nominal, self._cameras = config, knowledge.nominal_jacobian, knowledge.nominal_cameras
        self._n = knowledge.spec.n

    def start(self, jacobian: FloatArray) -> ArmState:
        """Start from the nominal arm; of Ĵ₀, (..., m, n), only the shape counts."""
        *lead, m, n = jacobian.shape
        config = self._config
        x = np.broadcast_to(np.concatenate([np.ones(n), np.zeros(n)]), (*lead, 2 * n))
        deviation = np.concatenate([np.full(n, config.gear_deviation), np.full(n, config.offset_deviation)])
        P = np.broadcast_to(np.diag(deviation**2), (*lead, 2 * n, 2 * n))
        none, no = np.zeros((*lead, n)), np.full(lead, False)
        return ArmState(x, P, np.full((*lead, n), np.nan), none, np.zeros((*lead, m)), np.zeros(lead)[()], no)

    def update(self, state: ArmState, motion: Motion) -> ArmState:
        """Add the motion to the present segment, and learn from the segment once it is long enough.

        Raises:
            FilterDiverged: the covariance is no longer positive definite.
        """
        gap = norm(state.begin + state.joint_step - motion.joint_position)
        state = branch(~(gap < CONTACT_TOLERANCE), _begin_segment, state, motion.joint_position)
        state = state._replace(
            joint_step=state.joint_step + motion.joint_step,
            feature_step=state.feature_step + motion.feature_step,
            duration=state.duration + motion.duration,
        )
        long = norm(state.joint_step) >= self._config.min_joint_step
        noise = np.asarray(self._config.feature_noise)[()] if motion.noise is None else motion.noise
        noise = np.broadcast_to(noise, np.shape(state.duration))[()]
        return branch(long, self._correct, state._replace(updated=long), noise, motion.interaction)

    def _correct(self, state: ArmState, noise: FloatArray, interaction: FloatArray | None) -> ArmState:
        config, n, segment = self._config, self._n, state.joint_step
        g, offset = state.x[..., :n], state.x[..., n:]
        poses = state.begin[..., None, :] + SHARES[:, None] * segment[..., None, :]
        at = g[..., None, :] * poses + offset[..., None, :]
        J = (
            self._nominal(at)
            if interaction is None or self._cameras is None
            else interaction[..., None, :, :] @ self._cameras.motions(at)
        )
        moved = np.matvec(J[..., 1:-1, :, :], (g * segment)[..., None, :])
        predicted = np.vecmat(HALVES, moved)
        first, last = J[..., 0, :, :], J[..., -1, :, :]
        by_gear = last * poses[..., -1, None, :] - first * poses[..., 0, None, :]
        H = np.concatenate([by_gear, last - first], axis=-1)
        r = 2.0 * noise * noise + config.model_error**2 * np.vecdot(predicted, predicted)
        R, Q = (
            r[..., None, None] * np.eye(H.shape[-2]),
            config.walk**2 * state.duration[..., None, None] * np.eye(2 * n),
        )
        z = state.feature_step - predicted + np.matvec(H, state.x)
        x, P = kalman_update(state.x, state.P, H, z, Q=Q, R=R)
        cholesky_of(P)
        return _begin_segment(state._replace(x=x, P=P), state.begin + segment)

    def jacobian(self, state: ArmState, joint_position: FloatArray) -> FloatArray:
        """Return Ĵ at `joint_position` (..., n), rad, as (..., m, n) in m/rad."""
        g, offset = state.x[..., : self._n], state.x[..., self._n :]
        return np.asarray(self._nominal(g * joint_position + offset) * g[..., None, :])

    def motions(self, state: ArmState, joint_position: FloatArray) -> FloatArray | None:
        """Return the motions of the points, (..., 3p, n) m/rad; None without a camera model."""
        if self._cameras is None:
            return None
        g, offset = state.x[..., : self._n], state.x[..., self._n :]
        return np.asarray(self._cameras.motions(g * joint_position + offset) * g[..., None, :])

    def diagnostics(self, state: ArmState) -> Diagnostics:
        """Return whether the last motion ended a segment, and the largest gear error (1) and offset (rad)."""
        return {
            "estimator_updated": state.updated,
            "largest_gear_error": np.abs(state.x[..., : self._n] - 1.0).max(axis=-1),
            "largest_offset": np.abs(state.x[..., self._n :]).max(axis=-1),
        }


def _begin_segment(state: ArmState, joint_position: FloatArray) -> ArmState:
    return state._replace(
        begin=joint_position,
        joint_step=np.zeros_like(state.joint_step),
        feature_step=np.zeros_like(state.feature_step),
        duration=np.zeros_like(state.duration),
    )
