"""The table of runs read: how runs ended, which of them are compared, and paired differences between controllers.

A run that did not complete never settled, even if its error was small before: see `settling_times`. In a comparison a
run without a value is lost, see `paired_difference`.

The functions of numbers alone are pure. In `median_with_interval` and `tail_mean` a missing value counts as +∞ unless
it is left out: so does a median where half of the values or more are missing. Intervals hold 95 %, those of mean
differences 90 %.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from servobench.harness.config.registry import CONTROLLERS, DECLARED, find_controller
from servobench.harness.run.metrics import METRICS
from servobench.harness.run.outcome import (
    ACHIEVED,
    FOLLOWED,
    FOLLOWING_BANDS,
    NOT_FOLLOWED,
    NOT_SETTLED,
    SETTLED,
)
from servobench.harness.run.request import RunSettings
from servobench.harness.run.result import COMPLETED
from servobench.harness.run.variations import varied_columns
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError

CONFIDENCE = 0.95
ALPHA = 0.05  # of each one-sided test
# The least number of equal signs that a two-sided sign test distinguishes from chance at 5 %
MIN_PAIRS = 6
# The difference in the share of lost runs up to which methods may be equivalent
LOST_MARGIN = 0.03  # [1]
Verdict = Literal["better", "equivalent", "worse", "undecided"]
Pair = tuple[str, str]  # names of two controllers
PageRow = dict[tuple[str, str], Any]  # cells by group and heading
RESAMPLES = 2000
DRAWN_AT_ONCE = 1_000_000  # values of resamples in memory; the same are drawn for any number
MISSING = "–"  # text for a number that there is not


def number(value: float, spec: str) -> str:
    """Return a number formatted with `spec` as a reader wants it: ∞ for infinity, – for no number, never -0."""
    if np.isnan(value):
        return MISSING
    sign = spec[0] if spec[:1] in {"+", "-", " "} else ""
    without_minus_zero = f"{sign}z{spec.removeprefix(sign)}"
    return format(value, without_minus_zero).replace("inf", "∞")


@dataclass(frozen=True)
class Estimate:
    """A number with its interval; `f"{estimate:.2f}"` is `0.75 [0.70, 0.80]`."""

    value: float  # the estimate
    low: float  # lower end; NaN where the sample is too small for an interval
    high: float  # upper end, likewise
    count: int  # size of the sample; 0 where there is no number

    def __format__(self, spec: str) -> str:
        """Return value and interval, each formatted with `spec`; ∞ for infinity, no interval where there is none."""
        if not self.count or np.isnan(self.value):
            return MISSING
        if np.isnan(self.low):
            return number(self.value, spec)
        return f"{number(self.value, spec)} [{number(self.low, spec)}, {number(self.high, spec)}]"

    def scaled(self, factor: float) -> Estimate:
        """Return the estimate in another unit, or with the other sign."""
        low, high = sorted((factor * self.low, factor * self.high))
        return Estimate(factor * self.value, low, high, self.count)


NO_ESTIMATE = Estimate(np.nan, np.nan, np.nan, 0)


@dataclass(frozen=True)
class Difference:
    """How a first method differs from a second one on the same robots, in a measure of which less is better."""

    mean: Estimate  # of first − second over the robots on which neither is lost, with Student's interval of 90 %
    probability: Estimate  # P(first < second) + P(equal)/2 on a robot, where a lost run is worse than any other
    signs: tuple[int, int]  # number of robots on which the first, and the second, has less
    lost: tuple[int, int]  # number of lost runs of the first and of the second
    verdict: Verdict  # on the first
    told_by_lost: bool  # whether the lost runs decide, not the mean

    @cached_property
    def p_value(self) -> float:
        """Of the two-sided exact sign test that neither has less more often; a lost run is worst, ties are left out."""
        return _sign_test(*self.signs, "two-sided")

    @property
    def on_average(self) -> bool:
        """Whether better or worse is said of the mean alone: the sign test does not show it."""
        if self.told_by_lost or self.verdict not in ("better", "worse"):
            return False
        first_less, second_less = self.signs
        same_side = (first_less > second_less) == (self.verdict == "better")
        return self.p_value >= ALPHA or not same_side


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
    one = _sample(first)
    other = _sample(second)
    with np.errstate(invalid="ignore"):
        difference = np.round(one - other, 12)  # ±∞ where one is lost, NaN where both are
    count = len(difference)
    mean = mean_with_interval(difference[np.isfinite(difference)])
    only_first_lost = int(np.count_nonzero(difference == np.inf))
    only_second_lost = int(np.count_nonzero(difference == -np.inf))
    lost_alike = abs(only_first_lost - only_second_lost) <= LOST_MARGIN * count
    loses_more = is_majority(only_first_lost, only_second_lost)
    loses_less = is_majority(only_second_lost, only_first_lost)
    is_judged = mean.count >= MIN_PAIRS
    verdict: Verdict = "undecided"
    if loses_more or (not loses_less and is_judged and mean.low > margin):
        verdict = "worse"
    elif loses_less or (is_judged and mean.high < -margin):
        verdict = "better"
    elif is_judged and max(-mean.low, mean.high) <= margin and lost_alike:
        verdict = "equivalent"
    # P(first < second) + P(equal)/2 = 1/2 − E(sign)/2; a robot that both lose counts as equal.
    sign = np.where(np.isnan(difference), 0.0, np.sign(difference))
    probability = 0.5 - 0.5 * float(sign.sum()) / max(count, 1)
    signs = int((sign < 0.0).sum()), int((sign > 0.0).sum())
    lost = int(np.isinf(one).sum()), int(np.isinf(other).sum())
    return Difference(
        mean, _wilson(probability, count), signs, lost, verdict, loses_more or loses_less
    )


def is_majority(ones: int, others: int) -> bool:
    """Return whether a one-sided sign test at 5 % shows `ones` to be more frequent; of few, nothing is shown."""
    if ones + others < MIN_PAIRS:
        return False
    return _sign_test(ones, others, "greater") < ALPHA


def _sign_test(ones: int, others: int, alternative: Literal["two-sided", "greater"]) -> float:
    """Return the p-value of an exact sign test; 1 where there are no signs."""
    from scipy import stats  # noqa: PLC0415 - half a second, to judge alone

    if ones + others == 0:
        return 1.0
    with np.errstate(under="ignore"):
        return float(stats.binomtest(ones, ones + others, alternative=alternative).pvalue)


def mean_with_interval(values: FloatArray) -> Estimate:
    """Return the mean of finite values with Student's interval of 90 %; none of fewer than two values."""
    from scipy.special import stdtrit  # noqa: PLC0415 - to judge alone

    count = len(values)
    if count == 0:
        return NO_ESTIMATE
    if count == 1:
        return Estimate(float(values.sum()), np.nan, np.nan, count)
    mean = float(values.mean())
    standard_error = float(values.std(ddof=1)) / count**0.5
    quantile = float(stdtrit(count - 1, 1.0 - ALPHA))  # ALPHA at each end
    reach = quantile * standard_error
    return Estimate(mean, mean - reach, mean + reach, count)


