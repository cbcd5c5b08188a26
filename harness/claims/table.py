"""The table of answers, and the measurements behind them, as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pandas as pd

from harness.claims.measurements import Answer
from harness.configuration import ConfigurationError

ANSWERS: Final = "answers.csv"
MEASUREMENTS: Final = "measurements.csv"
COLUMNS: Final = ("claim", "statement", "plant", "verdict", "evidence")


def answer_table(answers: Sequence[Answer]) -> pd.DataFrame:
    """Return a row for each claim and plant."""
    return pd.DataFrame([[getattr(answer, name) for name in COLUMNS] for answer in answers], columns=list(COLUMNS))


def measurement_table(answers: Sequence[Answer]) -> pd.DataFrame:
    """Return a row for each number behind the answers."""
    return pd.DataFrame(
        [
            {
                "claim": answer.claim,
                "plant": answer.plant,
                "measured": m.panel,
                "place": m.place,
                "label": m.label,
                "value": m.estimate.value,
                "low": m.estimate.low,
                "high": m.estimate.high,
                "count": m.estimate.count,
                "holds": m.holds,
            }
            for answer in answers
            for m in answer.measurements
        ]
    )


def write_tables(answers: Sequence[Answer], folder: Path) -> None:
    """Write both tables."""
    answer_table(answers).to_csv(folder / ANSWERS, index=False)
    measurement_table(answers).to_csv(folder / MEASUREMENTS, index=False)


def differences(answers: Sequence[Answer], committed: Path) -> list[str]:
    """Return a line for each answer that is not the one in the table `committed`.

    Raises:
        ConfigurationError: the file is not a table of answers.
    """
    try:
        told = pd.read_csv(committed, dtype=str, keep_default_na=False)
        rows = told[["claim", "plant", "verdict", "evidence"]].itertuples(index=False)
        wanted = {(claim, plant): (verdict, evidence) for claim, plant, verdict, evidence in rows}
    except (OSError, ValueError, KeyError) as error:
        raise ConfigurationError(f"{committed} is not a table of answers: {' '.join(str(error).split())}") from error
    lines = []
    for answer in answers:
        key = (answer.claim, answer.plant)
        if key not in wanted:
            lines.append(f"claim {answer.claim} on {answer.plant}: not in {committed}")
        elif wanted[key] != (answer.verdict, answer.evidence):
            lines.append(f"claim {answer.claim} on {answer.plant}: now {answer.verdict}: {answer.evidence}")
    return lines


def markdown_table(answers: Sequence[Answer]) -> str:
    """Return the answers as a table in Markdown."""
    lines = ["| claim | plant | verdict | evidence |", "|---|---|---|---|"]
    lines += [f"| {a.title} | {a.plant} | **{a.verdict}** | {a.evidence} |" for a in answers]
    return "\n".join(lines) + "\n"
