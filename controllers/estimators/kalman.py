"""Kalman filter for the Jacobian: a random walk that every motion measures; and the estimator of all such filters.

State x = vec(J) by rows, (mn,), so that entry i·n + j is ∂y_i/∂q_j:

    x(k) = x(k−1) + w,   w ~ N(0, Q)
    Δy(k) = H x(k) + v,  H = I_m ⊗ Δqᵀ,  v ~ N(0, R),  R = 2σ² I  (Δy is the difference of two measurements)

The measurement is linear in x, so this filter and the unscented one of `controllers.estimators.ukf` are the same.
With P₀ = p₀ I, Q = q I and R = r I it splits into m filters of n states, one a feature, that share one covariance.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple, TypeAlias, final

import numpy as np

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import GatedEstimator, Motion
from servobench.plant.contract.checks import FloatArray, is_finite
from servobench.plant.contract.faults import FilterDiverged
from servobench.plant.contract.lanes import outer, plus_diagonal, transposed
from servobench.plant.contract.settings import Deviation, NonNegative, Positive, settings
from servobench.plant.contract.signals import BoolArray


@settings
class RandomWalk:
    """Settings of every filter in which the Jacobian is a random walk."""

    initial_deviation: Positive = 0.05
    """[m/rad] of an entry of Ĵ₀; tuned for the Kalman filter: with a larger one latency spoils the first motions."""
    walk: NonNegative = 0.089443
    """[m/rad/√s] deviation of an entry after a second of motion; tuned for the Kalman filter."""
    feature_noise: Deviation = 0.001
    """[m] standard deviation σ of the feature per axis, unless it is identified."""
    min_joint_step: NonNegative = 0.002
    """[rad] smaller motions are left out: they hold little but 1 mm of noise."""


@settings
class KalmanConfig(RandomWalk):
    """Settings of the Kalman filter."""

    form: Literal["split", "full"] = "split"
    """Two computations of the same numbers; "full" is the readable reference."""


def cholesky_of(P: FloatArray) -> FloatArray:
    """Return the lower Cholesky factor of covariances (..., s, s).

    Raises:
        FilterDiverged: one of them is not finite or not positive definite.
    """
    try:
        L = np.asarray(np.linalg.cholesky(P))
    except np.linalg.LinAlgError as error:
        lowest = float(np.linalg.eigvalsh(P).min())
        raise FilterDiverged(f"covariance is not positive definite: smallest eigenvalue {lowest:.3e}") from error
    if not is_finite(L):  # LAPACK lets NaN pass
        raise FilterDiverged(f"covariance is not finite: diagonal {np.diagonal(P, axis1=-2, axis2=-1).tolist()}")
    return L


def measurement_matrix(joint_step: FloatArray, m: int) -> FloatArray:
    """Return H = I_m ⊗ Δqᵀ, (..., m, mn), for Δq (..., n)."""
    H = np.zeros((*joint_step.shape[:-1], m, m, joint_step.shape[-1]))
    for i in range(m):
        H[..., i, i, :] = joint_step
    return H.reshape(*H.shape[:-2], -1)


def kalman_update(
    x: FloatArray, P: FloatArray, H: FloatArray, z: FloatArray, *, Q: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Predict a random walk and correct it by one measurement, covariance in Joseph form.

    Args:
        x: state, (..., s).
        P: its covariance, (..., s, s).
        H: measurement matrix, (..., m, s).
        z: measurement, (..., m).
        Q: process covariance, (..., s, s).
        R: measurement covariance, (..., m, m).

    Returns:
        The new state and covariance.
    """
    P = P + Q
    HP = H @ P
    K = transposed(np.linalg.solve(HP @ transposed(H) + R, HP))
    A = np.eye(x.shape[-1]) - K @ H
    P = A @ P @ transposed(A) + K @ R @ transposed(K)
    return x + np.matvec(K, z - np.matvec(H, x)), (P + transposed(P)) / 2


