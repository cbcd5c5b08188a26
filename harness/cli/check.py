"""The command `servobench check`: a controller or a plant against its contract."""

from __future__ import annotations

import sys
from typing import Annotated, Final

import typer

from servobench.harness.cli.terminal import console

FAILED: Final = 1  # exit code
COLOURS: Final = {"ok": "green", "failed": "bold red", "note": "yellow"}


def check(
    subject: Annotated[
        list[str], typer.Argument(metavar="CONTROLLER | plant PLANT", help="As ./mine.py:Mine, or plant kinematic.")
    ],
    limit: Annotated[float, typer.Option(min=1.0, help="Time limit of one check [s].")] = 60.0,
) -> None:
    """Check a controller or a plant against its contract.

    Each failure says what to change.
    """
    from rich.text import Text

    from servobench.harness.batch.apart import Checks, check_apart
    from servobench.harness.check.controllers import check_controller
    from servobench.harness.check.plants import check_plant
    from servobench.harness.check.report import Finding
    from servobench.harness.config.settings import ConfigurationError

    if subject == ["plant"]:
        raise ConfigurationError("check plant needs a plant, such as servobench check plant ./cell.py")
    if subject[0] == "plant" and len(subject) == 2:
        checks: Checks = check_plant
        name = subject[1]
    elif len(subject) == 1:
        checks, name = check_controller, subject[0]
    else:
        raise ConfigurationError(f"check needs a controller, or the word plant and a plant, got {' '.join(subject)!r}")
    findings: list[Finding] = []

    def hear(finding: Finding) -> None:
        findings.append(finding)
        console.print(
            Text.assemble((f"{finding.verdict:7s}", COLOURS[finding.verdict]), f"{finding.check:15s}", finding.text),
            soft_wrap=True,
        )

    check_apart(checks, name, limit, hear)
    failed = sum(finding.verdict == "failed" for finding in findings)
    console.print(f"{name}: " + (f"{failed} of {len(findings)} checks failed" if failed else "keeps its contract"))
    if failed:
        sys.exit(FAILED)
