"""The paper's claims in both readings, the methods best equipped and as published, and on both physics engines."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

import stored_tables
from page_studies.study import ENGINES, Study
from servobench.harness.studies.claims import UNDECIDED
from servobench.harness.studies.reproduction import ANSWERS

FIRST, SECOND = ENGINES


def answers_of(study: Study, folder: Path) -> pd.DataFrame:
    """Return the answers of all parts of a study."""
    parts = [folder / part / ANSWERS for part in study.commands]
    tables = [pd.read_csv(path, dtype=str, keep_default_na=False) for path in parts if path.exists()]
    return pd.concat(tables, ignore_index=True)


def titled(claim: str, statement: str) -> str:
    """Return a claim of the paper with its number, a further one without."""
    return f"{claim} {statement}" if claim.isdigit() else statement


def claims_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return all answers, and the verdicts alone with a column for each plant and division."""
    answers = answers_of(CLAIMS, folder)
    rows = []
    for claim, own in answers.groupby("claim", sort=False):
        verdicts = {f"`{each.plant}`, {each.division}": each.verdict for each in own.itertuples()}
        rows.append({"claim": titled(str(claim), own["statement"].iloc[0])} | verdicts)
    return {"claims": answers, "claims_summary": pd.DataFrame(rows).fillna("")}


def engines_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the verdicts on both engines side by side, and the answers on the second one with their evidence.

    Those on the first one are the stored ones of the study `claims`.
    """
    first = stored_tables.read(stored_tables.FOLDER / "claims.csv").table
    second = answers_of(CLAIMS_ENGINES, folder)
    verdicts = first[first["plant"] == FIRST].set_index(["claim", "division"])["verdict"]
    rows = [
        {
            "claim": titled(each.claim, each.statement),
            "division": each.division,
            f"`{FIRST}`": verdicts[each.claim, each.division],
            f"`{SECOND}`": each.verdict,
            "alike": alike(verdicts[each.claim, each.division], each.verdict),
        }
        for each in second.itertuples()
    ]
    return {"engines": pd.DataFrame(rows), "engines_answers": second}


def alike(one: str, other: str) -> str:
    """Return whether two verdicts say the same; in how many comparisons a claim holds may differ."""
    if UNDECIDED in (one, other):
        return "open"
    return "yes" if one.partition(":")[0] == other.partition(":")[0] else "**no**"


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
CLAIMS_ENGINES = Study(
    "engines",
    "the paper's seven claims on the second physics engine, with as many robots as on the first",
    5,
    {
        division: ("claims", "--plants", SECOND, "--seeds", "10", "--division", division)
        for division in ("equipped", "published")
    },
    engines_tables,
)
