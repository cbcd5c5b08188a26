"""The command `servobench selftest`: results that others can check."""

from __future__ import annotations

import sys
from typing import Annotated

from servobench.harness.cli import selection
from servobench.harness.cli.options import option
from servobench.harness.cli.terminal import FAILED, say
from servobench.plant.contract.faults import ConfigurationError


def selftest(
    plants: Annotated[
        str, option("NAMES", "Comma-separated: kinematic, bullet, mujoco; default: kinematic.")
    ] = "kinematic",
) -> None:
    """Say whether this machine computes as the pages' did.

    Elementary functions, linear algebra and short runs are held against stored numbers. The exit code is 1 if a bit
    differs.
    """
    from servobench.harness.apps.board import selftest as test
    from servobench.harness.batch.fingerprint import numbers
    from servobench.plant.contract.settings import suggest

    machine, wanted = test.read_reference()
    names = selection.split("plants", plants)
    for name in names:
        if name not in wanted:
            raise ConfigurationError(f"--plants: {name} has no reference: {suggest(name, wanted)}")
    parts = list(test.compare(numbers(names, test.METHODS), wanted))
    say(f"here: {test.describe_machine()}")
    say(f"reference: {machine}")
    say("\n".join(map(str, parts)))
    different = sum(part.difference > 0.0 for part in parts)
    if different:
        say(f"{different} of {len(parts)} parts differ from the reference")
        sys.exit(FAILED)
    say("this machine computes bit for bit as the reference did")
