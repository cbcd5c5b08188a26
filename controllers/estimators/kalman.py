"""Kalman filters for the Jacobian, the unscented one among them, their estimator, and recursive least squares.

The Jacobian is a random walk that every motion measures. State x = vec(J) by rows, (mn,), so that entry i·n + j is
∂y_i/∂q_j:

    x(k) = x(k−1) + w,   w ~ N(0, Q)
    Δy(k) = H x(k) + v,  H = I_m ⊗ Δqᵀ,  v ~ N(0, R),  R = 2σ² I  (Δy is the difference of two measurements)

With P₀ = p₀ I, Q = q I and R = r I the filter splits into m filters of n states, one a feature, that share one
covariance, with the same numbers for a small part of the cost: `split_update`, and "split" of the unscented filter.

The unscented filter is that of methods 2 and 3 of the paper. Van der Merwe's scaled sigma points, 2s+1 of them for
s = mn, with Λ = α²(s + κ) − s and L Lᵀ = P + Q:

    χ₀ = x,  χ_i = x ± √(s + Λ) L_i          (a random walk passes x on unchanged and turns P into P + Q, exactly)
    ζ_i = reshape(χ_i) Δq,  ẑ = Σ wᵐ_i ζ_i
    S = Σ wᶜ_i (ζ_i − ẑ)(ζ_i − ẑ)ᵀ + R,   C = Σ wᶜ_i (χ_i − x)(ζ_i − ẑ)ᵀ,   K = C S⁻¹
    x ← x + K (Δy − ẑ),   P ← P + Q − K S Kᵀ

Δy is linear in x, so the transform is exact for any α, β, κ: this filter *is* the Kalman filter. That is a fact about
the method, and the tests check it to 1e-9.

Recursive least squares has exponential forgetting in place of the walk:

    K = PΔq / (λ + ΔqᵀPΔq),      Ĵ ← Ĵ + (Δy − ĴΔq) Kᵀ,      P ← (P − K ΔqᵀP) / λ,      0 < λ ≤ 1

It minimises Σ λ^(k−t) ‖Δy_t − J Δq_t‖² + λ^k tr[(J − Ĵ₀) P₀⁻¹ (J − Ĵ₀)ᵀ]; all rows of J share P (n, n), 1/rad².
λ = 1 is batch least squares.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Annotated, Literal, NamedTuple, TypeAlias, final

import numpy as np

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import GatedEstimator, Motion
from servobench.plant.contract.checks import FloatArray, is_finite
from servobench.plant.contract.dependence import Only
from servobench.plant.contract.faults import FilterDiverged
from servobench.plant.contract.lanes import outer, plus_diagonal
from servobench.plant.contract.settings import (
    Deviation,
    NonNegative,
    Positive,
    PositiveOrInfinite,
    settings,
)
from servobench.plant.contract.signals import BoolArray


@settings
class RandomWalk:
    """Settings of every filter in which the Jacobian is a random walk."""

    initial_deviation: Positive = 0.05
    """[m/rad] of an entry of Ĵ₀; tuned for `kalman`; larger, latency spoils the first motions."""
    walk: NonNegative = 0.089443
    """[m/rad/√s] deviation of an entry after 1 s of motion; tuned for `kalman`."""
    feature_noise: Deviation = 0.001
    """[m] σ of the feature per axis, unless identified."""
    min_joint_step: NonNegative = 0.002
    """[rad] smaller motions are skipped as noise."""


@settings
class KalmanConfig(RandomWalk):
    """Settings of the Kalman filter."""


def cholesky_of(P: FloatArray) -> FloatArray:
    """Return the lower Cholesky factor of covariances (..., s, s).

    Raises:
        FilterDiverged: one of them is not finite or not positive definite.
    """
    try:
        L = np.asarray(np.linalg.cholesky(P))
    except np.linalg.LinAlgError as error:
        lowest = float(np.linalg.eigvalsh(P).min())
        raise FilterDiverged(
            f"covariance is not positive definite: smallest eigenvalue {lowest:.3e}"
        ) from error
    # LAPACK lets NaN pass.
    if not is_finite(L):
        raise FilterDiverged(
            f"covariance is not finite: diagonal {np.diagonal(P, axis1=-2, axis2=-1).tolist()}"
        )
    return L


Corrected: TypeAlias = tuple[FloatArray, FloatArray]
"""Ĵ and its covariance after a motion."""
Update: TypeAlias = Callable[..., Corrected]
"""The formula by which a filter corrects the Jacobian and its covariance after the walk, called as `split_update`; the
shape of P depends on the filter, see `Covariance`."""


def joseph(
    P: FloatArray, PH: FloatArray, K: FloatArray, joint_step: FloatArray, r: FloatArray
) -> FloatArray:
    """Return (I − KΔqᵀ) P (I − KΔqᵀ)ᵀ + r K Kᵀ, (..., n, n), for PH = PΔq, K and Δq, (..., n), and r, (...).

    With A = P − K PHᵀ it is multiplied out: A − (A Δq) Kᵀ + r K Kᵀ.
    """
    A = P - outer(K, PH)
    column = r[..., None] * K - np.matvec(A, joint_step)
    return A + outer(column, K)


def symmetric(P: FloatArray) -> FloatArray:
    """Return (P + Pᵀ)/2, (..., n, n): rounding leaves a covariance a little asymmetric."""
    return (P + P.mT) / 2


def split_update(
    J: FloatArray, P: FloatArray, joint_step: FloatArray, feature_step: FloatArray, *, r: FloatArray
) -> Corrected:
    """Correct vec(J) by one motion, where its covariance is I_m ⊗ P: all rows of J share the gain K, (n,), and P.

    K = PΔq / (ΔqᵀPΔq + r),   J ← J + (Δy − JΔq) Kᵀ,   P ← (I − KΔqᵀ) P (I − KΔqᵀ)ᵀ + r K Kᵀ

    Args:
        J: Jacobian, (..., m, n), m/rad.
        P: covariance of each of its rows after the walk, (..., n, n), (m/rad)².
        joint_step: Δq, (..., n), rad.
        feature_step: Δy, (..., m), m.
        r: variance of Δy, (...), m².

    Returns:
        The new Jacobian and covariance.
    """
    PH = np.matvec(P, joint_step)
    K = PH / (np.vecdot(joint_step, PH) + r)[..., None]
    P = joseph(P, PH, K, joint_step, r)
    return J + outer(feature_step - np.matvec(J, joint_step), K), symmetric(P)


Covariance: TypeAlias = Literal["shared", "by_rows", "full"]
"""One P, (n, n), that all rows of J share; one of each row, (m, n, n); or one of all entries, (mn, mn)."""


class WalkState(NamedTuple):
    """The state of a filter."""

    J: FloatArray  # Ĵ, (..., m, n), m/rad
    P: FloatArray  # covariance, (m/rad)²; see `Covariance`
    updated: BoolArray  # (...), whether the last motion was used


@final
class RandomWalkEstimator(GatedEstimator[WalkState]):
    """The random walk of J, corrected by the formula of a filter; motions below a minimum ‖Δq‖ are left out.

    J changes only where the arm moves, so a motion that is left out adds no process noise either.
    """

    def __init__(self, config: RandomWalk, update: Update, covariance: Covariance) -> None:
        """Take the settings of the walk, the formula, and the form of its covariance."""
        super().__init__(config)
        self._formula = update
        self._covariance = covariance
        self._walk = config.walk**2
        self._noise: FloatArray = np.asarray(config.feature_noise)[()]

    def start(self, jacobian: FloatArray) -> WalkState:
        """Start from Ĵ₀, (..., m, n), m/rad, with the configured covariance."""
        *lead, m, n = jacobian.shape
        shapes = {"shared": (n, n), "by_rows": (m, n, n), "full": (m * n, m * n)}
        shape = shapes[self._covariance]
        P = np.eye(shape[-1]) * self._config.initial_deviation**2
        P = np.broadcast_to(P, (*lead, *shape))
        return WalkState(jacobian, P, np.full(lead, False))

    def _correct(self, state: WalkState, motion: Motion) -> WalkState:
        noise: FloatArray = self._noise if motion.noise is None else motion.noise
        walk = self._walk * np.asarray(motion.duration)
        r = 2.0 * noise * noise
        if r.ndim < walk.ndim:
            r = np.broadcast_to(r, walk.shape)
        diagonal = walk[..., None]
        if self._covariance == "by_rows":
            diagonal = diagonal[..., None]
        P = plus_diagonal(state.P, diagonal)
        J, P = self._formula(state.J, P, motion.joint_step, motion.feature_step, r=r)
        cholesky_of(P)
        return state._replace(J=J, P=P)

    def diagnostics(self, state: WalkState) -> Diagnostics:
        """Return whether the last motion was used and the mean deviation of an entry of the Jacobian, m/rad."""
        trace: FloatArray = state.P.trace(axis1=-2, axis2=-1)
        if self._covariance == "by_rows":
            trace = trace.mean(axis=-1)
        return {
            "estimator_updated": state.updated,
            "jacobian_deviation": np.sqrt(trace / state.P.shape[-1]),
        }


def kalman_estimator(
    config: KalmanConfig, knowledge: RobotKnowledge | None = None
) -> RandomWalkEstimator:
    """Return the Kalman filter: x ← x + K (Δy − H x), K = P Hᵀ (H P Hᵀ + R)⁻¹, P in Joseph form.

    Nothing about the robot is needed.
    """
    return RandomWalkEstimator(config, split_update, "shared")


@settings
class UkfConfig(RandomWalk):
    """Settings of the unscented Kalman filter."""

    alpha: Annotated[Positive, Only(form="sigma_points")] = 1.0
    """[1] spread of the sigma points; 1: no negative weights."""
    beta: Annotated[NonNegative, Only(form="sigma_points")] = 2.0
    """[1] prior of the distribution; 2 suits a Gaussian."""
    kappa: Annotated[NonNegative, Only(form="sigma_points")] = 0.0
    """[1] secondary spread."""
    form: Literal["split", "sigma_points"] = "split"
    """Same numbers; "sigma_points" is the reference, several times slower."""


class SigmaWeights(NamedTuple):
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
    r: FloatArray,
    config: UkfConfig,
) -> Corrected:
    """Correct vec(J) by one motion with sigma points; see `split_update`.

    Args:
        J: as there, like the others up to `r`.
        P: covariance of vec(J) by rows after the walk, (..., mn, mn), (m/rad)².
        joint_step: Δq.
        feature_step: Δy.
        r: variance of Δy.
        config: α, β and κ.

    Raises:
        FilterDiverged: P is not positive definite.
    """
    *lead, m, n = J.shape
    size = m * n
    weights = sigma_weights(size, config.alpha, config.beta, config.kappa)
    reach = weights.reach * cholesky_of(P).mT
    centre = np.zeros((*lead, 1, size))
    offsets = np.concatenate([centre, reach, -reach], axis=-2)
    points = J.reshape(*lead, 1, size) + offsets
    # Each point is m rows of J.
    jacobians = points.reshape(*lead, 2 * size + 1, m, n)
    Z = np.matvec(jacobians, joint_step[..., None, :])
    z = np.vecmat(weights.mean, Z)
    deviations = Z - z[..., None, :]
    weighted = weights.covariance[:, None] * deviations
    R = r[..., None, None] * np.eye(m)
    S = deviations.mT @ weighted + R
    C = offsets.mT @ weighted
    K = np.linalg.solve(S, C.mT).mT
    # K S Kᵀ = K Cᵀ, as K S = C.
    P = P - K @ C.mT
    change = np.matvec(K, feature_step - z)
    return J + change.reshape(J.shape), symmetric(P)


def ukf_estimator(
    config: UkfConfig, knowledge: RobotKnowledge | None = None
) -> RandomWalkEstimator:
    """Return the random-walk estimator whose gain is that of the unscented transform.

    The paper gives neither P₀, Q and R nor a rule for an arm at rest; here R is the variance 2σ² of the feature's
    noise, and motions below a minimum ‖Δq‖ are left out.
    """
    if config.form == "split":
        return RandomWalkEstimator(config, split_update, "shared")
    return RandomWalkEstimator(config, partial(unscented_update, config=config), "full")


@settings
class RlsConfig:
    """Settings of recursive least squares."""

    memory: PositiveOrInfinite = 0.975
    """[s] λ = exp(−duration/memory), 0.95 for a motion of 0.05 s."""
    initial_covariance: Positive = 100.0
    """[1/rad²] P₀ = p₀ I: Ĵ₀ weighs as much as a motion of 0.1 rad of each joint."""
    covariance_limit: Positive = 100.0
    """[1/rad²] bound of the mean of P's diagonal."""
    min_joint_step: NonNegative = 0.01
    """[rad] smaller motions are skipped as noise."""

    def __post_init__(self) -> None:
        """Check across fields."""
        limit = self.covariance_limit
        least = self.initial_covariance
        if limit < least:
            raise ValueError(
                f"covariance_limit must be at least initial_covariance = {least:g}, got {limit:g}"
            )


