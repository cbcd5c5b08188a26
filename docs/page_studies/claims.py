"""The paper's claims in both readings: the methods best equipped, and as published."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from page_studies.study import Study
from servobench.harness.studies.reproduction import ANSWERS


def claims_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return all answers, and the verdicts alone with a column for each plant and division."""
    parts = [pd.read_csv(folder / part / ANSWERS, dtype=str, keep_default_na=False) for part in CLAIMS.commands]
    answers = pd.concat(parts, ignore_index=True)
    rows = []
    for claim, own in answers.groupby("claim", sort=False):
        statement = own["statement"].iloc[0]
        row = {"claim": f"{claim} {statement}" if str(claim).isdigit() else statement}
        verdicts = {f"`{each.plant}`, {each.division}": each.verdict for each in own.itertuples()}
        rows.append(row | verdicts)
    return {"claims": answers, "claims_summary": pd.DataFrame(rows).fillna("")}


CLAIMS = Study(
    "claims",
    "the paper's seven claims, for the methods best equipped and as published",
    40,
    {
        "exact": ("claims", "--plants", "kinematic,fmu", "--seeds", "500"),
        "rendered": ("claims", "--plants", "bullet", "--seeds", "10"),
    },
    claims_tables,
)
