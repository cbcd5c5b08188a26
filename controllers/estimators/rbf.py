"""Estimators with a Gaussian Jacobian network that learns online.

`rbf`, of the proposed method, learns from a window of past motions (eqs. 28–39); `rbf_lyapunov`, of the method RBF +
PID, by a Lyapunov update (eqs. 40–44).
"""

from typing import Annotated, Any, NamedTuple, TypeVar, final

import numpy as np
import numpy.typing as npt
from annotated_types import Lt

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.networks.file import TrainedNetworks
from servobench.plant.contract.checks import FloatArray, IntArray, Shape
from servobench.plant.contract.lanes import norm
from servobench.plant.contract.settings import Count, NonNegative, Positive, settings

REFERENCE_NOISE = 0.001  # [m] noise of the feature for which ε is stated


@settings
class RbfConfig:
    """Settings of the update."""

    window: Count = 8
    """[motions] T, window learned from at once."""
    k2: Annotated[Positive, Lt(2.0)] = 0.5
    """[1] k₂, step size."""
    epsilon: NonNegative = 1e-3
    """[rad²] ε, squared joint motion in the window below which learning fades; grows with identified noise."""
    leak: NonNegative = 0.0
    """[1/s] rate at which learned weights fade (σ-modification); 0 as in the paper."""


def window_step(
    sizes: FloatArray,
    joint_steps: FloatArray,
    count: IntArray,
    k2: float,
    epsilon: npt.ArrayLike,
) -> FloatArray:
    """Return α₂ = k₂ / (ε ‖θ‖² + Σ_t Σ_i Δq²_{i,t} ‖θ_i(q_t)‖²) (eq. 36 with ε), (...); 0 where nothing has moved.

    Args:
        sizes: ‖θ_i(q_t)‖², (..., T, n); 0 for motions that are still missing. ‖θ‖² is their mean.
        joint_steps: Δq_t, (..., T, n), rad.
        count: motions in the window, (...).
        k2: k₂.
        epsilon: ε, (...), rad².
    """
    flat = (*sizes.shape[:-2], -1)
    size = sizes.reshape(flat)
    squares = (joint_steps * joint_steps).reshape(flat)
    entries = count * sizes.shape[-1]
    total = np.vecdot(squares, size)
    total = total + epsilon * np.add.reduce(size, axis=-1) / entries
    moved = total > 0.0
    return np.where(moved, k2 / np.where(moved, total, 1.0), 0.0)[()]


class RbfState(NamedTuple):
    """The state of the update; the window holds the T − 1 motions before the next one, the newest last."""

    rows: FloatArray  # W by rows of the Jacobian, (..., m, n, L), m/rad
    theta: FloatArray  # θ in the window, (..., T−1, U, L); 0 where a motion is still missing, as in the next two
    joint_steps: FloatArray  # Δq of the window, (..., T−1, n), rad
    feature_steps: FloatArray  # Δy of the window, (..., T−1, m), m
    filled: IntArray  # how many motions there are, (...)
    errors: FloatArray  # Δy_t − Ĵ_t Δq_t of the last update, (..., T, m), m
    step: FloatArray  # α₂ of the last update, (...)


class RbfLyapunovState(NamedTuple):
    """W by rows of the Jacobian, (..., m, n, L), m/rad; and s of the last motion, (..., m), m/s."""

    rows: FloatArray
    rate_error: FloatArray


NetworkState = TypeVar("NetworkState", RbfState, RbfLyapunovState)


