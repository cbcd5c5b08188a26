"""How sure a number is: rates, medians and tails with intervals, and verdicts on paired differences.

All functions are pure. In `median_with_interval` and `tail_mean` a missing value counts as +∞ unless it is left out: so
does a median where half of the values or more are missing. Intervals hold 95 %, those of mean differences 90 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from servobench.plant.contract.checks import FloatArray

CONFIDENCE: Final = 0.95
ALPHA: Final = 0.05  # of each one-sided test
MIN_PAIRS: Final = 6  # least number of equal signs that a two-sided sign test distinguishes from chance at 5 %
LOST_MARGIN: Final = 0.03  # difference in the share of lost runs up to which methods may be equivalent
Verdict = Literal["better", "equivalent", "worse", "undecided"]
RESAMPLES: Final = 2000
MISSING: Final = "–"  # text for a number that there is not


def number(value: float, spec: str) -> str:
    """Return a number formatted with `spec` as a reader wants it: ∞ for infinity, – for no number, never -0."""
    if np.isnan(value):
        return MISSING
    sign, rest = (spec[0], spec[1:]) if spec[:1] in {"+", "-", " "} else ("", spec)
    return format(value, f"{sign}z{rest}").replace("inf", "∞")


@dataclass(frozen=True)
class Estimate:
    """A number with its interval; `f"{estimate:.2f}"` is `0.75 [0.70, 0.80]`.

    Attributes:
        value: the estimate.
        low: lower end; NaN where the sample is too small for an interval.
        high: upper end, likewise.
        count: size of the sample; 0 where there is no number.
    """

    value: float
    low: float
    high: float
    count: int

    def __format__(self, spec: str) -> str:
        """Return value and interval, each formatted with `spec`; ∞ for infinity, no interval where there is none."""
        if not self.count or np.isnan(self.value):
            return MISSING
        if np.isnan(self.low):
            return number(self.value, spec)
        return f"{number(self.value, spec)} [{number(self.low, spec)}, {number(self.high, spec)}]"

    def scaled(self, factor: float) -> Estimate:
        """Return the estimate in another unit."""
        return Estimate(factor * self.value, factor * self.low, factor * self.high, self.count)


NO_ESTIMATE: Final = Estimate(np.nan, np.nan, np.nan, 0)


@dataclass(frozen=True)
class Difference:
    """How a first method differs from a second one on the same robots, in a measure of which less is better.

    Attributes:
        mean: of first − second over the robots on which neither is lost, with Student's interval of 90 %.
        probability: P(first < second) + P(equal)/2 on a robot, where a lost run is worse than any other.
        lost: number of lost runs of the first and of the second.
        verdict: on the first.
    """

    mean: Estimate
    probability: Estimate
    lost: tuple[int, int]
    verdict: Verdict


def paired_difference(first: ArrayLike, second: ArrayLike, margin: float) -> Difference:
    """Compare two methods robot by robot.

    Where a sign test over the robots that only one of them loses shows a difference, fewer lost runs are better. Else
    two one-sided t-tests decide (Schuirmann, 1987): better or worse where the interval of the mean lies beyond the
    margin, equivalent where it lies within and the shares of lost runs differ by at most `LOST_MARGIN`. All else is
    undecided, as are fewer than `MIN_PAIRS` robots.

    Args:
        first: values by robot, less is better; NaN or +∞ is a lost run.
        second: likewise, of the same robots.
        margin: difference that does not matter.
    """
    one, other = _sample(first), _sample(second)
    with np.errstate(invalid="ignore"):
        difference = np.round(one - other, 12)  # ±∞ where one is lost, NaN where both are
    count, sign = len(difference), np.where(np.isnan(difference), 0.0, np.sign(difference))
    mean = mean_with_interval(difference[np.isfinite(difference)])
    more, fewer = (int(np.count_nonzero(each)) for each in (difference == np.inf, difference == -np.inf))
    verdict: Verdict = "undecided"
    if is_majority(more, fewer) or is_majority(fewer, more):
        verdict = "worse" if more > fewer else "better"
    elif mean.count >= MIN_PAIRS and (mean.low > margin or mean.high < -margin):
        verdict = "worse" if mean.value > 0.0 else "better"
    elif mean.count >= MIN_PAIRS and max(-mean.low, mean.high) <= margin:
        verdict = "equivalent" if abs(more - fewer) <= LOST_MARGIN * count else "undecided"
    lost = int(np.isinf(one).sum()), int(np.isinf(other).sum())
    return Difference(mean, _wilson(0.5 - 0.5 * float(sign.sum()) / max(count, 1), count), lost, verdict)


def is_majority(ones: int, others: int) -> bool:
    """Return whether a one-sided sign test at 5 % shows `ones` to be more frequent; of few, nothing is shown."""
    from scipy import stats  # noqa: PLC0415 - half a second, to judge alone

    with np.errstate(under="ignore"):
        return ones + others >= MIN_PAIRS and stats.binomtest(ones, ones + others, alternative="greater").pvalue < ALPHA


def mean_with_interval(values: FloatArray) -> Estimate:
    """Return the mean of finite values with Student's interval of 90 %; none of fewer than two values."""
    from scipy import stats  # noqa: PLC0415 - half a second, to judge alone

    count = len(values)
    if count < 2:
        return Estimate(float(values.sum()), np.nan, np.nan, count) if count else NO_ESTIMATE
    mean, error = float(values.mean()), float(values.std(ddof=1)) / count**0.5
    reach = float(stats.t.ppf(1.0 - ALPHA, count - 1)) * error
    return Estimate(mean, mean - reach, mean + reach, count)


