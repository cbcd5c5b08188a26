"""How runs of the studies become rows and cells of a table."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from page_studies.study import ENGINES
from servobench.harness.analysis.comparison import (
    Comparison,
    column_of,
    compare_pairs,
    differences_of_pairs,
    outcomes,
    settled_share,
    settling_times,
)
from servobench.harness.analysis.statistics import MISSING, Estimate, median_with_interval, success_rate, tail_mean
from servobench.harness.run.result import COMPLETED

TAIL: Final = 0.95
CHANGED: Final = ("changed", "usual")  # a pair: a method with one thing changed, and as it is


def by_method(runs: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield each method with its runs, in order of appearance."""
    for name, own in runs.groupby("controller", sort=False):
        yield str(name), own


def rows_by_method(
    runs: pd.DataFrame, cells: Mapping[str, Callable[[pd.DataFrame], str]], title: str = "method"
) -> Iterator[dict[str, str]]:
    """Yield a row for each method, of its name and of what each of `cells` says of its runs."""
    for name, own in by_method(runs):
        yield {title: quoted(name)} | {heading: cell(own) for heading, cell in cells.items()}


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


def counted(runs: pd.DataFrame) -> str:
    """Return the outcomes of runs with their numbers."""
    return ", ".join(f"{count} {word}" for word, count in outcomes(runs).value_counts().items())


def ended_early(runs: pd.DataFrame) -> str:
    """Return with which statuses runs ended early, and how many with each."""
    early = runs.loc[runs["status"] != COMPLETED, "status"].value_counts()
    return ", ".join(f"{count} {status}" for status, count in early.items())


def marked(cell: str) -> str:
    """Return a cell in bold."""
    return f"**{cell}**"


@dataclass(frozen=True)
class Measure:
    """How pairs of names in the column `controller` are compared, robot by robot.

    Attributes:
        task: whose runs are compared.
        metric: the column that is compared, less is better.
        never: what a run counts as that has no value or did not complete.
        digits: after the point.
        factor: to the unit that is shown.
    """

    task: str
    metric: str
    never: float
    digits: int
    factor: float

    def compare(self, runs: pd.DataFrame, pairs: Sequence[tuple[str, str]]) -> list[Comparison]:
        """Return the paired difference of each pair of names."""
        own, keys = runs[runs["task"] == self.task], ("plant", "task", "seed")
        return compare_pairs(own, pairs, never=self.never, metric=self.metric, keys=keys)

    def difference(self, comparison: Comparison) -> str:
        """Return a paired difference with its interval, and in brackets the p-value after Holm's correction."""
        value = comparison.difference.scaled(self.factor)
        return f"{value:+.{self.digits}f} (p {comparison.corrected_p_value:.1g})"

    def on_engines(
        self, runs: Mapping[str, pd.DataFrame], pairs: Sequence[tuple[str, str]]
    ) -> Iterator[dict[str, str]]:
        """Yield for each pair its difference on each engine, in bold on both where it holds on one only.

        That is where the interval of one lies above or below 0, that of the other does not lie on the same side, and
        the difference differs between the engines, robot by robot: the interval of its median lies above or below 0.
        """
        compared = [self.compare(runs[engine], pairs) for engine in ENGINES]
        for pair, *found in zip(pairs, *compared, strict=True):
            one, other = (self._by_robot(runs[engine], pair) for engine in ENGINES)
            between = median_with_interval(np.asarray(differences_of_pairs(*one.align(other, join="inner"))))
            cells = {engine: self.difference(each) for engine, each in zip(ENGINES, found, strict=True)}
            on_one_only = len({side(each.difference) for each in found}) > 1 and side(between) != 0
            yield {engine: marked(cell) for engine, cell in cells.items()} if on_one_only else cells

    def _by_robot(self, runs: pd.DataFrame, pair: tuple[str, str]) -> pd.Series[float]:
        """Return the difference of two names for each seed."""
        own = runs[runs["task"] == self.task]
        values = column_of(own, self.metric).where(own["status"] == COMPLETED).fillna(self.never)
        first, second = (
            values[own["controller"] == name].set_axis(own.loc[own["controller"] == name, "seed"]) for name in pair
        )
        return differences_of_pairs(*first.align(second, join="inner"))


MOVES: Final = Measure("random", "settling_time_s", never=10.0, digits=2, factor=1.0)  # 10 s is the whole move
CIRCLES: Final = Measure("circle", "rms_error_evaluated", never=1.0, digits=1, factor=1e3)  # [m], shown in mm


def changed_and_usual(changed: pd.DataFrame, usual: pd.DataFrame, name: str) -> pd.DataFrame:
    """Return the runs of a method under the two names of `CHANGED`."""
    both = zip(CHANGED, (changed, usual), strict=True)
    return pd.concat(runs[runs["controller"] == name].assign(controller=label, plant="") for label, runs in both)


def side(estimate: Estimate) -> int:
    """Return 1 or −1 where the interval lies above or below 0, and 0 where it does not."""
    return int(estimate.low > 0.0) - int(estimate.high < 0.0)


def most(count: int, other: int) -> bool:
    """Return whether `count` is more than half of both beyond the Wilson interval."""
    return count > 0 and success_rate(count, count + other).low > 0.5
