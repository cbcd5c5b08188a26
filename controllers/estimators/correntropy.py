"""Maximum correntropy Kalman filters for the Jacobian (MCKF, GMCKF, IMCC-KF, RMCKF), for noise with outliers.

Each is the Kalman filter of `controllers.estimators.kalman` with weights in (0, 1] on the measurement, and some also
weight the prior: a large normalised error e gets a small weight, such as G(e) = exp(−e²/(2b²)) with the bandwidth b.
With P₀ = p₀ I, Q = q I and R = r I each row of J, one per feature, has a covariance of its own, (n, n). The matrices of
size mn in the papers thus split exactly into rows; only the weights may couple them:

    P ← P + q I,   B Bᵀ = P,   ν_i = Δy_i − J_i Δq,   h_i = B_iᵀ Δq
    K_i = w_i B_i X_i⁻¹ h_i / (w_i h_iᵀ X_i⁻¹ h_i + r)          w_i weight of Δy_i, X_i diagonal, weights of the prior
    J_i ← J_i + ν_i K_iᵀ,   P_i ← (I − K_iΔqᵀ) P_i (I − K_iΔqᵀ)ᵀ + r K_i K_iᵀ

A weight of 0 leaves the row as it was. As b grows without limit all of them become the Kalman filter.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.kalman import (
    Corrected,
    RandomWalk,
    RandomWalkEstimator,
    cholesky_of,
    joseph,
    symmetric,
)
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import entries, norm, outer, repeat
from servobench.plant.contract.settings import Count, Positive, settings
from servobench.plant.contract.signals import BoolArray

MAX_EXPONENT = 40.0  # [1] a weight of exp(−40) is practically 0, but can be divided by
MIN_ERROR = 0.1  # [1] smallest |e| of the generalised kernel, in standard deviations


def gaussian_weight(error: FloatArray, bandwidth: float) -> FloatArray:
    """Return G(e) = exp(−e²/(2b²)), from exp(−`MAX_EXPONENT`) to 1, for normalised errors of any shape."""
    exponent = error * error / (2.0 * bandwidth**2)
    return np.exp(-np.minimum(exponent, MAX_EXPONENT))


def generalised_weight(error: FloatArray, shape: float, bandwidth: float) -> FloatArray:
    """Return |e|^(α−2) exp(−|e/β|^α), above 0, for normalised errors of any shape."""
    size = np.maximum(np.abs(error), MIN_ERROR)
    exponent = np.minimum((size / bandwidth) ** shape, MAX_EXPONENT)
    return size ** (shape - 2.0) * np.exp(-exponent)


def weighted_gain(
    P: FloatArray, joint_step: FloatArray, weight: FloatArray, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return P Δq and the gain K of each row, (..., m, n), for weights of the measurement (..., m) alone."""
    dq = joint_step[..., None, :]
    PH = np.matvec(P, dq)
    variance = weight * np.vecdot(PH, dq) + r[..., None]
    return PH, weight[..., None] * PH / variance[..., None]


def corrected(
    J: FloatArray,
    P: FloatArray,
    gain: FloatArray,
    joint_step: FloatArray,
    feature_step: FloatArray,
    *,
    r: FloatArray,
) -> Corrected:
    """Return Ĵ and P after a motion with a gain K of each row, (..., m, n), P in Joseph form."""
    dq = joint_step[..., None, :]
    P = symmetric(joseph(P, np.matvec(P, dq), gain, dq, r[..., None]))
    innovation = feature_step - np.matvec(J, joint_step)
    return J + innovation[..., None] * gain, P


@settings
class MckfConfig(RandomWalk):
    """Settings of the maximum correntropy Kalman filter (`mckf_estimator`)."""

    bandwidth: Positive = 3.0
    """[1] b, error in standard deviations with the weight exp(−1/2)."""
    tolerance: Positive = 1e-6
    """[1] relative change of J that ends the iteration."""
    iterations: Count = 20
    """[1] limit per update."""


@settings
class GmckfConfig(RandomWalk):
    """Settings of the generalised maximum correntropy Kalman filter."""

    shape: Positive = 1.5
    """[1] α, exponent of the kernel: 2 Gaussian, 1 Laplacian."""
    bandwidth: Positive = 4.0
    """[1] β, error in standard deviations with the kernel exp(−1)."""
    tolerance: Positive = 1e-6
    """[1] relative change of J that ends the iteration."""
    iterations: Count = 20
    """[1] limit per update."""


class Iterate(NamedTuple):
    """A step of the fixed-point iteration."""

    J: FloatArray  # the present Ĵ, (..., m, n), m/rad
    gain: FloatArray  # K of each row, (..., m, n), rad⁻¹
    prior: FloatArray  # error of the prior as B⁻¹ (J⁻ − J), (..., m, n), 1
    moves: BoolArray  # (...), whether Ĵ changed by more than the tolerance


