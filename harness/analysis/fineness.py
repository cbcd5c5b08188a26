"""How fine a folder can tell methods apart: the least difference, and whether halves of its robots agree.

The unit is the robot, of which both methods have one run: whatever is drawn anew or split, its runs stay together.
"""

from __future__ import annotations

import numpy as np

from servobench.harness.analysis.comparison import ALPHA, Estimate

POWER = 0.8  # with which a least difference is told
MIN_AGREEMENT = 0.95  # share of the splits in which both halves must order a pair alike


def least_difference(mean: Estimate, margin: float) -> float:
    """Return the mean difference that is told to be beyond a margin with a probability of `POWER`.

        margin + (t₀.₉₅ + t₀.₈) s / √n

    Args:
        mean: a mean paired difference with Student's interval of 90 %, of n robots.
        margin: difference that does not matter, in the same unit.

    Returns:
        The difference; NaN where there is no interval.
    """
    if mean.count < 2:
        return np.nan
    from scipy.special import stdtrit  # noqa: PLC0415 - to judge alone

    level, power = stdtrit(mean.count - 1, [1.0 - ALPHA, POWER])
    standard_error = (mean.high - mean.low) / (2.0 * level)
    return float(margin + (level + power) * standard_error)


def agreement_of_halves(signs: tuple[int, int], robots: int) -> float:
    """Return in what share of all splits of the robots into halves both say that the same method is better more often.

    Args:
        signs: number of robots on which the first, and the second, has less.
        robots: their number, with those on which both have the same.
    """
    from scipy import stats  # noqa: PLC0415 - as above

    first, second = signs
    half = robots // 2
    if first == robots:
        return float(half > 0)
    # The first half has i of those on which the first method has less, and then j of the others' second
    i = np.arange(first + 1)[:, None]
    j = np.arange(second + 1)[None, :]
    with np.errstate(all="ignore"):
        chance = stats.hypergeom.pmf(i, robots, first, half)
        chance = chance * stats.hypergeom.pmf(j, robots - first, second, half - i)
    one = np.sign(i - j)
    other = np.sign((first - i) - (second - j))
    is_same = (one == other) & (one != 0)
    return float(np.nansum(np.where(is_same, chance, 0.0)))
