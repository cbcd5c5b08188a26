"""The roles of an FMU's variables: commands, joints, features and parameters; given in Python or in a TOML file.

file = "crane.fmu"                 # beside the TOML file
inputs = ["v[1]", "v[2]"]          # joint velocity commands, rad/s
features = ["hook"]                # an array, or all of hook[1], hook[2], ...
joints = ["q"]                     # optional; without them commands are integrated
home = "q0"                        # optional: the parameter that takes the joint positions at the start
start = [0.3, 1.2]                 # optional: these joint positions, rad; needs a home, or that there are no joints
period = 0.01                      # optional: the FMU's own step, s

[parameters]
mass = 12.5
gains = [1.0, 2.0]

[nominal]                          # optional: values that controllers believe where they differ from [parameters];
mass = 10.0                        # needs model exchange with directional derivatives

[truth]                            # optional, for the log and upper bounds only
features = ["hook"]
jacobian = ["J"]                   # row-major
states = ["q"]                     # of the model-exchange side: those that are the joint positions

[limits]                           # optional
max_joint_speed = 1.0              # rad/s
joint_lower = -3.1                 # rad
joint_upper = 3.1                  # rad

[names]                            # optional, for the log
joints = ["slew", "luff"]
features = ["x", "y"]
feature_unit = "m"
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from servobench.plant.checks import FloatArray, check_number
from servobench.plant.fmu.description import FmuDescription, total_size
from servobench.plant.settings import suggest
from servobench.plant.signals import PlantSpec

Names: TypeAlias = tuple[str, ...]


@dataclass(frozen=True)
class FmuMapping:
    """The roles of an FMU's variables.

    A name stands for a scalar, an array, or all of `name[1]`, `name[2]`, …

    Attributes:
        path: the .fmu file.
        inputs: joint velocity commands, rad/s; they give n.
        features: what is measured; they give m.
        joints: joint positions, rad; without them commands are integrated from the start.
        true_features: the features without any noise of the FMU's own; without them, the features.
        true_jacobian: ∂feature/∂joint, row-major (m, n); without it, the plant asks the model-exchange side if
            `true_states` are named, and cannot tell otherwise.
        true_states: states of the model-exchange side that are the joint positions; without them, the joints.
        home: a parameter that takes the joint positions at the start, if there is one.
        camera: two parameters that take the camera's position, m, and roll, pitch and yaw, rad, in the base frame.
        start: (n,), rad, at time 0, for an FMU with a home or without joints; None for the FMU's own.
        parameters: values by name, set before every run.
        nominal: the values that controllers believe, where they differ; None: there is no nominal model.
        period: the FMU's step, s; None for the control period.
        max_joint_speed: rad/s; commands are clipped to it.
        joint_lower: rad, of all joints.
        joint_upper: rad, of all joints.
        joint_names: for the log; None for joint_1, joint_2, …
        feature_names: for the log; None for feature_1, feature_2, …
        feature_unit: unit of the features.
    """

    path: Path
    inputs: Names
    features: Names
    joints: Names = ()
    true_features: Names = ()
    true_jacobian: Names = ()
    true_states: Names = ()
    home: str | None = None
    camera: tuple[str, str] | None = None
    start: FloatArray | None = None
    parameters: Mapping[str, FloatArray] = field(default_factory=dict)
    nominal: Mapping[str, FloatArray] | None = None
    period: float | None = None
    max_joint_speed: float = 1.0
    joint_lower: float = -2 * np.pi
    joint_upper: float = 2 * np.pi
    joint_names: Names | None = None
    feature_names: Names | None = None
    feature_unit: str = "m"

    def __post_init__(self) -> None:
        """Check the rules that need no FMU."""
        for name in ("inputs", "features"):
            if not getattr(self, name):
                raise ValueError(f"{name} must name at least one variable of the FMU, got none")
        check_number("max_joint_speed", self.max_joint_speed, above=0.0)
        if self.start is not None and self.joints and self.home is None:
            raise ValueError("start needs home, the parameter that takes it: the FMU tells its joints itself")
        if self.period is not None:
            check_number("period", self.period, above=0.0)


def read_mapping(path: Path) -> FmuMapping:
    """Read a mapping from a TOML file.

    Raises:
        ValueError: an unreadable or malformed file, an unknown key, or a value of the wrong kind.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"mapping {path} cannot be read: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"mapping {path} is not valid TOML: {error}") from error
    try:
        arguments = _arguments(table)
        arguments["path"] = path.parent / arguments["path"]
        return FmuMapping(**arguments)
    except ValueError as error:
        raise ValueError(f"mapping {path}: {error}") from error


