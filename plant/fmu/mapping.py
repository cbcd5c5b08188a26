"""The roles of an FMU's variables: commands, joints, features and parameters; given in Python or in a TOML file.

    file = "crane.fmu"                      # beside the TOML file
    inputs = ["v[1]", "v[2]"]
    features = ["hook"]
    parameters = {mass = 12.5, gains = [1.0, 2.0]}
    limits.max_joint_speed = 2.0

The keys are the fields of `FmuMapping`, its sections the fields of their own classes.
"""

from collections.abc import Container, Iterable, Mapping
from dataclasses import MISSING, field, fields, replace
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.files import read_toml
from servobench.plant.contract.settings import (
    File,
    Names,
    Numbers,
    Positive,
    SomeNames,
    Usual,
    Values,
    nested,
    override,
    remark,
    settings,
)
from servobench.plant.contract.signals import PlantSpec
from servobench.plant.contract.units import SPELLINGS, UNITS
from servobench.plant.fmu.description import (
    NUMERIC,
    REAL_TYPES,
    FmuDescription,
    Variable,
    total_size,
)
from servobench.plant.fmu.library import logger

Roles = TypeVar("Roles")
# Units of FMUs that are never another spelling of the wanted one.
DECLARED = {unit for units in UNITS.values() for unit in units if unit not in {"", "%"}} | {
    "um", "km", "mrad", "rev", "mrad/s", "rpm", "m/s", "mm/s", "rad/s2", "deg/s2", "m/s2", "N", "N.m", "A", "V",
}  # fmt: skip
# Outputs that may be named more than once, such as one flag
REPEATED = {"seen", "truth.jacobian", "jacobian"}
STEP_TOLERANCE = (
    1e-6  # tolerated deviation of a step from a multiple of the FMU's own, over the step
)
WHOLE_TOLERANCE = 1e-9  # [s] between a period and its steps
MIN_DIGITS = 4  # A step with fewer digits is exact.
MAX_STEP_ERROR = 1e-3  # relative error of a step from one instant of an FMU's clock to the next


@settings
class TruthMapping:
    """Sources of the truth, for the log and for upper bounds."""

    features: Names = ()
    """Features without noise; without them, `features`."""
    jacobian: Names = ()
    """∂feature/∂joint, row-major (m, n); without it, the plant asks the model-exchange side if `states` are named."""
    states: Names = ()
    """States of the model-exchange side that are the joint positions; without them, the joints."""


@settings
class JointLimits:
    """Limits of the joints: one number for all of them, or one for each."""

    max_joint_speed: Annotated[Numbers, Usual(20.0)] = field(default_factory=lambda: np.array(1.0))
    """[rad/s] commands are clipped to it."""
    joint_lower: Annotated[Numbers, Usual(4 * np.pi)] = field(
        default_factory=lambda: np.array(-2 * np.pi)
    )
    """[rad]"""
    joint_upper: Annotated[Numbers, Usual(4 * np.pi)] = field(
        default_factory=lambda: np.array(2 * np.pi)
    )
    """[rad]"""

    def __post_init__(self) -> None:
        """Check the sign of the speeds."""
        if not (self.max_joint_speed > 0.0).all():
            raise ValueError(
                f"max_joint_speed must be above 0, got {self.max_joint_speed.tolist()}"
            )

    def of(self, name: str, n: int) -> FloatArray:
        """Return a limit of each of `n` joints, (n,).

        Raises:
            ValueError: a list of another length.
        """
        value: FloatArray = getattr(self, name)
        if value.shape not in {(), (n,)}:
            raise ValueError(f"limits.{name} must have one number or {n}, got {value.tolist()}")
        return np.full(n, value)


@settings
class LogNames:
    """Names for the log."""

    joints: Names | None = None
    """None for joint_1, joint_2, …"""
    features: Names | None = None
    """None for feature_1, feature_2, …"""
    feature_unit: str = "m"
    """Unit of the features."""