def success_rate(successes: int, runs: int) -> Estimate:
    """Return the share of successes with its Wilson interval.

    Raises:
        ValueError: no run, or more successes than runs.
    """
    if not 0 <= successes <= runs or runs < 1:
        raise ValueError(f"successes must be from 0 to runs, and runs at least 1; got {successes} of {runs}")
    return _wilson(successes / runs, runs)


def median_with_interval(values: ArrayLike, *, missing: Literal["infinite", "left_out"] = "infinite") -> Estimate:
    """Return the median with its percentile bootstrap interval.

    BCa is not used: its jackknife is degenerate for a median. The interval may reach to +∞, and does where that many
    resamples have an infinite median. A single value has no interval (NaN); equal values have one of no width.

    Args:
        values: a sample, NaN where a run has no value.
        missing: NaN counts as +∞ (never settled), or is left out (the metric does not apply).

    Raises:
        ValueError: no value, or −∞.
    """
    from scipy import stats  # noqa: PLC0415 - as above

    given = np.asarray(values, dtype=np.float64).ravel()
    sample = _sample(given[~np.isnan(given)] if missing == "left_out" else given)
    if len(sample) == 0:
        raise ValueError("values must hold at least one number")
    finite = np.isfinite(sample)
    known = sample[finite] if finite.any() else np.zeros(1)
    largest = float(known.max())

    def restored(medians: FloatArray) -> FloatArray:
        return np.where(medians > largest, np.inf, medians)

    # Stand-ins above all finite values keep the order; a mean with one of them lies above, too.
    sample = np.where(finite, sample, largest + 2.0 * (1.0 + float(np.ptp(known))))
    value = float(restored(np.median(sample, keepdims=True))[0])
    if len(sample) == 1:
        return Estimate(value, np.nan, np.nan, 1)
    with np.errstate(under="ignore"):  # scipy also takes a standard error, of numbers however small
        drawn = stats.bootstrap(
            (sample,), np.median, n_resamples=RESAMPLES, method="percentile", rng=np.random.default_rng(0)
        ).bootstrap_distribution
    medians = restored(np.sort(drawn))
    cut = int((1.0 - CONFIDENCE) / 2.0 * RESAMPLES)  # order statistics, as nothing lies between a number and infinity
    return Estimate(value, float(medians[cut]), float(medians[-1 - cut]), len(sample))


def tail_mean(values: ArrayLike, level: float = 0.95) -> float:
    """Return the conditional value at risk: the mean of the worst share 1 − `level` of a sample of errors.

    The share need not be a whole number of values: the one at its edge counts in part (Rockafellar and Uryasev, 2002).
    """
    if not 0.0 <= level < 1.0:
        raise ValueError(f"level must be at least 0 and below 1, got {level}")
    sample = np.sort(_sample(values))[::-1]
    if len(sample) == 0:
        raise ValueError("values must hold at least one number")
    if np.isinf(sample[0]):
        return np.inf
    share = (1.0 - level) * len(sample)
    weight = np.clip(share - np.arange(len(sample)), 0.0, 1.0)
    return float(weight @ sample / weight.sum())


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values after Holm's correction for their number."""
    order = np.argsort(p_values)
    scaled = np.asarray(p_values)[order] * np.arange(len(order), 0, -1)
    corrected = np.empty(len(order))
    corrected[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return [float(value) for value in corrected]


def _wilson(share: float, count: int) -> Estimate:
    """Return a share with its Wilson interval; of a share with ties as halves it is wider than need be."""
    if count == 0:
        return NO_ESTIMATE
    z = NormalDist().inv_cdf((1.0 + CONFIDENCE) / 2.0)
    centre, reach = share + z * z / (2.0 * count), z * (share * (1.0 - share) / count + (0.5 * z / count) ** 2) ** 0.5
    low, high = ((centre + side * reach) / (1.0 + z * z / count) for side in (-1.0, 1.0))
    return Estimate(share, max(low, 0.0), min(high, 1.0), count)


def _sample(values: ArrayLike) -> FloatArray:
    """Return a sample with +∞ in place of NaN."""
    sample = np.array(values, dtype=np.float64).ravel()
    if np.isneginf(sample).any():
        raise ValueError("values must not be −∞")
    return np.where(np.isnan(sample), np.inf, sample)
