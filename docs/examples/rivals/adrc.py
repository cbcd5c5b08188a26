"""Active disturbance rejection control (ADRC), which has been proposed for uncalibrated hand-eye coordination.

    servobench compare --controllers ./adrc.py:Adrc,./adrc.py:AdrcAlone,regression_mfac --tasks random --seeds 20

Sources: the extended state observer is by J. Han, "From PID to active disturbance rejection control", IEEE Trans. Ind.
Electron. 56(3), 2009; its gains from one bandwidth by Z. Gao, "Scaling and bandwidth-parameterization based controller
tuning", ACC 2003; their discrete form by G. Herbst, "A simulative study on active disturbance rejection control (ADRC)
as a control tool for practitioners", Electronics 2(3), 2013. Commands that enter the observer late are by S. Zhao and
Z. Gao, "Modified active disturbance rejection control for time-delay systems", ISA Trans. 53(4), 2014. ADRC for a robot
and its camera is by J. Su, H. Ma, W. Qiu and Y. Xi, "Task-independent robotic uncalibrated hand-eye coordination based
on the extended state observer", IEEE Trans. Syst. Man Cybern. B 34(4), 2004.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated

import numpy as np

import servobench


@dataclass(frozen=True)
class AdrcConfig:
    """Settings, with the ranges in which `servobench tune` searches."""

    gain: Annotated[float, servobench.Tuned(0.5, 30.0, log=True)] = 3.0  # [1/s] k
    bandwidth: Annotated[float, servobench.Tuned(0.3, 60.0, log=True)] = 10.0  # [1/s] w, observer
    input_delay: Annotated[float, servobench.Tuned(0.0, 0.25)] = 0.0  # [s]
    damping: Annotated[float, servobench.Tuned(0.002, 0.2, log=True)] = 0.02  # [m/rad] δ


class Adrc(servobench.Controller):
    """Linear ADRC of first order for each feature, ẏ = v + f, with the virtual input v = J u and a disturbance f.

    J is the nominal Jacobian at the present joints; all that is wrong with it is part of f. The observer has the states
    z₁ for y and z₂ for f, T is the period, and a = exp(−w T):

        p = z₁ + T (z₂ + v of a delay before)
        z₁ ← p + (1 − a²) (y − p),      z₂ ← z₂ + (1 − a)² (y − p) / T
        v = k (r − z₁) + ṙ − z₂,        u = Jᵀ (J Jᵀ + δ² I)⁻¹ v

    Where a feature is lost, y − p is 0. The law brings its own feedforward ṙ: that of the aids would be a disturbance
    to the observer.
    """

    aids = {**servobench.EQUIPPED, "feedforward": False}  # noqa: RUF012 - read once

    def __init__(self, config: AdrcConfig, knowledge):
        self.config = config
        self.jacobian = knowledge.nominal_jacobian
        self.limit = knowledge.spec.joint_velocity_limit
        self.period = knowledge.spec.period
        self.late = round(config.input_delay / self.period)  # periods
        a = math.exp(-config.bandwidth * self.period)
        self.first_gain = 1.0 - a * a
        self.second_gain = (1.0 - a) ** 2 / self.period

    def reset(self, observation, seed):
        self.z1 = observation.feature
        self.z2 = np.zeros_like(self.z1)
        self.inputs = deque([self.z2] * (self.late + 1), maxlen=self.late + 1)

    def step(self, observation, reference):
        self.observe(observation)
        rate = 0.0
        if len(reference) > 1:
            rate = (reference[1] - reference[0]) / self.period
        v = self.config.gain * (reference[0] - self.z1) + rate - self.z2
        J = self.jacobian(observation.joint_position)
        damped = J @ J.T + self.config.damping**2 * np.eye(len(v))
        u = J.T @ np.linalg.solve(damped, v)
        u = u / max(1.0, np.max(np.abs(u) / self.limit))
        self.inputs.append(J @ u)  # of the velocity that the limits allow
        return servobench.Command(u)

    def observe(self, observation):
        predicted = self.z1 + self.period * (self.z2 + self.inputs[0])
        misfit = np.where(observation.valid, observation.feature - predicted, 0.0)
        self.z1 = predicted + self.first_gain * misfit
        self.z2 = self.z2 + self.second_gain * misfit

    def diagnostics(self):
        return {"disturbance": float(np.linalg.norm(self.z2))}


class AdrcAlone(Adrc):
    """The same without aids; only the joint-speed limits are kept for it."""

    aids = {}  # noqa: RUF012 - read once
