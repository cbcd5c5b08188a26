"""The contract of a model whose features depend on joints and on parameters, such as the nominal robot of a run."""

from typing import NamedTuple, Protocol

from servobench.plant.contract.checks import FloatArray, Shape


class Derivatives(NamedTuple):
    """Features with their derivatives, for k joint positions."""

    feature: FloatArray  # y, (..., k, m)
    by_joint: FloatArray  # ∂y/∂q, (..., k, m, n), per rad
    by_parameter: FloatArray  # ∂y/∂θ, (..., k, m, P), per unit of each parameter


class FeatureModel(Protocol):
    """The features of the nominal robot as a function of its joints and of P parameters by which it may deviate.

    See `servobench.plant.robot.parametric`, which explains states and parameters.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the parameters."""
        ...

    @property
    def pose_columns(self) -> slice:
        """The place of the cameras' increments among them."""
        ...

    def columns(self, prefix: str) -> slice:
        """Return the place of the parameters whose names begin with a prefix."""
        ...

    def start(self, lead: Shape) -> tuple[FloatArray, FloatArray]:
        """Return θ (..., P) and cameras (..., c, 4, 4) of the nominal robot."""
        ...

    def moved(
        self, theta: FloatArray, cameras: FloatArray, step: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return both after a step (..., P)."""
        ...

    def feature(
        self,
        theta: FloatArray,
        cameras: FloatArray,
        joints: FloatArray,
        turn: FloatArray | None = None,
    ) -> FloatArray:
        """Return features (..., k, m) at joint positions (..., k, n) [rad], the first camera turned by (..., k) rad."""
        ...

    def derivatives(
        self,
        theta: FloatArray,
        cameras: FloatArray,
        joints: FloatArray,
        turn: FloatArray | None = None,
    ) -> Derivatives:
        """Return the same with derivatives."""
        ...

    def placed(
        self,
        theta: FloatArray,
        cameras: FloatArray,
        joints: FloatArray,
        features: FloatArray,
        weight: FloatArray,
    ) -> FloatArray:
        """Return cameras that fit features (..., k, m) of weights (..., k) best, or those given without such a form."""
        ...
