"""The message from the estimate to a control law."""

from __future__ import annotations

from dataclasses import dataclass

from servobench.plant.contract.checks import FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class Estimate:
    """What the law gets in each period.

    Attributes:
        jacobian: Ĵ, (..., m, n), m/rad, at the present joint position.
    """

    jacobian: FloatArray