def split_update(
    J: FloatArray, P: FloatArray, joint_step: FloatArray, feature_step: FloatArray, *, q: FloatArray, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Do the same for P = I_m ⊗ P_n, Q = q I, R = r I: all rows of J share the gain K (n,).

        P ← P + q I,   K = PΔq / (ΔqᵀPΔq + r),   J ← J + (Δy − JΔq) Kᵀ,   P ← (I − KΔqᵀ) P (I − KΔqᵀ)ᵀ + r K Kᵀ

    Args:
        J: Jacobian, (..., m, n), m/rad.
        P: covariance of each of its rows, (..., n, n), (m/rad)².
        joint_step: Δq, (..., n), rad.
        feature_step: Δy, (..., m), m.
        q: variance of the walk, (...), (m/rad)².
        r: variance of Δy, (...), m².

    Returns:
        The new Jacobian and covariance.
    """
    P = plus_diagonal(P, q[..., None])
    PH = np.matvec(P, joint_step)
    K = PH / (np.vecdot(joint_step, PH) + r)[..., None]
    # (I − KΔqᵀ) P (I − KΔqᵀ)ᵀ + r K Kᵀ with A = P − K PHᵀ multiplied out: A − (A Δq) Kᵀ + r K Kᵀ
    A = P - outer(K, PH)
    P = A + outer(r[..., None] * K - np.matvec(A, joint_step), K)
    return J + outer(feature_step - np.matvec(J, joint_step), K), (P + transposed(P)) / 2


def full_update(
    J: FloatArray, P: FloatArray, joint_step: FloatArray, feature_step: FloatArray, *, q: FloatArray, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Do the same by `kalman_update`, for P, (..., mn, mn), of all entries."""
    H = measurement_matrix(joint_step, J.shape[-2])
    x, P = kalman_update(J.reshape(*J.shape[:-2], -1), P, H, feature_step, **full_covariances(J, q, r))
    return x.reshape(J.shape), P


def full_covariances(J: FloatArray, q: FloatArray, r: FloatArray) -> dict[str, FloatArray]:
    """Return Q = q I, (..., mn, mn), and R = r I, (..., m, m), by name, for J (..., m, n)."""
    m, n = J.shape[-2:]
    return {"Q": q[..., None, None] * np.eye(m * n), "R": r[..., None, None] * np.eye(m)}


Update: TypeAlias = Callable[..., tuple[FloatArray, FloatArray]]
"""The formula by which a filter corrects the Jacobian and its covariance, called as `split_update`; the shape of P
depends on the filter, see `Covariance`."""
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
        self._formula, self._covariance = update, covariance
        self._walk = config.walk**2
        self._noise: FloatArray = np.asarray(config.feature_noise)[()]

    def start(self, jacobian: FloatArray) -> WalkState:
        """Start from Ĵ₀, (..., m, n), m/rad, with the configured covariance."""
        *lead, m, n = jacobian.shape
        shapes: dict[Covariance, tuple[int, ...]] = {"shared": (n, n), "by_rows": (m, n, n), "full": (m * n, m * n)}
        shape = shapes[self._covariance]
        P = np.broadcast_to(np.eye(shape[-1]) * self._config.initial_deviation**2, (*lead, *shape))
        return WalkState(jacobian, P, np.full(lead, False))

    def _correct(self, state: WalkState, motion: Motion) -> WalkState:
        noise: FloatArray = self._noise if motion.noise is None else motion.noise
        q, r = self._walk * np.asarray(motion.duration), 2.0 * noise * noise
        J, P = self._formula(state.J, state.P, motion.joint_step, motion.feature_step, q=q, r=r)
        cholesky_of(P)
        return state._replace(J=J, P=P)

    def diagnostics(self, state: WalkState) -> Diagnostics:
        """Return whether the last motion was used and the mean deviation of an entry of the Jacobian, m/rad."""
        trace: FloatArray = state.P.trace(axis1=-2, axis2=-1)
        if self._covariance == "by_rows":
            trace = trace.mean(axis=-1)
        return {"estimator_updated": state.updated, "jacobian_deviation": np.sqrt(trace / state.P.shape[-1])}


def kalman_estimator(config: KalmanConfig, knowledge: RobotKnowledge | None = None) -> RandomWalkEstimator:
    """Return the Kalman filter: x ← x + K (Δy − H x), K = P Hᵀ (H P Hᵀ + R)⁻¹, P in Joseph form.

    Nothing about the robot is needed.
    """
    if config.form == "split":
        return RandomWalkEstimator(config, split_update, "shared")
    return RandomWalkEstimator(config, full_update, "full")
