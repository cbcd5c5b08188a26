"""The check of an FMU in an isolated process, which its library may end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from servobench.harness.batch.trials import attempt
from servobench.plant.contract.faults import FmuError, configuration_errors

if TYPE_CHECKING:
    from servobench.harness.apps.fmu.inspection import Validation


def validate(path: Path) -> Validation:
    """Check the FMU at `path`; an FMU that ends its process has a problem.

    Raises:
        ConfigurationError: it is not a co-simulation FMU of FMI 2 or 3.
    """
    from servobench.harness.apps.fmu.inspection import Validation  # noqa: PLC0415 - FMPy takes time to import
    from servobench.harness.batch.processes import FOREIGN_TIME  # noqa: PLC0415 - as above

    answer, failure = attempt(
        _validate, path, limit=FOREIGN_TIME, why=lambda end, _: end.reason, quiet=False
    )
    match answer:
        case [list(problems), list(departures), float() | None as deviation]:
            return Validation(tuple(map(str, problems)), tuple(map(str, departures)), deviation)
    return Validation((f"the reference run ended: {failure or 'it gave no answer'}",), (), None)


def _validate(path: Path) -> tuple[Sequence[str], Sequence[str], float | None]:
    from servobench.harness.apps.fmu.inspection import validate_fmu  # noqa: PLC0415 - as above

    with configuration_errors("", FmuError):
        found = validate_fmu(path)
    return found.problems, found.departures, found.deviation