@settings
class FmuMapping:
    """The roles of an FMU's variables; a name is that of a scalar, an array, or the scalars `name[1]`, `name[2]`."""

    file: File
    """The .fmu file."""
    inputs: SomeNames
    """Joint velocity commands, rad/s; they give n."""
    features: SomeNames
    """The features that the controller gets; they give m."""
    joints: Names = ()
    """Joint positions, rad; without them, commands are integrated."""
    seen: Names = ()
    """Which features are seen: true, or above 0.5, for each of them that is; without it all are."""
    captured: str | None = None
    """An output that is the time [s] at which the features were exposed, by the camera's clock."""
    truth: TruthMapping = nested(TruthMapping)
    """For evaluation only."""
    home: str | None = None
    """A parameter that takes the joint positions at the start, if there is one."""
    camera: tuple[str, str] | None = None
    """Two parameters that take the camera's position, m, and roll, pitch and yaw, rad, in the base frame."""
    start: Numbers | None = None
    """(n,) [rad] at time 0, for an FMU with a home or without joints; None for the FMU's own."""
    parameters: Mapping[str, Values] = nested(dict)
    """Values by name, set before every run: numbers, `true` and `false`, or texts, as the FMU declares them."""
    nominal: Mapping[str, Numbers] | None = None
    """Nominal values of parameters, for controllers; needs directional derivatives. None: there is no nominal model."""
    period: Annotated[Positive, Usual(1.0)] | None = None
    """[s] the FMU's step; None for the control period."""
    start_time: float | None = None
    """[s] of the FMU's clock at the start of a run; None for that of its default experiment, or else 0."""
    tolerance: Positive | None = None
    """[1] relative one of the FMU's own solver, or of CVode in model exchange; None for the solver's own."""
    debug_log: File | None = None
    """A file to which all messages of the FMU are appended, with its debug log turned on; None: it is off."""
    limits: JointLimits = nested(JointLimits)
    """Limits of the joints."""
    names: LogNames = nested(LogNames)
    """Names for the log."""

    def __post_init__(self) -> None:
        """Check that something takes the start."""
        if self.start is not None and self.joints and self.home is None:
            raise ValueError(
                "start needs home, the parameter that takes it: the FMU has joints of its own"
            )
        if self.home in self.parameters:
            raise ValueError(
                f"home and parameters name {self.home!r}, the joints at the start: write start instead"
            )


def read_mapping(kind: type[Roles], path: Path) -> Roles:
    """Read a mapping from a TOML file.

    Args:
        kind: class of the mapping, with a `file` and a `debug_log`, whose paths begin in the folder of the file.
        path: of the file.

    Raises:
        ValueError: an unreadable or malformed file, a missing or unknown key, or a value of the wrong kind.
    """
    table = read_toml("mapping", path)
    needed = [
        each.name
        for each in fields(cast(Any, kind))
        if each.default is MISSING and each.default_factory is MISSING
    ]
    for key in needed:
        if key not in table:
            raise ValueError(f"mapping {path}: the key {key!r} is missing")
    # `override` wants an object; what it lacks a default for is in the table.
    placeholders: dict[str, Any] = dict.fromkeys(needed, ("to be given",))
    placeholders["file"] = path
    mapping: Any = override(f"mapping {path}", kind(**placeholders), table)
    folder = path.parent
    log = None if mapping.debug_log is None else folder.absolute() / mapping.debug_log
    return replace(mapping, file=folder / mapping.file, debug_log=log)


