"""What the correntropy filters share: a random walk of J, seen through motions whose noise has outliers.

All of them are the Kalman filter of `controllers.estimators.kalman` with weights in (0, 1] on the measurement, and some
on the prior: a large normalised error e gets a small weight, such as G(e) = exp(−e²/(2b²)) with the bandwidth b. With
P₀ = p₀ I, Q = q I and R = r I each row of J, one a feature, has a covariance of its own, (n, n), so that the matrices
of size mn of the papers fall apart into rows, exactly; only the weights may join them:

    P ← P + q I,   B Bᵀ = P,   ν_i = Δy_i − J_i Δq,   h_i = B_iᵀ Δq
    K_i = w_i B_i X_i⁻¹ h_i / (w_i h_iᵀ X_i⁻¹ h_i + r)          w_i weight of Δy_i, X_i diagonal, weights of the prior
    J_i ← J_i + ν_i K_iᵀ,   P_i ← (I − K_iΔqᵀ) P_i (I − K_iΔqᵀ)ᵀ + r K_i K_iᵀ

A weight of 0 leaves the row as it was. As b grows without limit all of them become the Kalman filter.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol, final

import numpy as np

from servobench.controllers.controller import Diagnostics
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.estimators.kalman import KalmanState, cholesky_of
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, norm, outer, transposed
from servobench.plant.contract.signals import BoolArray

MAX_EXPONENT = 40.0  # a weight of exp(−40) is as good as none, and can be divided by


class Update(Protocol):
    """The formula of a filter.

    Args:
        J: Ĵ before the motion, (..., m, n), m/rad.
        P: covariance of each row with the walk added, (..., m, n, n), (m/rad)².
        joint_step: Δq, (..., n), rad.
        feature_step: Δy, (..., m), m.
        r: variance of each component of Δy, (...), m².

    Returns:
        Ĵ and P after the motion.
    """

    def __call__(  # noqa: D102 - of the class
        self, J: FloatArray, P: FloatArray, joint_step: FloatArray, feature_step: FloatArray, *, r: FloatArray
    ) -> tuple[FloatArray, FloatArray]: ...


class WalkSettings(Protocol):
    """What the settings of every filter have; see `KalmanConfig`."""

    @property
    def initial_deviation(self) -> float: ...  # noqa: D102 - of the class
    @property
    def walk(self) -> float: ...  # noqa: D102
    @property
    def feature_noise(self) -> float: ...  # noqa: D102
    @property
    def min_joint_step(self) -> float: ...  # noqa: D102


def gaussian_weight(error: FloatArray, bandwidth: float) -> FloatArray:
    """Return G(e) = exp(−e²/(2b²)), from exp(−`MAX_EXPONENT`) to 1, for normalised errors of any shape."""
    return np.exp(-np.minimum(error * error / (2.0 * bandwidth**2), MAX_EXPONENT))


def corrected(
    J: FloatArray, P: FloatArray, gain: FloatArray, joint_step: FloatArray, feature_step: FloatArray, *, r: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return Ĵ and P after a motion with a gain K of each row, (..., m, n), P in Joseph form; see `Update`."""
    dq = joint_step[..., None, :]
    A = P - outer(gain, np.matvec(P, dq))
    P = A + outer(r[..., None, None] * gain - np.matvec(A, dq), gain)
    innovation = feature_step - np.matvec(J, joint_step)
    return J + innovation[..., None] * gain, (P + transposed(P)) / 2


class Iterate(NamedTuple):
    """A step of the fixed-point iteration.

    Attributes:
        J: the present Ĵ, (..., m, n), m/rad.
        gain: K of each row, (..., m, n), rad⁻¹.
        prior: error of the prior as B⁻¹ (J⁻ − J), (..., m, n), 1.
        moves: (...), whether Ĵ changed by more than the tolerance.
    """

    J: FloatArray
    gain: FloatArray
    prior: FloatArray
    moves: BoolArray


