"""Writes modelDescription.xml for FMI 2.0 and 3.0: co-simulation and, where a model has it, model exchange.

The dependencies of the unknowns are explicit (`Section`). The text holds no date and no machine name, so equal models
give equal bytes.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import metadata
from typing import TypeAlias

from servobench.fmus.dialect import (
    DERIVATIVES,
    INDICATORS,
    INITIAL_UNKNOWNS,
    OUTPUTS,
    ExportDialect,
)
from servobench.fmus.variables import (
    DERIVATIVE,
    FIXED,
    INDICATOR,
    INPUT,
    OUTPUT,
    PARAMETER,
    SAMPLED,
    STATE,
    ArmLayout,
    Group,
    Layout,
)
from servobench.plant.contract.checks import FloatArray

UNITS: dict[str, dict[str, str]] = {
    "1": {},
    "m": {"m": "1"},
    "rad": {"rad": "1"},
    "s": {"s": "1"},
    "rad/s": {"rad": "1", "s": "-1"},
    "rad/s2": {"rad": "1", "s": "-2"},
    "m/rad": {"m": "1", "rad": "-1"},
    "m/s": {"m": "1", "s": "-1"},
    "m/s2": {"m": "1", "s": "-2"},
}
DISPLAY_UNITS = {"rad": "deg", "rad/s": "deg/s", "rad/s2": "deg/s2"}
ATTRIBUTES = {
    PARAMETER: {"causality": "parameter", "variability": "tunable", "initial": "exact"},
    FIXED: {"causality": "parameter", "variability": "fixed", "initial": "exact"},
    INPUT: {"causality": "input", "variability": "continuous"},
    STATE: {"causality": "output", "variability": "continuous", "initial": "calculated"},
    DERIVATIVE: {"causality": "local", "variability": "continuous", "initial": "calculated"},
    INDICATOR: {"causality": "local", "variability": "continuous", "initial": "calculated"},
    OUTPUT: {"causality": "output", "variability": "continuous", "initial": "calculated"},
    SAMPLED: {"causality": "output", "variability": "discrete", "initial": "calculated"},
}
STARTED = (PARAMETER, FIXED, INPUT)  # roles with start values
LOG_CATEGORIES = {
    "logStatusError": "Errors.",
    "logStatusWarning": "Refused calls.",
    "logEvents": "Joints that meet a stop or leave it.",
}
REFERENCES = "org.fmi-standard.fmi-ls-ref"  # the layered standard for the roles of related files
REFERENCES_VERSION = "1.0.0-alpha.1"

# Rows hold an unknown, its dependencies, and whether it depends on them elementwise or as a whole.
_Rows: TypeAlias = list[tuple[str, tuple[str, ...], bool]]


@dataclass(frozen=True)
class Section:
    """One part of the model structure: which unknown depends on which groups, elementwise or as a whole."""

    part: str  # one of those whose elements an `ExportDialect` names
    layout: Layout
    unknowns: _Rows

    def scalars(self) -> Iterable[tuple[int, list[int]]]:
        """Yield index and dependencies of every number, these in ascending order."""
        for unknown, names, elementwise in self.unknowns:
            for k in range(self.layout.by_name[unknown].size):
                dependencies: list[int] = []
                for name in names:
                    first = self.layout.offsets[name]
                    if elementwise:
                        dependencies.append(first + k)
                    else:
                        dependencies += range(first, first + self.layout.by_name[name].size)
                yield self.layout.offsets[unknown] + k, sorted(dependencies)

    def arrays(self) -> Iterable[tuple[int, list[int]]]:
        """Yield value reference and dependencies of every group."""
        for unknown, names, _ in self.unknowns:
            dependencies = sorted(self.layout.offsets[name] for name in names)
            yield self.layout.offsets[unknown], dependencies


def arm_sections(layout: ArmLayout) -> tuple[Section, ...]:
    """Return outputs, derivatives, initial unknowns and event indicators of an arm with their dependencies."""
    geometry = [group.name for group in layout.kinematic]
    computed = [group.name for group in layout.computed]
    joints = ("joint_position", "joint_velocity")
    tool = ("tool_deflection", "tool_velocity")
    command = "joint_velocity_command"
    outputs: _Rows = [(name, (name,), True) for name in (*joints, *tool)]
    outputs.append(("encoder_position", ("joint_position",), True))
    outputs += [(name, ("joint_position", "tool_deflection"), False) for name in computed]
    derivatives: _Rows = [
        ("der(joint_position)", joints, True),
        ("der(joint_velocity)", (*joints, command), True),
        ("der(tool_deflection)", (*joints, *tool), False),
        ("der(tool_velocity)", (*joints, *tool), False),
    ]
    start: _Rows = [
        ("joint_position", ("home",), True),
        ("joint_velocity", (), True),
        ("der(joint_position)", (), True),
        ("der(joint_velocity)", ("lag", "max_speed", command), True),
        ("tool_deflection", (), True),
        ("tool_velocity", (), True),
        ("der(tool_deflection)", (), True),
        ("der(tool_velocity)", (), True),
        ("encoder_position", ("encoder_resolution", "home"), True),
    ]
    start += [(name, (*geometry, "home"), False) for name in computed]
    indicators: _Rows = [("stop_indicator", ("joint_position", command), False)]
    return (
        Section(OUTPUTS, layout, outputs),
        Section(DERIVATIVES, layout, derivatives),
        Section(INITIAL_UNKNOWNS, layout, start),
        Section(INDICATORS, layout, indicators),
    )


def sampled_sections(layout: Layout) -> tuple[Section, ...]:
    """Return outputs and initial unknowns of a system in discrete time: every output depends on every input."""
    inputs = tuple(group.name for group in layout.of_role(INPUT))
    rows: _Rows = [(group.name, inputs, False) for group in layout.of_role(SAMPLED)]
    return (
        Section(OUTPUTS, layout, rows),
        Section(INITIAL_UNKNOWNS, layout, rows),
    )


@dataclass(frozen=True)
class Description:
    """Content of a model description."""

    model_name: str  # display name
    model_identifier: str  # file name of the libraries
    summary: str  # one sentence
    layout: Layout  # the variables
    sections: tuple[Section, ...]  # parts of the model structure
    # Start values of parameters and inputs, flat arrays by group; all others are zero.
    start: Mapping[str, FloatArray]
    sources: tuple[str, ...]  # C files to compile, in order
    step: float  # [s] step of the default experiment
    exchange: bool = True  # whether there is model exchange, with derivatives, beside co-simulation


def exporter() -> str:
    """Return name and version of the exporter."""
    return f"servobench {metadata.version('servobench')}"


def write_description(description: Description, dialect: ExportDialect, token: str) -> bytes:
    """Return modelDescription.xml of a version of FMI with the token that importers pass on."""
    attributes = {
        "fmiVersion": f"{dialect.names.version}.0",
        "modelName": description.model_name,
        dialect.names.token: token,
        "description": description.summary,
        "generationTool": exporter(),
        "license": "BSD-3-Clause",
        "variableNamingConvention": "structured",
    }
    if dialect.indicator_count is not None:
        indicators = description.layout.of_role(INDICATOR)
        attributes[dialect.indicator_count] = str(sum(group.size for group in indicators))
    root = ET.Element("fmiModelDescription", attributes)
    _interfaces(root, description, dialect)
    _units(root, {group.unit for group in description.layout.groups})
    categories = ET.SubElement(root, "LogCategories")
    for name, text in LOG_CATEGORIES.items():
        ET.SubElement(categories, "Category", name=name, description=text)
    experiment = {
        "startTime": "0",
        "stopTime": "10",
        "tolerance": "1e-6",
        "stepSize": repr(description.step),
    }
    ET.SubElement(root, "DefaultExperiment", experiment)
    variables = ET.SubElement(root, "ModelVariables")
    structure = ET.SubElement(root, "ModelStructure")
    if dialect.arrays:
        _array_variables(variables, description)
        _array_structure(structure, description, dialect)
    else:
        _scalar_variables(variables, description)
        _scalar_structure(structure, description, dialect)
    return xml_bytes(root)


def _interfaces(root: ET.Element, description: Description, dialect: ExportDialect) -> None:
    """Add model exchange, if there is one, and co-simulation with their capabilities."""
    attributes = {"modelIdentifier": description.model_identifier}
    attributes |= dict.fromkeys(dialect.capabilities, "true")
    attributes |= dict.fromkeys(dialect.differentiation, str(description.exchange).lower())
    interfaces = {"CoSimulation": {"canHandleVariableCommunicationStepSize": "true"}}
    if description.exchange:
        interfaces = {"ModelExchange": dict(dialect.exchange), **interfaces}
    for name, more in interfaces.items():
        interface = ET.SubElement(root, name, {**attributes, **more})
        if dialect.describes_sources:
            files = ET.SubElement(interface, "SourceFiles")
            for source in description.sources:
                ET.SubElement(files, "File", name=source)


def write_build_description(description: Description) -> bytes:
    """Return sources/buildDescription.xml of FMI 3.0."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(
        root, "BuildConfiguration", modelIdentifier=description.model_identifier
    )
    files = ET.SubElement(configuration, "SourceFileSet", language="C11")
    for name in description.sources:
        ET.SubElement(files, "SourceFile", name=name)
    ET.SubElement(
        configuration,
        "Library",
        name="m",
        external="true",
        description="C's mathematical functions",
    )
    return xml_bytes(root)


