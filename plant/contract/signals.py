"""The messages that pass between harness, controllers and plants, and the description that a plant gives of itself.

Arrays are float64, finite, shape-checked at the boundary and read-only. Row k of a log holds the observation and the
command of instant t_k; the command acts on [t_k, t_{k+1}).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, Self, TypeAlias

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import (
    FloatArray,
    Shape,
    as_array,
    check_number,
    is_finite,
    real_numbers,
)

BoolArray = npt.NDArray[np.bool_]
# Joint positions (..., n) rad -> (..., m, n), unit of the feature per rad
JacobianFunction: TypeAlias = Callable[[FloatArray], FloatArray]
# CasADi expression (MX) of the joint positions, (n, 1) rad -> that of the feature, (m, 1)
SymbolicFeature: TypeAlias = Callable[[Any], Any]
JOINT_UNIT = "rad"
COMMAND = "joint_velocity_command"  # begin of the names of columns with commands
NAME_LENGTH = 100  # [letters] in the name of a joint or feature
SETTLING_BAND = 0.005  # share of a feature's natural size: 5 mm on the UR5


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """A named vector signal of k components.

    Attributes:
        names: k names, used in the columns of the log.
        unit: of all components.
        scale: natural size of a component, in the unit; bands and tolerances are shares of it.
        lower: (k,), in the unit; -inf for no limit.
        upper: (k,), in the unit; inf for no limit.
        tolerance: settling band of the error's norm, as a share of the scale.
    """

    names: tuple[str, ...]
    unit: str
    scale: float
    lower: FloatArray
    upper: FloatArray
    tolerance: float = SETTLING_BAND

    def __post_init__(self) -> None:
        """Check sizes and signs and freeze the arrays."""
        check_number("scale", self.scale, above=0.0)
        if np.ndim(self.names) != 1:
            raise ValueError(f"names of joints and features must be lists, got {self.names!r}")
        for name in ("lower", "upper"):
            bound = np.array(getattr(self, name), dtype=np.float64)
            if bound.shape != (len(self.names),) or np.isnan(bound).any():
                raise ValueError(
                    f"{name} must hold {len(self.names)} numbers, got {bound.tolist()}"
                )
            bound.flags.writeable = False
            object.__setattr__(self, name, bound)
        for name in self.names:
            if not str(name).isprintable() or len(name) > NAME_LENGTH:
                raise ValueError(
                    f"a joint or feature cannot have the name {name!r}, which is long or cannot be printed"
                )
        if len(set(self.names)) < len(self.names):
            raise ValueError(
                f"each joint and feature needs a name of its own, got {', '.join(self.names)}"
            )
        if not (self.lower < self.upper).all():
            raise ValueError(f"lower must be below upper for every one of {', '.join(self.names)}")

    @property
    def band(self) -> float:
        """The settling band of the error's norm, in the unit."""
        return self.tolerance * self.scale


