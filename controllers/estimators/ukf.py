"""Unscented Kalman filter for the Jacobian, as methods 2 and 3 of the paper use it.

State x = vec(J) by rows, s = mn, a random walk with covariance Q; measurement Δy = J Δq with covariance R. Van der
Merwe's scaled sigma points, 2s+1 of them, with Λ = α²(s + κ) − s and L Lᵀ = P + Q:

    χ₀ = x,  χ_i = x ± √(s + Λ) L_i          (a random walk passes x on unchanged and turns P into P + Q, exactly)
    ζ_i = reshape(χ_i) Δq,  ẑ = Σ wᵐ_i ζ_i
    S = Σ wᶜ_i (ζ_i − ẑ)(ζ_i − ẑ)ᵀ + R,   C = Σ wᶜ_i (χ_i − x)(ζ_i − ẑ)ᵀ,   K = C S⁻¹
    x ← x + K (Δy − ẑ),   P ← P + Q − K S Kᵀ

Δy is linear in x, so the transform is exact for any α, β, κ: this filter *is* the Kalman filter of
`controllers.estimators.kalman`. That is a fact about the method, and the tests check it to 1e-9. With P₀, Q and R
multiples of the identity it even splits by rows: the form "split" gives the same numbers for a small part of the cost.
"""

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators import kalman
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import transposed
from servobench.plant.contract.settings import NonNegative, Positive, settings


@settings
class UkfConfig(kalman.RandomWalk):
    """Settings of the unscented Kalman filter."""

    alpha: Positive = 1.0
    """[1] spread of the sigma points; 1 keeps all weights from being negative."""
    beta: NonNegative = 2.0
    """[1] prior knowledge of the distribution; 2 suits a Gaussian."""
    kappa: NonNegative = 0.0
    """[1] secondary spread."""
    form: Literal["split", "sigma_points"] = "split"
    """Two computations of the same numbers; "sigma_points" is the reference, several times slower."""


@dataclass(frozen=True, eq=False)
class SigmaWeights:
    """Weights of the scaled sigma points."""

    reach: float  # √(s + Λ), how many deviations the points stand off
    mean: FloatArray  # wᵐ, (2s+1,)
    covariance: FloatArray  # wᶜ, (2s+1,)


@cache
def sigma_weights(size: int, alpha: float, beta: float, kappa: float) -> SigmaWeights:
    """Return van der Merwe's weights for a state of `size` entries; α = 1, β = 0 are Julier's."""
    spread = alpha**2 * (size + kappa)
    mean = np.full(2 * size + 1, 0.5 / spread)
    mean[0] = (spread - size) / spread
    covariance = mean.copy()
    covariance[0] += 1.0 - alpha**2 + beta
    return SigmaWeights(float(np.sqrt(spread)), mean, covariance)


def unscented_update(
    J: FloatArray,
    P: FloatArray,
    joint_step: FloatArray,
    feature_step: FloatArray,
    *,
    Q: FloatArray,
    R: FloatArray,
    weights: SigmaWeights,
) -> tuple[FloatArray, FloatArray]:
    """Predict the random walk and correct it by one motion with sigma points.

    Args:
        J: Jacobian, (..., m, n), m/rad.
        P: covariance of vec(J) by rows, (..., mn, mn), (m/rad)².
        joint_step: Δq, (..., n), rad.
        feature_step: Δy, (..., m), m.
        Q: process covariance, (..., mn, mn), (m/rad)².
        R: covariance of Δy, (..., m, m), m².
        weights: from `sigma_weights` with s = mn.

    Returns:
        The new Jacobian and covariance.

    Raises:
        FilterDiverged: P + Q is not positive definite.
    """
    *lead, m, n = J.shape
    size, P = m * n, P + Q
    reach = weights.reach * transposed(kalman.cholesky_of(P))
    offsets = np.concatenate([np.zeros((*lead, 1, size)), reach, -reach], axis=-2)
    points = J.reshape(*lead, 1, size) + offsets
    Z = np.matvec(points.reshape(*lead, 2 * size + 1, m, n), joint_step[..., None, :])  # a point is m rows of J
    z = np.vecmat(weights.mean, Z)
    deviations = Z - z[..., None, :]
    weighted = weights.covariance[:, None] * deviations
    S = transposed(deviations) @ weighted + R
    C = transposed(offsets) @ weighted
    K = transposed(np.linalg.solve(S, transposed(C)))
    P = P - K @ transposed(C)  # K S = C
    return J + np.matvec(K, feature_step - z).reshape(J.shape), (P + transposed(P)) / 2


def ukf_estimator(config: UkfConfig, knowledge: RobotKnowledge | None = None) -> kalman.RandomWalkEstimator:
    """Return the random-walk estimator whose gain is that of the unscented transform.

    The paper gives neither P₀, Q and R nor a rule for an arm at rest; here R is the variance 2σ² of the feature's
    noise, and motions below a minimum ‖Δq‖ are left out.
    """
    if config.form == "split":
        return kalman.RandomWalkEstimator(config, kalman.split_update, "shared")

    def update(
        J: FloatArray, P: FloatArray, joint_step: FloatArray, feature_step: FloatArray, *, q: FloatArray, r: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        weights = sigma_weights(P.shape[-1], config.alpha, config.beta, config.kappa)
        return unscented_update(J, P, joint_step, feature_step, **kalman.full_covariances(J, q, r), weights=weights)

    return kalman.RandomWalkEstimator(config, update, "full")
