"""Improved maximum correntropy criterion Kalman filter (IMCC-KF), for the Jacobian.

Kulikova, "Square-root algorithms for maximum correntropy estimation of linear discrete-time systems in presence of
non-Gaussian noise", Systems & Control Letters 108 (2017) 8-15, algorithm 1: one weight for the whole measurement, and
no iteration,

    λ = G(‖Δy − H x⁻‖_R⁻¹),   K = λ P⁻ Hᵀ (λ H P⁻ Hᵀ + R)⁻¹,   x = x⁻ + K (Δy − H x⁻),   P = (I − K H) P⁻
"""

from __future__ import annotations

from functools import partial

import numpy as np

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.correntropy import CorrentropyEstimator, gaussian_weight
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm, outer, transposed
from servobench.plant.contract.settings import NonNegative, Positive, settings


@settings
class ImcckfConfig:
    """Settings of the improved maximum correntropy criterion Kalman filter."""

    initial_deviation: Positive = 0.05
    """[m/rad] of an entry of Ĵ₀."""
    walk: NonNegative = 0.089443
    """[m/rad/√s] deviation of an entry after a second of motion; that of `kalman`."""
    feature_noise: Positive = 0.001
    """[m] standard deviation σ of the feature per axis, unless it is identified; R = 2σ² I."""
    min_joint_step: NonNegative = 0.002
    """[rad] smaller motions are left out: they hold little but 1 mm of noise."""
    bandwidth: Positive = 5.0
    """[1] b, norm of the innovation in standard deviations at which the weight has sunk to exp(−1/2)."""


def imcckf_update(
    J: FloatArray, P: FloatArray, joint_step: FloatArray, feature_step: FloatArray, *, r: FloatArray, bandwidth: float
) -> tuple[FloatArray, FloatArray]:
    """Correct by one motion; see `servobench.controllers.estimators.correntropy.Update`."""
    innovation = feature_step - np.matvec(J, joint_step)
    weight = gaussian_weight(norm(innovation) / np.sqrt(r), bandwidth)[..., None]
    PH = np.matvec(P, joint_step[..., None, :])
    gain = weight[..., None] * PH / (weight * np.vecdot(PH, joint_step[..., None, :]) + r[..., None])[..., None]
    P = P - outer(gain, PH)
    return J + innovation[..., None] * gain, (P + transposed(P)) / 2


def imcckf_estimator(config: ImcckfConfig, knowledge: RobotKnowledge | None = None) -> CorrentropyEstimator:
    """Return the filter; nothing about the robot is needed."""
    return CorrentropyEstimator(config, partial(imcckf_update, bandwidth=config.bandwidth))
