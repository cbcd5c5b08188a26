"""Positions and speeds that the joints of an arm do not leave."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servobench.plant.contract.checks import FloatArray, as_vector


@dataclass(frozen=True, eq=False)
class JointLimits:
    """The limits of n joints.

    Attributes:
        lower: (n,) [rad].
        upper: (n,) [rad].
        speed: (n,) [rad/s], the same both ways.
    """

    lower: FloatArray
    upper: FloatArray
    speed: FloatArray

    def __post_init__(self) -> None:
        """Check order and signs and freeze the arrays."""
        for name in ("lower", "upper", "speed"):
            object.__setattr__(self, name, as_vector(name, getattr(self, name), len(self.lower)))
        if not (self.lower < self.upper).all():
            raise ValueError(
                "joint_lower must be below joint_upper for every joint, "
                f"got {self.lower.tolist()} and {self.upper.tolist()}"
            )
        if not (self.speed > 0.0).all():
            raise ValueError(f"joint_velocity_limit must be positive, got {self.speed.tolist()}")


def narrowed(limits: JointLimits | None, n: int, speed: float, reach: float) -> JointLimits:
    """Return limits of `n` joints within a speed [rad/s], a distance from zero [rad] and, where given, others.

    Raises:
        ValueError: a speed or a distance that is not positive, or one that leaves a joint no range.
    """
    speeds, ends = np.full(n, speed), np.full(n, reach)
    if limits is None:
        return JointLimits(-ends, ends, speeds)
    return JointLimits(
        np.maximum(limits.lower, -ends), np.minimum(limits.upper, ends), np.minimum(limits.speed, speeds)
    )
