"""Motion for a log from which a robot can be identified: every joint swings as a sum of sines about where it begins.

servobench run --controller ./excite.py --plant kinematic --robot ur10e --task random --set random.duration=60 --out log
servobench identify log --out twin.toml
"""

from dataclasses import dataclass

import numpy as np

import servobench


@dataclass(frozen=True)
class ExciteConfig:
    """Settings: --set Excite.reach=0.15 keeps the ball in a box about where it begins, such as --task target."""

    swing: float = 0.35  # [rad] of each joint, root of the sum of squared amplitudes
    slowest: float = 0.03  # [Hz]
    fastest: float = 0.25  # [Hz]
    sines: int = 4
    ramp: float = 3.0  # [s] until the full swing
    reach: float = np.inf  # [m] of the ball each way in the first ten minutes, by the nominal model


class Excite(servobench.Controller):
    """u_i = d/dt Σ a sin(2π f_ij t + φ_ij), frequencies and phases drawn from the seed; the reference is ignored."""

    def __init__(self, config: ExciteConfig, knowledge):
        self.config, self.period, self.n = config, knowledge.spec.period, knowledge.spec.n
        self.jacobian, self.limit = knowledge.nominal_jacobian, knowledge.spec.joint_velocity_limit

    def reset(self, observation, seed):
        config, draws = self.config, np.random.default_rng(seed)
        size = self.n, config.sines
        self.frequency = draws.uniform(config.slowest, config.fastest, size)
        self.phase = draws.uniform(0.0, 2.0 * np.pi, size)
        self.share = 1.0
        if self.jacobian is not None:
            swings = np.array([self.position(time) for time in np.arange(0.0, 600.0, 0.1)])
            moved = np.abs(swings @ self.jacobian(observation.joint_position).T).max()
            self.share = min(1.0, config.reach / moved)

    def position(self, time):
        """Return the swing of each joint at a time, (n,) rad."""
        sines = np.sin(2.0 * np.pi * self.frequency * time + self.phase).sum(axis=1)
        return (
            self.share
            * self.config.swing
            / self.config.sines**0.5
            * min(1.0, time / self.config.ramp)
            * sines
        )

    def step(self, observation, reference):
        now, then = self.position(observation.time), self.position(observation.time + self.period)
        # Logged as it is sent
        return servobench.Command(np.clip((then - now) / self.period, -self.limit, self.limit))
