"""The contract of a world: a robot and its camera, of which `servobench.plant.bench.bench` makes a plant."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

from servobench.plant.bench.plant import Abilities
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import RunFault
from servobench.plant.contract.signals import BoolArray


class World(Abilities):
    """A robot and its camera, which only advance and see; `Bench` makes a plant of it.

    Arrays that a world returns are never changed again, finite and float64; the bench makes them read-only. Those of a
    world that carries out runs side by side have the leading axis `lead`.
    """

    lead: tuple[int, ...] = ()
    """Number of runs side by side, as the shape of the leading axis; () for a single run."""

    lag: float | None = None
    """[s] time constant of the joints' velocity loops; None where it is unknown."""

    def fail(self, lane: int, fault: RunFault) -> None:
        """Take the fault of a lane, or raise that of a single run; of a lane the first one counts."""
        if not self.lead:
            raise fault
        self.faults = {lane: fault, **self.faults}

    noise_unit: float = 1.0
    """What a metre of noise is in the unit of the features."""

    @abstractmethod
    def reset(self, seed: Any) -> FloatArray:  # noqa: ANN401 - narrowed by worlds that carry out one run only
        """Go back to the start, at rest, and draw all randomness from `seed`.

        Args:
            seed: one, or a sequence of one for each of the runs side by side.

        Returns:
            The joint positions, (..., n) rad.
        """

    @abstractmethod
    def advance(self, joint_velocity: FloatArray) -> FloatArray:
        """Hold a command for one period of the world, `spec.period`.

        Args:
            joint_velocity: (..., n), rad/s, within the limits.

        Returns:
            The joint positions after it, (..., n) rad, as reported; of a lane that failed, those before.

        Raises:
            PlantDiverged: they are not finite.
        """

    @abstractmethod
    def see(self) -> FloatArray | None:
        """Return the feature as the sensor sees it now, (..., m); None if a single run's is not found."""

    def visible(self) -> BoolArray | None:
        """Return which features of what was seen last are measured, (..., m); None for all of them."""
        return None

    def why_unseen(self) -> str:
        """Return why `see` found nothing, with evidence, for an error message."""
        return "the feature is not visible at the start"
