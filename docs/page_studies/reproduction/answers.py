"""Tables of the answers to the paper's claims: written, read, and compared with stored ones."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pandas as pd

from page_studies.reproduction.rules import UNDECIDED, Answer
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import read_text, write_atomically

ANSWERS = "answers.csv"
MEASUREMENTS = "measurements.csv"
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w.])")
# Tolerances of the numbers in the evidence: a tenth, and a period
RELATIVE = 0.1  # [1]
ABSOLUTE = 0.051  # [s] for times
# Claim, plant, division -> verdict, evidence
Answers: TypeAlias = Mapping[tuple[str, ...], tuple[str, str]]


def write_tables(answers: Sequence[Answer], folder: Path) -> None:
    """Write a row for each claim, plant and division, and a row for each number behind the answers."""
    table = pd.DataFrame(answers).drop(columns="measurements")
    write_atomically(folder / ANSWERS, partial(table.to_csv, index=False))
    rows = []
    for answer in answers:
        about = {"claim": answer.claim, "plant": answer.plant, "division": answer.division}
        for m in answer.measurements:
            measured = {"measured": m.panel, "place": m.place, "label": m.label}
            rows.append({**about, **measured, **asdict(m.estimate), "holds": m.holds})
    measurements = pd.DataFrame(rows)
    write_atomically(folder / MEASUREMENTS, partial(measurements.to_csv, index=False))


def read_answers(path: Path) -> Answers:
    """Return verdict and evidence by claim, plant and division from a table of answers.

    Lines that begin with `#` are left out: the tables of docs/tables begin with how they were made.

    Raises:
        ConfigurationError: the file is not a table of answers.
    """
    text = read_text("table of answers", path)
    columns = ["claim", "plant", "division", "verdict", "evidence"]
    try:
        table = pd.read_csv(
            io.StringIO(text),
            dtype=str,
            keep_default_na=False,
            comment="#",
            usecols=columns,
        )
    except ValueError as error:
        raise ConfigurationError(
            f"{path} is not a table of answers: wanted one with the columns {', '.join(columns)}, such as "
            f"{ANSWERS} of a folder of claims"
        ) from error
    answers: dict[tuple[str, ...], tuple[str, str]] = {}
    for claim, plant, division, verdict, evidence in table[columns].itertuples(index=False):
        answers[claim, plant, division] = (verdict, evidence)
    return answers


def differences(answers: Sequence[Answer], wanted: Answers) -> list[str]:
    """Return a line for each answer that differs from the stored one.

    Verdicts and words must be the same. Numbers of the evidence may differ by a tenth and a period: networks that are
    fitted on another processor differ by rounding, which loops amplify.
    """
    lines = []
    for answer in answers:
        name = f"claim {answer.claim} on {answer.plant}, {answer.division}"
        key = answer.claim, answer.plant, answer.division
        if key not in wanted:
            lines.append(f"{name}: not in the table")
            continue
        verdict, evidence = wanted[key]
        if verdict != answer.verdict or not _agree(answer.evidence, evidence):
            lines.append(f"{name}: now {answer.verdict}: {answer.evidence}")
    return lines


def _agree(found: str, wanted: str) -> bool:
    """Return whether two lines of evidence have the same words and nearly the same numbers."""
    if NUMBER.sub("", found) != NUMBER.sub("", wanted):
        return False
    ours = [float(number) for number in NUMBER.findall(found)]
    theirs = [float(number) for number in NUMBER.findall(wanted)]
    return bool(np.allclose(ours, theirs, rtol=RELATIVE, atol=ABSOLUTE))


def markdown_table(answers: Sequence[Answer]) -> str:
    """Return the answers as a table in Markdown."""
    lines = ["| claim | plant | division | verdict | evidence |", "|---|---|---|---|---|"]
    lines += (
        f"| {a.title} | {a.plant} | {a.division} | **{a.verdict}**{elsewhere(a, answers)} | {a.evidence} |"
        for a in answers
    )
    return "\n".join(lines) + "\n"


def elsewhere(answer: Answer, answers: Sequence[Answer]) -> str:
    """Return a remark about the plants with another verdict on the same claim; empty if there is none.

    In how many comparisons a claim holds is not compared, nor a verdict for which robots were too few.
    """
    own = _kind_of_verdict(answer)
    if own == UNDECIDED:
        return ""
    verdicts = {
        other.plant: _kind_of_verdict(other)
        for other in answers
        if other.claim == answer.claim and other.division == answer.division
    }
    others = [plant for plant, each in verdicts.items() if each not in (own, UNDECIDED)]
    if not others:
        return ""
    return f" (otherwise on {', '.join(others)})"


def _kind_of_verdict(answer: Answer) -> str:
    """Return a verdict without the number of cases in which it holds."""
    return answer.verdict.partition(":")[0]
