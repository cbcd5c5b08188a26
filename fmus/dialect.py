"""What differs between the versions of FMI in the files of an exported FMU: one row of facts for each version."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from servobench.plant.contract.facts import read_beside
from servobench.plant.fmu.dialect import FMI2, FMI3, FmiDialect

# Parts of the model structure.
OUTPUTS = "outputs"
DERIVATIVES = "derivatives"
INITIAL_UNKNOWNS = "initial unknowns"
INDICATORS = "event indicators"


@dataclass(frozen=True)
class ExportDialect:
    """The names of one version of FMI in the files of an FMU."""

    names: FmiDialect  # those that an importer knows as well
    headers: Sequence[str]  # those of the standard that the C sources include
    arrays: bool  # whether a variable may be an array; else every number is a variable
    reference: str  # attribute by which an unknown names its variable
    first_index: int  # number of the first variable where one names another
    # Part of the model structure -> its element; without one it is left out.
    sections: Mapping[str, str]
    capabilities: Sequence[str]  # those that every model has
    differentiation: Sequence[str]  # capabilities of models with derivatives
    # Whether sources are listed in the description; else in a file of their own.
    describes_sources: bool
    # Attribute of the description; None: importers count themselves.
    indicator_count: str | None = None
    # Further attributes of model exchange.
    exchange: Mapping[str, str] = field(default_factory=dict)


_TABLES = read_beside(__file__, "dialect.toml")
EXPORTS = {names.version: ExportDialect(names, **_TABLES[names.prefix]) for names in (FMI2, FMI3)}


def export_dialect(fmi_version: int) -> ExportDialect:
    """Return the dialect of a version of FMI.

    Raises:
        ValueError: it is not exported.
    """
    if fmi_version not in EXPORTS:
        known = " or ".join(map(str, EXPORTS))
        raise ValueError(f"fmi_version must be {known}, got {fmi_version}")
    return EXPORTS[fmi_version]
