"""What differs between the versions of FMI, by name: one row of facts for each version.

A dialect holds what an importer needs and what both sides share; what only an export needs is in `fmus.dialect`. Calls
whose arguments differ are methods of the classes in `plant.fmu.instances`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

import numpy as np

# Type of a variable -> word in the names of functions, type in memory
Kinds: TypeAlias = Mapping[str, tuple[str, Any]]
# For settings.
FmiVersion: TypeAlias = Literal[2, 3]
# Whole numbers of FMI 3 -> their type in memory.
WHOLE_TYPES: Final = {
    f"{sign}Int{bits}": f"{sign}int{bits}".lower() for sign in ("", "U") for bits in (8, 16, 32, 64)
}


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
    kinds: Kinds  # the same word for each numeric type, and how its numbers lie in memory
    state: str  # word for states in the names of functions and capabilities
    deserialise: str  # the verb of the function that reads a state from bytes
    derivatives: str  # name of the function that reads the states' derivatives
    early: str  # word for a step that ended early, in messages


FMI2: Final = FmiDialect(
    version=2,
    prefix="fmi2",
    token="guid",
    system_folders=True,
    real="Real",
    kinds={
        "Real": ("Real", np.float64),
        "Integer": ("Integer", np.int32),
        "Enumeration": ("Integer", np.int32),
        "Boolean": ("Boolean", np.int32),
    },
    state="FMUstate",
    deserialise="DeSerialize",
    derivatives="GetDerivatives",
    early="discard",
)
FMI3: Final = FmiDialect(
    version=3,
    prefix="fmi3",
    token="instantiationToken",
    system_folders=False,
    real="Float64",
    kinds={
        "Float64": ("Float64", np.float64),
        "Float32": ("Float32", np.float32),
        **{word: (word, kind) for word, kind in WHOLE_TYPES.items()},
        "Enumeration": ("Int64", np.int64),
        "Boolean": ("Boolean", np.bool_),
    },
    state="FMUState",
    deserialise="Deserialize",
    derivatives="GetContinuousStateDerivatives",
    early="early",
)
DIALECTS: Final = {dialect.version: dialect for dialect in (FMI2, FMI3)}
