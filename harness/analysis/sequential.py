"""Paired comparisons that may end as soon as they are decided, of numbers alone.

A gambler bets on each robot that the mean of bounded values xᵢ ∈ [−1, 1] is above a bound b, with a share λ:

    K_n = Π (1 + λ (xᵢ − b)),   0 < λ < 1 / (1 + b)

If the mean is not above b, K is a nonnegative supermartingale that begins with 1, and so is any average of such K over
several λ. It ever reaches 1/α with a probability of at most α (Ville, 1939), whenever one looks. Sources: Waudby-Smith
and Ramdas, Estimating means of bounded random variables by betting, JRSS B 86, 2024; for several bounds at once, the
union of their levels (e-Bonferroni), which needs no independence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from servobench.harness.analysis.comparison import LOST_MARGIN, Verdict
from servobench.plant.contract.checks import FloatArray

CLIP = 5.0  # [margins] at which a paired difference is clipped, so that it is bounded
# For *equivalent*, the difference of lost shares is shown to be less
LOST_WITHIN = 0.1  # [1]
# Shares λ as parts of their largest value, and the weights of their wealths: it does most where methods are alike
PARTS = (0.98, 0.5, 0.25, 0.125)
WEIGHTS = (0.5, 0.25, 0.125, 0.125)
WITHIN = frozenset({"not more", "not less", "not more lost", "not fewer lost"})
# For less, for more, for fewer and for more lost runs: the level is divided among them
BETS = 4


@dataclass(frozen=True)
class Decision:
    """What a comparison says of its first method, and after how many robots."""

    verdict: Verdict
    robots: int  # those that were looked at
    told_by_lost: bool  # whether the lost runs decide, not the mean
    mean: float  # first − second over robots that neither loses [margins], each clipped at `CLIP`; NaN of none
    lost: tuple[int, int]  # number of lost runs of the first and of the second


def log_wealth(values: FloatArray, bound: float) -> FloatArray:
    """Return the logarithm of the wealth after each value of a gambler who bets that their mean is above a bound.

    Args:
        values: (..., n), from -1 to 1; NaN where there is no bet.
        bound: above -1 and below 1.

    Returns:
        (..., n): ln K, of the average of K over several λ.
    """
    gains = np.where(np.isnan(values), 0.0, values - bound)
    wealths = []
    for part, weight in zip(PARTS, WEIGHTS, strict=True):
        share = part / (1.0 + bound)
        growth = np.cumsum(np.log1p(share * gains), axis=-1)
        wealths.append(growth + np.log(weight))
    return np.logaddexp.reduce(wealths)


def decide(
    first: ArrayLike, second: ArrayLike, margin: float, level: float, looks: Sequence[int]
) -> Decision:
    """Compare two methods robot by robot, and end at the first look that decides.

    The rules are those of `servobench.harness.analysis.comparison.paired_difference`, with bets in place of its tests.
    Fewer lost runs are better where a bet on them says so. Else, over the robots that neither loses, the mean of
    differences that are clipped at `CLIP` margins decides: better or worse where it is shown to lie beyond the margin,
    equivalent where it is shown to lie within, and the difference of lost shares within `LOST_WITHIN`. For *better* and
    *worse* the other method must not have lost fewer runs by more than `LOST_MARGIN`, for *equivalent* neither; and the
    mean without clipping must lie on the same side. Of two bets on one side that with the harder bound is never richer,
    so that four levels are enough for all eight.

    Args:
        first: values by robot, less is better; NaN or +∞ is a lost run.
        second: likewise, of the same robots in the same order.
        margin: difference that does not matter.
        level: largest probability of a false verdict.
        looks: numbers of robots after which one looks, in order, none above that of the values.

    Returns:
        That of the first look that decides; undecided after the last one.
    """
    one = np.asarray(first, dtype=np.float64)
    other = np.asarray(second, dtype=np.float64)
    lost_one = ~np.isfinite(one)
    lost_other = ~np.isfinite(other)
    both = ~lost_one & ~lost_other
    difference = np.where(both, one, 0.0) - np.where(both, other, 0.0)
    clipped = np.full(len(one), np.nan)
    if margin > 0.0:
        inside = np.clip(difference / (CLIP * margin), -1.0, 1.0)
        clipped = np.where(both, inside, np.nan)
    more_lost = lost_one.astype(float) - lost_other.astype(float)
    bound = 1.0 / CLIP  # the margin
    wealths = {
        "more": log_wealth(clipped, bound),
        "less": log_wealth(-clipped, bound),
        "not more": log_wealth(-clipped, -bound),
        "not less": log_wealth(clipped, -bound),
        "more lost": log_wealth(more_lost, 0.0),
        "fewer lost": log_wealth(-more_lost, 0.0),
        "not more lost": log_wealth(-more_lost, -LOST_WITHIN),
        "not fewer lost": log_wealth(more_lost, -LOST_WITHIN),
    }
    needed = np.log(BETS / level)
    shown = {name: np.logical_or.accumulate(each >= needed) for name, each in wealths.items()}
    found = Decision("undecided", 0, False, np.nan, (0, 0))
    for robots in looks:
        seen = slice(robots)
        sure = {name for name, each in shown.items() if each[robots - 1]}
        ahead = float(more_lost[seen].sum())  # lost runs that the first has more than the second
        counted = int(both[seen].sum())
        plain = float(difference[seen].sum())
        verdict, told_by_lost = _verdict(sure, ahead, LOST_MARGIN * robots, plain, margin * counted)
        mean = np.nan
        if counted and margin > 0.0:
            mean = CLIP * float(np.nanmean(clipped[seen]))
        lost = int(lost_one[seen].sum()), int(lost_other[seen].sum())
        found = Decision(verdict, robots, told_by_lost, mean, lost)
        if verdict != "undecided":
            break
    return found


def _verdict(
    sure: set[str], ahead: float, few: float, plain: float, margin: float
) -> tuple[Verdict, bool]:
    """Return the verdict on the first method, and whether lost runs tell it.

    Args:
        sure: the bets that are won.
        ahead: lost runs that the first method has more than the second.
        few: difference in lost runs that does not matter.
        plain: sum of the differences without clipping.
        margin: sum of the margins of as many robots.
    """
    if "more lost" in sure:
        return "worse", True
    if "fewer lost" in sure:
        return "better", True
    if "more" in sure and ahead >= -few and plain > margin:
        return "worse", False
    if "less" in sure and ahead <= few and plain < -margin:
        return "better", False
    if sure >= WITHIN and abs(ahead) <= few and abs(plain) <= margin:
        return "equivalent", False
    return "undecided", False