class NetworkEstimator(Estimator[NetworkState]):
    """A Jacobian network whose weights are updated online.

    It keeps θ and Ĵ of the last joint positions and the change of the last weights, which are asked for more than once.
    That saves time only: they are values of pure functions, and rows of weights never change.
    """

    brings_model = True

    def __init__(self, config: Any, knowledge: RobotKnowledge, networks: TrainedNetworks) -> None:  # noqa: ANN401
        """Take the settings and the offline Jacobian network, from which a run starts."""
        self._config = config
        self._network = networks.jacobian
        self._position = b""
        self._shape: Shape = (-1,)
        self._theta = np.empty(0)
        self._rows = np.empty(0)
        self._jacobian = np.empty(0)
        self._changed = np.empty(0)
        self._change = np.empty(0)

    def _started(self, jacobian: FloatArray) -> FloatArray:
        """Return the offline weights, (..., m, n, L); Ĵ₀, which holds for one joint position alone, is left out."""
        rows: FloatArray = self._network.rows
        return np.broadcast_to(rows, (*jacobian.shape[:-2], *rows.shape))

    def features(self, q: FloatArray) -> FloatArray:
        """Return θ, (..., U, L), at q, (..., n), rad."""
        position = q.tobytes()
        if position != self._position or q.shape != self._shape:
            self._theta = self._network.features(q)
            self._position = position
            self._shape = q.shape
            # Ĵ of the last rows was that at another joint position.
            self._rows = np.empty(0)
        return self._theta

    def jacobian(self, state: NetworkState, joint_position: FloatArray) -> FloatArray:
        """Return Ĵ at `joint_position` (..., n), rad, as (..., m, n) in m/rad."""
        return self._with_rows(state.rows, joint_position)

    def deviation(
        self, state: NetworkState, first: NetworkState | None, joint_position: FloatArray
    ) -> FloatArray:
        """Return the Jacobian of the difference of the weights; see `Estimator.deviation`."""
        if first is None:
            return self.jacobian(state, joint_position)
        if state.rows is not self._changed:
            self._changed = state.rows
            self._change = state.rows - first.rows
        return self._with_rows(self._change, joint_position)

    def _with_rows(self, rows: FloatArray, q: FloatArray) -> FloatArray:
        """Return the Jacobian of weights by rows, (..., m, n), at q, (..., n), rad."""
        theta = self.features(q)
        if rows is not self._rows:
            self._jacobian = self._network.output(rows, theta[..., None, :, :])[..., 0, :, :]
            self._rows = rows
        return self._jacobian


@final
class RbfEstimator(NetworkEstimator[RbfState]):
    """Jacobian network with the paper's windowed gradient update.

        Ĵ_i(q) = W_i θ_i(q)                                                     (eqs. 29, 30)
        W_i ← W_i + α₂ Σ_t (Δy_t − Ĵ_t Δq_t) Δq_{i,t} θ_i(q_t)ᵀ                  (eqs. 31–33)
        α₂ = k₂ / (ε ‖θ‖² + Σ_t Σ_i Δq²_{i,t} ‖θ_i(q_t)‖²),   0 < k₂ < 2         (eq. 36)

    over the last T motions, all with the present weights. Symbols: q joint position (n,) rad; Δq, Δy steps of joints
    (n,) rad and feature (m,) m; W_i weights (m, L) m/rad; θ_i features (L,); T window; k₂, α₂ step sizes; ε rad².

    Departures from the paper: α₂ > 0 (the paper's is negative and enters with a minus sign); ε, in joint motion per
    unit of ‖θ‖², without which the step grows without bound as the arm comes to rest and noise rewrites the network
    there; the leak σ, W ← W − (1 − exp(−σ Δt)) (W − W(0)), without which an estimated map (aid `model`) and the network
    turn against each other, since many pairs of them give the same Ĵ: in half an hour on a circle the map turned by
    0.8 rad and the network turned back; the sum in α₂ runs over the same window as the gradient (the paper's has one
    term more).
    """

    _config: RbfConfig

    def start(self, jacobian: FloatArray) -> RbfState:
        """Start from the offline network, without regard to Ĵ₀."""
        lead = jacobian.shape[:-2]
        window = self._config.window
        network = self._network
        before = (*lead, window - 1)
        theta = np.zeros((*before, *network.layers))
        joint_steps = np.zeros((*before, network.n))
        feature_steps = np.zeros((*before, network.m))
        filled = np.zeros(lead, dtype=np.int_)
        errors = np.zeros((*lead, window, network.m))
        step = np.zeros(lead)
        rows = self._started(jacobian)
        return RbfState(rows, theta, joint_steps, feature_steps, filled, errors, step)

    def update(self, state: RbfState, motion: Motion) -> RbfState:
        """Learn from the window that `motion` completes."""
        config = self._config
        network = self._network
        epsilon: FloatArray | float = config.epsilon
        if motion.noise is not None:
            ratio = motion.noise / REFERENCE_NOISE
            epsilon = epsilon * (ratio * ratio)
        theta_t = self.features(motion.joint_position)[..., None, :, :]
        dq_t = motion.joint_step[..., None, :]
        dy_t = motion.feature_step[..., None, :]
        theta = np.concatenate([state.theta, theta_t], axis=-3)
        joint_steps = np.concatenate([state.joint_steps, dq_t], axis=-2)
        feature_steps = np.concatenate([state.feature_steps, dy_t], axis=-2)
        jacobians = network.output(state.rows, theta)
        errors = feature_steps - np.matvec(jacobians, joint_steps)
        filled = np.minimum(state.filled + 1, config.window)
        sizes = np.vecdot(theta, theta).take(network.layer_of, axis=-1)
        step = window_step(sizes, joint_steps, filled, config.k2, epsilon)
        scaled = step[..., None, None] * errors
        rows = network.gradient(scaled, joint_steps, theta)
        np.add(rows, state.rows, out=rows)
        if config.leak:
            gone = -np.expm1(-config.leak * motion.duration)
            rows -= gone[..., None, None, None] * (rows - network.rows)
        return RbfState(
            rows=rows,
            theta=theta[..., 1:, :, :],
            joint_steps=joint_steps[..., 1:, :],
            feature_steps=feature_steps[..., 1:, :],
            filled=filled,
            errors=errors,
            step=step,
        )

    def diagnostics(self, state: RbfState) -> Diagnostics:
        """Return the step size α₂, the root of Q, the window's prediction error (m), and the norm of all weights."""
        lead = state.step.shape
        errors = state.errors.reshape(*lead, -1)
        weights = state.rows.reshape(*lead, -1)
        return {
            "estimator_step_size": state.step,
            "window_error": norm(errors),
            "estimator_weight_norm": norm(weights),
        }


