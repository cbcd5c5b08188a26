"""What differs between the versions of FMI in the files of an exported FMU: one row of facts for each version."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from servobench.plant.fmu.dialect import FMI2, FMI3, FmiDialect

# Parts of the model structure.
OUTPUTS: Final = "outputs"
DERIVATIVES: Final = "derivatives"
INITIAL_UNKNOWNS: Final = "initial unknowns"
INDICATORS: Final = "event indicators"


@dataclass(frozen=True)
class ExportDialect:
    """The names of one version of FMI in the files of an FMU."""

    names: FmiDialect  # those that an importer knows as well
    headers: tuple[str, ...]  # those of the standard that the C sources include
    arrays: bool  # whether a variable may be an array; else every number is a variable
    reference: str  # attribute by which an unknown names its variable
    first_index: int  # number of the first variable where one names another
    sections: Mapping[
        str, str
    ]  # part of the model structure -> its element; without one it is left out
    capabilities: tuple[str, ...]  # those that every model has
    differentiation: tuple[str, ...]  # capabilities of models with derivatives
    indicator_count: str | None  # attribute of the description; None: importers count themselves
    # Whether sources are listed in the description; else in a file of their own.
    describes_sources: bool
    exchange: Mapping[str, str] = field(
        default_factory=dict
    )  # further attributes of model exchange


_FMI2: Final = ExportDialect(
    names=FMI2,
    headers=("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    arrays=False,
    reference="index",
    first_index=1,
    sections={
        OUTPUTS: "Outputs",
        DERIVATIVES: "Derivatives",
        INITIAL_UNKNOWNS: "InitialUnknowns",
    },
    capabilities=(
        "canNotUseMemoryManagementFunctions",
        "canGetAndSetFMUstate",
        "canSerializeFMUstate",
    ),
    differentiation=("providesDirectionalDerivative",),
    indicator_count="numberOfEventIndicators",
    describes_sources=True,
    exchange={"completedIntegratorStepNotNeeded": "false"},
)
_FMI3: Final = ExportDialect(
    names=FMI3,
    headers=("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
    arrays=True,
    reference="valueReference",
    first_index=0,
    sections={
        OUTPUTS: "Output",
        DERIVATIVES: "ContinuousStateDerivative",
        INITIAL_UNKNOWNS: "InitialUnknown",
        INDICATORS: "EventIndicator",
    },
    capabilities=("canGetAndSetFMUState", "canSerializeFMUState"),
    differentiation=("providesDirectionalDerivatives", "providesAdjointDerivatives"),
    indicator_count=None,
    describes_sources=False,
)
EXPORTS: Final = {dialect.names.version: dialect for dialect in (_FMI2, _FMI3)}


def export_dialect(fmi_version: int) -> ExportDialect:
    """Return the dialect of a version of FMI.

    Raises:
        ValueError: it is not exported.
    """
    if fmi_version not in EXPORTS:
        known = " or ".join(map(str, EXPORTS))
        raise ValueError(f"fmi_version must be {known}, got {fmi_version}")
    return EXPORTS[fmi_version]