def _arguments(table: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments of `FmuMapping` that a TOML table holds."""
    arguments: dict[str, Any] = {}
    for section in _SECTIONS:
        if section in table:
            values = table.pop(section)
            if not isinstance(values, dict):
                raise ValueError(f"{section} must be a section, [{section}]")
            arguments[section] = {name: _numbers(name, value) for name, value in values.items()}
    for key, value in _flatten(table):
        if key not in _KEYS:
            raise ValueError(f"unknown key {key!r}; {suggest(key, [*_KEYS, *_SECTIONS])}")
        argument, convert = _KEYS[key]
        arguments[argument] = convert(key, value)
    for key in ("file", "inputs", "features"):
        if _KEYS[key][0] not in arguments:
            raise ValueError(f"the key {key!r} is missing")
    return arguments


def _flatten(table: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from ((f"{key}.{inner}", item) for inner, item in value.items())
        else:
            yield key, value


def _text(key: str, value: object) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{key} must be text, got {value!r}")  # noqa: TRY004
    return value


def _path(key: str, value: object) -> Path:
    return Path(_text(key, value))


def _names(key: str, value: object) -> Names:
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{key} must be a name or a list of names, got {value!r}")
    return tuple(names)


def _number(key: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{key} must be a number, got {value!r}")  # noqa: TRY004
    return float(value)


def _numbers(key: str, value: object) -> FloatArray:
    if isinstance(value, list):
        return np.array([_number(key, item) for item in value])
    return np.array(_number(key, value))


_SECTIONS = ("parameters", "nominal")  # in which any name may stand
_KEYS: dict[str, tuple[str, Callable[[str, object], Any]]] = {
    "file": ("path", _path),
    "inputs": ("inputs", _names),
    "features": ("features", _names),
    "joints": ("joints", _names),
    "home": ("home", _text),
    "start": ("start", _numbers),
    "period": ("period", _number),
    "truth.features": ("true_features", _names),
    "truth.jacobian": ("true_jacobian", _names),
    "truth.states": ("true_states", _names),
    "limits.max_joint_speed": ("max_joint_speed", _number),
    "limits.joint_lower": ("joint_lower", _number),
    "limits.joint_upper": ("joint_upper", _number),
    "names.joints": ("joint_names", _names),
    "names.features": ("feature_names", _names),
    "names.feature_unit": ("feature_unit", _text),
}


def mapping_spec(mapping: FmuMapping, description: FmuDescription, period: float) -> PlantSpec:
    """Return the spec of a plant whose variables `mapping` names.

    Raises:
        ValueError: a name that the FMU does not have, or sizes that do not fit together.
    """
    inputs, features = description.select(mapping.inputs, "inputs"), description.select(mapping.features, "features")
    for variable in inputs:
        if variable.causality != "input":
            raise ValueError(f"inputs names {variable.name!r}, which is of causality {variable.causality}")
    n, m = total_size(inputs), total_size(features)
    wanted = {"joints": n, "true_features": m, "true_jacobian": n * m, "true_states": n}
    for name, size in wanted.items():
        names: Names = getattr(mapping, name)
        came = total_size(description.select(names, name))
        if names and came != size:
            raise ValueError(f"{name} must name {size} numbers for {n} inputs and {m} features, got {came}")
    return PlantSpec.of_joints(
        _labels("joint", mapping.joint_names, n),
        _labels("feature", mapping.feature_names, m),
        np.full(n, mapping.max_joint_speed),
        np.full(n, mapping.joint_lower),
        np.full(n, mapping.joint_upper),
        period,
        mapping.feature_unit,
    )


def _labels(kind: str, names: Names | None, count: int) -> Names:
    if names is None:
        return tuple(f"{kind}_{i + 1}" for i in range(count))
    if len(names) != count:
        raise ValueError(f"{kind}_names must hold {count} names, got {len(names)}")
    return names
