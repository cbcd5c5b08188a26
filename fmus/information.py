"""Tells what an FMU is: version, interfaces, platforms, capabilities and variables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plant.fmu_archive import FmuFolder
from plant.fmu_variables import parse_description


@dataclass(frozen=True)
class VariableInformation:
    """One variable, as the description has it."""

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
    """What an FMU says about itself.

    Attributes:
        fmi_version: as written.
        model_name: for people.
        token: GUID or instantiation token.
        tool: what made it.
        interfaces: of co-simulation, model exchange and scheduled execution, those it offers.
        platforms: folders below binaries/.
        capabilities: names of the boolean capabilities that are true for co-simulation (else model exchange).
        has_sources: it can be compiled.
        variables: all of them, in order.
    """

    fmi_version: str
    model_name: str
    token: str
    tool: str
    interfaces: tuple[str, ...]
    platforms: tuple[str, ...]
    capabilities: tuple[str, ...]
    has_sources: bool
    variables: tuple[VariableInformation, ...]


def read_information(path: Path) -> FmuInformation:
    """Read the FMU at `path`.

    Raises:
        ValueError: it is not an FMU.
    """
    folder = FmuFolder(path)
    try:
        root = folder.root
        description = parse_description(path, root)
        offered = {
            "co-simulation": description.coSimulation,
            "model exchange": description.modelExchange,
            "scheduled execution": description.scheduledExecution,
        }
        present = {name: interface for name, interface in offered.items() if interface is not None}
        binaries = root / "binaries"
        return FmuInformation(
            fmi_version=str(description.fmiVersion),
            model_name=str(description.modelName),
            token=str(description.guid or description.instantiationToken),
            tool=str(description.generationTool or "unknown"),
            interfaces=tuple(present),
            platforms=tuple(sorted(item.name for item in binaries.iterdir())) if binaries.is_dir() else (),
            capabilities=_capabilities(next(iter(present.values()), None)),
            has_sources=(root / "sources").is_dir(),
            variables=tuple(_variable(variable) for variable in description.modelVariables),
        )
    finally:
        folder.close()


CAPABILITIES = (
    "canHandleVariableCommunicationStepSize",
    "canGetAndSetFMUstate",
    "canSerializeFMUstate",
    "providesDirectionalDerivative",
    "providesDirectionalDerivatives",
    "canBeInstantiatedOnlyOncePerProcess",
    "needsExecutionTool",
)


def _capabilities(interface: Any) -> tuple[str, ...]:  # noqa: ANN401 - fmpy's classes carry no usable types
    return tuple(name for name in CAPABILITIES if getattr(interface, name, False))


def _variable(variable: Any) -> VariableInformation:  # noqa: ANN401 - as above
    dimensions = [dimension.start for dimension in variable.dimensions or ()]
    return VariableInformation(
        name=variable.name,
        type=variable.type,
        shape=tuple(int(start) for start in dimensions if start is not None),
        causality=variable.causality or "local",
        variability=variable.variability or "continuous",
        unit=variable.unit or "",
        start=str(variable.start or ""),
        description=variable.description or "",
    )
