"""Every method under every sensing set-up, with the values that were tuned for `position`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

import pandas as pd

from page_studies.methods import BOTH, by_method, quoted, settling, share, short
from page_studies.study import Study, sweep
from servobench.harness.analysis.comparison import column_of
from servobench.harness.analysis.statistics import median_with_interval
from servobench.harness.batch.results import load_runs

RUNS: Final = "runs"


def path_ratio(runs: pd.DataFrame) -> str:
    """Return the median ratio of the path of the features to the straight one, with its interval."""
    return short(median_with_interval(column_of(runs, "path_length_ratio"), missing="left_out"), 2)


def seen(runs: pd.DataFrame) -> str:
    """Return the mean share of features that were seen [%]."""
    return f"{100.0 * (1.0 - column_of(runs, 'feature_invalid_fraction').mean()):.1f}"


CELLS: Final[dict[str, Callable[[pd.DataFrame], str]]] = {
    "eyes": share, "eyes_time": settling, "eyes_path": path_ratio, "eyes_view": seen,
}  # fmt: skip
"""Name of a table -> what a cell of it says of the runs of a method under a set-up."""


def tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return a table for each measure, with a row for each method and a column for each set-up."""
    runs = load_runs(folder / RUNS)
    set_ups = list(dict.fromkeys(runs["sensing"]))
    return {
        name: pd.DataFrame(
            {"method": quoted(method)} | {quoted(each): cell(own[own["sensing"] == each]) for each in set_ups}
            for method, own in by_method(runs)
        )
        for name, cell in CELLS.items()
    }


EYES: Final = Study(
    "eyes",
    "every method under every sensing set-up, 200 robots",
    30,
    {RUNS: sweep("kinematic", BOTH, "random", "66000:66200", "--sensing", "all")},
    tables,
)
