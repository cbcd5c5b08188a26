"""Reads a model description and finds in it the variables that a mapping names.

A name stands for a scalar, for an FMI 3 array, or for all scalars `name[1]`, `name[2]`, … of FMI 2 in that order, so
that one mapping serves both versions of a model.
"""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import prod
from operator import itemgetter
from pathlib import Path
from textwrap import shorten
from typing import Any, Self

from servobench.plant.contract.checks import Shape
from servobench.plant.contract.faults import one_line
from servobench.plant.contract.settings import suggest
from servobench.plant.contract.units import UNITS
from servobench.plant.fmu.archive import DESCRIPTION
from servobench.plant.fmu.dialect import DIALECTS, FmiDialect

REAL_TYPES = ("Real", "Float64", "Float32")
NUMERIC = (*REAL_TYPES, "Integer", "Boolean", "Int32")
MAX_NUMBERS = 1_000_000  # largest size of a variable
BASES = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")  # whose exponents define a unit
SI_UNITS = {
    (0, 1, 0, 0, 0, 0, 0, 0): "m",
    (0,) * 7 + (1,): "rad",
    (0, 0, -1, 0, 0, 0, 0, 1): "rad/s",
}
# A file name without folders; the standard wants an identifier of C.
IDENTIFIER = re.compile(r"(?!\.)[\w.+ -]{1,200}")


@dataclass(frozen=True)
class Variable:
    """A variable of an FMU."""

    name: str  # as in the description
    reference: int  # value reference
    size: int  # how many values it holds
    causality: str  # parameter, structuralParameter, input, output, local or independent
    type: str = "Real"  # such as Real, Float32, Int64, Boolean or String
    # sizes of its axes: numbers, or names of structural parameters with their start values
    dimensions: tuple[tuple[str, int], ...] = ()
    unit: str = ""  # empty where the FMU names none; see `_unit`
    settable: bool = True  # whether the FMU takes a value for it before a run

    def labels(self) -> list[str]:
        """Return a name for each of its numbers."""
        if self.size == 1:
            return [self.name]
        return [f"{self.name}[{i + 1}]" for i in range(self.size)]


@dataclass(frozen=True)
class FmuDescription:
    """The part of a model description that is used here."""

    path: Path  # the .fmu file, for messages.
    root: Path  # folder to which it is extracted
    version: int  # one of `DIALECTS`
    model_name: str  # for people
    identifier: str  # file name of the library
    token: str  # GUID or instantiation token
    can_save: bool  # states can be saved and restored
    can_serialise: bool  # saved states can be turned into bytes
    once_per_process: bool  # its library bears one instance only
    variables: tuple[Variable, ...]  # all of them, in order
    needs_tool: bool = False  # it calls the tool that made it, which has to be installed
    exchange: bool = False  # it offers model exchange only and has to be integrated by a solver
    n_states: int = 0  # number of continuous states
    n_indicators: int = 0  # number of event indicators
    internal_step: float | None = (
        None  # its own fixed step size, s, of which steps must be multiples; None for none
    )
    usual_step: float | None = None  # that of its default experiment, s; None for none
    start_time: float = 0.0  # that of its default experiment, s; NaN for one that is no number

    @property
    def dialect(self) -> FmiDialect:
        """The names of its version of FMI."""
        return DIALECTS[self.version]

    @cached_property
    def _by_name(self) -> dict[str, Variable]:
        return {variable.name: variable for variable in self.variables}

    @cached_property
    def _families(self) -> dict[str, list[Variable]]:
        families: dict[str, list[tuple[Shape, Variable]]] = {}
        for variable in self.variables:
            match = re.fullmatch(r"(.+)\[([0-9, ]+)\](\)?)", variable.name)
            if match is not None:
                # "der(q[2])" is a member of the family "der(q)".
                family = match[1] + match[3]
                index = tuple(int(part) for part in match[2].split(","))
                families.setdefault(family, []).append((index, variable))
        for pairs in families.values():
            pairs.sort(key=itemgetter(0))
        return {name: [variable for _, variable in pairs] for name, pairs in families.items()}

    def find(
        self, name: str, role: str, types: Container[str] | None = REAL_TYPES
    ) -> list[Variable]:
        """Return the variables that `name` stands for.

        Args:
            name: of a scalar, of an array, or of a family of scalars.
            role: its use in the mapping, for the message.
            types: that may be used there; None for all.

        Raises:
            ValueError: no such variable, which lists those there, with the nearest name; or one of another type.
        """
        found = [self._by_name[name]] if name in self._by_name else self._families.get(name)
        if found is None:
            scalars = [each.name for each in self.variables if "[" not in each.name]
            known = [*self._families, *scalars]
            raise ValueError(
                f"{role} names {name!r}, which {self.path.name} does not have: {suggest(name, known)}"
            )
        for variable in found:
            if not variable.settable and role.startswith(("parameters", "home", "camera")):
                raise ValueError(
                    f"{role} names {name!r}, which takes no value; wanted a parameter or a start value"
                )
            if types is not None and variable.type not in types:
                raise ValueError(
                    f"{role} names {name!r}, which is of type {variable.type}; wanted a real variable"
                )
        return found

    def select(
        self, names: Iterable[str], role: str, types: Container[str] | None = REAL_TYPES
    ) -> tuple[Variable, ...]:
        """Return the variables that `names` stand for, in order; arguments and errors as of `find`."""
        return tuple(variable for name in names for variable in self.find(name, role, types))

    def resized(self, sizes: Mapping[str, int]) -> Self:
        """Return the description with other values of structural parameters, which give the sizes of arrays.

        Raises:
            ValueError: an array becomes too large.
        """
        if not sizes:
            return self

        def resize(variable: Variable) -> Variable:
            if not variable.dimensions:
                return variable
            axes = tuple((name, sizes.get(name, size)) for name, size in variable.dimensions)
            size = prod(size for _, size in axes)
            if size > MAX_NUMBERS:
                raise _bad_size(variable, self.path, size)
            return replace(variable, size=size, dimensions=axes)

        return replace(self, variables=tuple(resize(variable) for variable in self.variables))


