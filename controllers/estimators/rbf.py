"""Estimator of the proposed method: a Gaussian Jacobian network, updated from a window of past motions (eqs. 28–39)."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import Annotated, final

import numpy as np
from annotated_types import Lt

from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator, Motion
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.rbf import LatestFeatures, jacobian_output
from servobench.plant.checks import FloatArray
from servobench.plant.settings import Count, NonNegative, Positive, settings


@settings
class RbfConfig:
    """Settings of the update."""

    window: Count = 8
    """[motions] T, from which is learned at once."""
    k2: Annotated[Positive, Lt(2.0)] = 0.5
    """[1] k₂, step size."""
    epsilon: NonNegative = 1e-3
    """[rad²] ε, joint motion (squared, summed over the window) below which learning fades."""


def window_gradient(weights: FloatArray, moved: FloatArray, feature_steps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return −½ ∂Q/∂W of the window's squared prediction error (eqs. 31, 32) and the errors themselves.

    With μ_t = [Δq_{1,t} θ_1(q_t) … Δq_{n,t} θ_n(q_t)] and W = [W_1 … W_n] is Ĵ_t Δq_t = W μ_t, all columns at once.

    Args:
        weights: W, (m, n L), m/rad.
        moved: μ_t, (T, n L), rad.
        feature_steps: Δy_t, (T, m), m.

    Returns:
        G = Σ_t (Δy_t − W μ_t) μ_tᵀ, (m, n L), and Δy_t − W μ_t, (T, m).
    """
    error = feature_steps - moved @ weights.T
    return error.T @ moved, error


def window_step(squares: Collection[tuple[float, float]], k2: float, epsilon: float) -> float:
    """Return α₂ = k₂ / (ε ‖θ‖² + Σ_t ‖μ_t‖²) (eq. 36 with ε); 0 where nothing has moved.

    Args:
        squares: for each motion of the window the mean of ‖θ_i(q_t)‖² over the columns, and
            ‖μ_t‖² = Σ_i Δq²_{i,t} ‖θ_i(q_t)‖², rad²; ‖θ‖² is the mean of the first over the window.
        k2: k₂.
        epsilon: ε, rad².
    """
    total = epsilon * sum(theta for theta, _ in squares) / len(squares) + sum(moved for _, moved in squares)
    return k2 / total if total > 0.0 else 0.0


@final
class RbfEstimator(Estimator):
    """Jacobian network with the paper's windowed gradient update.

        Ĵ_i(q) = W_i θ_i(q)                                                     (eqs. 29, 30)
        W_i ← W_i + α₂ Σ_t (Δy_t − Ĵ_t Δq_t) Δq_{i,t} θ_i(q_t)ᵀ                  (eqs. 31–33)
        α₂ = k₂ / (ε ‖θ‖² + Σ_t Σ_i Δq²_{i,t} ‖θ_i(q_t)‖²),   0 < k₂ < 2         (eq. 36)

    over the last T motions, all with the present weights. Symbols: q joint position (n,) rad; Δq, Δy steps of joints
    (n,) rad and feature (m,) m; W_i weights (m, L) m/rad; θ_i features (L,); T window; k₂, α₂ step sizes; ε rad².

    Departures from the paper: α₂ > 0 (the paper's is negative and enters with a minus sign); ε, in joint motion per
    unit of ‖θ‖², without which the step grows without bound as the arm comes to rest and noise rewrites the network
    there; the sum in α₂ runs over the same window as the gradient (the paper's has one term more).
    """

    def __init__(self, config: RbfConfig, knowledge: RobotKnowledge, networks: TrainedNetworks) -> None:
        """Start from the offline Jacobian network."""
        self._config = config
        self._network = networks.jacobian
        self._features = LatestFeatures(self._network)
        self._count = 0
        self._restore()

    @property
    def weights(self) -> FloatArray:
        """W as it is now, (n, m, L), m/rad; a copy."""
        return np.array(self._columns())

    def reset(self, jacobian: FloatArray) -> None:
        """Forget everything and restore the offline network.

        Args:
            jacobian: Ĵ₀, (m, n); only its size is looked at. The network is itself the initial Jacobian, for all joint
                positions; one matrix without its joint position holds less.

        Raises:
            ValueError: `jacobian` is of another size than the network.
        """
        if jacobian.shape != (self._network.m, self._network.n):
            raise ValueError(f"jacobian must have shape {(self._network.m, self._network.n)}, got {jacobian.shape}")
        self._restore()

    def update(self, motion: Motion) -> None:
        """Learn from the window that `motion` completes."""
        theta = self._features.at(motion.joint_position)
        row = self._count % self._config.window
        moved = self._moved[row]
        np.multiply(motion.joint_step[:, None], theta, out=moved.reshape(theta.shape))
        self._feature_steps[row] = motion.feature_step
        self._squares.append((float(np.vdot(theta, theta)) / len(theta), float(np.vdot(moved, moved))))
        self._count += 1
        filled = slice(min(self._count, self._config.window))
        gradient, self._error = window_gradient(self._weights, self._moved[filled], self._feature_steps[filled])
        self._step = window_step(self._squares, self._config.k2, self._epsilon)
        gradient *= self._step
        self._weights += gradient

    def scale_epsilon(self, factor: float) -> None:
        """Use `factor` times the configured ε, for a feature whose variance is so many times the assumed one."""
        self._epsilon = factor * self._config.epsilon

    def jacobian(self, joint_position: FloatArray) -> FloatArray:
        """Return Ĵ at `joint_position` (n,), rad."""
        return jacobian_output(self._columns(), self._features.at(joint_position))

    def diagnostics(self) -> Diagnostics:
        """Return the step size α₂, the root of Q, the window's prediction error (m), and the norm of all weights."""
        return {
            "estimator_step_size": self._step,
            "window_error": float(np.linalg.norm(self._error)),
            "estimator_weight_norm": float(np.linalg.norm(self._weights)),
        }

    def _columns(self) -> FloatArray:
        """Return W_i as a view, (n, m, L), of the weights, (m, n L)."""
        network = self._network
        return self._weights.reshape(network.m, network.n, -1).swapaxes(0, 1)

    def _restore(self) -> None:
        network, window = self._network, self._config.window
        self._weights = network.weights.swapaxes(0, 1).reshape(network.m, -1).copy()
        self._moved: FloatArray = np.empty((window, self._weights.shape[1]))  # μ_t; the oldest row is overwritten
        self._feature_steps: FloatArray = np.empty((window, network.m))
        self._squares: deque[tuple[float, float]] = deque(maxlen=window)
        self._count = 0
        self._epsilon = self._config.epsilon
        self._error = np.zeros((1, network.m))
        self._step = 0.0
