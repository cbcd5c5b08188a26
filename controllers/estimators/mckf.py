"""Maximum correntropy Kalman filter (MCKF), for the Jacobian.

Chen, Liu, Zhao and Príncipe, "Maximum correntropy Kalman filter", Automatica 76 (2017) 70-77: the sum of the kernels
G of all errors, of the prior and of the measurement, is maximised by a fixed-point iteration,

    e = [B_P⁻¹ (x⁻ − x), B_R⁻¹ (Δy − H x)],   B_P B_Pᵀ = P⁻,  B_R B_Rᵀ = R,   C = diag(G(e))
    P̃ = B_P C_x⁻¹ B_Pᵀ,   R̃ = B_R C_y⁻¹ B_Rᵀ,   K = P̃ Hᵀ (H P̃ Hᵀ + R̃)⁻¹,   x ← x⁻ + K (Δy − H x⁻)

until x stays. Then P = (I − K H) P⁻ (I − K H)ᵀ + K R Kᵀ. Ren and Li applied it to visual servoing.
"""

from __future__ import annotations

from functools import partial

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.correntropy import CorrentropyEstimator, fixed_point_update, gaussian_weight
from servobench.plant.contract.settings import Count, NonNegative, Positive, settings


@settings
class MckfConfig:
    """Settings of the maximum correntropy Kalman filter."""

    initial_deviation: Positive = 0.05
    """[m/rad] of an entry of Ĵ₀."""
    walk: NonNegative = 0.089443
    """[m/rad/√s] deviation of an entry after a second of motion; that of `kalman`."""
    feature_noise: Positive = 0.001
    """[m] standard deviation σ of the feature per axis, unless it is identified; R = 2σ² I."""
    min_joint_step: NonNegative = 0.002
    """[rad] smaller motions are left out: they hold little but 1 mm of noise."""
    bandwidth: Positive = 3.0
    """[1] b, error in standard deviations at which the weight has sunk to exp(−1/2)."""
    tolerance: Positive = 1e-6
    """[1] the iteration ends when J changes by less than this share of its norm."""
    iterations: Count = 20
    """[1] the most of them in an update."""


def mckf_estimator(config: MckfConfig, knowledge: RobotKnowledge | None = None) -> CorrentropyEstimator:
    """Return the filter; nothing about the robot is needed."""
    weight = partial(gaussian_weight, bandwidth=config.bandwidth)
    fixed_point = partial(fixed_point_update, weight=weight, tolerance=config.tolerance, iterations=config.iterations)
    return CorrentropyEstimator(config, fixed_point)
