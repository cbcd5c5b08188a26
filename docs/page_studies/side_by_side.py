"""Both physics engines side by side: the same commands on each, and a mark on what holds on one of them only."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np
import pandas as pd

from page_studies.methods import difference, paired
from page_studies.study import Words
from servobench.harness.analysis.comparison import Comparison, column_of, differences_of_pairs
from servobench.harness.analysis.statistics import Estimate, median_with_interval, success_rate
from servobench.harness.run.result import COMPLETED

ENGINES: Final = ("bullet", "mujoco")


def on_engines(command: Callable[[str], Words]) -> dict[str, Words]:
    """Return a command for each engine, by the name of its plant."""
    return {engine: command(engine) for engine in ENGINES}


def bare(plant: str) -> tuple[str, str]:
    """Return the setting that leaves table and floor out of the images: the same observations, bit for bit."""
    return ("--set", f"{plant}.scenery=false")


def marked(cell: str) -> str:
    """Return a cell in bold."""
    return f"**{cell}**"


def differences(
    runs: Mapping[str, pd.DataFrame],
    pairs: Sequence[tuple[str, str]],
    *,
    metric: str,
    never: float,
    digits: int = 2,
    factor: float = 1.0,
) -> Iterator[dict[str, str]]:
    """Yield for each pair of names their paired difference on each engine, in bold on both where it holds on one only.

    That is where the interval of one lies above or below 0, that of the other does not lie on the same side, and the
    difference differs between the engines, robot by robot: the interval of the median of that lies above or below 0.

    Args:
        runs: by engine, with the names in the column `controller`.
        pairs: names, two and two.
        metric: the column that is compared.
        never: what a run counts as that has no value or did not complete.
        digits: after the point.
        factor: of the unit that is shown.
    """
    compared = [paired(runs[engine], pairs, metric=metric, never=never) for engine in ENGINES]
    for pair, *found in zip(pairs, *compared, strict=True):
        by_robot = [robots(runs[engine], pair, metric, never) for engine in ENGINES]
        between = median_with_interval(np.asarray(differences_of_pairs(*by_robot[0].align(by_robot[1], join="inner"))))
        cells = {engine: difference(each, digits, factor) for engine, each in zip(ENGINES, found, strict=True)}
        yield {engine: marked(cell) for engine, cell in cells.items()} if on_one_only(found, between) else cells


def robots(runs: pd.DataFrame, pair: tuple[str, str], metric: str, never: float) -> pd.Series[float]:
    """Return the difference of two names for each task and seed."""
    values = column_of(runs, metric).where(runs["status"] == COMPLETED).fillna(never)
    indexed = pd.Series(values.to_numpy(), index=pd.MultiIndex.from_frame(runs[["task", "seed"]]))
    first, second = (indexed[(runs["controller"] == name).to_numpy()] for name in pair)
    return differences_of_pairs(*first.align(second, join="inner"))


def on_one_only(found: Sequence[Comparison], between: Estimate) -> bool:
    """Return whether a difference holds on one engine only, beyond the interval `between` the engines."""
    one, other = (side(each.difference) for each in found)
    return one != other and side(between) != 0


def side(estimate: Estimate) -> int:
    """Return 1 or −1 where the interval lies above or below 0, and 0 where it does not."""
    return int(estimate.low > 0.0) - int(estimate.high < 0.0)


def most(count: int, other: int) -> bool:
    """Return whether `count` is more than half of both beyond the Wilson interval."""
    return count > 0 and success_rate(count, count + other).low > 0.5
