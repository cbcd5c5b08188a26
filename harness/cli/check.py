"""The command `servobench check`: a controller against its contract."""

from __future__ import annotations

import sys
from typing import Annotated, Final

import typer

from servobench.harness.cli.terminal import console

FAILED: Final = 1  # exit code
COLOURS: Final = {"ok": "green", "failed": "bold red", "note": "yellow"}


def check(
    name: Annotated[str, typer.Argument(metavar="CONTROLLER", help="Such as ./mine.py, ./mine.py:Mine or ukf_mfac.")],
    limit: Annotated[float, typer.Option(min=1.0, help="Time limit of one check [s].")] = 60.0,
) -> None:
    """Check a controller against its contract.

    Each failure says what to change.
    """
    from rich.text import Text

    from servobench.harness.check.controllers import check_controller
    from servobench.harness.check.guarded import check_guarded

    findings = []
    for finding in check_guarded(check_controller, name, limit):
        findings.append(finding)
        console.print(
            Text.assemble((f"{finding.verdict:7s}", COLOURS[finding.verdict]), f"{finding.check:15s}", finding.text),
            soft_wrap=True,
        )
    failed = sum(finding.verdict == "failed" for finding in findings)
    console.print(f"{name}: " + (f"{failed} of {len(findings)} checks failed" if failed else "keeps its contract"))
    if failed:
        sys.exit(FAILED)
