"""The profile `lab` beside `moderate`: methods, and the orders and claims that change."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Final

import pandas as pd

from page_studies import cells
from page_studies.claims import titled
from page_studies.study import FIVE, RENDERED, Study, sweep
from servobench.harness.batch.results import load_runs
from servobench.harness.studies.reproduction import ANSWERS

PROFILES: Final = ("moderate", "lab")
EQUIPPED, PUBLISHED = FIVE, tuple(name for name in RENDERED if name not in FIVE)
SEEDS: Final = "71000:71200"


def lab_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return both measures of each method in both profiles, and the orders and claims that differ."""
    runs = load_runs(folder / "runs")
    parts = {name: runs[runs["mismatch"] == name] for name in PROFILES}
    measured = (("settling [s]", "random", cells.settling), ("circle [mm]", "circle", cells.millimetres))
    shown = {
        f"{title}, `{name}`": cells.where("mismatch", name, cells.where("task", task, cell))
        for title, task, cell in measured
        for name in PROFILES
    }
    changes = [*changed_orders(parts), *changed_claims(folder)]
    return {"lab": pd.DataFrame(cells.rows_by_method(runs, shown)), "lab_changes": pd.DataFrame(changes)}


def changed_orders(parts: dict[str, pd.DataFrame]) -> Iterator[dict[str, str]]:
    """Yield the pairs of methods, equipped alike, whose verdicts differ between the profiles."""
    pairs = [*combinations(EQUIPPED, 2), *combinations(PUBLISHED, 2)]
    for word, measure in (("moves", cells.MOVES), ("circle", cells.CIRCLES)):
        compared = {name: measure.compare(own, pairs) for name, own in parts.items()}
        for (one, other), *found in zip(pairs, *compared.values(), strict=True):
            if len({each.verdict for each in found}) > 1:
                text = {f"`{name}`": measure.difference(each) for name, each in zip(PROFILES, found, strict=True)}
                yield {"claim, or first and second method": f"`{one}`, `{other}`", "of": word} | text


def changed_claims(folder: Path) -> Iterator[dict[str, str]]:
    """Yield the paper's claims whose verdicts differ between the profiles."""
    keys = ["claim", "statement", "division"]
    answers = [pd.read_csv(folder / name / ANSWERS, dtype=str).set_index(keys)["verdict"] for name in PROFILES]
    for (claim, statement, division), *verdicts in pd.concat(answers, axis=1).itertuples(name=None):
        if len(set(verdicts)) > 1:
            text = {f"`{name}`": verdict for name, verdict in zip(PROFILES, verdicts, strict=True)}
            yield {"claim, or first and second method": titled(claim, statement), "of": division} | text


LAB: Final = Study(
    "lab",
    "nine methods and the paper's claims in the profile `lab` beside `moderate`, 200 and 100 robots",
    6,
    {
        "runs": sweep("kinematic", RENDERED, "random,circle", SEEDS, "--mismatch", ",".join(PROFILES)),
        **{name: ("claims", "--plants", "kinematic", "--seeds", "100", "--mismatch", name) for name in PROFILES},
    },
    lab_tables,
)
