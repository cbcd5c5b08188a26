"""Reads an FMU (version, interfaces, platforms, capabilities, variables), and checks it.

The checks are those of the archive and the description (by fmpy), and a run against the reference inside it.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from fmpy.validation import validate_fmu as validate_by_fmpy

from servobench.fmus.reference import INPUT_FILE, OUTPUT_FILE, read_table
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import FmuError, one_line
from servobench.plant.fmu.archive import DESCRIPTION, extract_fmu
from servobench.plant.fmu.description import (
    IDENTIFIER,
    FmuDescription,
    Variable,
    parse_description,
    read_description,
    read_time,
)
from servobench.plant.fmu.instance import Port
from servobench.plant.fmu.instances import open_instance

MAX_START = 1e12  # [s] A larger clock loses steps of milliseconds.
TOLERANCE = 1e-9  # [1] largest relative difference of a run from the reference


@dataclass(frozen=True)
class FmuInformation:
    """Content of an FMU."""

    description: Any  # the model description, as fmpy reads it
    # The interfaces that it offers, co-simulation, model exchange and scheduled execution, each with the names of
    # its capabilities.
    interfaces: Mapping[str, tuple[str, ...]]
    platforms: tuple[str, ...]  # folders below binaries/
    has_sources: bool  # whether it holds its C sources


def read_information(path: Path) -> FmuInformation:
    """Read the FMU at `path`.

    Raises:
        ValueError: it is not an FMU.
    """
    root = extract_fmu(path)
    binaries = root / "binaries"
    platforms = []
    if binaries.is_dir():
        platforms = sorted(item.name for item in binaries.iterdir())
    return FmuInformation(
        description=parse_description(path, root),
        interfaces=_interfaces(root),
        platforms=tuple(platforms),
        has_sources=(root / "sources").is_dir(),
    )


INTERFACES = {
    "CoSimulation": "co-simulation",
    "ModelExchange": "model exchange",
    "ScheduledExecution": "scheduled execution",
}


def _interfaces(root: Path) -> dict[str, tuple[str, ...]]:
    """Return the capabilities by interface from the XML, since fmpy does not read all of FMI 3."""
    description = ET.parse(root / "modelDescription.xml").getroot()
    interfaces = {}
    for tag, name in INTERFACES.items():
        element = description.find(tag)
        if element is None:
            continue
        capabilities = []
        for key, value in element.attrib.items():
            if key.startswith(("can", "needs", "provides")) and value in ("true", "1"):
                capabilities.append(key)
        interfaces[name] = tuple(capabilities)
    return interfaces


@dataclass(frozen=True)
class Validation:
    """Result of the checks."""

    problems: tuple[str, ...]  # one line for each; empty if there are none
    # Departures from the standard, one line for each, with which it runs here nevertheless.
    departures: tuple[str, ...]
    # Largest difference from the reference run, or None without a reference run.
    deviation: float | None


def validate_fmu(path: Path) -> Validation:
    """Check the FMU at `path`.

    Raises:
        ValueError: it is not a co-simulation FMU of FMI 2 or 3.
    """
    root = extract_fmu(path)
    description = read_description(path, root)
    departures = list(map(one_line, validate_by_fmpy(str(path))))
    problems = [*_odd_times(root), *_odd_names(root)]
    deviation = None
    referenced = (root / INPUT_FILE).is_file() and (root / OUTPUT_FILE).is_file()
    try:
        if referenced:
            deviation = _deviation(description)
        else:
            with closing(open_instance(description)) as instance:
                instance.start(description.start_time)
    except (FmuError, ValueError) as error:
        failed = "the reference run failed" if referenced else "it cannot be made ready for a run"
        problems.append(f"{failed}: {error}")
    if deviation is not None and not deviation <= TOLERANCE:
        problems.append(
            f"the run differs from the reference by {deviation:.3g}, allowed is {TOLERANCE:g}"
        )
    return Validation(tuple(problems), tuple(departures), deviation)


def _odd_times(root: Path) -> Iterator[str]:
    """Yield the faults of the times and the tolerance of the default experiment."""
    experiment = "DefaultExperiment"
    start = read_time(root, experiment, "startTime", 0.0)
    stop = read_time(root, experiment, "stopTime", max(start, 0.0) + 1.0)
    step = read_time(root, experiment, "stepSize", 1e-3)
    tolerance = read_time(root, experiment, "tolerance", 1e-3)
    if not abs(start) < MAX_START:
        yield f"startTime of the default experiment must be within {MAX_START:g} s, got {start:g}"
    if not start < stop < math.inf:
        yield f"stopTime of the default experiment must be later than startTime, {start:g}, got {stop:g}"
    if not 0.0 < step < math.inf:
        yield f"stepSize of the default experiment must be above 0, got {step:g}"
    if not 0.0 < tolerance < math.inf:
        yield f"tolerance of the default experiment must be above 0, got {tolerance:g}"


def _odd_names(root: Path) -> Iterator[str]:
    """Yield identifiers that are no names of a library, of every interface, and names of files that no one can type."""
    description = ET.parse(root / DESCRIPTION).getroot()
    for tag, name in INTERFACES.items():
        for element in description.findall(tag):
            identifier = element.get("modelIdentifier", "")
            if not IDENTIFIER.fullmatch(identifier):
                yield f"modelIdentifier of {name} must be the name of a library, without folders, got {identifier!r}"
    for file in root.rglob("*"):
        if not file.name.isprintable():
            yield f"the name of a file must have printable letters, got {str(file.relative_to(root))!r}"


def _deviation(description: FmuDescription) -> float:
    """Run the FMU under the reference commands and return the largest difference of its outputs."""
    root = description.root
    header_in, commands = read_table((root / INPUT_FILE).read_text(encoding="utf-8"))
    header_out, wanted = read_table((root / OUTPUT_FILE).read_text(encoding="utf-8"))
    inputs = Port(_variables(description, header_in))
    outputs = Port(_variables(description, header_out))
    # The first column of a table is the time.
    inputs_fit = commands.shape[1] == inputs.values.size + 1
    outputs_fit = wanted.shape == (len(commands), outputs.values.size + 1)
    if not inputs_fit or not outputs_fit:
        raise ValueError("the reference tables do not fit the FMU's variables")
    with closing(open_instance(description)) as instance:
        write = instance.writer(inputs)
        read = instance.reader(outputs)
        times = commands[:, 0]
        instance.start(float(times[0]))
        came: FloatArray = np.empty_like(wanted[:, 1:])
        for k, time in enumerate(times):
            read()
            came[k] = outputs.values
            inputs.values[:] = commands[k, 1:]
            write()
            if k + 1 < len(times):
                advance = instance.stepper(float(times[k + 1] - time))
                advance(float(time))
    # Differences of large numbers are relative: the pixels of a point beside a camera are large.
    size = np.maximum(1.0, np.abs(wanted[:, 1:]))
    difference = np.abs(came - wanted[:, 1:])
    return float((difference / size).max())


def _variables(description: FmuDescription, header: list[str]) -> list[Variable]:
    """Return the variables of the columns; in FMI 3 the columns `name[1]`, … belong to one array variable."""
    known = {variable.name for variable in description.variables}
    names = [name if name in known else name.partition("[")[0] for name in header[1:]]
    variables = []
    for name in dict.fromkeys(names):
        variables += description.find(name, "reference run")
    return variables
