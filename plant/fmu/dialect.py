"""What differs between the versions of FMI, by name: one row of facts for each version.

A dialect holds what an importer needs and what both sides share; what only an export needs is in `fmus.dialect`. Calls
whose arguments differ are methods of the classes in `plant.fmu.instances`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from servobench.plant.contract.facts import read_facts

# For settings.
FmiVersion: TypeAlias = Literal[2, 3]


@dataclass(frozen=True)
class FmiDialect:
    """The names of one version of FMI, on either side."""

    version: int  # first number of its version
    prefix: str  # begins the names of all functions in the library
    token: str  # attribute of the description with the token that an importer passes on
    # Whether folders of libraries are named by the system alone, such as linux64, not by processor and system.
    system_folders: bool
    # Word for real numbers in the names of the functions that read and write them.
    real: str
    # The same word for each numeric type of variables, and numpy's name of its numbers in memory
    kinds: Mapping[str, tuple[str, str]]
    state: str  # word for states in the names of functions and capabilities
    deserialise: str  # the verb of the function that reads a state from bytes
    derivatives: str  # name of the function that reads the states' derivatives
    early: str  # word for a step that ended early, in messages


FMI = read_facts("fmi")
FMI2 = FmiDialect(**FMI["fmi2"])
FMI3 = FmiDialect(**FMI["fmi3"])
INTEGERS = FMI["integers"]
DIALECTS = {dialect.version: dialect for dialect in (FMI2, FMI3)}
