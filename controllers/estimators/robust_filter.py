"""Robust estimation of the Jacobian: a Kalman filter of the feature and J together, re-weighted frame by frame.

An outlier in one frame spoils the two motions that begin and end there: with 40 % outlier frames 64 % of all motions
are wrong. So the state of each feature i holds the true feature itself beside its row of J, and frames are judged, not
motions:

    x_i = [y_i, J_i],   y_i ← y_i + J_i Δq + v,  v ~ N(0, (c ‖ĴΔq‖)²),   J_i ← J_i + w,  w ~ N(0, q I)
    measured:  y_i + σ s ε,  of which a share are outliers

Each measurement is weighted by Tukey's bisquare of its own residual, by iteratively re-weighted least squares:

    ν = measured − predicted,   p = P H,  H = [1, 0 … 0]ᵀ,   K = w p / (w p₀ + σ²s²)
    residual = ν (1 − K₀),   w = (1 − (residual / (c_b σ s))²)²  up to c_b σ s, 0 beyond,   c_b = 4.685
    x ← x + K ν,   P ← P − K pᵀ

Only differences of the feature are known, which is enough: with `deviation` = measured − estimated feature of the last
frame, ν = deviation + Δy − ĴΔq. The scale s ≥ 1 follows the median of |ν|: it rises or sinks at a constant rate until
half of the normalised innovations are above the median of a normal distribution, so that no outlier counts by its
size. A lasting change is accepted: a feature that is rejected in more than `LOST_SHARE` of the last second is reset to
its measurement, with J as it is. So an outlier in the first frame, or a camera that is moved, costs a second or two.

M-estimation with re-weighting for the Jacobian: Shademan, Farahmand and Jägersand, "Robust Jacobian Estimation for
Uncalibrated Visual Servoing", ICRA 2010, there from a memory of motions; of a Kalman filter: Gandhi and Mili, "Robust
Kalman Filter Based on a Generalized Maximum-Likelihood-Type Estimator", IEEE Trans. Signal Process. 58 (2010) 2509.
"""

from typing import NamedTuple, final

import numpy as np

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.estimators.kalman import RandomWalk, cholesky_of
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm, outer, where
from servobench.plant.contract.settings import NonNegative, settings

BISQUARE = 4.685  # [1] c_b: 95 % efficiency under normal noise
NORMAL_MEDIAN = 0.6745  # [1] median of |N(0, 1)|
IRLS_STEPS = 5  # number of re-weightings of a measurement
SCALE_RATE = 1.0  # [1/s] at which ln s rises or sinks
MAX_SCALE = 1e3  # [1] largest s
REJECTION_WEIGHT = 0.01  # [1] a smaller weight is a rejection
MEMORY = 1.0  # [s] time constant with which rejections are forgotten
LOST_SHARE = 0.7  # [1] share of rejections above which a feature is reset to its measurement


@settings
class RobustConfig(RandomWalk):
    """Settings of the robust filter of feature and Jacobian."""

    motion_error: NonNegative = 0.1
    """[1] c, error of a predicted motion over its size (delay, curvature of the path)."""
    min_joint_step: NonNegative = 0.002
    """[rad] no process noise in smaller motions."""


class RobustState(NamedTuple):
    """The state of the filter."""

    J: FloatArray  # Ĵ, (..., m, n), m/rad
    P: FloatArray  # covariance of [y_i, J_i] of each feature, (..., m, 1 + n, 1 + n), m² and (m/rad)²
    deviation: FloatArray  # measured − estimated feature of the last frame, (..., m), m
    scale: FloatArray  # s, (...), 1
    rejected: FloatArray  # share of rejections of each feature, (..., m), with forgetting


def bisquare_weight(residual: FloatArray) -> FloatArray:
    """Return Tukey's weight (1 − (u/c_b)²)², 0 beyond c_b, of normalised residuals u of any shape."""
    inside = np.maximum(1.0 - (residual / BISQUARE) ** 2, 0.0)
    return inside * inside