def success_rate(successes: int, runs: int) -> Estimate:
    """Return the share of successes with its Wilson interval.

    Raises:
        ValueError: no run, or more successes than runs.
    """
    if not 0 <= successes <= runs or runs < 1:
        raise ValueError(
            f"successes must be from 0 to runs, and runs at least 1; got {successes} of {runs}"
        )
    return _wilson(successes / runs, runs)


def median_with_interval(
    values: ArrayLike, *, missing: Literal["infinite", "left_out"] = "infinite"
) -> Estimate:
    """Return the median with its percentile bootstrap interval.

    BCa is not used: its jackknife is degenerate for a median. The interval may reach to +∞, and does where that many
    resamples have an infinite median. A single value has no interval (NaN); equal values have one of no width.

    Args:
        values: a sample, NaN where a run has no value.
        missing: NaN counts as +∞ (never settled), or is left out (the metric does not apply).

    Raises:
        ValueError: no value, or −∞.
    """
    given = np.asarray(values, dtype=np.float64).ravel()
    if missing == "left_out":
        given = given[~np.isnan(given)]
    sample = _sample(given)
    if len(sample) == 0:
        raise ValueError("values must hold at least one number")
    value = float(np.median(sample))
    if len(sample) == 1:
        return Estimate(value, np.nan, np.nan, 1)
    from scipy import stats  # noqa: PLC0415 - as above

    # scipy also takes a standard error, of numbers however small and of infinite ones.
    with np.errstate(under="ignore", invalid="ignore"):
        drawn = stats.bootstrap(
            (sample,),
            np.median,
            n_resamples=RESAMPLES,
            batch=max(1, DRAWN_AT_ONCE // len(sample)),
            method="percentile",
            rng=np.random.default_rng(0),
        )
    medians = np.sort(drawn.bootstrap_distribution)
    # The ends are order statistics, as nothing lies between a number and infinity.
    cut = int((1.0 - CONFIDENCE) / 2.0 * RESAMPLES)
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
    share = (1.0 - level) * len(sample)  # a number of values, seldom a whole one
    weight = np.clip(share - np.arange(len(sample)), 0.0, 1.0)
    return float(weight @ sample / weight.sum())


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values after Holm's correction for their number."""
    order = np.argsort(p_values)
    # The k-th smallest of m is multiplied by m − k + 1, and none becomes less than the one before it.
    factors = np.arange(len(order), 0, -1)
    scaled = np.asarray(p_values)[order] * factors
    corrected = np.empty(len(order))
    corrected[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return [float(value) for value in corrected]


def _wilson(share: float, count: int) -> Estimate:
    """Return a share with its Wilson interval; of a share with ties as halves it is wider than need be."""
    if count == 0:
        return NO_ESTIMATE
    # (p + z²/2n ± z √(p(1 − p)/n + z²/4n²)) / (1 + z²/n)
    z = NormalDist().inv_cdf((1.0 + CONFIDENCE) / 2.0)
    centre = share + z * z / (2.0 * count)
    variance = share * (1.0 - share) / count + (0.5 * z / count) ** 2
    reach = z * variance**0.5
    scale = 1.0 + z * z / count
    low = (centre - reach) / scale
    high = (centre + reach) / scale
    return Estimate(share, max(low, 0.0), min(high, 1.0), count)


def _sample(values: ArrayLike) -> FloatArray:
    """Return a sample with +∞ in place of NaN."""
    sample = np.array(values, dtype=np.float64).ravel()
    if np.isneginf(sample).any():
        raise ValueError("values must not be −∞")
    return np.where(np.isnan(sample), np.inf, sample)


FROM_TWIN = "drawn from the twin"  # in titles, the mismatch none of such robots
KEYS = ("plant", "task", "mismatch", "seed")  # columns that two runs of a pair share
CONDITION = ("plant", "sensing", "task", "mismatch")  # with the settings that are varied
HANDY_UNITS = {"m": ("mm", 1000.0)}
# Differences that do not matter, see `margin`
ERROR_MARGIN = 0.04  # [1] share of the settling band: 0.2 mm in 5 mm
BOUND_MARGIN = 0.1  # [1] share of the error of a controller that knows the robot
MEDIAN_MARGIN = 0.1  # [1] share of the best median, of metrics without a natural margin
SHARE_MARGIN = 0.01  # [1]
SECOND_LAP = "rms_error_second_lap"
POINT_TO_POINT = "point_to_point"
CURVE = "curve"
SEQUENCE = "sequence"


def split_conditions(runs: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Return the runs of each plant, task and condition, with words for it, in order of appearance."""
    varied = varied_columns(runs.columns)
    known = [*(name for name in CONDITION if name in runs), *varied]
    found = []
    for key, group in runs.groupby(known, sort=False, dropna=False):
        values: dict[str, Any] = dict(zip(known, key, strict=True))
        place = place_name(values["plant"], values.get("sensing"))
        words = f"{values['task']} on {place}, {values['mismatch']}"
        # The factor is NaN in a row of a table without this column.
        if abs(values.get("noise_factor", 1.0) - 1.0) > 0.0:
            words += f", noise × {values['noise_factor']:g}"
        for name, (heading, factor) in varied.items():
            if name != "noise_factor" and not pd.isna(values[name]):
                quantity, _, unit = heading.removesuffix("]").partition(" [")
                words += f", {quantity} {shown_value(values[name], factor)}"
                if unit:
                    words += f" {unit}"
        found.append((words, group))
    return found


def shown_value(value: Any, factor: float = 1.0, missing: str = "as configured") -> str:  # noqa: ANN401 - a cell
    """Return the value of a condition as text: a number times the factor to the unit in which it is shown."""
    if pd.isna(value):
        return missing
    if isinstance(value, float):
        return f"{factor * value:g}"
    return str(value)


def place_name(plant: Any, sensing: Any) -> str:  # noqa: ANN401 - cells of the table of runs
    """Return a plant's name for a title, with the sensing set-up where it is not the usual one."""
    if sensing in (None, DEFAULT_SENSING) or pd.isna(sensing):
        return f"{plant}"
    return f"{plant} {sensing}"


def with_places(runs: pd.DataFrame) -> pd.DataFrame:
    """Return runs whose plants are named as in titles, so that runs in other units are at other places."""
    if "sensing" not in runs or (runs["sensing"] == DEFAULT_SENSING).all():
        return runs
    return runs.assign(plant=list(map(place_name, runs["plant"], runs["sensing"])))


def split_tasks(runs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the runs of the moves, also of several in a row, and those of the tracked curves.

    A task of which no run could be built has no kind and is in neither.
    """
    kinds = texts_of(runs, "task_kind")
    moves = runs.loc[kinds.isin((POINT_TO_POINT, SEQUENCE)), "task"].unique()
    curves = runs.loc[kinds == CURVE, "task"].unique()
    return runs[runs["task"].isin(moves)], runs[runs["task"].isin(curves)]


def grouped(rows: Any) -> pd.DataFrame:  # noqa: ANN401 - rows, or columns by their names
    """Return a table whose columns are pairs (group, heading)."""
    table = pd.DataFrame(rows)
    if table.empty:
        return table
    return table.set_axis(pd.MultiIndex.from_tuples(map(tuple, table.columns)), axis=1)


def texts_of(runs: pd.DataFrame, name: str) -> pd.Series[Any]:
    """Return a column of the table of runs, NaN throughout where the table has none of this name."""
    if name in runs:
        return runs[name]
    return pd.Series(np.nan, index=runs.index, name=name)


def column_of(runs: pd.DataFrame, name: str) -> pd.Series[float]:
    """Return a column of numbers of the table of runs, likewise."""
    return texts_of(runs, name).astype(float)


def completed(runs: pd.DataFrame, name: str) -> pd.Series[float]:
    """Return a column of numbers of the table of runs, NaN where a run did not complete."""
    return column_of(runs, name).where(runs["status"] == COMPLETED)


def settling_times(runs: pd.DataFrame) -> pd.Series[float]:
    """Return the settling time of each run, s; NaN where it never settled or did not complete."""
    return completed(runs, "settling_time_s")


def settled_share(runs: pd.DataFrame) -> Estimate:
    """Return how many of `runs` settled, in percent, with the Wilson interval."""
    settled = int(settling_times(runs).notna().sum())
    return success_rate(settled, len(runs)).scaled(100.0)


def achieved_share(runs: pd.DataFrame) -> Estimate:
    """Return how many of `runs` settled or followed their curve, in percent, with the Wilson interval."""
    achieved = int(outcomes(runs).isin(ACHIEVED).sum())
    return success_rate(achieved, len(runs)).scaled(100.0)


def outcomes(runs: pd.DataFrame) -> pd.Series[str]:
    """Return the outcome of each run; in a table without it, `not_settled` or `not_followed` give no reason."""
    is_curve = texts_of(runs, "task_kind") == CURVE
    largest_error = FOLLOWING_BANDS * column_of(runs, "settling_band")
    follows = column_of(runs, "rms_error_evaluated") <= largest_error
    on_curve = np.where(follows, FOLLOWED, NOT_FOLLOWED)
    on_move = np.where(settling_times(runs).notna(), SETTLED, NOT_SETTLED)
    guessed = pd.Series(np.where(is_curve, on_curve, on_move), index=runs.index)
    guessed = guessed.where(runs["status"] == COMPLETED, runs["status"])
    stored = texts_of(runs, "outcome").astype(object)
    return stored.where(stored.notna(), guessed).rename("outcome").astype(str)


def achievement(runs: pd.DataFrame) -> str:
    """Return the word for a good outcome of these runs of one task: `settled`, or `followed` on a curve."""
    if (texts_of(runs, "task_kind") == CURVE).any():
        return FOLLOWED
    return SETTLED


def handy_unit(feature_unit: str | None) -> tuple[str, float]:
    """Return the unit in which errors of a feature are shown, and the factor to it; None is an unknown unit."""
    if not feature_unit:
        return ("feature unit", 1.0)
    return HANDY_UNITS.get(feature_unit, (feature_unit, 1.0))


def shown_unit(name: str, runs: pd.DataFrame) -> tuple[str, float]:
    """Return the unit in which a metric of these runs is shown, and the factor to it."""
    metric = METRICS[name]
    if metric.unit:
        if metric.percent:
            return ("%", 100.0)
        return (metric.unit, 1.0)
    units = texts_of(runs, "feature_unit").dropna().unique().tolist()
    if len(units) > 1:
        return (" or ".join(units), 1.0)
    return handy_unit(units[0] if units else None)


def metric_heading(name: str, runs: pd.DataFrame) -> str:
    """Return the label of a metric with the unit in which it is shown for these runs."""
    unit, _ = shown_unit(name, runs)
    if unit == "1":
        return METRICS[name].label
    return f"{METRICS[name].label} [{unit}]"


def is_superfluous(name: str, runs: pd.DataFrame) -> bool:
    """Return whether a metric repeats another one: these runs have no second lap, or it is the judged part."""
    if name != SECOND_LAP:
        return False
    second = texts_of(runs, name)
    is_judged_part = second == column_of(runs, "rms_error_evaluated")
    return (second.isna() | is_judged_part).all().item()


def in_handy_units(runs: pd.DataFrame) -> pd.DataFrame:
    """Return runs of several units with the errors of each in its handy one; runs of one unit as they are."""
    units = texts_of(runs, "feature_unit")
    if units.nunique() < 2:
        return runs
    handy = [handy_unit(unit if isinstance(unit, str) else None) for unit in units]
    factors = [factor for _, factor in handy]
    errors = [name for name, metric in METRICS.items() if not metric.unit and name in runs]
    changed = {name: factors * runs[name] for name in errors}
    return runs.assign(feature_unit=[unit for unit, _ in handy], **changed)


def settling_band(runs: pd.DataFrame, factor: float = 1.0) -> str:
    """Return the settling band of these runs times a factor with its unit, `5 mm`; words where they have several."""
    known = runs.reindex(columns=["settling_band", "feature_unit"]).dropna().drop_duplicates()
    if len(known) != 1:
        if factor == 1.0:
            return "the settling band"
        return f"{factor:g} settling bands"
    (band,) = known["settling_band"]
    (unit,) = known["feature_unit"]
    name, to_handy = handy_unit(str(unit))
    return f"{factor * to_handy * float(band):.3g} {name}"


def margin(name: str, runs: pd.DataFrame) -> float:
    """Return the difference in a metric of runs of one place that does not matter, in the unit of its column.

    For a time that is one control period; for an error 0.2 mm, as a share of the settling band, or a tenth of the
    median of the best controller that knows the robot if that is more; for a share or ratio 0.01; else a tenth of the
    median that is nearest to zero. A metric of a user's may declare its own.
    """
    unit = "unknown"
    if name in METRICS:
        unit = METRICS[name].unit
        declared = METRICS[name].margin
        if declared is not None:
            return declared
    if unit == "s":
        return float(column_of(runs, "period_s").fillna(RunSettings.period).max())
    if unit == "1" and name not in DECLARED:
        return SHARE_MARGIN
    if unit:
        medians = column_of(runs, name).groupby(runs["controller"]).median().abs()
        return float(np.nan_to_num(MEDIAN_MARGIN * medians.min()))
    names = [each for each in runs["controller"].unique() if knows_truth(str(each))]
    bounds = runs[runs["controller"].isin(names)]
    best = column_of(bounds, name).groupby(bounds["controller"]).median().min()
    band = column_of(runs, "settling_band").max()
    larger = np.fmax(ERROR_MARGIN * band, BOUND_MARGIN * best)  # either may be unknown, NaN
    return float(np.nan_to_num(larger))


def direction(metric: str) -> float:
    """Return 1, or -1 for a metric of which more is better."""
    if metric in METRICS and METRICS[metric].better == "more":
        return -1.0
    return 1.0


def knows_truth(name: str) -> bool:
    """Return whether a controller of this package needs the true robot; a third party's is not loaded for this."""
    with contextlib.suppress(ConfigurationError):
        return (name in CONTROLLERS or "+" in name) and find_controller(name).needs_truth
    return False


def compare_pairs(
    runs: pd.DataFrame,
    pairs: Sequence[Pair],
    *,
    metric: str = "settling_time_s",
    keys: Sequence[str] = KEYS,
) -> list[Difference]:
    """Compare controllers on the runs of one place that they share.

    Args:
        runs: the table of runs.
        pairs: names of controllers, two and two.
        metric: the column compared, negated if more is better; a run that has no value or did not complete is lost.
        keys: columns that two runs of a pair share.

    Raises:
        ValueError: two controllers without a common run, or two runs of a controller with the same keys.
    """
    small = margin(metric, runs)
    return [paired_difference(*_paired_values(runs, pair, metric, keys), small) for pair in pairs]


def _paired_values(
    runs: pd.DataFrame, pair: Pair, metric: str, keys: Sequence[str]
) -> tuple[pd.Series[float], pd.Series[float]]:
    """Return the values of two controllers on the runs that they share, by the keys of these; NaN of lost ones."""
    values = direction(metric) * completed(runs, metric)
    index = pd.MultiIndex.from_frame(runs[list(keys)])
    indexed = pd.Series(values.to_numpy(), index=index)
    first = indexed[(runs["controller"] == pair[0]).to_numpy()]
    second = indexed[(runs["controller"] == pair[1]).to_numpy()]
    for name, series in zip(pair, (first, second), strict=True):
        if series.index.has_duplicates:
            raise ConfigurationError(
                f"{name} has several runs of the same {', '.join(keys)}: pairs are ambiguous"
            )
    common = first.index.intersection(second.index, sort=False)
    if len(common) == 0:
        raise ValueError(f"{pair[0]} and {pair[1]} have no run in common: nothing to compare")
    return first[common], second[common]