class Measured(NamedTuple):
    """The quantities that stay the same during the iteration."""

    J: FloatArray  # J⁻, (..., m, n), m/rad
    B: FloatArray  # Cholesky factor of the covariance of each row, (..., m, n, n)
    h: FloatArray  # BᵀΔq, (..., m, n)
    joint_step: FloatArray  # Δq, (..., n), rad
    feature_step: FloatArray  # Δy, (..., m), m
    r: FloatArray  # variance of each component of Δy, (...), m²


class Iteration(NamedTuple):
    """The tree on which the iteration works."""

    at: Iterate
    given: Measured


def fixed_point_update(
    J: FloatArray,
    P: FloatArray,
    joint_step: FloatArray,
    feature_step: FloatArray,
    *,
    r: FloatArray,
    weight: Callable[[FloatArray], FloatArray],
    config: MckfConfig | GmckfConfig,
) -> Corrected:
    """Correct by one motion with weights of measurement and prior that belong to the corrected estimate itself.

    With e = [B⁻¹ (J⁻ − J), (Δy − J Δq)/√r] the gain is that of the weights w(e), until J changes by less than the
    tolerance times its norm; it begins at J⁻.

    Args:
        J: J⁻; see `kalman.split_update`, as for the others up to `r`.
        P: covariance of each row after the walk, (..., m, n, n).
        joint_step: Δq.
        feature_step: Δy.
        r: variance of each component of Δy.
        weight: w, of normalised errors; above 0.
        config: tolerance and number of iterations.

    Raises:
        FilterDiverged: a covariance is not positive definite.
    """
    B = cholesky_of(P)
    h = np.vecmat(joint_step[..., None, :], B)
    given = Measured(J, B, h, joint_step, feature_step, r)

    def improved(tree: Iteration) -> Iteration:
        at = tree.at
        J, B, h, dq, dy, r = tree.given
        sigma = np.sqrt(r)[..., None]
        error = (dy - np.matvec(at.J, dq)) / sigma
        spread = h / weight(at.prior)
        w = weight(error)
        variance = w * np.vecdot(h, spread) + r[..., None]
        share = w / variance
        gain = share[..., None] * np.matvec(B, spread)
        nu = dy - np.matvec(J, dq)
        new = J + nu[..., None] * gain
        # B⁻¹ (J⁻ − J) without a solve: J − J⁻ = ν Kᵀ, and B⁻¹ K is the share times the spread.
        prior = -(share * nu)[..., None] * spread
        change = norm(entries(new - at.J))
        moves = change > config.tolerance * norm(entries(at.J))
        return Iteration(Iterate(new, gain, prior, moves), tree.given)

    none = np.zeros_like(J)
    moves = np.ones_like(r, dtype=np.bool_)[()]
    first = Iterate(J, none, none, moves)
    last = repeat(_moves, improved, Iteration(first, given), config.iterations)
    return corrected(J, P, last.at.gain, joint_step, feature_step, r=r)


def _moves(tree: Iteration) -> BoolArray:
    return tree.at.moves


def mckf_estimator(
    config: MckfConfig, knowledge: RobotKnowledge | None = None
) -> RandomWalkEstimator:
    """Return the maximum correntropy Kalman filter (MCKF); nothing about the robot is needed.

    Chen, Liu, Zhao and Príncipe, "Maximum correntropy Kalman filter", Automatica 76 (2017) 70-77: the sum of the
    kernels G of all errors, of the prior and of the measurement, is maximised by a fixed-point iteration,

        e = [B_P⁻¹ (x⁻ − x), B_R⁻¹ (Δy − H x)],   B_P B_Pᵀ = P⁻,  B_R B_Rᵀ = R,   C = diag(G(e))
        P̃ = B_P C_x⁻¹ B_Pᵀ,   R̃ = B_R C_y⁻¹ B_Rᵀ,   K = P̃ Hᵀ (H P̃ Hᵀ + R̃)⁻¹,   x ← x⁻ + K (Δy − H x⁻)

    until x stays. Then P = (I − K H) P⁻ (I − K H)ᵀ + K R Kᵀ. Ren and Li applied it to visual servoing.
    """
    weight = partial(gaussian_weight, bandwidth=config.bandwidth)
    update = partial(fixed_point_update, weight=weight, config=config)
    return RandomWalkEstimator(config, update, "by_rows")


