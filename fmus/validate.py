"""Checks an FMU: the archive, the description (by fmpy), and a run against the reference inside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from fmpy.validation import validate_fmu as validate_by_fmpy

from servobench.fmus.reference import INPUT_FILE, OUTPUT_FILE, read_table
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import FmuError
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.description import FmuDescription, Variable, read_description
from servobench.plant.fmu.instances import open_instance
from servobench.plant.fmu.port import Port

TOLERANCE = 1e-9


@dataclass(frozen=True)
class Validation:
    """Result of the checks.

    Attributes:
        problems: one line for each; empty if there are none.
        deviation: largest difference from the reference run, or None without a reference run.
    """

    problems: tuple[str, ...]
    deviation: float | None


def validate_fmu(path: Path) -> Validation:
    """Check the FMU at `path`.

    Raises:
        ValueError: it is not a co-simulation FMU of FMI 2 or 3.
    """
    root = extract_fmu(path)
    description = read_description(path, root)
    problems = [" ".join(str(problem).split()) for problem in validate_by_fmpy(str(path))]
    deviation = None
    if (root / INPUT_FILE).is_file() and (root / OUTPUT_FILE).is_file():
        try:
            deviation = _deviation(description, root)
        except (FmuError, ValueError) as error:
            problems.append(f"the reference run failed: {error}")
    if deviation is not None and not deviation <= TOLERANCE:
        problems.append(f"the run differs from the reference by {deviation:.3g}, allowed is {TOLERANCE:g}")
    return Validation(tuple(problems), deviation)


def _deviation(description: FmuDescription, root: Path) -> float:
    """Run the FMU under the reference commands and return the largest difference of its outputs."""
    header_in, commands = read_table((root / INPUT_FILE).read_text(encoding="utf-8"))
    header_out, wanted = read_table((root / OUTPUT_FILE).read_text(encoding="utf-8"))
    inputs, outputs = Port(_variables(description, header_in)), Port(_variables(description, header_out))
    if commands.shape[1] != inputs.values.size + 1 or wanted.shape != (len(commands), outputs.values.size + 1):
        raise ValueError("the reference tables do not fit the FMU's variables")
    instance = open_instance(description, root)
    try:
        write, read = instance.writer(inputs), instance.reader(outputs)
        times = commands[:, 0]
        instance.start(float(times[0]))
        came: FloatArray = np.empty_like(wanted[:, 1:])
        for k, time in enumerate(times):
            read()
            came[k] = outputs.values
            inputs.values[:] = commands[k, 1:]
            write()
            if k + 1 < len(times):
                instance.stepper(float(times[k + 1] - time))(float(time))
    finally:
        instance.close()
    size = np.maximum(1.0, np.abs(wanted[:, 1:]))  # pixels of a point beside a camera are large
    return float((np.abs(came - wanted[:, 1:]) / size).max())


def _variables(description: FmuDescription, header: list[str]) -> list[Variable]:
    """Return the variables of the columns; in FMI 3 the columns `name[1]`, … belong to one array variable."""
    known = {variable.name for variable in description.variables}
    names = [name if name in known else name.partition("[")[0] for name in header[1:]]
    return [variable for name in dict.fromkeys(names) for variable in description.find(name, "reference run")]