def mapping_spec(mapping: FmuMapping, description: FmuDescription, period: float) -> PlantSpec:
    """Return the spec of a plant whose variables `mapping` names.

    Raises:
        ValueError: a name that the FMU does not have, sizes that do not fit together, or a step that it cannot take.
    """
    step = own_step(mapping.period, period)
    own = description.internal_step
    if own is not None and not count_steps(step, own):
        raise ValueError(
            f"{description.path.name} takes steps of multiples of {own!r} s only (fixedInternalStepSize), so period "
            f"must be one, got {step!r} s"
        )
    n = total_size(description.select(mapping.inputs, "inputs"))
    m = total_size(description.select(mapping.features, "features"))
    if not (n and m):
        raise ValueError(f"inputs and features must name at least one number each, got {n} and {m}")
    truth = mapping.truth
    home = () if mapping.home is None else (mapping.home,)
    # Parameters of several cameras begin with the first, the one that is moved; the mapping gives where the others are.
    camera = []
    for place, name in enumerate(mapping.camera or ()):
        given = mapping.parameters.get(name, 0.0)
        size = max((3, *np.shape(given)[-1:]))
        camera.append((f"camera[{place + 1}]", (name,), size, ("m", "rad")[place]))
    captured: Names = ()
    if mapping.captured is not None:
        captured = (mapping.captured,)
    unit = mapping.names.feature_unit
    # Role, names, number of values, unit.
    roles = (
        ("inputs", mapping.inputs, n, "rad/s"),
        ("joints", mapping.joints, n, "rad"),
        ("features", mapping.features, m, unit),
        ("seen", mapping.seen, m, "1"),
        ("captured", captured, 1, "s"),
        ("truth.features", truth.features, m, unit),
        ("truth.jacobian", truth.jacobian, n * m, f"{unit}/rad"),
        ("truth.states", truth.states, n, "rad"),
        ("home", home, n, "rad"),
        *camera,
    )
    found = {}
    for role, names, *_ in roles:
        types = NUMERIC if role == "seen" else REAL_TYPES
        found[role] = description.select(names, role, types)
    # Those of the truth may be variables that have another role as well.
    repeatable = ("truth.features", "truth.states")
    unique = {role: part for role, part in found.items() if role not in repeatable}
    check_roles(unique, ("inputs",), description)
    values = description.select(mapping.parameters, "parameters", None)
    check_roles({"inputs": found["inputs"], "parameters": values}, (), description)
    declared = {variable.unit.translate(SPELLINGS): variable.name for variable in found["features"]}
    known = DECLARED & declared.keys()
    if known and unit.translate(SPELLINGS) not in known:
        first = min(known)
        raise ValueError(
            f"names.feature_unit must be {first}, the unit of {declared[first]}, got {unit}"
        )
    for role, names, size, own_unit in roles:
        any_quantity = role.endswith(("features", "jacobian"))
        check_unit(role, found[role], own_unit, any_quantity=any_quantity)
        came = total_size(found[role])
        if names and came != size:
            raise ValueError(
                f"{role} must name {size} numbers for {n} inputs and {m} features, got {came}"
            )
    joints = _labels("joint", mapping.names.joints, n)
    features = _labels("feature", mapping.names.features, m)
    speed = mapping.limits.of("max_joint_speed", n)
    lower = mapping.limits.of("joint_lower", n)
    upper = mapping.limits.of("joint_upper", n)
    return PlantSpec.of_joints(joints, features, speed, lower, upper, period, unit)


def check_roles(
    roles: Mapping[str, Iterable[Variable]], inputs: Container[str], description: FmuDescription
) -> None:
    """Refuse variables by role that are named twice, or that are no inputs in the roles `inputs`.

    Raises:
        ValueError: names the variable.
    """
    taken: dict[str, str] = {}
    pairs = [(role, variable) for role, variables in roles.items() for variable in variables]
    for role, variable in pairs:
        if role in inputs and variable.causality != "input":
            raise ValueError(
                f"{role} names {variable.name!r}, which is of causality {variable.causality}"
            )
        other = taken.get(variable.name)
        if {other, role} == {"joints", "features"} and role not in inputs:
            logger.warning(
                "features name the joint %s; a camera measures other quantities", variable.name
            )
        elif other is not None and (other != role or role in inputs or role not in REPEATED):
            how = "twice" if other == role else f"as {other} does; each has its own"
            raise ValueError(f"{description.path.name}: {role} names {variable.name!r} {how}")
        taken[variable.name] = role


