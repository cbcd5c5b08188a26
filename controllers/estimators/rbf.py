"""Estimator of the proposed method: a Gaussian Jacobian network, updated from a window of past motions (eqs. 28–39)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import final

import numpy as np

from controllers.controller import Diagnostics
from controllers.estimators.estimator import Estimator, Motion
from controllers.networks import JacobianNetwork, jacobian_features, jacobian_output
from plant.signals import FloatArray, check_number


@dataclass(frozen=True)
class RbfConfig:
    """Settings of the update."""

    window: int = 8  # T, motions that are learned from at once
    k2: float = 0.5  # k₂, step size, 0 < k₂ < 2
    epsilon: float = 1e-3  # ε, rad², joint motion (squared, summed over the window) below which learning fades

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_number("window", self.window, at_least=1)
        check_number("k2", self.k2, above=0.0, below=2.0)
        check_number("epsilon", self.epsilon, at_least=0.0)


def window_gradient(
    weights: FloatArray, theta: FloatArray, joint_steps: FloatArray, feature_steps: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return −½ ∂Q/∂W of the window's squared prediction error (eqs. 31, 32) and the errors themselves.

    Args:
        weights: W, (n, m, L), m/rad.
        theta: θ(q_t), (T, n, L).
        joint_steps: Δq_t, (T, n), rad.
        feature_steps: Δy_t, (T, m), m.

    Returns:
        G_i = Σ_t (Δy_t − Ĵ_t Δq_t) Δq_{i,t} θ_i(q_t)ᵀ, (n, m, L), and Δy_t − Ĵ_t Δq_t, (T, m).
    """
    moved = joint_steps[:, :, None] * theta
    error = feature_steps - np.einsum("iml,til->tm", weights, moved, optimize=True)
    return np.einsum("tm,til->iml", error, moved, optimize=True), error


def window_step(theta: FloatArray, joint_steps: FloatArray, k2: float, epsilon: float) -> float:
    """Return α₂ = k₂ / (ε ‖θ‖² + Σ_t Σ_i Δq²_{i,t} ‖θ_i(q_t)‖²) (eq. 36 with ε); 0 where nothing has moved.

    Args:
        theta: θ(q_t), (T, n, L).
        joint_steps: Δq_t, (T, n), rad.
        k2: k₂.
        epsilon: ε, rad²; ‖θ‖² is the mean of ‖θ_i(q_t)‖² over columns and window.
    """
    size = np.einsum("til,til->ti", theta, theta)
    total = epsilon * float(size.mean()) + float(np.vdot(joint_steps**2, size))
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

    def __init__(self, config: RbfConfig, network: JacobianNetwork) -> None:
        """Start from the offline `network`."""
        self._config = config
        self._network = network
        self._weights = network.weights
        self._restore()

    @property
    def weights(self) -> FloatArray:
        """W as it is now, (n, m, L), m/rad; a copy."""
        return np.array(self._weights)

    def reset(self, jacobian: FloatArray) -> None:
        """Forget everything and restore the offline network.

        Args:
            jacobian: Ĵ₀, (m, n); only its size is looked at. The network is itself the initial Jacobian, for all joint
                positions; one matrix, whose joint position is not told, says less.

        Raises:
            ValueError: `jacobian` is of another size than the network.
        """
        if jacobian.shape != (self._network.m, self._network.n):
            raise ValueError(f"jacobian must have shape {(self._network.m, self._network.n)}, got {jacobian.shape}")
        self._restore()

    def update(self, motion: Motion) -> None:
        """Learn from the window that `motion` completes."""
        theta = jacobian_features(motion.joint_position, self._network.centres, self._network.widths)
        self._window.append((theta, motion.joint_step, motion.feature_step))
        thetas, joint_steps, feature_steps = (np.array(column) for column in zip(*self._window, strict=True))
        gradient, error = window_gradient(self._weights, thetas, joint_steps, feature_steps)
        self._step = window_step(thetas, joint_steps, self._config.k2, self._config.epsilon)
        self._weights = self._weights + self._step * gradient
        self._window_error = float(np.linalg.norm(error))

    def jacobian(self, joint_position: FloatArray) -> FloatArray:
        """Return Ĵ at `joint_position` (n,), rad."""
        theta = jacobian_features(joint_position, self._network.centres, self._network.widths)
        return jacobian_output(self._weights, theta)

    def diagnostics(self) -> Diagnostics:
        """Return the step size α₂, the root of Q, the window's prediction error (m), and the norm of all weights."""
        return {
            "estimator_step_size": self._step,
            "window_error": self._window_error,
            "estimator_weight_norm": float(np.linalg.norm(self._weights)),
        }

    def _restore(self) -> None:
        self._weights = self._network.weights.copy()
        self._window: deque[tuple[FloatArray, FloatArray, FloatArray]] = deque(maxlen=self._config.window)
        self._step = 0.0
        self._window_error = 0.0
