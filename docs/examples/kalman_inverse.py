"""A law of one's own with aids and without: a damped pseudo-inverse with a Kalman filter for the Jacobian.

servobench compare --controllers ./kalman_inverse.py:KalmanInverse,./kalman_inverse.py:KalmanInverseAlone,ukf_mfac
"""

from dataclasses import dataclass

import numpy as np

import servobench


@dataclass(frozen=True)
class KalmanInverseConfig:
    """Settings: --set KalmanInverse.law.gain=12."""

    gain: float = 6.0  # [1/s]
    damping: float = 0.02  # [m/rad]
    prior: float = 0.1  # [m/rad] deviation of an entry of E at first
    walk: float = 0.02  # [m/rad] by which an entry of E may change from one motion to the next
    noise: float = 0.0015  # [m] of the feature
    shortest: float = 0.01  # [rad] motion from which something is learned


class KalmanInverse(servobench.Controller):
    """u = gain Ĵᵀ (Ĵ Ĵᵀ + damping² I)⁻¹ e with Ĵ = J(q) + E.

    The rows of E (m, n) are a random walk with the common covariance P (n, n); a motion is Δy = (J + E) Δq + noise:

        k = P Δq / (Δqᵀ P Δq + 2 noise²),   E ← E + (Δy − Ĵ Δq) kᵀ,   P ← P − k Δqᵀ P
    """

    aids = servobench.EQUIPPED

    def __init__(self, config: KalmanInverseConfig, knowledge):
        # In `step` the aids correct it
        self.config, self.jacobian = (config, knowledge.nominal_jacobian)

    def reset(self, observation, seed):
        self.q, self.y = observation.joint_position, observation.feature
        self.E = np.zeros((len(self.y), len(self.q)))
        self.P = self.config.prior**2 * np.eye(len(self.q))

    def step(self, observation, reference):
        q, y = observation.joint_position, observation.feature
        if observation.feature_valid and np.linalg.norm(q - self.q) > self.config.shortest:
            self.learn(q - self.q, y - self.y)
            self.q, self.y = q, y
        J = self.J = self.jacobian(q) + self.E
        e = reference[0] - y
        damped = J @ J.T + self.config.damping**2 * np.eye(len(e))
        return servobench.Command(self.config.gain * J.T @ np.linalg.solve(damped, e))

    def learn(self, dq, dy):
        misfit = dy - (self.jacobian(self.q + 0.5 * dq) + self.E) @ dq
        P = self.P + self.config.walk**2 * np.eye(len(dq))
        k = P @ dq / (dq @ P @ dq + 2.0 * self.config.noise**2)
        self.E, self.P = self.E + np.outer(misfit, k), P - np.outer(k, P @ dq)


class KalmanInverseAlone(KalmanInverse):
    """The same without aids; only the joint-speed limits are kept for it."""

    aids = {}  # noqa: RUF012 - read once
