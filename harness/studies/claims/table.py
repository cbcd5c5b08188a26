"""The table of answers, and the measurements behind them, as files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
import pandas as pd

from servobench.harness.config.settings import ConfigurationError
from servobench.harness.studies.claims.measurements import UNDECIDED, Answer

ANSWERS: Final = "answers.csv"
MEASUREMENTS: Final = "measurements.csv"
NUMBER: Final = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w.])")
RELATIVE, ABSOLUTE = 0.1, 0.051  # tolerances of the numbers in the evidence: a tenth and a period

Answers: TypeAlias = Mapping[tuple[str, ...], tuple[str, str]]  # claim, plant, division -> verdict, evidence


def write_tables(answers: Sequence[Answer], folder: Path) -> None:
    """Write a row for each claim, plant and division, and a row for each number behind the answers."""
    pd.DataFrame(answers).drop(columns="measurements").to_csv(folder / ANSWERS, index=False)
    rows = [
        {"claim": answer.claim, "plant": answer.plant, "division": answer.division,
         "measured": m.panel, "place": m.place, "label": m.label,
         **asdict(m.estimate), "holds": m.holds}
        for answer in answers
        for m in answer.measurements
    ]  # fmt: skip
    pd.DataFrame(rows).to_csv(folder / MEASUREMENTS, index=False)


def read_answers(path: Path) -> Answers:
    """Return verdict and evidence by claim, plant and division from a table of answers.

    Lines that begin with `#` are left out: the tables of docs/tables begin with how they were made.

    Raises:
        ConfigurationError: the file is not a table of answers.
    """
    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False, comment="#")
        rows = table[["claim", "plant", "division", "verdict", "evidence"]].itertuples(index=False)
        return {tuple(key): (verdict, evidence) for *key, verdict, evidence in rows}
    except (OSError, ValueError, KeyError) as error:
        raise ConfigurationError(f"{path} is not a table of answers: {' '.join(str(error).split())}") from error


def differences(answers: Sequence[Answer], wanted: Answers) -> list[str]:
    """Return a line for each answer that is not the one wanted.

    Verdicts and words must be the same. Numbers of the evidence may differ by a tenth and a period: networks that are
    fitted on another processor differ by rounding, which loops amplify.
    """
    lines = []
    for answer in answers:
        name = f"claim {answer.claim} on {answer.plant}, {answer.division}"
        key = answer.claim, answer.plant, answer.division
        if key not in wanted:
            lines.append(f"{name}: not in the table")
        elif wanted[key][0] != answer.verdict or not _agree(answer.evidence, wanted[key][1]):
            lines.append(f"{name}: now {answer.verdict}: {answer.evidence}")
    return lines


def _agree(found: str, wanted: str) -> bool:
    ours, theirs = ([float(number) for number in NUMBER.findall(text)] for text in (found, wanted))
    same_words = NUMBER.sub("", found) == NUMBER.sub("", wanted)
    return same_words and bool(np.allclose(ours, theirs, rtol=RELATIVE, atol=ABSOLUTE))


def markdown_table(answers: Sequence[Answer]) -> str:
    """Return the answers as a table in Markdown."""
    lines = ["| claim | plant | division | verdict | evidence |", "|---|---|---|---|---|"]
    for a in answers:
        verdict = f"**{a.verdict}**{elsewhere(a, answers)}"
        lines.append(f"| {a.title} | {a.plant} | {a.division} | {verdict} | {a.evidence} |")
    return "\n".join(lines) + "\n"


def elsewhere(answer: Answer, answers: Sequence[Answer]) -> str:
    """Return a remark about the plants on which the same claim came out otherwise; empty if there is none.

    In how many comparisons a claim holds is not compared, nor a verdict for which robots were too few.
    """
    others = [
        other.plant
        for other in answers
        if (other.claim, other.division) == (answer.claim, answer.division)
        and _outcome(other) != _outcome(answer)
        and UNDECIDED not in (other.verdict, answer.verdict)
    ]
    return f" (otherwise on {', '.join(others)})" if others else ""


def _outcome(answer: Answer) -> str:
    return answer.verdict.partition(":")[0]
