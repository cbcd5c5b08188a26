"""Checks of a controller or plant in an isolated process: one that ends or hangs it costs one line."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

from servobench.harness.apps.check.report import Finding, Hear
from servobench.harness.batch.trials import attempt

if TYPE_CHECKING:
    from servobench.harness.batch.isolation import Tell

Checks: TypeAlias = Callable[..., Any]


def run_checks(checks: Checks, subject: str, limit: float, hear: Hear) -> None:
    """Carry checks out and hand over the findings; a check that ends or hangs the process is the last.

    Args:
        checks: `check_controller` or `check_plant`.
        subject: the controller or plant, as text.
        limit: [s] time limit of one check.
        hear: receives the findings.

    Raises:
        ConfigurationError: the subject cannot be loaded.
    """
    current = ["loading"]  # the step before the first check

    def receive(told: object) -> None:
        match told:
            case [str(check), "ok" | "failed" | "note" as verdict, str(text)]:
                hear(Finding(check, verdict, text))
            case str(check):
                current.append(check)

    _, failure = attempt(_check, checks, subject, limit=limit, hear=receive)
    if failure:
        hear(Finding(current[-1], "failed", failure))


def _check(tell: Tell, checks: Checks, subject: str) -> None:
    checks(subject, tell, lambda finding: tell(list(finding)))
