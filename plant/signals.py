"""The messages that pass between harness, controllers and plants, and what a plant says about itself.

Arrays are float64, finite, shape-checked at the boundary and read-only. Row k of a log holds the observation and the
command of instant t_k; the command acts on [t_k, t_{k+1}).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servobench.plant.checks import FloatArray, as_vector


@dataclass(frozen=True, slots=True)
class PlantSpec:
    """What a plant tells about its sizes, names, units, limits and period.

    Attributes:
        joint_names: n names, used in the columns of the log.
        feature_names: m names, used in the columns of the log.
        joint_velocity_limit: (n,), rad/s, positive.
        joint_lower: (n,), rad.
        joint_upper: (n,), rad.
        period: control period, s.
        feature_unit: unit of the feature.
    """

    joint_names: tuple[str, ...]
    feature_names: tuple[str, ...]
    joint_velocity_limit: FloatArray
    joint_lower: FloatArray
    joint_upper: FloatArray
    period: float
    feature_unit: str = "m"

    def __post_init__(self) -> None:
        """Check sizes and signs."""
        for name in ("joint_velocity_limit", "joint_lower", "joint_upper"):
            object.__setattr__(self, name, as_vector(name, getattr(self, name), self.n))
        if not (self.joint_velocity_limit > 0.0).all():
            raise ValueError(f"joint_velocity_limit must be positive, got {self.joint_velocity_limit.tolist()}")
        if not (self.joint_lower < self.joint_upper).all():
            raise ValueError("joint_lower must be below joint_upper for every joint")
        if not self.period > 0.0:
            raise ValueError(f"period must be positive, got {self.period} s")

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def m(self) -> int:
        """Number of features."""
        return len(self.feature_names)


@dataclass(frozen=True, slots=True)
class Observation:
    """What a controller sees at an instant.

    Attributes:
        time: s, k times the period.
        joint_position: (n,), rad, as the encoders report it.
        feature: (m,), in the unit of the plant's feature; the last valid one where `feature_valid` is false.
        feature_valid: whether `feature` was measured for this instant.
    """

    time: float
    joint_position: FloatArray
    feature: FloatArray
    feature_valid: bool = True

    def __post_init__(self) -> None:
        """Check that everything is finite and freeze the arrays."""
        if not np.isfinite(self.time):
            raise ValueError(f"time must be finite, got {self.time}")
        for name in ("joint_position", "feature"):
            value = getattr(self, name)
            object.__setattr__(self, name, as_vector(name, value, len(value)))


@dataclass(frozen=True, slots=True)
class Command:
    """What a controller asks for over the next period.

    Attributes:
        joint_velocity: (n,), rad/s.
    """

    joint_velocity: FloatArray

    def __post_init__(self) -> None:
        """Check that everything is finite and freeze the array."""
        value = self.joint_velocity
        object.__setattr__(self, "joint_velocity", as_vector("joint_velocity", value, len(value)))


@dataclass(frozen=True, slots=True)
class Truth:
    """What only the log may know.

    Attributes:
        feature: (m,), the feature without noise, latency or gaps.
        jacobian: (m, n), ∂feature/∂joint_position, or None where the plant cannot tell.
    """

    feature: FloatArray
    jacobian: FloatArray | None


def trusted_observation(time: float, joints: FloatArray, feature: FloatArray, valid: bool) -> Observation:
    """Return an observation of arrays that are known to be fresh, finite, float64 and read-only.

    `Observation` checks and copies what it is given, which costs more than a step of an FMU; this is for a plant whose
    arrays come out of a buffer that has just been checked.
    """
    observation = _new(Observation)
    _set_time(observation, time)
    _set_joints(observation, joints)
    _set_feature(observation, feature)
    _set_valid(observation, valid)
    return observation


_new = object.__new__
_set_time, _set_joints, _set_feature, _set_valid = (
    getattr(Observation, name).__set__ for name in ("time", "joint_position", "feature", "feature_valid")
)
