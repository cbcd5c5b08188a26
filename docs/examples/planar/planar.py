"""A plant of my own: two links in a plane."""

import numpy as np

from servobench.plant.bench.bench import Bench, build_bench
from servobench.plant.bench.plant import PlantEntry, PlantSetup, World
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import NonNegative, nested, settings
from servobench.plant.contract.signals import PlantSpec, Truth


@settings
class PlanarConfig:
    """Settings; every field needs a default."""

    command_delay: NonNegative = 0.0
    """[s] between a command and its first effect."""
    sensing: SensingConfig = nested(SensingConfig)
    """Noise, latency and lost frames."""


class Planar(World):
    """y = 0.5 (cos q₁, sin q₁) + 0.4 (cos(q₁+q₂), sin(q₁+q₂)), q̇ = u."""

    def __init__(self, setup: PlantSetup) -> None:
        limit, stop = np.ones(2), np.full(2, 3.0)
        self.spec = PlantSpec.of_joints(
            ("shoulder", "elbow"), ("x", "y"), limit, -stop, stop, setup.period
        )

    def reset(self, seed: int) -> FloatArray:
        self._q = np.array([0.3, 1.2])
        return self._q

    def advance(self, joint_velocity: FloatArray) -> FloatArray:
        q = self._q + self.spec.period * joint_velocity
        self._q = np.clip(q, self.spec.joint_lower, self.spec.joint_upper)
        return self._q

    def see(self) -> FloatArray:
        return self.truth().feature

    def truth(self) -> Truth:
        shoulder, elbow = self._q[0], self._q[0] + self._q[1]
        upper = 0.5 * np.array([np.cos(shoulder), np.sin(shoulder)])
        fore = 0.4 * np.array([np.cos(elbow), np.sin(elbow)])
        turn = np.array([[0.0, -1.0], [1.0, 0.0]])
        return Truth(upper + fore, np.column_stack([turn @ (upper + fore), turn @ fore]))

    def close(self) -> None:
        """Nothing is held."""


def build(config: PlanarConfig, setup: PlantSetup) -> Bench:
    """Put the world on the bench."""
    return build_bench(Planar, setup, config.command_delay, config.sensing)


ENTRY = PlantEntry("planar", "two links in a plane", PlanarConfig, build, own_robot=True)
