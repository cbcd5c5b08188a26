"""The contract of a model whose features depend on joints and on parameters, such as the nominal robot of a run."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple, TypeAlias

from servobench.plant.contract.checks import FloatArray, Shape

# θ, (..., P), and the poses of the cameras, (..., c, 4, 4)
ModelState: TypeAlias = tuple[FloatArray, FloatArray]


class Derivatives(NamedTuple):
    """Features with their derivatives, for k joint positions."""

    feature: FloatArray  # y, (..., k, m)
    by_joint: FloatArray  # ∂y/∂q, (..., k, m, n), per rad
    by_parameter: FloatArray  # ∂y/∂θ, (..., k, m, P), per unit of each parameter


def parameters_of_joints(joints: Sequence[str]) -> list[str]:
    """Return the names of the deviations of gears and then of zeros, one for each joint."""
    return [f"{kind}_{joint}" for kind in ("gear", "zero") for joint in joints]


class FeatureModel(ABC):
    """The features of the nominal robot as a function of its joints and of P parameters by which it may deviate.

    See `servobench.plant.robot.parametric`, which explains states and parameters.
    """

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """The names of the parameters."""

    @cached_property
    def pose_columns(self) -> slice:
        """The place of the cameras' increments among them."""
        return self.columns("camera")

    def columns(self, prefix: str) -> slice:
        """Return the place of the parameters whose names begin with a prefix, such as `gear_`."""
        found = [index for index, name in enumerate(self.names) if name.startswith(prefix)]
        if not found:
            return slice(0, 0)
        return slice(found[0], found[-1] + 1)

    @abstractmethod
    def start(self, lead: Shape) -> ModelState:
        """Return θ (..., P) and cameras (..., c, 4, 4) of the nominal robot."""

    @abstractmethod
    def moved(self, theta: FloatArray, cameras: FloatArray, step: FloatArray) -> ModelState:
        """Return both after a step (..., P)."""

    def feature(
        self,
        theta: FloatArray,
        cameras: FloatArray,
        joints: FloatArray,
        turn: FloatArray | None = None,
    ) -> FloatArray:
        """Return features (..., k, m) at joint positions (..., k, n) [rad], the first camera turned by (..., k) rad."""
        return self.derivatives(theta, cameras, joints, turn).feature

    @abstractmethod
    def derivatives(
        self,
        theta: FloatArray,
        cameras: FloatArray,
        joints: FloatArray,
        turn: FloatArray | None = None,
    ) -> Derivatives:
        """Return the same with derivatives."""

    def placed(
        self,
        theta: FloatArray,
        cameras: FloatArray,
        joints: FloatArray,
        features: FloatArray,
        weight: FloatArray,
    ) -> FloatArray:
        """Return cameras that fit features (..., k, m) of weights (..., k) best, or those given without such a form."""
        del theta, joints, features, weight
        return cameras