def total_size(variables: Iterable[Variable]) -> int:
    """Return the total number of values of the variables."""
    return sum(variable.size for variable in variables)


@lru_cache(maxsize=64)
def read_description(path: Path, root: Path) -> FmuDescription:
    """Read the model description of the FMU at `path`, extracted to `root`; once a process.

    Raises:
        ValueError: broken, of FMI 1, or with scheduled execution only.
    """
    description = parse_description(path, root)
    version = int(description.fmiVersion[0])
    interface = description.coSimulation or description.modelExchange
    if interface is None:
        raise ValueError(
            f"fmu file {path} offers scheduled execution only; wanted co-simulation or model exchange"
        )
    identifier = str(interface.modelIdentifier)
    if not IDENTIFIER.fullmatch(identifier):
        raise ValueError(
            f"fmu file {path} has the modelIdentifier {_line(repr(identifier))}, which is no name of a library: "
            "wanted letters, digits and '_', without folders"
        )
    units = {each.name: each.baseUnit for each in description.unitDefinitions}
    variables = [_variable(each, path, units) for each in description.modelVariables]
    token = getattr(description, DIALECTS[version].token)
    return FmuDescription(
        path=path,
        root=root,
        version=version,
        model_name=str(description.modelName),
        identifier=identifier,
        token=str(token),
        can_save=bool(interface.canGetAndSetFMUstate),
        can_serialise=bool(interface.canSerializeFMUstate),
        once_per_process=bool(interface.canBeInstantiatedOnlyOncePerProcess),
        variables=tuple(variables),
        needs_tool=bool(interface.needsExecutionTool),
        exchange=description.coSimulation is None,
        n_states=int(description.numberOfContinuousStates or 0),
        n_indicators=int(description.numberOfEventIndicators or 0),
        internal_step=_step(root, "CoSimulation", "fixedInternalStepSize"),
        usual_step=_step(root, "DefaultExperiment", "stepSize"),
        start_time=read_time(root, "DefaultExperiment", "startTime", 0.0),
    )


def _step(root: Path, tag: str, name: str) -> float | None:
    """Return a step of the description, s; None for one that is missing or no positive number."""
    step = read_time(root, tag, name, math.nan)
    return step if 0.0 < step < math.inf else None


def read_time(root: Path, tag: str, name: str, default: float) -> float:
    """Return a time of the description, s; fmpy does not read all of them.

    Args:
        root: folder with the description.
        tag: element below its root.
        name: attribute of this element.
        default: for an attribute that is not there.

    Returns:
        NaN for an attribute that is no number.
    """
    element = ET.parse(root / DESCRIPTION).getroot().find(tag)
    if element is None or name not in element.attrib:
        return default
    try:
        return float(element.attrib[name])
    except ValueError:
        return math.nan