def irls_weight(innovation: FloatArray, variance: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the weight of a measurement that belongs to its own residual, from 0 to 1.

    Args:
        innovation: ν, (..., m), m.
        variance: p₀, of the predicted feature, (..., m), m².
        noise: σ²s², of the measurement, (..., m), m².
    """
    weight = np.ones_like(innovation)
    for _ in range(IRLS_STEPS):
        weight = bisquare_weight(innovation * np.sqrt(noise) / (weight * variance + noise))
    return weight


@final
class RobustEstimator(Estimator[RobustState]):
    """Ĵ of a filter that re-weights each frame by its residual; every motion is used, however small."""

    def __init__(self, config: RobustConfig, knowledge: RobotKnowledge | None = None) -> None:
        """Take the settings; nothing about the robot is needed."""
        self._config = config
        self._noise: FloatArray = np.asarray(config.feature_noise)[()]

    def start(self, jacobian: FloatArray) -> RobustState:
        """Start from Ĵ₀, (..., m, n), m/rad, and the first measurement of the feature."""
        *lead, m, n = jacobian.shape
        feature_variance = self._config.feature_noise**2
        entry_variances = np.full(n, self._config.initial_deviation**2)
        variances = np.concatenate([[feature_variance], entry_variances])
        P = np.broadcast_to(np.diag(variances), (*lead, m, n + 1, n + 1))
        zero = np.zeros((*lead, m))
        return RobustState(jacobian, P, zero, np.ones(lead)[()], zero)

    def update(self, state: RobustState, motion: Motion) -> RobustState:
        """Predict by the motion of the joints and correct by the frame at its end.

        Raises:
            FilterDiverged: a covariance is no longer positive definite.
        """
        duration = np.asarray(motion.duration)
        sigma: FloatArray = self._noise if motion.noise is None else motion.noise
        predicted = np.matvec(state.J, motion.joint_step)
        innovation = state.deviation + motion.feature_step - predicted
        P = self._predicted(state.P, motion.joint_step, predicted, duration)
        cholesky_of(P)
        column = P[..., 0]
        variance = column[..., 0]
        sigma_s = sigma * state.scale
        square = sigma_s * sigma_s
        noise = square[..., None] * np.ones_like(innovation)
        weight = irls_weight(innovation, variance, noise)
        total = weight * variance + noise
        gain = weight[..., None] * column / total[..., None]
        J = state.J + innovation[..., None] * gain[..., 1:]
        P = P - outer(gain, column)
        deviation = innovation * (1.0 - gain[..., 0])

        keep = np.exp(-duration / MEMORY)[..., None]
        is_rejected = weight < REJECTION_WEIGHT
        rejected = keep * state.rejected + (1.0 - keep) * is_rejected
        lost = rejected > LOST_SHARE
        restarted = _restarted_at_frame(P, noise)
        P = where(lost, restarted, (P + P.mT) / 2)

        # The scale rises with each innovation above the normal median, and sinks with each below.
        median = NORMAL_MEDIAN * np.sqrt(variance + noise)
        above = np.sign(np.abs(innovation) - median)
        excess = above.mean(axis=-1)
        factor = np.exp(SCALE_RATE * duration * excess)
        scale = np.clip(state.scale * factor, 1.0, MAX_SCALE)
        none = np.zeros_like(innovation)
        return RobustState(
            J=J,
            P=P,
            deviation=where(lost, none, deviation),
            scale=scale,
            rejected=where(lost, none, rejected),
        )

    def _predicted(
        self, P: FloatArray, joint_step: FloatArray, predicted: FloatArray, duration: FloatArray
    ) -> FloatArray:
        """Return the covariance after a motion: F P Fᵀ + Q with F = [[1, Δqᵀ], [0, I]]."""
        config = self._config
        n = joint_step.shape[-1]
        identity = np.eye(n + 1)
        F = np.broadcast_to(identity, (*joint_step.shape[:-1], n + 1, n + 1)).copy()
        F[..., 0, 1:] = joint_step
        F = F[..., None, :, :]
        moves = norm(joint_step) >= config.min_joint_step
        walk = np.where(moves, config.walk**2 * duration, 0.0)
        Q = np.broadcast_to(walk[..., None, None], (*predicted.shape, n + 1)).copy()
        length = norm(predicted)[..., None]
        Q[..., 0] = (config.motion_error * length) ** 2
        propagated = F @ P @ F.mT
        return propagated + Q[..., None] * identity

    def diagnostics(self, state: RobustState) -> Diagnostics:
        """Return the scale of the noise, the share of rejected frames and the mean deviation of J's entries, m/rad."""
        diagonal = np.diagonal(state.P, axis1=-2, axis2=-1)
        of_entries = diagonal[..., 1:]
        variance = of_entries.mean(axis=-1).mean(axis=-1)
        return {
            "noise_scale": state.scale,
            "rejected_share": state.rejected.mean(axis=-1),
            "jacobian_deviation": np.sqrt(variance),
        }


def _restarted_at_frame(P: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the covariance of a feature that is reset to its measurement, which holds no information about J."""
    taken = P.copy()
    taken[..., 0, :] = 0.0
    taken[..., :, 0] = 0.0
    taken[..., 0, 0] = noise
    return taken
