"""The seven claims and the robustness map on the second physics engine, beside those on the first."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

import stored_tables
from page_studies.methods import by_method, quoted
from page_studies.side_by_side import ENGINES, bare, marked, most, on_engines
from page_studies.study import Study
from page_studies.worlds import MAPPED
from servobench.harness.analysis.comparison import settling_times
from servobench.harness.batch.results import load_runs
from servobench.harness.studies.claims import UNDECIDED
from servobench.harness.studies.reproduction import ANSWERS
from servobench.harness.studies.robustness import KNOWN_LINES

FIRST, SECOND = ENGINES
AXES = "camera_rotation,latency,noise,camera_move"  # those on which methods fail; see the map on `fmu`


def engines_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the verdicts on both engines side by side, and the answers on the second one with their evidence.

    Those on the first one are the stored ones of the study `claims`.
    """
    first = stored_tables.read(stored_tables.FOLDER / "claims.csv").table
    parts = [folder / part / ANSWERS for part in CLAIMS_ENGINES.commands]
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


CLAIMS_ENGINES = Study(
    "engines",
    "the paper's seven claims on the second physics engine, with as many robots as on the first",
    15,
    {
        division: ("claims", "--plants", SECOND, "--seeds", "10", "--division", division)
        for division in ("equipped", "published")
    },
    engines_tables,
)


def map_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return how many robots settle at each place of the map on both engines, in bold where most do on one only."""
    runs = pd.concat([load_runs(folder / engine) for engine in ENGINES], ignore_index=True)
    rows = []
    for axis, along in runs.groupby("axis", sort=False):
        line = KNOWN_LINES[str(axis)]
        title = f"{line.title}: {', '.join(f'{place.number:g}' for place in line.places)}"
        cells = {quoted(name): settled_at_places(own) for name, own in by_method(along)}
        for k, engine in enumerate(ENGINES):
            rows.append({"axis": title, "plant": engine} | {name: both[k] for name, both in cells.items()})
    return {"robustness_engines": pd.DataFrame(rows)}


def settled_at_places(runs: pd.DataFrame) -> list[str]:
    """Return for each engine how many runs of a method settle at each place of an axis."""
    runs = runs.assign(settled=settling_times(runs).notna())
    found = [
        runs[runs["plant"] == engine].pivot(index="seed", columns="magnitude", values="settled") for engine in ENGINES
    ]
    only = [int((one & ~other).to_numpy().sum()) for one, other in (found, found[::-1])]
    cells = [" ".join(str(count) for count in each.sum()) for each in found]
    return [marked(cell) for cell in cells] if most(*only) or most(*only[::-1]) else cells


MAP_ENGINES = Study(
    "robustness_engines",
    "the robustness map on both physics engines, 5 robots, along the axes on which methods fail",
    20,
    on_engines(
        lambda plant: (
            "robustness", "--plant", plant, "--controllers", ",".join(MAPPED), "--seeds", "50000:50005",
            "--axes", AXES, *bare(plant),
        )
    ),
    map_tables,
)  # fmt: skip