def write_references(files: Iterable[tuple[str, str, str]]) -> bytes:
    """Return the manifest of FMI-LS-REF.

    Args:
        files: path relative to the manifest, role and description of each related CSV file.
    """
    namespace = "http://fmi-standard.org/fmi-ls-manifest"
    ET.register_namespace("fmi-ls", namespace)
    attributes = {
        f"{{{namespace}}}fmi-ls-name": REFERENCES,
        f"{{{namespace}}}fmi-ls-version": REFERENCES_VERSION,
        f"{{{namespace}}}fmi-ls-description": "Layered Standard providing information on related files included in "
        "an FMU.",
    }
    root = ET.Element("fmiReferences", attributes)
    for source, role, text in files:
        ET.SubElement(root, "Related", type="text/csv", source=source, role=role, description=text)
    return xml_bytes(root)


def _units(root: ET.Element, used: set[str]) -> None:
    definitions = ET.SubElement(root, "UnitDefinitions")
    # A pixel, or any other unit of a set-up, is a number.
    own: dict[str, dict[str, str]] = {}
    for name in sorted(used - set(UNITS)):
        own[name] = {"rad": "-1"} if name.endswith("/rad") else {}
    for name, exponents in (UNITS | own).items():
        unit = ET.SubElement(definitions, "Unit", name=name)
        ET.SubElement(unit, "BaseUnit", exponents)
        if name in DISPLAY_UNITS:
            ET.SubElement(unit, "DisplayUnit", name=DISPLAY_UNITS[name], factor=repr(180 / math.pi))


