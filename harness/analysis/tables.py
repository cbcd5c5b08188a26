"""Tables of runs for a reader: in the terminal, on a page, in the report. Numbers are in handy units."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import Final

import pandas as pd

from servobench.harness.analysis.cells import Cell, Row, as_text
from servobench.harness.analysis.comparison import (
    achieved_share,
    achievement,
    column_of,
    compare_pairs,
    outcomes,
    settling_times,
    split_conditions,
    split_tasks,
)
from servobench.harness.analysis.measures import MEASURES, Measure
from servobench.harness.analysis.statistics import (
    NO_ESTIMATE,
    Estimate,
    median_with_interval,
    tail_mean,
)
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.run.outcome import ACHIEVED
from servobench.harness.run.result import COMPLETED
from servobench.plant.contract.settings import suggest

Tables = Iterator[tuple[str, pd.DataFrame]]  # title, rows of text


SWEPT: Final = ("noise_factor", "latency_s", "period_s")  # shown where they vary
CONDITIONS: Final = ("plant", "mismatch", *SWEPT)
TAIL: Final = 0.95


def statistics_tables(runs: pd.DataFrame, metric: str | None = None, never: float | None = None) -> Tables:
    """Yield for each plant, task and condition how each controller does, and how each pair of them differs."""
    for words, controllers, pairs in statistics_rows(runs, metric, never):
        yield words, as_text(controllers)
        if pairs:
            yield "pairs", as_text(pairs)


def statistics_rows(
    runs: pd.DataFrame, metric: str | None = None, never: float | None = None
) -> Iterator[tuple[str, list[Row], list[Row]]]:
    """Yield for each plant, task and condition its words, a row for each controller and one for each pair of them."""
    for words, place in split_conditions(runs):
        yield words, _controller_rows(place), _pair_rows(place, metric, never)


def judge_controllers(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each controller: how often and when it settled, its worst runs, and how runs failed.

    Args:
        runs: of one plant, task and condition.

    Returns:
        Text; medians and rates have 95 % intervals. Errors are in the unit of the plant's feature or a handier one.
    """
    return as_text(_controller_rows(runs))


def _controller_rows(runs: pd.DataFrame) -> list[Row]:
    unit, factor = MEASURES["steady_state_error"].scale(runs)
    rows: list[Row] = []
    for name, own in runs.groupby("controller", sort=False):
        ended = outcomes(own)
        failed = ended[~ended.isin(ACHIEVED)].value_counts()
        final = column_of(own, "steady_state_error").where(own["status"] == COMPLETED)
        rows.append(
            {
                "controller": Cell(str(name)),
                "runs": Cell(len(own)),
                f"{achievement(runs)}, %": Cell(achieved_share(own), ".1f"),
                "settling time, s": Cell(_median(settling_times(own)), ".2f"),
                "overshoot, %": Cell(_median(100.0 * column_of(own, "overshoot")), ".1f"),
                f"RMS end, {unit}": Cell(_median(factor * column_of(own, "rms_error_evaluated")), ".1f"),
                f"worst 5 %, {unit}": Cell(factor * tail_mean(final, TAIL), ".1f"),
                "failures": Cell(", ".join(f"{count} {kind}" for kind, count in failed.items()) or "none"),
            }
        )
    return rows


def compare_controllers(runs: pd.DataFrame, metric: str | None = None, never: float | None = None) -> pd.DataFrame:
    """Return a row for each pair of controllers: the median of their paired difference and Wilcoxon's p-value.

    Args:
        runs: of one plant, task and condition.
        metric: column that is compared; by default the settling time, on a curve the error along it.
        never: stands for the value of a run without one, or that did not complete; by default twice the largest value.

    Raises:
        ConfigurationError: no such column of numbers.
    """
    return as_text(_pair_rows(runs, metric, never))


def _pair_rows(runs: pd.DataFrame, metric: str | None, never: float | None) -> list[Row]:
    pairs = list(combinations(dict.fromkeys(runs["controller"]), 2))
    if not pairs:
        return []
    if metric is None:
        metric = "rms_error_evaluated" if len(split_tasks(runs)[1]) else "settling_time_s"
    numbers = [str(name) for name in runs.select_dtypes("number").columns]
    if metric not in numbers:
        raise ConfigurationError(f"--metric: the table has no column of numbers {metric!r}: {suggest(metric, numbers)}")
    if never is None:
        known = runs[metric].dropna()
        never = 2.0 * float(known.max()) if len(known) else 1.0
    compared = compare_pairs(runs, pairs, never=never, metric=metric, keys=("seed",))
    measure = MEASURES.get(metric, Measure(metric.replace("_", " "), 2, "1"))
    unit, factor = measure.scale(runs)
    what = measure.name if unit == "1" else f"{measure.name}, {unit}"
    return [
        {
            "pair": Cell(f"{pair.first} − {pair.second}"),
            "pairs": Cell(pair.difference.count),
            f"difference in {what}": Cell(pair.difference.scaled(factor), ".2f"),
            "p after Holm": Cell(pair.corrected_p_value, ".2g"),
        }
        for pair in compared
    ]


def _median(values: pd.Series[float]) -> Estimate:
    """Return the median of a column, a missing value counting as ∞; no estimate where all are missing."""
    return median_with_interval(values) if values.notna().any() else NO_ESTIMATE