def fixed_point_update(
    J: FloatArray,
    P: FloatArray,
    joint_step: FloatArray,
    feature_step: FloatArray,
    *,
    r: FloatArray,
    weight: Callable[[FloatArray], FloatArray],
    tolerance: float,
    iterations: int,
) -> tuple[FloatArray, FloatArray]:
    """Correct by one motion with weights of measurement and prior that belong to the corrected estimate itself.

    With e = [B⁻¹ (J⁻ − J), (Δy − J Δq)/√r] the gain is that of the weights w(e), until J changes by less than the
    tolerance times its norm; it begins at J⁻.

    Args:
        J: J⁻; see `Update`, as for the others up to `r`.
        P: its covariance.
        joint_step: Δq.
        feature_step: Δy.
        r: variance of each component of Δy.
        weight: w, of normalised errors; above 0.
        tolerance: of the change of J, relative.
        iterations: the most of them.

    Raises:
        FilterDiverged: a covariance is not positive definite.
    """
    B = cholesky_of(P)
    h = np.vecmat(joint_step[..., None, :], B)

    def improved(
        at: Iterate, J: FloatArray, B: FloatArray, h: FloatArray, dq: FloatArray, dy: FloatArray, r: FloatArray
    ) -> Iterate:
        error = (dy - np.matvec(at.J, dq)) / np.sqrt(r)[..., None]
        spread, w = h / weight(at.prior), weight(error)
        share = w / (w * np.vecdot(h, spread) + r[..., None])
        gain = share[..., None] * np.matvec(B, spread)
        nu = dy - np.matvec(J, dq)
        new = J + nu[..., None] * gain
        change, size = (norm(each.reshape(*each.shape[:-2], -1)) for each in (new - at.J, at.J))
        return Iterate(new, gain, -(share * nu)[..., None] * spread, change > tolerance * size)

    at = Iterate(J, np.zeros_like(J), np.zeros_like(J), np.ones_like(r, dtype=np.bool_)[()])
    for _ in range(iterations):
        if not np.any(at.moves):
            break
        at = branch(at.moves, improved, at, J, B, h, joint_step, feature_step, r)
    return corrected(J, P, at.gain, joint_step, feature_step, r=r)


@final
class CorrentropyEstimator(Estimator[KalmanState]):
    """The random walk of J, corrected by the formula of a filter; motions below a minimum ‖Δq‖ are left out."""

    def __init__(self, config: WalkSettings, update: Update) -> None:
        """Take the settings of the walk and the formula."""
        self._config, self._formula = config, update
        self._walk = config.walk**2
        self._noise: FloatArray = np.asarray(config.feature_noise)[()]

    def start(self, jacobian: FloatArray) -> KalmanState:
        """Start from Ĵ₀, (..., m, n), m/rad, with the configured covariance of each row."""
        *lead, m, n = jacobian.shape
        P = np.broadcast_to(np.eye(n) * self._config.initial_deviation**2, (*lead, m, n, n))
        return KalmanState(jacobian, P, np.full(lead, False))

    def update(self, state: KalmanState, motion: Motion) -> KalmanState:
        """Correct by one motion.

        Raises:
            FilterDiverged: a covariance is no longer positive definite.
        """
        large = norm(motion.joint_step) >= self._config.min_joint_step
        return branch(large, self._correct, state._replace(updated=large), motion)

    def _correct(self, state: KalmanState, motion: Motion) -> KalmanState:
        noise: FloatArray = self._noise if motion.noise is None else motion.noise
        q, r = self._walk * np.asarray(motion.duration), 2.0 * noise * noise
        P = state.P + q[..., None, None, None] * np.eye(state.P.shape[-1])
        r = np.broadcast_to(r, q.shape)[()]
        J, P = self._formula(state.J, P, motion.joint_step, motion.feature_step, r=r)
        cholesky_of(P)
        return state._replace(J=J, P=P)

    def diagnostics(self, state: KalmanState) -> Diagnostics:
        """Return whether the last motion was used and the mean deviation of an entry of the Jacobian, m/rad."""
        variance = state.P.trace(axis1=-2, axis2=-1).mean(axis=-1) / state.P.shape[-1]
        return {"estimator_updated": state.updated, "jacobian_deviation": np.sqrt(variance)}
