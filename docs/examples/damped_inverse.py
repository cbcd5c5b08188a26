"""A law of one's own with the aids of the bench's methods, and the same law without them: a damped pseudo-inverse.

servobench compare --controllers ./damped_inverse.py:DampedInverse,./damped_inverse.py:DampedInverseAlone,ukf_mfac
"""

from dataclasses import dataclass

import numpy as np

import servobench


@dataclass(frozen=True)
class DampedInverseConfig:
    """Settings: --set DampedInverse.law.gain=12."""

    gain: float = 6.0  # [1/s]
    damping: float = 0.02  # [m/rad]


class DampedInverse(servobench.Controller):
    """u = gain Jᵀ (J Jᵀ + damping² I)⁻¹ e with the error e of the feature."""

    aids = servobench.EQUIPPED

    def __init__(self, config: DampedInverseConfig, knowledge):
        # In `step` the aids correct it
        self.config, self.jacobian = (config, knowledge.nominal_jacobian)

    def reset(self, observation, seed):
        """Nothing is remembered between periods."""

    def step(self, observation, reference):
        e = reference[0] - observation.feature
        J = self.jacobian(observation.joint_position)
        damped = J @ J.T + self.config.damping**2 * np.eye(len(e))
        return servobench.Command(self.config.gain * J.T @ np.linalg.solve(damped, e))


class DampedInverseAlone(DampedInverse):
    """The same without aids; only the joint-speed limits are kept for it."""

    aids = {}  # noqa: RUF012 - read once