def _scalar_variables(parent: ET.Element, description: Description) -> None:
    """Add every number as a variable."""
    layout = description.layout
    for group in layout.groups:
        first = layout.offsets[group.name]
        starts = _starts(group, description)
        for k, name in enumerate(group.scalar_names()):
            number = _number(group)
            if group.role in STARTED:
                number["start"] = starts[k]
            if group.role == DERIVATIVE:
                # Variables are counted from 1 here.
                number["derivative"] = str(_state_offset(group, layout) + k + 1)
            variable = ET.SubElement(parent, "ScalarVariable", _identity(group, name, first + k))
            ET.SubElement(variable, "Real", number)


def _array_variables(parent: ET.Element, description: Description) -> None:
    """Add every group as a variable, and the time."""
    layout = description.layout
    for group in layout.groups:
        attributes = _identity(group, group.name, layout.offsets[group.name]) | _number(group)
        if group.role in STARTED:
            attributes["start"] = " ".join(_starts(group, description))
        if group.role == DERIVATIVE:
            attributes["derivative"] = str(_state_offset(group, layout))
        variable = ET.SubElement(parent, "Float64", attributes)
        for size in group.shape:
            ET.SubElement(variable, "Dimension", start=str(size))
    time = {
        "name": "time",
        "valueReference": str(layout.size),
        "causality": "independent",
        "variability": "continuous",
        "unit": "s",
        "description": "Simulation time.",
    }
    ET.SubElement(parent, "Float64", time)


def _identity(group: Group, name: str, reference: int) -> dict[str, str]:
    """Return name, value reference, role and description of a variable."""
    attributes = {"name": name, "valueReference": str(reference), **ATTRIBUTES[group.role]}
    attributes["description"] = group.description
    return attributes


def _number(group: Group) -> dict[str, str]:
    """Return units and bounds of the numbers of a group."""
    attributes = {"unit": group.unit}
    if group.unit in DISPLAY_UNITS:
        attributes["displayUnit"] = DISPLAY_UNITS[group.unit]
    if group.minimum is not None:
        attributes["min"] = str(group.minimum)
    if group.nominal is not None:
        attributes["nominal"] = str(group.nominal)
    return attributes


def _starts(group: Group, description: Description) -> list[str]:
    """Return the start value of each number of a group."""
    values = description.start.get(group.name)
    if values is None:
        return ["0.0"] * group.size
    return [repr(float(value)) for value in values]


def _state_offset(derivative: Group, layout: Layout) -> int:
    """Return the offset of the state whose derivative a group is."""
    return layout.offsets[derivative.name.removeprefix("der(").removesuffix(")")]


def _scalar_structure(
    structure: ET.Element, description: Description, dialect: ExportDialect
) -> None:
    """Add a list of unknowns for every part of the model structure."""
    for section in description.sections:
        if section.part in dialect.sections:
            element = ET.SubElement(structure, dialect.sections[section.part])
            for index, dependencies in section.scalars():
                # Variables are counted from 1 here.
                indices = [dependency + 1 for dependency in dependencies]
                attributes = {"index": str(index + 1)} | _dependent(indices)
                ET.SubElement(element, "Unknown", attributes)


def _array_structure(
    structure: ET.Element, description: Description, dialect: ExportDialect
) -> None:
    """Add the unknowns of every part of the model structure."""
    for section in description.sections:
        if section.part in dialect.sections:
            for reference, dependencies in section.arrays():
                attributes = {"valueReference": str(reference)} | _dependent(dependencies)
                ET.SubElement(structure, dialect.sections[section.part], attributes)


def _dependent(dependencies: list[int]) -> dict[str, str]:
    return {
        "dependencies": " ".join(map(str, dependencies)),
        "dependenciesKind": " ".join(["dependent"] * len(dependencies)),
    }


def xml_bytes(root: ET.Element) -> bytes:
    """Return the text of an XML file, one line for each element."""
    ET.indent(root)
    text: str = ET.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'.encode()
