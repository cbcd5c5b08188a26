"""Generalised maximum correntropy Kalman filter (GMCKF), for the Jacobian.

Mo, Wang, Yang, Chen, Li and Jiang, "Generalized Maximum Correntropy Kalman Filter for Target Tracking in TianGong-2
Space Laboratory", Space: Science & Technology 2022, 9796015: the filter of `controllers.estimators.mckf` with the
generalised Gaussian density exp(−|e/β|^α) as kernel, whose gradient gives the weights

    w(e) = |e|^(α−2) exp(−|e/β|^α)

Common factors of all weights cancel in the gain, so α = 2 with β = √2 b is the MCKF of bandwidth b. For α ≠ 2 the
factor |e|^(α−2) has no finite or no positive value at e = 0, where the iteration begins: |e| is taken as at least
`MIN_ERROR`. The paper's choice of α by an estimate of the kurtosis is left out; α is a setting.
"""

from __future__ import annotations

from functools import partial
from typing import Final

import numpy as np

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.correntropy import MAX_EXPONENT, CorrentropyEstimator, fixed_point_update
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.settings import Count, NonNegative, Positive, settings

MIN_ERROR: Final = 0.1  # [1] in standard deviations


@settings
class GmckfConfig:
    """Settings of the generalised maximum correntropy Kalman filter."""

    initial_deviation: Positive = 0.05
    """[m/rad] of an entry of Ĵ₀."""
    walk: NonNegative = 0.089443
    """[m/rad/√s] deviation of an entry after a second of motion; that of `kalman`."""
    feature_noise: Positive = 0.001
    """[m] standard deviation σ of the feature per axis, unless it is identified; R = 2σ² I."""
    min_joint_step: NonNegative = 0.002
    """[rad] smaller motions are left out: they hold little but 1 mm of noise."""
    shape: Positive = 1.5
    """[1] α, exponent of the kernel: 2 is Gaussian, 1 is Laplacian."""
    bandwidth: Positive = 4.0
    """[1] β, error in standard deviations at which the kernel has sunk to exp(−1)."""
    tolerance: Positive = 1e-6
    """[1] the iteration ends when J changes by less than this share of its norm."""
    iterations: Count = 20
    """[1] the most of them in an update."""


def generalised_weight(error: FloatArray, shape: float, bandwidth: float) -> FloatArray:
    """Return |e|^(α−2) exp(−|e/β|^α), above 0, for normalised errors of any shape."""
    size = np.maximum(np.abs(error), MIN_ERROR)
    return np.asarray(size ** (shape - 2.0) * np.exp(-np.minimum((size / bandwidth) ** shape, MAX_EXPONENT)))


def gmckf_estimator(config: GmckfConfig, knowledge: RobotKnowledge | None = None) -> CorrentropyEstimator:
    """Return the filter; nothing about the robot is needed."""
    weight = partial(generalised_weight, shape=config.shape, bandwidth=config.bandwidth)
    fixed_point = partial(fixed_point_update, weight=weight, tolerance=config.tolerance, iterations=config.iterations)
    return CorrentropyEstimator(config, fixed_point)
