"""The methods that the studies compare, in both divisions, and how their runs become cells of a table."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

import pandas as pd

from servobench.controllers.methods import METHODS
from servobench.controllers.methods import PUBLISHED as SUFFIX
from servobench.harness.analysis.comparison import Comparison, column_of, compare_pairs, settled_share, settling_times
from servobench.harness.analysis.statistics import MISSING, Estimate, median_with_interval, tail_mean
from servobench.harness.run.result import COMPLETED

BETTER: Final = "arm_mfac"
FOUR: Final = ("rbfnn_mfac", "ukf_mfac", "ukf_mpc", "rbf_pid")  # those of the paper
SIX: Final = (BETTER, "map_mfac", *FOUR)
TAIL: Final = 0.95
MOVE: Final = 10.0  # [s] duration of a move, which a run that never settles counts as


PUBLISHED: Final = tuple(name for name in METHODS if name.endswith(SUFFIX))  # without any aid, the law as printed
EQUIPPED: Final = tuple(name for name in METHODS if name not in PUBLISHED)  # with all aids that help it
BOTH: Final = EQUIPPED + PUBLISHED


def division(name: str) -> str:
    """Return the division of a method in words."""
    return "as published" if name.endswith(SUFFIX) else "best equipped"


def by_method(runs: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield each method with its runs, in order of appearance."""
    for name, own in runs.groupby("controller", sort=False):
        yield str(name), own


def quoted(name: str) -> str:
    """Return a name as a page shows it."""
    return f"`{name}`"


def short(estimate: Estimate, digits: int) -> str:
    """Return value and interval; the dash where the value is infinite or unknown."""
    if not estimate.count or not abs(estimate.value) < float("inf"):
        return MISSING
    if math.isnan(estimate.low):
        return f"{estimate.value:.{digits}f}"
    return f"{estimate:.{digits}f}".replace("inf", "∞")


def settled(runs: pd.DataFrame) -> int:
    """Return how many runs settled."""
    return int(settling_times(runs).notna().sum())


def settling(runs: pd.DataFrame, digits: int = 2) -> str:
    """Return the median settling time with its interval [s]; a dash where half of the runs or more never settle."""
    return short(median_with_interval(settling_times(runs)), digits)


def count_and_median(runs: pd.DataFrame) -> str:
    """Return how many runs settled and their median settling time [s], as in `40, 0.83`."""
    middle = median_with_interval(settling_times(runs)).value
    count = settled(runs)
    return f"{count}, {middle:.2f}" if middle < float("inf") else f"{count}, {MISSING}" if count else "0"


def share(runs: pd.DataFrame) -> str:
    """Return the share of runs that settled with its interval [%]."""
    return f"{settled_share(runs):.1f}"


def millimetres(runs: pd.DataFrame, column: str = "rms_error_evaluated", digits: int = 1) -> str:
    """Return the median of a column of errors with its interval [mm]; a run that did not complete counts as ∞."""
    return short(median_with_interval(1000.0 * column_of(runs, column).where(runs["status"] == COMPLETED)), digits)


def worst_errors(runs: pd.DataFrame) -> str:
    """Return the mean of the worst twentieth of the errors in the last second [mm]."""
    value = 1000.0 * tail_mean(column_of(runs, "steady_state_error").where(runs["status"] == COMPLETED), TAIL)
    return f"{value:.1f}" if value < float("inf") else MISSING


def overshoot(runs: pd.DataFrame) -> str:
    """Return the median overshoot with its interval [%]."""
    values = 100.0 * column_of(runs, "overshoot")
    return short(median_with_interval(values, missing="left_out"), 1) if values.notna().any() else MISSING


def paired(
    runs: pd.DataFrame, pairs: Sequence[tuple[str, str]], *, metric: str = "settling_time_s", never: float
) -> list[Comparison]:
    """Return how the runs of two names in the column `controller` differ, robot by robot, for each pair of names."""
    return compare_pairs(runs, pairs, never=never, metric=metric, keys=("plant", "task", "seed"))


def difference(comparison: Comparison, digits: int = 2, factor: float = 1.0) -> str:
    """Return a paired difference with its interval, and in brackets the p-value after Holm's correction."""
    p_value = comparison.corrected_p_value
    return f"{comparison.difference.scaled(factor):+.{digits}f} (p {p_value:.1g})"