def check_unit(
    role: str, variables: Iterable[Variable], own: str, *, any_quantity: bool = False
) -> None:
    """Refuse variables that the FMU declares in another unit of the same quantity, or of another one.

    Raises:
        ValueError: names the variable and its unit.
    """
    for variable in variables:
        unit = variable.unit.translate(SPELLINGS)
        wanted = own.translate(SPELLINGS)
        is_known = unit in DECLARED or " × " in unit
        same_quantity = unit in UNITS.get(wanted, {}) or unit.endswith(f" × {wanted}")
        if is_known and unit != wanted and (same_quantity or not any_quantity):
            remedy = "convert it in the FMU" if same_quantity else "name another variable"
            raise ValueError(
                f"{role} names {variable.name!r}, whose unit is {unit}; wanted {own}: {remedy}"
            )


def unusual_step(mapping: FmuMapping, description: FmuDescription, period: float) -> str:
    """Return a remark if an FMU takes longer steps than intended, else an empty text.

    One of model exchange is integrated with steps of its solver's.
    """
    usual = description.usual_step
    if mapping.period is not None or usual is None or description.exchange:
        return ""
    if usual >= period or count_steps(period, usual) == 1:
        return ""
    return (
        f"{description.path.name} is meant to take steps of {usual:g} s and takes those of the control period, "
        f"{period:g} s; period = {usual:g} in the mapping changes that"
    )


def own_step(written: float | None, period: float) -> float:
    """Return the step of an FMU, s: that of its mapping, or the part of a period [s] that is rounded there."""
    if written is None:
        return period
    count = count_steps(period, written)
    if count and abs(count * written - period) > WHOLE_TOLERANCE:
        return period / count
    return written


def count_steps(period: float, written: float) -> int:
    """Return how many steps of an FMU a period has, 0 where they do not fit.

    Args:
        period: s.
        written: the step as in a file, s, where 1/60 s is 0.0166667.
    """
    count = max(1, round(period / written))
    exact = period / count
    _, digits, exponent = Decimal(repr(written)).as_tuple()
    last = 10.0 ** float(exponent)  # value of a one as the last digit
    is_near = abs(exact - written) <= STEP_TOLERANCE * exact
    # A number is near as well where its last digits were rounded or cut off.
    is_rounded = len(digits) >= MIN_DIGITS and -0.5 < (exact - written) / last < 1.0
    if is_near or (is_rounded and count * last < 0.1 * written):
        return count
    return 0


def first_instant(given: float | None, description: FmuDescription, step: float) -> float:
    """Return the time of an FMU's clock at which a run begins, s, with a remark on one that the user has not given.

    Args:
        given: the user's, s; None for that of the FMU's default experiment.
        description: of the FMU.
        step: of the FMU, s.

    Raises:
        ValueError: no number, or one so large that steps are lost in it.
    """
    file = description.path.name
    time = description.start_time
    source = "startTime of its default experiment"
    if given is not None:
        time = given
        source = "start_time of the mapping"
    error = abs(time + step - time - step)
    if not error <= MAX_STEP_ERROR * step:
        raise ValueError(
            f"{file} cannot take steps of {step:g} s from {time:g} s, the {source}: write start_time = 0.0 into "
            "the mapping"
        )
    if time and given is None:
        remark(f"{file} begins at {time:g} s, the {source}; start_time in the mapping changes that")
    return time


def _labels(kind: str, names: Names | None, count: int) -> Names:
    """Return the names of joints or features, by default numbered ones."""
    if names is None:
        return tuple(f"{kind}_{i + 1}" for i in range(count))
    if len(names) != count:
        raise ValueError(f"names.{kind}s must hold {count} names, got {len(names)}")
    return names
