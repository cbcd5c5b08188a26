"""The seven claims on the second physics engine, beside those on the first."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

import stored_tables
from page_studies.study import Study
from servobench.harness.studies.claims.measurements import UNDECIDED
from servobench.harness.studies.claims.table import ANSWERS

FIRST, SECOND = "bullet", "mujoco"


def engines_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the verdicts on both engines side by side, and the answers on the second one with their evidence.

    Those on the first one are the stored ones of the study `claims`.
    """
    first = stored_tables.read(stored_tables.FOLDER / "claims.csv").table
    parts = [folder / part / ANSWERS for part in ENGINES.commands]
    tables = [pd.read_csv(path, dtype=str, keep_default_na=False) for path in parts if path.exists()]
    second = pd.concat(tables, ignore_index=True)
    key = ["claim", "division"]
    verdicts = first[first["plant"] == FIRST].set_index(key)["verdict"]
    rows = [
        {
            "claim": f"{each.claim} {each.statement}" if each.claim.isdigit() else each.statement,
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


ENGINES = Study(
    "engines",
    "the paper's seven claims on the second physics engine, with as many robots as on the first",
    15,
    {
        division: ("claims", "--plants", SECOND, "--seeds", "10", "--division", division)
        for division in ("equipped", "published")
    },
    engines_tables,
)
