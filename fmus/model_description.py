"""Writes modelDescription.xml for FMI 2.0 and 3.0: co-simulation and, where a model has it, model exchange.

The dependencies of the unknowns are columns of the table of variables. The text holds no date and no machine name, so
equal models give equal bytes.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import metadata
from itertools import chain

import numpy as np

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
    Group,
    Layout,
)
from servobench.plant.contract.checks import NamedArrays
from servobench.plant.contract.facts import read_beside

_TABLES = read_beside(__file__, "model_description.toml")
UNITS: dict[str, dict[str, str]] = _TABLES["units"]
DISPLAY_UNITS: dict[str, str] = _TABLES["display_units"]
ATTRIBUTES: dict[str, dict[str, str]] = _TABLES["roles"]
STARTED = (PARAMETER, FIXED, INPUT)  # roles with start values
REFERENCES = "org.fmi-standard.fmi-ls-ref"  # the layered standard for the roles of related files
REFERENCES_VERSION = "1.0.0-alpha.1"
# Part of the model structure -> roles of its unknowns.
UNKNOWNS = {
    OUTPUTS: (STATE, OUTPUT, SAMPLED),
    DERIVATIVES: (DERIVATIVE,),
    INITIAL_UNKNOWNS: (STATE, DERIVATIVE, OUTPUT, SAMPLED),
    INDICATORS: (INDICATOR,),
}


@dataclass(frozen=True)
class Description:
    """Content of a model description."""

    model_name: str  # display name
    model_identifier: str  # file name of the libraries
    summary: str  # one sentence
    layout: Layout  # the variables
    # Start values of parameters and inputs, flat arrays by group; all others are zero.
    start: NamedArrays
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
    for name, text in _TABLES["log_categories"].items():
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
    _variables(variables, description, dialect)
    _structure(structure, description.layout, dialect)
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
    attributes = {
        "xmlns:fmi-ls": "http://fmi-standard.org/fmi-ls-manifest",
        "fmi-ls:fmi-ls-name": REFERENCES,
        "fmi-ls:fmi-ls-version": REFERENCES_VERSION,
        "fmi-ls:fmi-ls-description": "Layered Standard providing information on related files included in an FMU.",
    }
    root = ET.Element("fmiReferences", attributes)
    for source, role, text in files:
        ET.SubElement(root, "Related", type="text/csv", source=source, role=role, description=text)
    return xml_bytes(root)


def _units(root: ET.Element, used: set[str]) -> None:
    definitions = ET.SubElement(root, "UnitDefinitions")
    # A pixel, or any other unit of a set-up, is a number.
    own = {}
    for name in sorted(used - set(UNITS)):
        own[name] = {"rad": "-1"} if name.endswith("/rad") else {}
    for name, exponents in (UNITS | own).items():
        unit = ET.SubElement(definitions, "Unit", name=name)
        ET.SubElement(unit, "BaseUnit", exponents)
        if name in DISPLAY_UNITS:
            ET.SubElement(unit, "DisplayUnit", name=DISPLAY_UNITS[name], factor=repr(180 / math.pi))


def _variables(parent: ET.Element, description: Description, dialect: ExportDialect) -> None:
    """Add every group as a variable, and the time; or every number, where there are no arrays."""
    layout = description.layout
    for group in layout.groups:
        first = layout.offsets[group.name]
        values = np.resize(description.start.get(group.name, np.zeros(1)), group.size)
        starts = [repr(float(value)) for value in values]
        pieces = {group.name: " ".join(starts)}
        if not dialect.arrays:
            pieces = dict(zip(group.scalar_names(), starts, strict=True))
        for k, (name, start) in enumerate(pieces.items()):
            identity = {"name": name, "valueReference": str(first + k), **ATTRIBUTES[group.role]}
            identity["description"] = group.description
            number = _number(group)
            if group.role in STARTED:
                number["start"] = start
            if group.role == DERIVATIVE:
                state = group.name.removeprefix("der(").removesuffix(")")
                number["derivative"] = str(layout.offsets[state] + k + dialect.first_index)
            if dialect.arrays:
                variable = ET.SubElement(parent, "Float64", identity | number)
                for size in group.shape:
                    ET.SubElement(variable, "Dimension", start=str(size))
            else:
                variable = ET.SubElement(parent, "ScalarVariable", identity)
                ET.SubElement(variable, "Real", number)
    if dialect.arrays:
        time = {
            "name": "time",
            "valueReference": str(layout.size),
            "causality": "independent",
            "variability": "continuous",
            "unit": "s",
            "description": "Simulation time.",
        }
        ET.SubElement(parent, "Float64", time)


def _number(group: Group) -> dict[str, str]:
    """Return units and bounds of the numbers of a group."""
    attributes = {"unit": group.unit}
    if group.unit in DISPLAY_UNITS:
        attributes["displayUnit"] = DISPLAY_UNITS[group.unit]
    return attributes | dict(group.attributes)


def _structure(structure: ET.Element, layout: Layout, dialect: ExportDialect) -> None:
    """Add the unknowns of every part of the model structure; without arrays, in a list for each part."""
    for part, name in dialect.sections.items():
        unknowns = layout.of_role(*UNKNOWNS[part])
        parent = structure
        element = name
        if unknowns and not dialect.arrays:
            parent = ET.SubElement(structure, name)
            element = "Unknown"
        for unknown in unknowns:
            words = unknown.initially if part == INITIAL_UNKNOWNS else unknown.depends
            for k, dependencies in enumerate(_dependencies(layout, unknown, words, dialect)):
                index = layout.offsets[unknown.name] + k + dialect.first_index
                attributes = {
                    dialect.reference: str(index),
                    "dependencies": " ".join(map(str, dependencies)),
                    "dependenciesKind": " ".join(["dependent"] * len(dependencies)),
                }
                ET.SubElement(parent, element, attributes)


def _dependencies(
    layout: Layout, unknown: Group, words: Iterable[str], dialect: ExportDialect
) -> Iterator[list[int]]:
    """Yield the indices of what an unknown depends on: of an array as a whole, else of each of its numbers."""
    groups = layout.dependencies(words)
    firsts = [layout.offsets[group.name] + dialect.first_index for group in groups]
    if dialect.arrays:
        yield firsts
        return
    for k in range(unknown.size):
        if unknown.elementwise:
            yield [first + k for first in firsts]
        else:
            ranges = [
                range(first, first + group.size)
                for first, group in zip(firsts, groups, strict=True)
            ]
            yield [*chain.from_iterable(ranges)]


def xml_bytes(root: ET.Element) -> bytes:
    """Return the text of an XML file, one line for each element."""
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'.encode()