@dataclass(frozen=True, slots=True, eq=False)
class PlantSpec:
    """The sizes, names, units, limits and period of a plant with n joints and m features.

    Attributes:
        feature: the m features.
        command: the n joint velocities that are commanded; the limits are symmetric.
        joint_lower: (n,), rad.
        joint_upper: (n,), rad.
        period: control period, s.
    """

    feature: Channel
    command: Channel
    joint_lower: FloatArray
    joint_upper: FloatArray
    period: float

    def __post_init__(self) -> None:
        """Check sizes and signs."""
        if {type(self.feature), type(self.command)} != {Channel}:
            raise ValueError(
                f"feature and command must be Channels, got {self.feature!r} and {self.command!r}"
            )
        for name in ("joint_lower", "joint_upper"):
            object.__setattr__(self, name, as_array(name, getattr(self, name), (self.n,)))
        if not (self.joint_lower < self.joint_upper).all():
            raise ValueError("joint_lower must be below joint_upper for every joint")
        if not (self.command.lower == -self.command.upper).all():
            raise ValueError(
                f"command limits must be symmetric, got {self.command.lower} and {self.command.upper}"
            )
        check_number("period", self.period, above=0.0)

    @classmethod
    def of_joints(
        cls,
        joint_names: tuple[str, ...],
        feature_names: tuple[str, ...],
        joint_velocity_limit: npt.ArrayLike,
        joint_lower: npt.ArrayLike,
        joint_upper: npt.ArrayLike,
        period: float,
        feature_unit: str = "m",
    ) -> Self:
        """Return the spec of revolute joints whose velocities are commanded, with features of natural size 1.

        Args:
            joint_names: n names.
            feature_names: m names.
            joint_velocity_limit: (n,), rad/s, positive; commands are clipped to it.
            joint_lower: (n,), rad.
            joint_upper: (n,), rad.
            period: control period, s.
            feature_unit: unit of the features.
        """
        limit = as_array("joint_velocity_limit", joint_velocity_limit, (np.size(joint_names),))
        if not (limit > 0.0).all():
            raise ValueError(f"joint_velocity_limit must be positive, got {limit.tolist()}")
        unbounded = np.full(np.size(feature_names), np.inf)
        feature = Channel(feature_names, feature_unit, 1.0, -unbounded, unbounded)
        command = Channel(joint_names, "rad/s", 1.0, -limit, limit)
        return cls(feature, command, np.asarray(joint_lower), np.asarray(joint_upper), period)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.command.names)

    @property
    def m(self) -> int:
        """Number of features."""
        return len(self.feature.names)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.command.names

    @property
    def feature_names(self) -> tuple[str, ...]:
        """Names of the features."""
        return self.feature.names

    @property
    def feature_unit(self) -> str:
        """Unit of the features."""
        return self.feature.unit

    @property
    def joint_velocity_limit(self) -> FloatArray:
        """Largest joint velocities, (n,) rad/s."""
        return self.command.upper


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """The measurements that a controller gets at an instant.

    Many runs side by side share one observation, whose arrays have a leading axis; the bench makes it.

    Attributes:
        time: s, k times the period.
        joint_position: (..., n), rad, as the encoders report it.
        feature: (..., m), in the unit of the plant's feature; the last valid one where `feature_valid` is false.
        feature_valid: (...), whether all of `feature` was measured for this instant.
        valid: (..., m), the same for each feature; if it is given, `feature_valid` follows from it, else the reverse.
        capture_time: (...), s, when the frame of `feature` was exposed, by the camera's own clock, which has an unknown
            constant offset; NaN where the camera gives none.
    """

    time: float
    joint_position: FloatArray
    feature: FloatArray
    feature_valid: bool | BoolArray = True
    valid: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    capture_time: float | FloatArray = math.nan

    def __post_init__(self) -> None:
        """Check that everything is finite, but for a missing time of capture, and freeze the arrays."""
        as_array("time", self.time, ())
        for name in ("joint_position", "feature"):
            value = getattr(self, name)
            object.__setattr__(self, name, as_array(name, value, (np.size(value),)))
        given = len(self.valid) > 0
        valid = (
            np.array(self.valid, dtype=np.bool_)
            if given
            else np.full(len(self.feature), self.feature_valid)
        )
        if valid.shape != self.feature.shape:
            raise ValueError(f"valid must have shape {self.feature.shape}, got {valid.shape}")
        valid.flags.writeable = False
        object.__setattr__(self, "valid", valid)
        object.__setattr__(self, "feature_valid", bool(valid.all()))
        captured = real_numbers("capture_time", self.capture_time)
        if captured.ndim or np.isinf(captured):
            raise ValueError(
                f"capture_time must be a time in s, or NaN for none, got {captured.tolist()}"
            )
        object.__setattr__(self, "capture_time", float(captured))

    @property
    def lead(self) -> Shape:
        """The leading axes of all arrays: () for a single run."""
        return self.feature.shape[:-1]

    def with_values(self, joint_position: FloatArray, feature: FloatArray) -> Observation:
        """Return this observation with other joint positions and another feature, which are finite."""
        return trusted_observation(
            self.time, joint_position, feature, self.feature_valid, self.valid, self.capture_time
        )


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """The joint velocities that a controller asks for over the next period.

    Attributes:
        joint_velocity: (n,), rad/s; (..., n) for runs side by side.
    """

    joint_velocity: FloatArray

    def __post_init__(self) -> None:
        """Check that everything is finite and freeze the array."""
        value = real_numbers("joint_velocity", self.joint_velocity)
        if value.ndim == 0:
            raise ValueError(f"joint_velocity must have shape (n,), got {value}")
        if not is_finite(value):
            raise ValueError(f"joint_velocity must be finite, got {value.tolist()}")
        value.flags.writeable = False
        object.__setattr__(self, "joint_velocity", value)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The true state of a plant, for evaluation only.

    Attributes:
        feature: (..., m), the feature without noise, latency or gaps.
        jacobian: (..., m, n), ∂feature/∂joint_position, or None if the plant does not know it.
    """

    feature: FloatArray
    jacobian: FloatArray | None


def trusted_observation(
    time: float,
    joints: FloatArray,
    feature: FloatArray,
    feature_valid: bool | BoolArray,
    valid: BoolArray,
    capture_time: float | FloatArray = math.nan,
) -> Observation:
    """Return an observation of arrays that are known to be fresh, finite, float64 and read-only.

    `Observation` checks and copies its arguments, which costs more than a step of an FMU; the bench calls this instead
    with arrays that its world has checked.
    """
    observation = _new(Observation)
    _set_time(observation, time)
    _set_joints(observation, joints)
    _set_feature(observation, feature)
    _set_feature_valid(observation, feature_valid)
    _set_valid(observation, valid)
    _set_capture_time(observation, capture_time)
    return observation


_new = object.__new__
(
    _set_time,
    _set_joints,
    _set_feature,
    _set_feature_valid,
    _set_valid,
    _set_capture_time,
) = (getattr(Observation, each.name).__set__ for each in fields(Observation))


def column_names(spec: PlantSpec) -> dict[str, list[str]]:
    """Return the names of columns, such as `feature_x_m`, by kind in the order of the table of steps."""
    features, joints = (spec.feature_names, spec.feature_unit), (spec.joint_names, JOINT_UNIT)
    kinds = {"reference": features, "feature": features, "true_feature": features, "joint_position": joints,
             COMMAND: (spec.joint_names, spec.command.unit)}  # fmt: skip
    return {
        kind: [f"{kind}_{name}_{column_unit(unit)}" for name in names]
        for kind, (names, unit) in kinds.items()
    }


def column_unit(unit: str) -> str:
    """Return a unit as the names of columns end with it: `rad/s` -> `rad_s`."""
    return re.sub(r"\W+", "_", unit)
