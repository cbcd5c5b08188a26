"""A law of one's own with aids and without: a network trained on the nominal model, in a tenth of a second.

servobench compare --controllers ./trained_inverse.py:TrainedInverse,./trained_inverse.py:TrainedInverseAlone,ukf_mfac
"""

from dataclasses import dataclass

import numpy as np

import servobench


@dataclass(frozen=True)
class TrainedInverseConfig:
    """Settings: --set TrainedInverse.law.gain=12."""

    gain: float = 6.0  # [1/s]
    damping: float = 0.02  # [m/rad]
    units: int = 150
    samples: int = 2000


class TrainedInverse(servobench.Controller):
    """u = gain N(q) e, with a network N(q) = V [tanh(W r + b), 1] for Jᵀ (J Jᵀ + damping² I)⁻¹ of the nominal model.

    r is q within the working region, from −1 to 1. W and b are random, V is the solution of least squares.
    """

    aids = servobench.EQUIPPED
    in_model_frame = (
        True  # trained on the nominal model: the aids turn features into the frame of its camera
    )

    def __init__(self, config: TrainedInverseConfig, knowledge):
        rng, (lower, upper) = np.random.default_rng(0), knowledge.region
        self.gain, self.centre, self.half = (
            config.gain,
            (lower + upper) / 2.0,
            (upper - lower) / 2.0,
        )
        self.W = 0.5 * rng.normal(size=(config.units, len(lower)))
        self.b = rng.uniform(-1.0, 1.0, config.units)
        q = rng.uniform(lower, upper, (config.samples, len(lower)))
        J = knowledge.nominal_jacobian(q)
        wanted = J.mT @ np.linalg.inv(J @ J.mT + config.damping**2 * np.eye(J.shape[-2]))
        H, self.shape = self.hidden(q), wanted.shape[1:]
        self.V = np.linalg.solve(
            H.T @ H + 1e-3 * np.eye(H.shape[1]), H.T @ wanted.reshape(len(q), -1)
        )

    def hidden(self, q):
        h = np.tanh((q - self.centre) / self.half @ self.W.T + self.b)
        return np.concatenate([h, np.ones((*h.shape[:-1], 1))], axis=-1)

    def reset(self, observation, seed):
        """Nothing is remembered between periods."""

    def step(self, observation, reference):
        N = (self.hidden(observation.joint_position) @ self.V).reshape(self.shape)
        return servobench.Command(self.gain * N @ (reference[0] - observation.feature))


class TrainedInverseAlone(TrainedInverse):
    """The same without aids; only the joint-speed limits are kept for it."""

    aids = {}  # noqa: RUF012 - read once
