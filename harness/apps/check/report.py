"""Findings of checks: each ok, failed or a note."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self, TypeAlias

import numpy as np

from servobench.harness.config.source import describe_at, show
from servobench.harness.run.result import WrongAnswer, beginning
from servobench.plant.contract.faults import ConfigurationError, RunFault

Verdict: TypeAlias = Literal["ok", "failed", "note"]
WIDTH = 14  # [characters] width of the names of checks in print
HAPPENS = "; this happens with "  # begin of the notes of `naming`


class Finding(NamedTuple):
    """The finding of one check."""

    check: str
    """the checked property, in one or two words"""
    verdict: Verdict
    """a note is no defect, but worth knowing"""
    text: str = ""
    """the defect, its place and the remedy; empty if it is ok"""

    def __str__(self) -> str:
        """Return it as a line."""
        return f"{self.verdict:7s}{self.check:{WIDTH}s}{self.text}".rstrip()


@dataclass(frozen=True)
class Report:
    """The findings about one subject."""

    subject: str
    findings: tuple[Finding, ...]

    @property
    def failures(self) -> tuple[Finding, ...]:
        """The checks that failed."""
        return tuple(each for each in self.findings if each.verdict == "failed")

    @property
    def ok(self) -> bool:
        """Whether no check failed; notes are allowed."""
        return not self.failures

    def __str__(self) -> str:
        """Return all findings, a line each."""
        return "\n".join([f"{self.subject}:", *map(str, self.findings)])

    __repr__ = __str__


class CheckFailed(Exception):
    """A check found a defect; the message names the remedy."""


@contextlib.contextmanager
def naming(conditions: str) -> Iterator[None]:
    """Name the conditions under which code failed at the end of its error; nothing for those that are usual."""
    try:
        yield
    except Exception as error:
        if conditions:
            error.add_note(f"{HAPPENS}{conditions}")
        raise


def is_refusal(error: ValueError) -> bool:
    """Return whether code refused its arguments, and did not fail otherwise, such as by an index out of range."""
    return isinstance(error.__cause__, ValueError | RunFault | None)


Begin: TypeAlias = Callable[[str], None]  # receives the name of a check that begins
Hear: TypeAlias = Callable[[Finding], None]  # receives findings as they come


class Check(NamedTuple):
    """One check of a subject."""

    name: str
    carry_out: Callable[[], str | None]
    """returns a note or nothing, and raises `CheckFailed`"""
    needs: tuple[str, ...] = ()
    """checks without which this one finds nothing new"""

    @classmethod
    def of(cls, method: Callable[[], str | None], *needs: str) -> Self:
        """Return the check of a method, by the name of it in words."""
        return cls(method.__name__.replace("_", " "), method, needs)


def report(
    subject: str,
    checks: Iterable[Check],
    begin: Begin,
    found: Hear,
) -> Report:
    """Carry out checks one after the other and return their findings.

    Args:
        subject: of the checks.
        checks: a check is left out if one that it needs failed.
        begin: called with the name of each check before it is carried out.
        found: called with each finding as soon as it is there.
    """
    findings: list[Finding] = []
    for check in checks:
        if {each.check for each in findings if each.verdict != "failed"}.issuperset(check.needs):
            begin(check.name)
            findings.append(_finding(check))
            found(findings[-1])
    return Report(subject, tuple(findings))


def _finding(check: Check) -> Finding:
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            note = check.carry_out()
    except (Exception, SystemExit) as error:  # noqa: BLE001 - the checked code may raise anything
        notes = (each for each in getattr(error, "__notes__", ()) if each.startswith(HAPPENS))
        return Finding(check.name, "failed", "".join([_defect(error), *notes, _remedy(error)]))
    if note:
        return Finding(check.name, "note", note)
    return Finding(check.name, "ok")


def _defect(error: BaseException) -> str:
    if isinstance(error, WrongAnswer):
        return f"{at(error.method)}: {error}"
    if isinstance(error, CheckFailed | ConfigurationError):
        return str(error)
    return describe_at(error)


def at(method: Any) -> str:  # noqa: ANN401 - a method or a function
    """Return `FILE:LINE` of a method."""
    place = beginning(method)
    if place is None:
        return "step"
    return f"{show(Path(place.file))}:{place.line}"


def _remedy(error: BaseException) -> str:
    if isinstance(error, ValueError) and "read-only" in str(error):
        return "; the arguments of step must not be changed: work on a copy, such as e = reference[0].copy()"
    if isinstance(error, FloatingPointError):
        return "; such a number ends a run: guard the division, or the power, against it"
    if isinstance(error, SystemExit):
        return "; raise an error instead, so that the other runs go on"
    return ""