def gmckf_estimator(
    config: GmckfConfig, knowledge: RobotKnowledge | None = None
) -> RandomWalkEstimator:
    """Return the generalised maximum correntropy Kalman filter (GMCKF); nothing about the robot is needed.

    Mo, Wang, Yang, Chen, Li and Jiang, "Generalized Maximum Correntropy Kalman Filter for Target Tracking in TianGong-2
    Space Laboratory", Space: Science & Technology 2022, 9796015: the filter of `mckf_estimator` with the generalised
    Gaussian density exp(−|e/β|^α) as kernel, whose gradient gives the weights

        w(e) = |e|^(α−2) exp(−|e/β|^α)

    Common factors of all weights cancel in the gain, so α = 2 with β = √2 b is the MCKF of bandwidth b. For α ≠ 2 the
    factor |e|^(α−2) has no finite or no positive value at e = 0, where the iteration begins: |e| is taken as at least
    `MIN_ERROR`. The paper's choice of α by an estimate of the kurtosis is left out; α is a setting.
    """
    weight = partial(generalised_weight, shape=config.shape, bandwidth=config.bandwidth)
    update = partial(fixed_point_update, weight=weight, config=config)
    return RandomWalkEstimator(config, update, "by_rows")


@settings
class ImcckfConfig(RandomWalk):
    """Settings of the improved maximum correntropy criterion Kalman filter."""

    bandwidth: Positive = 5.0
    """[1] b, norm of the innovation in standard deviations with the weight exp(−1/2)."""


def imcckf_update(
    J: FloatArray,
    P: FloatArray,
    joint_step: FloatArray,
    feature_step: FloatArray,
    *,
    r: FloatArray,
    bandwidth: float,
) -> Corrected:
    """Correct by one motion, with a P of each row; see `kalman.split_update`."""
    innovation = feature_step - np.matvec(J, joint_step)
    size = norm(innovation) / np.sqrt(r)
    weight = gaussian_weight(size, bandwidth)
    PH, gain = weighted_gain(P, joint_step, weight[..., None], r)
    J = J + innovation[..., None] * gain
    P = P - outer(gain, PH)
    return J, symmetric(P)


def imcckf_estimator(
    config: ImcckfConfig, knowledge: RobotKnowledge | None = None
) -> RandomWalkEstimator:
    """Return the improved maximum correntropy criterion Kalman filter; nothing about the robot is needed.

    Kulikova, "Square-root algorithms for maximum correntropy estimation of linear discrete-time systems in presence of
    non-Gaussian noise", Systems & Control Letters 108 (2017) 8-15, algorithm 1: one weight for the whole measurement,
    and no iteration,

        λ = G(‖Δy − H x⁻‖_R⁻¹),   K = λ P⁻ Hᵀ (λ H P⁻ Hᵀ + R)⁻¹,   x = x⁻ + K (Δy − H x⁻),   P = (I − K H) P⁻
    """
    return RandomWalkEstimator(
        config, partial(imcckf_update, bandwidth=config.bandwidth), "by_rows"
    )


@settings
class RmckfConfig(RandomWalk):
    """Settings of the regularised maximum correntropy criterion Kalman filter."""

    bandwidth: Positive = 3.0
    """[1] b, innovation in standard deviations with the weight exp(−1/2)."""
    regularisation: Positive = 1e-6
    """[1] ε, added to every weight; the authors' value."""


def rmckf_update(
    J: FloatArray,
    P: FloatArray,
    joint_step: FloatArray,
    feature_step: FloatArray,
    r: FloatArray,
    config: RmckfConfig,
) -> Corrected:
    """Correct by one motion, with a P of each row; see `kalman.split_update`."""
    innovation = feature_step - np.matvec(J, joint_step)
    normalised = innovation / np.sqrt(r)[..., None]
    weight = gaussian_weight(normalised, config.bandwidth) + config.regularisation
    _, gain = weighted_gain(P, joint_step, weight, r)
    return corrected(J, P, gain, joint_step, feature_step, r=r)


def rmckf_estimator(
    config: RmckfConfig, knowledge: RobotKnowledge | None = None
) -> RandomWalkEstimator:
    """Return the regularised maximum correntropy criterion Kalman filter; nothing about the robot is needed.

    Leite, Araújo and Martins, "Regularized Maximum Correntropy Criterion Kalman Filter for Uncalibrated Visual Servoing
    in the Presence of Non-Gaussian Feature Tracking Noise", Sensors 23 (2023) 8518; their public code calls it GMCKF.
    Each feature has a weight of its own, of its innovation, and there is no iteration:

        C = diag(G(B_R⁻¹ (Δy − H x⁻))),   R̃ = B_R (C + ε I)⁻¹ B_Rᵀ,   K = P⁻ Hᵀ (H P⁻ Hᵀ + R̃)⁻¹
        x = x⁻ + K (Δy − H x⁻),   P = (I − K H) P⁻ (I − K H)ᵀ + K R Kᵀ

    Departures: their law multiplies each feature's error by the same weight, which no estimator can do here, and their
    annealing of the bandwidth, off in their settings, is left out.
    """
    return RandomWalkEstimator(config, partial(rmckf_update, config=config), "by_rows")
