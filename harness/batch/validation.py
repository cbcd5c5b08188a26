"""Checks an FMU in a process of its own, since its reference run carries out code that is not servobench's."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from servobench.fmus.inspection import Validation, validate_fmu
from servobench.harness.batch.guard import Task
from servobench.harness.batch.pool import Pool
from servobench.harness.batch.workers import Bounds
from servobench.harness.config.settings import ConfigurationError
from servobench.plant.contract.faults import FmuError


def validate_apart(path: Path) -> Validation:
    """Check the FMU at `path`; an FMU that ends its process has a problem.

    Raises:
        ConfigurationError: it is not a co-simulation FMU of FMI 2 or 3.
    """
    pool = Pool(1, Bounds().limits(1, foreign=True), (__name__,))
    try:
        answer = pool.submit(Task(_validate, os.fsencode(path), owner=str(path))).result()
    finally:
        pool.stop()
    found = answer.items[0] if answer.items else None
    if isinstance(found, str):
        raise ConfigurationError(found)
    if isinstance(found, Validation):
        return found
    reason = "it said nothing" if answer.end is None else answer.end.ending.reason
    return Validation((f"the reference run ended: {reason}",), None)


def _validate(path: bytes, tell: Callable[[Any], None]) -> None:
    """Check an FMU in a worker and tell what was found, or why nothing could be."""
    tell(None)  # the time limit begins after what is imported once
    try:
        tell(validate_fmu(Path(os.fsdecode(path))))
    except (ValueError, FmuError) as error:
        tell(str(error))
