"""How sure a comparison is: rates, medians and paired differences with intervals, tails, and kinds of failure.

All functions are pure, and seeded where they draw. What a run that never settled counts as is said with each function:

| function | a run that never settled (settling time NaN) |
|---|---|
| `success_rate` | is no success |
| `median_with_interval`, `tail_mean` | counts as +∞: so does a median where half of the runs or more never settle |
| `compare_pairs` | counts as `never`, the duration of the run: a bound from below, as ranks need finite numbers |
| `outcomes` | is `not_settled` if it completed, else the fault |

A run that did not complete never settled, whatever its error was before: `settling_times` says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from servobench.harness.run.episode import COMPLETED
from servobench.plant.checks import FloatArray

CONFIDENCE: Final = 0.95
RESAMPLES: Final = 2000
SETTLED: Final = "settled"
NOT_SETTLED: Final = "not_settled"
KEYS: Final = ("plant", "task", "mismatch", "seed")  # what two runs must share to be a pair


@dataclass(frozen=True)
class Estimate:
    """A number with its interval.

    Attributes:
        value: the estimate.
        low: lower end; NaN where the sample is too small to tell.
        high: upper end, likewise.
        count: size of the sample.
    """

    value: float
    low: float
    high: float
    count: int


@dataclass(frozen=True)
class Comparison:
    """Two controllers on the same plants, tasks and seeds.

    Attributes:
        first: name of a controller.
        second: name of the other.
        difference: median of first − second over pairs; below 0 the first one is better.
        p_value: two-sided, of the Wilcoxon signed-rank test.
        corrected_p_value: after Holm, over all comparisons made together.
    """

    first: str
    second: str
    difference: Estimate
    p_value: float
    corrected_p_value: float


def success_rate(successes: int, runs: int, confidence: float = CONFIDENCE) -> Estimate:
    """Return the share of successes with its Wilson interval.

    Raises:
        ValueError: no run, or more successes than runs.
    """
    from scipy import stats  # noqa: PLC0415 - half a second, to judge alone

    if not 0 <= successes <= runs or runs < 1:
        raise ValueError(f"successes must be from 0 to runs, and runs at least 1; got {successes} of {runs}")
    with np.errstate(under="ignore"):  # scipy also takes a p-value, however small
        interval = stats.binomtest(successes, runs).proportion_ci(confidence, method="wilson")
    return Estimate(successes / runs, float(interval.low), float(interval.high), runs)


def median_with_interval(
    values: ArrayLike,
    *,
    missing: Literal["infinite", "left_out"] = "infinite",
    seed: int = 0,
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
) -> Estimate:
    """Return the median with its percentile bootstrap interval.

    BCa is not used: its jackknife is degenerate for a median. The interval may reach to +∞, and does where that many
    resamples have an infinite median. A single value has no interval (NaN); equal values have one of no width.

    Args:
        values: a sample, NaN where a run has no value.
        missing: NaN counts as +∞ (never settled), or is left out (the metric does not apply).
        seed: of the resampling.
        confidence: of the interval.
        resamples: how many.

    Raises:
        ValueError: no value, or −∞.
    """
    from scipy import stats  # noqa: PLC0415 - as above

    sample = _sample(values, missing)
    if len(sample) == 0:
        raise ValueError("values must hold at least one number")
    finite = np.isfinite(sample)
    if not finite.all():  # stand-ins above all finite values keep the order; a mean with one of them lies above, too
        largest = float(sample[finite].max()) if finite.any() else 0.0
        spread = float(np.ptp(sample[finite])) if finite.any() else 0.0
        sample = np.where(finite, sample, largest + 2.0 * (1.0 + spread))
    else:
        largest = float(sample.max())
    if len(sample) == 1:
        return Estimate(float(_restored(sample, largest)[0]), np.nan, np.nan, 1)
    with np.errstate(under="ignore"):  # scipy also takes a standard error, of numbers however small
        drawn = stats.bootstrap(
            (sample,), np.median, n_resamples=resamples, method="percentile", rng=np.random.default_rng(seed)
        ).bootstrap_distribution
    medians = _restored(np.sort(drawn), largest)
    cut = int((1.0 - confidence) / 2.0 * resamples)  # order statistics, as nothing lies between a number and infinity
    value = float(_restored(np.array([np.median(sample)]), largest)[0])
    return Estimate(value, float(medians[cut]), float(medians[-1 - cut]), len(sample))


def tail_mean(
    values: ArrayLike, level: float = 0.95, *, missing: Literal["infinite", "left_out"] = "infinite"
) -> float:
    """Return the conditional value at risk: the mean of the worst share 1 − `level` of a sample of errors.

    The share need not be a whole number of values: the one at its edge counts in part (Rockafellar and Uryasev, 2002).
    """
    if not 0.0 <= level < 1.0:
        raise ValueError(f"level must be at least 0 and below 1, got {level}")
    sample = np.sort(_sample(values, missing))[::-1]
    if len(sample) == 0:
        raise ValueError("values must hold at least one number")
    if np.isinf(sample[0]):
        return np.inf
    share = (1.0 - level) * len(sample)
    weight = np.clip(share - np.arange(len(sample)), 0.0, 1.0)
    return float(weight @ sample / weight.sum())


def compare_pairs(
    runs: pd.DataFrame,
    pairs: Sequence[tuple[str, str]],
    *,
    never: float,
    metric: str = "settling_time_s",
    keys: Sequence[str] = KEYS,
    seed: int = 0,
    confidence: float = CONFIDENCE,
) -> list[Comparison]:
    """Compare controllers on the runs that they share, and correct for the number of comparisons.

    Wilcoxon's signed-rank test, two-sided, and Holm's correction over all `pairs`; see `signed_rank_p_value`. Settling
    times are whole periods, so equal ones are frequent.

    Args:
        runs: the table of runs.
        pairs: names of controllers, two and two.
        never: what a run counts as that has no value or did not complete; for settling times the duration, s.
        metric: the column compared, less is better.
        keys: columns that two runs of a pair share.
        seed: of the bootstrap interval of the median difference.
        confidence: of that interval.

    Raises:
        ValueError: no pair, two controllers without a common run, or two runs of a controller with the same keys.
    """
    if not pairs:
        raise ValueError("pairs must hold at least one pair of controllers")
    differences = [_differences(runs, pair, never, metric, keys) for pair in pairs]
    p_values = [signed_rank_p_value(difference) for difference in differences]
    corrected = holm(p_values)
    return [
        Comparison(
            *pair, median_with_interval(difference, seed=seed, confidence=confidence), p_value, float(corrected_p_value)
        )
        for pair, difference, p_value, corrected_p_value in zip(pairs, differences, p_values, corrected, strict=True)
    ]


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values after Holm's correction for their number."""
    order = np.argsort(p_values)
    scaled = np.asarray(p_values)[order] * np.arange(len(order), 0, -1)
    corrected = np.empty(len(order))
    corrected[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return [float(value) for value in corrected]


def signed_rank_p_value(differences: ArrayLike) -> float:
    """Return the two-sided p-value of Wilcoxon's signed-rank test with Pratt's zeros; 1 where all are zero.

    Differences below a billionth of the largest count as zero and equal ones as ties: 0.3 − 0.1 and 0.2 are no ranks.
    """
    from scipy import stats  # noqa: PLC0415 - as above

    difference = np.asarray(differences, dtype=np.float64)
    largest = float(np.abs(difference).max())
    if largest == 0.0:
        return 1.0
    return float(stats.wilcoxon(np.round(difference / largest, 9), zero_method="pratt").pvalue)


def column_of(runs: pd.DataFrame, name: str) -> pd.Series[float]:
    """Return a column of the table of runs, NaN throughout where the table has none of this name."""
    return runs.reindex(columns=[name])[name].astype(float)


def settling_times(runs: pd.DataFrame) -> pd.Series[float]:
    """Return the settling time of each run, s; NaN where it never settled or did not complete."""
    return column_of(runs, "settling_time_s").where(runs["status"] == COMPLETED)


def settled_share(runs: pd.DataFrame, confidence: float = CONFIDENCE) -> Estimate:
    """Return how many of `runs` settled, in percent, with the Wilson interval."""
    rate = success_rate(int(settling_times(runs).notna().sum()), len(runs), confidence)
    return Estimate(100.0 * rate.value, 100.0 * rate.low, 100.0 * rate.high, rate.count)


def outcomes(runs: pd.DataFrame) -> pd.Series[str]:
    """Return for each run `settled`, `not_settled` (it completed, outside the band) or the fault that ended it."""
    settled = pd.Series(np.where(settling_times(runs).notna(), SETTLED, NOT_SETTLED), index=runs.index)
    return settled.where(runs["status"] == COMPLETED, runs["status"]).rename("outcome").astype(str)


def _sample(values: ArrayLike, missing: Literal["infinite", "left_out"]) -> FloatArray:
    sample = np.array(values, dtype=np.float64).ravel()
    if np.isneginf(sample).any():
        raise ValueError("values must not be −∞")
    unknown = np.isnan(sample)
    return np.where(unknown, np.inf, sample) if missing == "infinite" else sample[~unknown]


def _restored(values: FloatArray, largest: float) -> FloatArray:
    """Return `values` with +∞ for all that lie above the largest finite one of the sample."""
    return np.where(values > largest, np.inf, values)


def _differences(
    runs: pd.DataFrame, pair: tuple[str, str], never: float, metric: str, keys: Sequence[str]
) -> FloatArray:
    values = column_of(runs, metric).where(runs["status"] == COMPLETED).fillna(never)
    indexed = pd.Series(values.to_numpy(), index=pd.MultiIndex.from_frame(runs[list(keys)]))
    first, second = (indexed[(runs["controller"] == name).to_numpy()] for name in pair)
    for name, series in zip(pair, (first, second), strict=True):
        if series.index.has_duplicates:
            raise ValueError(f"{name} has several runs of the same {', '.join(keys)}: pairs are ambiguous")
    first, second = first.align(second, join="inner")
    if len(first) == 0:
        raise ValueError(f"{pair[0]} and {pair[1]} have no run in common: nothing to compare")
    return np.asarray(first - second, dtype=np.float64)
