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
    """One part of the model structure: which unknown depends on which groups, elementwise or as a whole.

    FMI 2 has no element for event indicators.
    """

    fmi2: str
    fmi3: str
    layout: Layout
    unknowns: _Rows

    def scalars(self) -> Iterable[tuple[int, list[int]]]:
        """Yield index and dependencies of every number; FMI 2 wants them in ascending order."""
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
        Section("Outputs", "Output", layout, outputs),
        Section("Derivatives", "ContinuousStateDerivative", layout, derivatives),
        Section("InitialUnknowns", "InitialUnknown", layout, start),
        Section("", "EventIndicator", layout, indicators),
    )


def sampled_sections(layout: Layout) -> tuple[Section, ...]:
    """Return outputs and initial unknowns of a system in discrete time: every output depends on every input."""
    inputs = tuple(group.name for group in layout.of_role(INPUT))
    rows: _Rows = [(group.name, inputs, False) for group in layout.of_role(SAMPLED)]
    return (
        Section("Outputs", "Output", layout, rows),
        Section("InitialUnknowns", "InitialUnknown", layout, rows),
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


def write_description(description: Description, version: int, token: str) -> bytes:
    """Return modelDescription.xml of FMI 2.0 or 3.0 with its GUID or instantiation token."""
    attributes = {
        "fmiVersion": f"{version}.0",
        "modelName": description.model_name,
        "guid" if version == 2 else "instantiationToken": token,
        "description": description.summary,
        "generationTool": exporter(),
        "license": "BSD-3-Clause",
        "variableNamingConvention": "structured",
    }
    if version == 2:
        indicators = description.layout.of_role(INDICATOR)
        attributes["numberOfEventIndicators"] = str(sum(group.size for group in indicators))
    root = ET.Element("fmiModelDescription", attributes)
    _interfaces(root, description, version)
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
    _variables(ET.SubElement(root, "ModelVariables"), description, version)
    structure = ET.SubElement(root, "ModelStructure")
    for section in description.sections:
        if version == 3:
            for reference, dependencies in section.arrays():
                attributes = {"valueReference": str(reference)} | _dependent(dependencies)
                ET.SubElement(structure, section.fmi3, attributes)
        elif section.fmi2:
            element = ET.SubElement(structure, section.fmi2)
            for index, dependencies in section.scalars():
                # FMI 2 counts variables from 1 here.
                indices = [dependency + 1 for dependency in dependencies]
                attributes = {"index": str(index + 1)} | _dependent(indices)
                ET.SubElement(element, "Unknown", attributes)
    return xml_bytes(root)


def _interfaces(root: ET.Element, description: Description, version: int) -> None:
    """Add model exchange, if there is one, and co-simulation with their capabilities."""
    derivatives = str(description.exchange).lower()
    state = "FMUstate" if version == 2 else "FMUState"
    capabilities = {"modelIdentifier": description.model_identifier}
    if version == 2:
        capabilities["canNotUseMemoryManagementFunctions"] = "true"
    capabilities[f"canGetAndSet{state}"] = "true"
    capabilities[f"canSerialize{state}"] = "true"
    if version == 2:
        capabilities["providesDirectionalDerivative"] = derivatives
    else:
        capabilities["providesDirectionalDerivatives"] = derivatives
        capabilities["providesAdjointDerivatives"] = derivatives
    interfaces = {"CoSimulation": {"canHandleVariableCommunicationStepSize": "true"}}
    if description.exchange:
        own = {"completedIntegratorStepNotNeeded": "false"} if version == 2 else {}
        interfaces = {"ModelExchange": own, **interfaces}
    for name, more in interfaces.items():
        interface = ET.SubElement(root, name, {**capabilities, **more})
        if version == 2:
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


def _variables(parent: ET.Element, description: Description, version: int) -> None:
    """Add every number of FMI 2, every group and the time of FMI 3."""
    layout = description.layout
    for group in layout.groups:
        first = layout.offsets[group.name]
        starts = ["0.0"] * group.size
        values = description.start.get(group.name)
        if values is not None:
            starts = [repr(float(value)) for value in values]
        names = group.scalar_names() if version == 2 else [group.name]
        for k, name in enumerate(names):
            attributes = {"name": name, "valueReference": str(first + k), **ATTRIBUTES[group.role]}
            attributes["description"] = group.description
            real = {"unit": group.unit}
            if group.unit in DISPLAY_UNITS:
                real["displayUnit"] = DISPLAY_UNITS[group.unit]
            if group.minimum is not None:
                real["min"] = str(group.minimum)
            if group.nominal is not None:
                real["nominal"] = str(group.nominal)
            if group.role in (PARAMETER, FIXED, INPUT):
                real["start"] = starts[k] if version == 2 else " ".join(starts)
            if group.role == DERIVATIVE:
                state = layout.offsets[group.name.removeprefix("der(").removesuffix(")")]
                real["derivative"] = str(state + k + 1 if version == 2 else state)
            if version == 2:
                scalar = ET.SubElement(parent, "ScalarVariable", attributes)
                ET.SubElement(scalar, "Real", real)
            else:
                variable = ET.SubElement(parent, "Float64", attributes | real)
                for size in group.shape:
                    ET.SubElement(variable, "Dimension", start=str(size))
    if version == 3:
        time = {
            "name": "time",
            "valueReference": str(layout.size),
            "causality": "independent",
            "variability": "continuous",
            "unit": "s",
            "description": "Simulation time.",
        }
        ET.SubElement(parent, "Float64", time)


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