@final
class RlsEstimator(GatedEstimator[WalkState]):
    """`split_update` with r = λ, and P/λ after it; motions below a minimum ‖Δq‖ are left out.

    Forgetting inflates P in directions in which nothing moves, without bound. So P is scaled back to a mean diagonal
    of at most `covariance_limit`; scaling keeps it symmetric and positive definite.
    """

    _config: RlsConfig

    def start(self, jacobian: FloatArray) -> WalkState:
        """Start from Ĵ₀, (..., m, n), m/rad, with P (..., n, n), 1/rad²."""
        *lead, _, n = jacobian.shape
        P = np.eye(n) * self._config.initial_covariance
        P = np.broadcast_to(P, (*lead, n, n))
        return WalkState(jacobian, P, np.full(lead, False))

    def _correct(self, state: WalkState, motion: Motion) -> WalkState:
        config = self._config
        forgetting = np.exp(-np.asarray(motion.duration) / config.memory)
        J, P = split_update(state.J, state.P, motion.joint_step, motion.feature_step, r=forgetting)
        P = P / forgetting[..., None, None]
        kept = np.minimum(1.0, config.covariance_limit / _mean_diagonal(P))
        P = P * kept[..., None, None]
        cholesky_of(P)
        return state._replace(J=J, P=P)

    def diagnostics(self, state: WalkState) -> Diagnostics:
        """Return whether the last motion was used and the mean of P's diagonal, 1/rad²."""
        return {"estimator_updated": state.updated, "covariance_mean": _mean_diagonal(state.P)}


def _mean_diagonal(P: FloatArray) -> FloatArray:
    """Return the mean of the diagonal of P, (...)."""
    return P.trace(axis1=-2, axis2=-1) / P.shape[-1]
