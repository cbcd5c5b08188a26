"""A world of a user whose answers are checked: the bench trusts those of this package, which are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import numpy as np

from servobench.harness.config.settings import ConfigurationError
from servobench.plant.bench.plant import ImageArray, TrueModel, World
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import PlantDiverged
from servobench.plant.contract.signals import PlantSpec, Truth


@final
class WatchedWorld(World):
    """A world that carries out one run, with joint positions and features copied, checked and as float64."""

    def __init__(self, world: World) -> None:
        """Watch a world.

        Raises:
            ConfigurationError: its constructor left out its sizes, limits and period.
        """
        self._world, self._name = world, type(world).__name__
        spec: object = getattr(world, "spec", None)
        if not isinstance(spec, PlantSpec):
            raise ConfigurationError(missing_spec(world))
        self.spec, self.lag = spec, world.lag

    def reset(self, seed: int) -> FloatArray:
        """See `World.reset`."""
        return self._checked("reset", self._world.reset(seed), self.spec.n, "joint positions")

    def advance(self, joint_velocity: FloatArray) -> FloatArray:
        """See `World.advance`."""
        return self._checked("advance", self._world.advance(joint_velocity), self.spec.n, "joint positions")

    def see(self) -> FloatArray | None:
        """See `World.see`."""
        seen = self._world.see()
        return None if seen is None else self._checked("see", seen, self.spec.m, "features, or None")

    def _checked(self, method: str, answer: object, size: int, what: str) -> FloatArray:
        """Return an answer as an array (size,) that nobody else holds.

        Raises:
            ValueError: it is no such array.
            PlantDiverged: a number in it is not finite.
        """
        wanted = f"{self._name}.{method} must return {size} {what}"
        try:
            values = np.array(answer, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{wanted}, got {answer!r}") from error
        if values.shape != (size,):
            raise ValueError(f"{wanted}, got shape {values.shape}")
        if not np.isfinite(values).all():
            raise PlantDiverged(f"{self._name}.{method} returned {values.tolist()}, which is not finite")
        return values

    def why_unseen(self) -> str:
        """See `World.why_unseen`."""
        return self._world.why_unseen()

    def truth(self) -> Truth:
        """See `Plant.truth`."""
        return self._world.truth()

    def save(self) -> Any:  # noqa: ANN401 - as `Plant.save`
        """See `Plant.save`."""
        return self._world.save()

    def restore(self, state: Any) -> None:  # noqa: ANN401 - as `Plant.restore`
        """See `Plant.restore`."""
        self._world.restore(state)

    def true_model(self) -> TrueModel:
        """See `Plant.true_model`."""
        return self._world.true_model()

    def nominal_jacobian(self) -> Callable[[FloatArray], FloatArray] | None:
        """See `Plant.nominal_jacobian`."""
        return self._world.nominal_jacobian()

    def picture(self) -> ImageArray | None:
        """See `Plant.picture`."""
        return self._world.picture()

    def move_camera(self, X_BC: FloatArray) -> None:
        """See `Plant.move_camera`."""
        self._world.move_camera(X_BC)

    def close(self) -> None:
        """See `Plant.close`."""
        self._world.close()


def missing_spec(made: object) -> str:
    """Return what to say about a plant or world whose constructor left out its spec."""
    spec, name = getattr(made, "spec", None), type(made).__name__
    came = "nothing" if spec is None else type(spec).__name__
    return (
        f"{name}.__init__ must set self.spec to a servobench.PlantSpec, got {came}; PlantSpec.of_joints(...) makes one"
    )
