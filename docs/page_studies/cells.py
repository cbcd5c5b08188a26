"""How runs of the studies become rows and cells of a table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import pandas as pd

from page_studies.study import ENGINES
from servobench.harness.analysis.comparison import (
    CURVE,
    MISSING,
    Difference,
    Estimate,
    achieved_share,
    column_of,
    compare_pairs,
    mean_with_interval,
    median_with_interval,
    outcomes,
    settled_share,
    settling_times,
    tail_mean,
    texts_of,
)
from servobench.harness.run.result import COMPLETED

Cell: TypeAlias = Callable[[pd.DataFrame], str]  # what a table says of runs
TAIL: Final = 0.95
CHANGED: Final = (
    " changed"  # end of the name of a method with one thing changed, beside the method as it is
)


def by_method(runs: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield each method with its runs, in order of appearance."""
    for name, own in runs.groupby("controller", sort=False):
        yield str(name), own


def rows_by_method(
    runs: pd.DataFrame, cells: Mapping[str, Cell], title: str = "method"
) -> Iterator[dict[str, str]]:
    """Yield a row for each method, of its name and of what each of `cells` says of its runs."""
    for name, own in by_method(runs):
        yield {title: quoted(name)} | {heading: cell(own) for heading, cell in cells.items()}


def where(column: str, value: str, cell: Cell) -> Cell:
    """Return a cell of those runs alone that have a value in a column."""
    return lambda runs: cell(runs[runs[column] == value])


def quoted(name: str) -> str:
    """Return a name as a page shows it."""
    return f"`{name}`"


def short(estimate: Estimate, digits: int) -> str:
    """Return value and interval; the dash where the value is infinite or unknown."""
    return f"{estimate:.{digits}f}" if estimate.value < float("inf") else MISSING


def settled(runs: pd.DataFrame) -> str:
    """Return how many runs settled."""
    return str(settling_times(runs).notna().sum())


def settling(runs: pd.DataFrame, digits: int = 2) -> str:
    """Return the median settling time with its interval [s]; a dash where half of the runs or more never settle."""
    return with_lost(short(median_with_interval(settling_times(runs)), digits), runs)


def with_lost(cell: str, runs: pd.DataFrame) -> str:
    """Return a cell with the share of runs that neither settled nor followed their curve, where there are any."""
    lost = 100.0 - achieved_share(runs).value
    return f"{cell}, {lost:.0f} % lost" if lost >= 0.5 else cell


def share(runs: pd.DataFrame) -> str:
    """Return the share of runs that settled with its interval [%]."""
    return f"{settled_share(runs):.1f}"


def millimetres(runs: pd.DataFrame, column: str = "rms_error_evaluated", digits: int = 1) -> str:
    """Return the median of a column of errors with its interval [mm]; a run that did not complete counts as ∞.

    Of a curve that not all runs followed, the share of lost runs is told, too.
    """
    middle = short(
        median_with_interval(1000.0 * column_of(runs, column).where(runs["status"] == COMPLETED)),
        digits,
    )
    return with_lost(middle, runs) if (texts_of(runs, "task_kind") == CURVE).all() else middle


def worst_errors(runs: pd.DataFrame) -> str:
    """Return the mean of the worst twentieth of the errors in the last second [mm]."""
    value = 1000.0 * tail_mean(
        column_of(runs, "steady_state_error").where(runs["status"] == COMPLETED), TAIL
    )
    return f"{value:.1f}" if value < float("inf") else MISSING


def overshoot(runs: pd.DataFrame) -> str:
    """Return the median overshoot with its interval [%]."""
    values = 100.0 * column_of(runs, "overshoot")
    return (
        short(median_with_interval(values, missing="left_out"), 1)
        if values.notna().any()
        else MISSING
    )


def counted(runs: pd.DataFrame) -> str:
    """Return the outcomes of runs with their numbers."""
    return ", ".join(f"{count} {word}" for word, count in outcomes(runs).value_counts().items())


def ended_early(runs: pd.DataFrame) -> str:
    """Return with which statuses runs ended early, and how many with each."""
    early = runs.loc[runs["status"] != COMPLETED, "status"].value_counts()
    return ", ".join(f"{count} {status}" for status, count in early.items())


marked = "**{}**".format  # a cell in bold


@dataclass(frozen=True)
class Measure:
    """How pairs of names in the column `controller` are compared, robot by robot.

    Attributes:
        task: whose runs are compared.
        metric: the column that is compared, less is better.
        digits: after the point.
        factor: to the unit that is shown.
    """

    task: str
    metric: str
    digits: int
    factor: float

    def compare(self, runs: pd.DataFrame, pairs: Sequence[tuple[str, str]]) -> list[Difference]:
        """Return the paired difference of each pair of names."""
        own, keys = runs[runs["task"] == self.task], ("plant", "task", "seed")
        return compare_pairs(own, pairs, metric=self.metric, keys=keys)

    def differences(self, runs: pd.DataFrame, pairs: Sequence[tuple[str, str]]) -> list[str]:
        """Return the text on the paired difference of each pair of names."""
        return [self.difference(found) for found in self.compare(runs, pairs)]

    def difference(self, found: Difference) -> str:
        """Return the lost runs of both if there are any, the mean difference with its interval, and the verdict."""
        lost = "{} : {} lost, ".format(*found.lost) if any(found.lost) else ""
        return f"{lost}{found.mean.scaled(self.factor):+.{self.digits}f} {found.verdict}"

    def on_engines(
        self, runs: Mapping[str, pd.DataFrame], pairs: Sequence[tuple[str, str]]
    ) -> Iterator[dict[str, str]]:
        """Yield for each pair its difference on each engine, in bold on both where it holds on one only.

        That is where the interval of one lies above or below 0, that of the other does not lie on the same side, and
        the difference differs between the engines, robot by robot: the interval of its mean lies above or below 0.
        """
        compared = [self.compare(runs[engine], pairs) for engine in ENGINES]
        for pair, *found in zip(pairs, *compared, strict=True):
            one, other = (self._by_robot(runs[engine], pair) for engine in ENGINES)
            between = mean_with_interval((one - other).dropna().to_numpy())
            cells = {
                engine: self.difference(each) for engine, each in zip(ENGINES, found, strict=True)
            }
            on_one_only = len({side(each.mean) for each in found}) > 1 and side(between) != 0
            yield {engine: marked(cell) for engine, cell in cells.items()} if on_one_only else cells

    def _by_robot(self, runs: pd.DataFrame, pair: tuple[str, str]) -> pd.Series[float]:
        """Return the difference of two names for each seed."""
        own = runs[runs["task"] == self.task]
        values = column_of(own, self.metric).where(own["status"] == COMPLETED)
        first, second = (
            values[own["controller"] == name].set_axis(own.loc[own["controller"] == name, "seed"])
            for name in pair
        )
        return first - second


MOVES: Final = Measure("random", "settling_time_s", digits=2, factor=1.0)
CIRCLES: Final = Measure("circle", "rms_error_evaluated", digits=1, factor=1e3)  # [m], shown in mm


def changed_and_usual(changed: pd.DataFrame, usual: pd.DataFrame) -> pd.DataFrame:
    """Return the runs of methods with one thing changed, whose names end with `CHANGED`, and of methods as they are."""
    return pd.concat([changed.assign(controller=changed["controller"] + CHANGED), usual]).assign(
        plant=""
    )


def side(estimate: Estimate) -> int:
    """Return 1 or −1 where the interval lies above or below 0, and 0 where it does not."""
    return int(estimate.low > 0.0) - int(estimate.high < 0.0)
