"""The paper's claims in both readings, the methods best equipped and as published, also on both physics engines.

And in the profile `lab` beside `moderate`: methods, and the orders and claims that change.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Final

import pandas as pd

import stored_tables
from page_studies import cells
from page_studies.reproduction.answers import ANSWERS
from page_studies.reproduction.rules import UNDECIDED
from page_studies.study import ENGINES, FIVE, RENDERED, REPRODUCTION, Study, sweep
from servobench.harness.batch.results import load_runs

FIRST, SECOND = ENGINES
PROFILES: Final = ("moderate", "lab")
EQUIPPED, PUBLISHED = FIVE, tuple(name for name in RENDERED if name not in FIVE)
SEEDS: Final = "71000:71200"


def answers_of(study: Study, folder: Path) -> pd.DataFrame:
    """Return the answers of all parts of a study."""
    parts = [folder / part / ANSWERS for part in study.commands]
    tables = [
        pd.read_csv(path, dtype=str, keep_default_na=False) for path in parts if path.exists()
    ]
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


def lab_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return both measures of each method in both profiles, and the orders and claims that differ."""
    runs = load_runs(folder / "runs")
    parts = {name: runs[runs["mismatch"] == name] for name in PROFILES}
    measured = (
        ("settling [s]", "random", cells.settling),
        ("circle [mm]", "circle", cells.millimetres),
    )
    shown = {
        f"{title}, `{name}`": cells.where("mismatch", name, cells.where("task", task, cell))
        for title, task, cell in measured
        for name in PROFILES
    }
    changes = [*changed_orders(parts), *changed_claims(folder)]
    return {
        "lab": pd.DataFrame(cells.rows_by_method(runs, shown)),
        "lab_changes": pd.DataFrame(changes),
    }


def changed_orders(parts: dict[str, pd.DataFrame]) -> Iterator[dict[str, str]]:
    """Yield the pairs of methods, equipped alike, whose verdicts differ between the profiles."""
    pairs = [*combinations(EQUIPPED, 2), *combinations(PUBLISHED, 2)]
    for word, measure in (("moves", cells.MOVES), ("circle", cells.CIRCLES)):
        compared = {name: measure.compare(own, pairs) for name, own in parts.items()}
        for (one, other), *found in zip(pairs, *compared.values(), strict=True):
            if len({each.verdict for each in found}) > 1:
                text = {
                    f"`{name}`": measure.difference(each)
                    for name, each in zip(PROFILES, found, strict=True)
                }
                yield {
                    "claim, or first and second method": f"`{one}`, `{other}`",
                    "of": word,
                } | text


def changed_claims(folder: Path) -> Iterator[dict[str, str]]:
    """Yield the paper's claims whose verdicts differ between the profiles."""
    keys = ["claim", "statement", "division"]
    answers = [
        pd.read_csv(folder / name / ANSWERS, dtype=str).set_index(keys)["verdict"]
        for name in PROFILES
    ]
    for (claim, statement, division), *verdicts in pd.concat(answers, axis=1).itertuples(name=None):
        if len(set(verdicts)) > 1:
            text = {f"`{name}`": verdict for name, verdict in zip(PROFILES, verdicts, strict=True)}
            yield {
                "claim, or first and second method": titled(claim, statement),
                "of": division,
            } | text


CLAIMS = Study(
    "claims",
    "the paper's seven claims, for the methods best equipped and as published",
    40,
    {
        "exact": (REPRODUCTION, "--plants", "kinematic,fmu", "--seeds", "500"),
        "rendered": (REPRODUCTION, "--plants", "bullet", "--seeds", "10"),
    },
    claims_tables,
)
CLAIMS_ENGINES = Study(
    "engines",
    "the paper's seven claims on the second physics engine, with as many robots as on the first",
    5,
    {
        division: (REPRODUCTION, "--plants", SECOND, "--seeds", "10", "--division", division)
        for division in ("equipped", "published")
    },
    engines_tables,
)
LAB = Study(
    "lab",
    "nine methods and the paper's claims in the profile `lab` beside `moderate`, 200 and 100 robots",
    6,
    {
        "runs": sweep(
            "kinematic", RENDERED, "random,circle", SEEDS, "--mismatch", ",".join(PROFILES)
        ),
        **{
            name: (REPRODUCTION, "--plants", "kinematic", "--seeds", "100", "--mismatch", name)
            for name in PROFILES
        },
    },
    lab_tables,
)