def read_exchange(path: Path, root: Path) -> None:
    """Check that the FMU at `path`, extracted to `root`, offers its own derivatives in model exchange.

    Raises:
        ValueError: broken, not of FMI 2, without model exchange or without directional derivatives.
    """
    description = parse_description(path, root)
    version = str(description.fmiVersion)
    exchange = description.modelExchange
    lack = ""
    if not version.startswith("2."):
        lack = f"is of FMI {version}"
    elif exchange is None:
        lack = "offers no model exchange"
    elif not exchange.providesDirectionalDerivative:
        lack = "has no directional derivatives"
    if lack:
        raise ValueError(
            f"fmu file {path} {lack}, so its Jacobian cannot be read; wanted FMI 2 with model exchange and directional "
            "derivatives"
        )
    if exchange.canBeInstantiatedOnlyOncePerProcess:
        raise ValueError(
            f"fmu file {path} allows one instance in a process, so its Jacobian cannot be read during a run"
        )


def parse_description(path: Path, root: Path) -> Any:  # noqa: ANN401 - fmpy's classes carry no usable types
    """Return fmpy's model description of the FMU at `path`, extracted to `root`.

    Raises:
        ValueError: broken, or of another version than those of `DIALECTS`.
    """
    from fmpy import read_model_description  # noqa: PLC0415 - takes a third of a second and loads libraries

    try:
        version = ET.parse(root / DESCRIPTION).getroot().get("fmiVersion", "none")
    except (ET.ParseError, LookupError, ValueError, OSError) as error:
        # A LookupError is an unknown encoding.
        raise ValueError(f"fmu file {path} has a broken {DESCRIPTION}: {_line(error)}") from error
    if not version.startswith(tuple(f"{known}." for known in DIALECTS)):
        wanted = " or ".join(map(str, DIALECTS))
        raise ValueError(f"fmu file {path} is of FMI {_line(version)}; wanted FMI {wanted}")
    try:
        return read_model_description(str(root), validate=False)
    except Exception as error:  # fmpy raises exceptions of every kind.
        raise ValueError(f"fmu file {path} has a broken {DESCRIPTION}: {_line(error)}") from error


def _line(words: object) -> str:
    """Return text of a foreign file as one line of limited length."""
    return shorten(one_line(words) or type(words).__name__, 300, placeholder=" ...")


def _unit(variable: Any, units: Mapping[str, Any]) -> str:  # noqa: ANN401 - as above
    """Return the usual name of a unit of length, angle or speed, or such as `0.1 × rad`; else the unit's own name."""
    kind = variable.declaredType
    name = variable.unit or getattr(kind, "unit", None) or ""
    base = units.get(name)
    if base is None:
        return str(name)
    exponents = tuple(getattr(base, each) for each in BASES)
    own = SI_UNITS.get(exponents)
    if own is None:
        return str(name)
    described = kind if variable.relativeQuantity is None else variable
    is_difference = getattr(described, "relativeQuantity", False)
    if base.offset and not is_difference:
        return f"{base.offset:g} + {base.factor:g} × {own}"
    for usual, per in UNITS[own].items():
        if math.isclose(base.factor * per, 1.0, rel_tol=1e-3):
            return usual
    return f"{base.factor:g} × {own}"


def _variable(variable: Any, path: Path, units: Mapping[str, Any]) -> Variable:  # noqa: ANN401 - as above
    """Return a variable from fmpy's; a name or a size that cannot be used is a ValueError."""
    name = variable.name
    reference = variable.valueReference
    if name is None or not 0 <= reference < 2**32:
        raise ValueError(
            f"fmu file {path} has a variable {_line(repr(name))} with the value reference {_line(reference)}; wanted a "
            "name and 32 bits"
        )
    axes = []
    for dimension, length in zip(variable.dimensions, variable.shape, strict=True):
        if not 0 <= length <= MAX_NUMBERS:
            raise _bad_size(variable, path, length)
        parameter = ""
        if dimension.start is None:
            parameter = str(dimension.variable.name)
        axes.append((parameter, length))
    size = prod(variable.shape)
    if size > MAX_NUMBERS:
        raise _bad_size(variable, path, size)
    causality = variable.causality or "local"
    settable = variable.variability != "constant" and variable.initial != "calculated"
    unit = _unit(variable, units)
    return Variable(name, reference, size, causality, variable.type, tuple(axes), unit, settable)


def _bad_size(variable: Any, path: Path, came: object) -> ValueError:  # noqa: ANN401 - as above
    return ValueError(
        f"fmu file {path}: the size of {_line(repr(variable.name))} must be a whole number up to {MAX_NUMBERS:,}, got "
        f"{_line(came)}"
    )
