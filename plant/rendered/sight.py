"""The contract of what the cameras of a rendered plant measure."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Generic, TypeVar

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import BoolArray, Truth
from servobench.plant.rendered.detection import ByteArray
from servobench.plant.robot.hand_eye import SensedArm

Model = TypeVar("Model", bound=SensedArm)


class Sight(ABC, Generic[Model]):
    """Cameras whose images are rendered and searched; arm and cameras are given as they are now.

    All methods take `model`, the true arm and cameras, and `q`, (n,) rad, exact joint positions at which the scene is.
    """

    @abstractmethod
    def reset(self, seed: int) -> None:
        """Draw all randomness from `seed`."""

    @abstractmethod
    def see(self, model: Model, q: FloatArray) -> FloatArray | None:
        """Return the features as seen now, (m,); None if nothing is found."""

    def visible(self) -> BoolArray | None:
        """Return which features of what was seen last are measured, (m,); None for all of them."""
        return None

    @abstractmethod
    def truth(self, model: Model, q: FloatArray) -> Truth:
        """Return the true features and their Jacobian."""

    @abstractmethod
    def why_unseen(self, model: Model, q: FloatArray) -> str:
        """Return why a feature is not seen at the start, with evidence."""

    @abstractmethod
    def picture(self, model: Model, q: FloatArray) -> ByteArray:
        """Return what the cameras see with what is found marked, (h, w, 3)."""

    @abstractmethod
    def save(self) -> Any:  # noqa: ANN401 - each sight has a state of its own
        """Return the state of what is random, as a value."""

    @abstractmethod
    def restore(self, state: Any) -> None:  # noqa: ANN401 - what `save` returned
        """Return to a state."""
