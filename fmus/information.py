"""Reads version, interfaces, platforms, capabilities and variables of an FMU."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.description import parse_description


@dataclass(frozen=True)
class VariableInformation:
    """One variable of the model description."""

    name: str
    type: str
    shape: tuple[int, ...]
    causality: str
    variability: str
    unit: str
    start: str
    description: str


@dataclass(frozen=True)
class FmuInformation:
    """Content of a model description.

    Attributes:
        fmi_version: as written.
        model_name: display name.
        token: GUID or instantiation token.
        tool: generation tool.
        interfaces: those of co-simulation, model exchange and scheduled execution that it offers, each with the names
            of its capabilities.
        platforms: folders below binaries/.
        has_sources: whether it holds its C sources.
        variables: all of them, in order.
    """

    fmi_version: str
    model_name: str
    token: str
    tool: str
    interfaces: Mapping[str, tuple[str, ...]]
    platforms: tuple[str, ...]
    has_sources: bool
    variables: tuple[VariableInformation, ...]


def read_information(path: Path) -> FmuInformation:
    """Read the FMU at `path`.

    Raises:
        ValueError: it is not an FMU.
    """
    root = extract_fmu(path)
    description = parse_description(path, root)
    binaries = root / "binaries"
    return FmuInformation(
        fmi_version=str(description.fmiVersion),
        model_name=str(description.modelName),
        token=str(description.guid or description.instantiationToken),
        tool=str(description.generationTool or "unknown"),
        interfaces=_interfaces(root),
        platforms=tuple(sorted(item.name for item in binaries.iterdir())) if binaries.is_dir() else (),
        has_sources=(root / "sources").is_dir(),
        variables=tuple(_variable(variable) for variable in description.modelVariables),
    )


INTERFACES = {
    "CoSimulation": "co-simulation",
    "ModelExchange": "model exchange",
    "ScheduledExecution": "scheduled execution",
}


def _interfaces(root: Path) -> dict[str, tuple[str, ...]]:
    """Return the capabilities by interface from the XML, since fmpy does not read all of FMI 3."""
    description = ET.parse(root / "modelDescription.xml").getroot()
    elements = {name: description.find(tag) for tag, name in INTERFACES.items()}
    return {
        name: tuple(
            key
            for key, value in element.attrib.items()
            if key.startswith(("can", "needs", "provides")) and value in ("true", "1")
        )
        for name, element in elements.items()
        if element is not None
    }


def _variable(variable: Any) -> VariableInformation:  # noqa: ANN401 - as above
    axes = variable.dimensions or ()
    sizes = [each.start if each.start is not None else getattr(each.variable, "start", None) for each in axes]
    return VariableInformation(
        name=variable.name,
        type=variable.type,
        shape=tuple(int(size) for size in sizes if size is not None),
        causality=variable.causality or "local",
        variability=variable.variability or "continuous",
        unit=variable.unit or "",
        start=str(variable.start or ""),
        description=variable.description or "",
    )
