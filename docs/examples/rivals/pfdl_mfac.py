"""Model-free adaptive control that remembers several commands: partial-form dynamic linearisation (PFDL).

    servobench compare --controllers ./pfdl_mfac.py:PfdlMfac,./pfdl_mfac.py:PfdlMfacAlone,regression_mfac \
        --tasks random --seeds 20 --out pfdl

Sources: Z. Hou and S. Jin, "Data-driven model-free adaptive control for a class of MIMO nonlinear discrete-time
systems", IEEE Trans. Neural Netw. 22(12), 2011, and their book "Model Free Adaptive Control: Theory and Applications",
CRC Press, 2013. The method `cfdl_mfac` of the bench is the compact form, with the last command alone.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated

import numpy as np

import servobench

KEPT = 0.1  # [1] share of the nominal Jacobian below which Φ₁ has turned away from it


@dataclass(frozen=True)
class PfdlMfacConfig:
    """Settings, with the ranges in which `servobench tune` searches."""

    gain: Annotated[float, servobench.Tuned(0.5, 40.0, log=True)] = 3.0  # [1/s] K
    step_weight: Annotated[float, servobench.Tuned(1e-4, 0.2, log=True)] = 0.02  # [m²/rad²] λ
    memory: Annotated[float, servobench.Tuned(0.05, 0.4)] = 0.15  # [s] L periods, at least one
    step_factor: Annotated[float, servobench.Tuned(0.01, 1.9, log=True)] = 0.5  # [1] η
    regularisation: Annotated[float, servobench.Tuned(1e-5, 0.1, log=True)] = 1e-3  # [rad²] μ


class PfdlMfac(servobench.Controller):
    """PFDL-MFAC: Δy(k) = Φ(k) h(k) with the last L joint steps h(k) = [Δq(k−1), …, Δq(k−L)] as commanded.

        Φ ← Φ + η (Δy − Φ h) hᵀ / (μ + ‖h‖²)
        Δq(k) = ρ Φ₁ᵀ (λ I + Φ₁ Φ₁ᵀ)⁻¹ (r − y − Φ₂ Δq(k−1) − … − Φ_L Δq(k−L+1)),      ρ = 1 − exp(−K T)

    Departures from the source: Φ is [J(q), 0, …, 0] + E with the nominal Jacobian at the present joints, and E is
    learned, as J turns with the arm; a matrix is inverted in place of ‖Φ₁‖²; and E begins anew, as Φ does there, where
    ⟨Φ₁, J⟩ < 0.1 ⟨J, J⟩.
    """

    aids = servobench.EQUIPPED

    def __init__(self, config: PfdlMfacConfig, knowledge):
        self.config = config
        self.jacobian = knowledge.nominal_jacobian
        self.limit = knowledge.spec.joint_velocity_limit
        self.period = knowledge.spec.period
        self.length = max(1, round(config.memory / self.period))  # L
        self.rho = 1.0 - math.exp(-config.gain * self.period)

    def reset(self, observation, seed):
        n, m = len(observation.joint_position), len(observation.feature)
        self.steps = deque([np.zeros(n)] * self.length, maxlen=self.length)  # the newest one first
        self.E = np.zeros((m, n * self.length))
        self.y = observation.feature
        self.valid = observation.valid
        self.J = self.jacobian(observation.joint_position)

    def step(self, observation, reference):
        y = observation.feature
        self.learn(y - self.y, observation.valid & self.valid)
        self.y = y
        self.valid = observation.valid
        J = self.J = self.jacobian(observation.joint_position)
        n = J.shape[1]
        if np.sum((J + self.E[:, :n]) * J) < KEPT * np.sum(J * J):
            self.E[:] = 0.0
        first = J + self.E[:, :n]
        before = np.concatenate(self.steps)[:-n]  # Δq(k−1) … Δq(k−L+1)
        coming = self.E[:, n:] @ before
        e = reference[0] - y - coming
        square = first @ first.T + self.config.step_weight * np.eye(len(e))
        u = self.rho * first.T @ np.linalg.solve(square, e) / self.period
        u = u / max(1.0, np.max(np.abs(u) / self.limit))
        self.steps.appendleft(u * self.period)
        return servobench.Command(u)

    def learn(self, change, valid):
        """Learn from the change of the features in the last period, (m,), of those that are valid before and after."""
        h = np.concatenate(self.steps)
        n = self.J.shape[1]
        misfit = np.where(valid, change - self.J @ h[:n] - self.E @ h, 0.0)
        self.E = self.E + self.config.step_factor * np.outer(misfit, h) / (
            self.config.regularisation + h @ h
        )

    def diagnostics(self):
        return {"deviation": float(np.linalg.norm(self.E))}


class PfdlMfacAlone(PfdlMfac):
    """The same without aids; only the joint-speed limits are kept for it."""

    aids = {}  # noqa: RUF012 - read once
