"""The robustness map: its pictures, and both physics engines beside each other."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from PIL import Image

from page_studies.cells import by_method, marked, quoted
from page_studies.pictures import small
from page_studies.study import ENGINES, FOUR, SUFFIX, Study, Words, on_engines
from servobench.harness.analysis.comparison import is_majority, settling_times
from servobench.harness.apps.studies.robustness import KNOWN_LINES
from servobench.harness.batch.results import load_runs

# Best equipped all stay above 90 % everywhere
MAPPED = ("regression_mfac", *(name + SUFFIX for name in FOUR))
AXES = (
    "camera_rotation,latency,noise,camera_move"  # those on which methods fail; see the map on `fmu`
)


def mapping(plant: str, seeds: str, *options: str) -> Words:
    """Return the arguments of a robustness map."""
    return (
        "robustness",
        "--plant",
        plant,
        "--controllers",
        ",".join(MAPPED),
        "--seeds",
        seeds,
        *options,
    )


def map_pictures(folder: Path) -> dict[str, bytes]:
    """Return the two pictures of the robustness map."""
    paths = sorted((folder / "map" / "figures").glob("*.png"))
    return {f"pictures/{path.name}": small(Image.open(path)) for path in paths}


def map_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return how many robots settle at each place of the map on both engines, in bold where most do on one only."""
    runs = pd.concat([load_runs(folder / engine) for engine in ENGINES], ignore_index=True)
    rows = []
    for axis, along in runs.groupby("axis", sort=False):
        line = KNOWN_LINES[str(axis)]
        title = f"{line.title}: {', '.join(f'{place.number:g}' for place in line.places)}"
        cells = {quoted(name): settled_at_places(own) for name, own in by_method(along)}
        for k, engine in enumerate(ENGINES):
            rows.append(
                {"axis": title, "plant": engine} | {name: both[k] for name, both in cells.items()}
            )
    return {"robustness_engines": pd.DataFrame(rows)}


def settled_at_places(runs: pd.DataFrame) -> list[str]:
    """Return for each engine how many runs of a method settle at each place of an axis."""
    runs = runs.assign(settled=settling_times(runs).notna())
    found = [
        runs[runs["plant"] == engine].pivot(index="seed", columns="magnitude", values="settled")
        for engine in ENGINES
    ]
    only = [int((one & ~other).to_numpy().sum()) for one, other in (found, found[::-1])]
    cells = [" ".join(str(count) for count in each.sum()) for each in found]
    return (
        [marked(cell) for cell in cells]
        if is_majority(*only) or is_majority(*only[::-1])
        else cells
    )


MAP = Study(
    "robustness",
    "the robustness map: its two pictures",
    2,
    {"map": mapping("fmu", "50000:50030")},
    files=map_pictures,
)
MAP_ENGINES = Study(
    "robustness_engines",
    "the robustness map on both physics engines, 5 robots, along the axes on which methods fail",
    20,
    on_engines(lambda plant: mapping(plant, "50000:50005", "--axes", AXES)),
    map_tables,
)
