"""Regularised maximum correntropy criterion Kalman filter (RMCKF), for the Jacobian.

Leite, Araújo and Martins, "Regularized Maximum Correntropy Criterion Kalman Filter for Uncalibrated Visual Servoing in
the Presence of Non-Gaussian Feature Tracking Noise", Sensors 23 (2023) 8518; their public code calls it GMCKF. Each
feature has a weight of its own, of its innovation, and there is no iteration:

    C = diag(G(B_R⁻¹ (Δy − H x⁻))),   R̃ = B_R (C + ε I)⁻¹ B_Rᵀ,   K = P⁻ Hᵀ (H P⁻ Hᵀ + R̃)⁻¹
    x = x⁻ + K (Δy − H x⁻),   P = (I − K H) P⁻ (I − K H)ᵀ + K R Kᵀ

Departures: their law multiplies each feature's error by the same weight, which no estimator can do here, and their
annealing of the bandwidth, off in their settings, is left out.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.correntropy import CorrentropyEstimator, corrected, gaussian_weight
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.settings import NonNegative, Positive, settings


@settings
class RmckfConfig:
    """Settings of the regularised maximum correntropy criterion Kalman filter."""

    initial_deviation: Positive = 0.05
    """[m/rad] of an entry of Ĵ₀."""
    walk: NonNegative = 0.089443
    """[m/rad/√s] deviation of an entry after a second of motion; that of `kalman`."""
    feature_noise: Positive = 0.001
    """[m] standard deviation σ of the feature per axis, unless it is identified; R = 2σ² I."""
    min_joint_step: NonNegative = 0.002
    """[rad] smaller motions are left out: they hold little but 1 mm of noise."""
    bandwidth: Positive = 3.0
    """[1] b, innovation in standard deviations at which the weight has sunk to exp(−1/2)."""
    regularisation: Positive = 1e-6
    """[1] ε, added to every weight; the authors'."""


def rmckf_update(
    J: FloatArray,
    P: FloatArray,
    joint_step: FloatArray,
    feature_step: FloatArray,
    *,
    r: FloatArray,
    bandwidth: float,
    regularisation: float,
) -> tuple[FloatArray, FloatArray]:
    """Correct by one motion; see `servobench.controllers.estimators.correntropy.Update`."""
    innovation = feature_step - np.matvec(J, joint_step)
    weight = gaussian_weight(innovation / np.sqrt(r)[..., None], bandwidth) + regularisation
    PH = np.matvec(P, joint_step[..., None, :])
    gain = weight[..., None] * PH / (weight * np.vecdot(PH, joint_step[..., None, :]) + r[..., None])[..., None]
    return corrected(J, P, gain, joint_step, feature_step, r=r)


def rmckf_estimator(config: RmckfConfig, knowledge: RobotKnowledge | None = None) -> CorrentropyEstimator:
    """Return the filter; nothing about the robot is needed."""
    update = partial(rmckf_update, bandwidth=config.bandwidth, regularisation=config.regularisation)
    return CorrentropyEstimator(config, update)