@settings
class RbfLyapunovConfig:
    """Settings of the update; the gains are small because they are multiplied by ‖θ‖² of some ten."""

    n2: Positive = 0.005
    """[1/(m s)] n₂, weight of the error."""
    n3: Positive = 0.05
    """[1/m] n₃, weight of the prediction error."""


@final
class RbfLyapunovEstimator(NetworkEstimator[RbfLyapunovState]):
    """Jacobian network whose update makes V = ½ n₂ eᵀe + ½ Σ‖W̃_i‖² decrease under u = K_p Ĵ⁺ e.

        Ĵ_i(q) = W_i θ_i(q)                                            (eqs. 40, 41)
        Ẇ_i = q̇_i (n₃ s − n₂ e) θ_i(q)ᵀ,   s = ẏ − Ĵ q̇                  (eq. 42)
        V̇ = −K_p n₂ ‖e‖² − n₃ ‖s‖² ≤ 0                                 (eq. 44)

    Symbols: e = y_ref − y (m,) m; s prediction error (m,) m/s; q̇ (n,) rad/s; W_i weights (m, L) m/rad; W̃_i their
    error; θ_i features (L,); n₂ and n₃ gains. Discretised with the duration of the motion: W_i ← W_i + ΔW_i with
    ΔW_i = Δq_i (n₃ s − n₂ e) θ_iᵀ.

    Departures from the paper: n₂ enters with a minus, since e = y_ref − y here and y − y_ref there. V̇ ≤ 0 holds for a
    target at rest; a moving one adds n₂ eᵀẏ_ref to V̇, which no choice of Ẇ cancels: the update stays as it is (s does
    not see the target), and the law may cancel the term by feeding ẏ_ref forward. In discrete time the gains must be
    small: n₃ Σ Δq_i² ‖θ_i‖² / duration < 2 for the s-part alone.
    """

    _config: RbfLyapunovConfig

    def start(self, jacobian: FloatArray) -> RbfLyapunovState:
        """Start from the offline network, without regard to Ĵ₀."""
        return RbfLyapunovState(self._started(jacobian), np.zeros(jacobian.shape[:-1]))

    def update(self, state: RbfLyapunovState, motion: Motion) -> RbfLyapunovState:
        """Learn from one motion."""
        q = motion.joint_position
        dq = motion.joint_step
        theta = self.features(q)
        unexplained = motion.feature_step - np.matvec(self.jacobian(state, q), dq)
        s = unexplained / np.asarray(motion.duration)[..., None]
        pull = self._config.n3 * s - self._config.n2 * motion.error
        rows = self._network.gradient(pull[..., None, :], dq[..., None, :], theta[..., None, :, :])
        np.add(rows, state.rows, out=rows)
        return RbfLyapunovState(rows, s)

    def diagnostics(self, state: RbfLyapunovState) -> Diagnostics:
        """Return ‖s‖, the prediction error of the feature's velocity (m/s), and the norm of all weights."""
        flat = state.rows.reshape(*state.rows.shape[:-3], -1)
        return {"rate_error": norm(state.rate_error), "estimator_weight_norm": norm(flat)}
