"""Scores against a reference over many challenges: interquartile means, shared ranks, profiles and their resolution.

A table is tidy: a row a run, with the columns `challenge`, `controller`, `seed` and `score` (0 to 1), for `profile`
with `value` (an error or a time, less is better) in place of the score. All methods of a table ran on the same robots.
Sources: Agarwal et al., Deep reinforcement learning at the edge of the statistical precipice, NeurIPS 2021 (rliable);
Dolan and Moré, Benchmarking optimization software with performance profiles, Mathematical Programming 91, 2002.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from servobench.harness.analysis.comparison import ALPHA, CONFIDENCE, RESAMPLES, Estimate, holm
from servobench.plant.contract.checks import FloatArray, IntArray

TRIMMED = 0.25  # share of the scores that an interquartile mean leaves out at each end
SPLITS = 200  # random halves of the robots from which the resolution is estimated


@dataclass(frozen=True)
class Ranked:
    """A method's place among others."""

    rank: int  # 1 for the first; methods that cannot be told apart from the first one of their rank share it
    controller: str  # its name
    score: Estimate  # interquartile mean with its interval of 95 %
    lost: float  # share of lost runs, which the interquartile mean forgives up to a quarter


def scores(own: ArrayLike, reference: ArrayLike, floor: ArrayLike) -> FloatArray:
    """Return min(1, max(reference, floor) / max(own, floor)) of each run.

    Args:
        own: errors or times, less is better; NaN or +∞ of a lost run, whose score is 0.
        reference: those of the reference on the same robots; NaN or +∞ where it is lost, which any run outdoes.
        floor: value below which a difference does not count, above 0.

    Raises:
        ValueError: a floor that is not above 0.
    """
    arrays = [np.asarray(each, np.float64) for each in (own, reference, floor)]
    own, reference, floor = np.broadcast_arrays(*arrays)
    if not (floor > 0.0).all():
        raise ValueError(f"floor must be above 0, got {float(np.min(floor))}")
    known = np.where(np.isfinite(own), np.maximum(own, floor), np.inf)
    bound = np.where(np.isfinite(reference), np.maximum(reference, floor), known)
    with np.errstate(invalid="ignore"):  # ∞ / ∞, where both are lost
        ratio = np.minimum(1.0, bound / known)
    return np.where(np.isinf(known), 0.0, ratio)


def ranking(table: pd.DataFrame) -> list[Ranked]:
    """Return the methods by interquartile mean; those that cannot be told apart share a rank.

    The mean is that of the middle half of the scores over challenges and robots, its interval that of a percentile
    bootstrap that draws robots anew within each challenge, as rliable does.

    Two methods are told apart where the difference of their interquartile means, over its standard deviation in
    resamples of the same robots, is significant at 5 % after Holm's correction over all pairs. A rank is shared by the
    methods that cannot be told apart from the best one in it.

    Raises:
        ValueError: no run, a method without a score on a robot of the others, or two scores on one.
    """
    by_robot = _by_robot(table, "score")
    means, drawn = _means_with_resamples(by_robot)
    tail = (1.0 - CONFIDENCE) / 2.0
    ends = drawn.quantile([tail, 1.0 - tail])
    apart = _told_apart(means, drawn)
    found = []
    rank = 1
    best = str(means.index[0])  # among those with this rank
    for place, name in enumerate(map(str, means.index), start=1):
        if frozenset((best, name)) in apart:
            rank = place
            best = name
        low, high = ends[name]
        estimate = Estimate(means[name], low, high, len(by_robot))
        lost = (by_robot[name] == 0.0).mean()
        found.append(Ranked(rank, name, estimate, lost))
    return found


def profile(table: pd.DataFrame, factors: Sequence[float]) -> pd.DataFrame:
    """Return ρ(τ): the share of challenges and robots with a value of at most τ times the best one of all methods.

    Args:
        table: with a column `value`, NaN of a lost run; apply a floor first where tiny values do not differ.
        factors: values of τ, at least 1.

    Returns:
        A row for each factor, a column for each controller.

    Raises:
        ValueError: a factor below 1, or as `ranking`.
    """
    if min(factors, default=1.0) < 1.0:
        raise ValueError(f"factors must be at least 1, got {min(factors)}")
    values = _by_robot(table, "value", lost=True)
    best = values.min(axis=1)
    rows = [values.le(factor * best, axis=0).mean() for factor in factors]
    return pd.DataFrame(rows, index=pd.Index(factors, name="factor"))


def resolution(table: pd.DataFrame) -> float:
    """Return the median difference of the interquartile means of a method on two random halves of the robots.

    A robot is in the same half in all challenges, and each challenge is halved. All robots resolve about half of it.

    Raises:
        ValueError: a challenge with fewer than two robots, or as `ranking`.
    """
    by_robot = _by_robot(table, "score")
    values = by_robot.to_numpy().T
    rows = _rows_of_challenges(by_robot)
    if min(map(len, rows)) < 2:
        raise ValueError("a ranking is split into halves: each challenge needs at least two robots")
    seeds = by_robot.index.get_level_values("seed")
    robots, robot_of_row = np.unique(seeds, return_inverse=True)
    generator = np.random.default_rng(0)
    differences = []
    for _ in range(SPLITS):
        # Robots have one order in all challenges; each challenge is halved where half of its own robots are passed.
        order = generator.permutation(len(robots))[robot_of_row]
        halves = []
        for own in rows:
            shuffled = own[np.argsort(order[own])]
            halves.append(np.split(shuffled, [len(own) // 2]))
        first, second = (
            _middle_means(values[:, np.concatenate(half)]) for half in zip(*halves, strict=True)
        )
        differences.append(np.abs(first - second))
    return float(np.median(differences))


def _by_robot(table: pd.DataFrame, column: str, *, lost: bool = False) -> pd.DataFrame:
    """Return a column of a table, a row for each challenge and seed, a column for each controller."""
    keys = ["challenge", "seed", "controller"]
    if table.empty:
        raise ValueError("table must hold at least one run")
    if (again := table.duplicated(keys)).any():
        challenge, seed, name = table.loc[again, keys].iloc[0]
        raise ValueError(f"{name} has several runs of challenge {challenge}, seed {seed}: keep one")
    known = table.set_index(keys)[column].astype(float)
    if lost:
        known = known.fillna(np.inf)  # so that only runs that do not exist are NaN
    filled = known.unstack("controller", sort=False)
    missing: Any = filled.isna().stack()
    if missing.any():
        challenge, seed, name = missing.idxmax()
        raise ValueError(
            f"{name} lacks the {column} of challenge {challenge}, seed {seed}: methods need the same runs"
        )
    if lost:
        return filled.where(filled != np.inf)
    return filled


def _rows_of_challenges(by_robot: pd.DataFrame) -> list[IntArray]:
    """Return the numbers of the rows of each challenge."""
    challenges = by_robot.index.get_level_values("challenge")
    return [np.flatnonzero(challenges == name) for name in challenges.unique()]


def _middle_means(values: FloatArray) -> FloatArray:
    """Return the interquartile mean over the last axis, as scipy.stats.trim_mean at a fiftieth of its time."""
    count = values.shape[-1]
    cut = int(TRIMMED * count)
    # The value at -cut - 1 is the largest of the middle ones
    ordered = np.partition(values, (cut, -cut - 1))
    return np.mean(ordered[..., cut : count - cut], axis=-1)


def _means_with_resamples(by_robot: pd.DataFrame) -> tuple[pd.Series[float], pd.DataFrame]:
    """Return the interquartile mean of each method, best first, and those of resamples of the robots."""
    values = np.ascontiguousarray(by_robot.to_numpy().T)
    rows = _rows_of_challenges(by_robot)
    generator = np.random.default_rng(0)
    drawn = []
    for _ in range(RESAMPLES):
        sample = np.concatenate([generator.choice(own, len(own)) for own in rows])
        drawn.append(_middle_means(values[:, sample]))
    means = pd.Series(_middle_means(values), index=by_robot.columns)
    best_first = means.sort_values(ascending=False, kind="stable")
    return best_first, pd.DataFrame(drawn, columns=by_robot.columns)


def _told_apart(means: pd.Series[float], drawn: pd.DataFrame) -> set[frozenset[str]]:
    """Return the pairs of methods whose means differ significantly, see `ranking`."""
    pairs = list(combinations(map(str, means.index), 2))
    p_values = []
    for first, second in pairs:
        deviation = (drawn[first] - drawn[second]).std()
        difference = abs(means[first] - means[second])
        if deviation > 0.0:
            # Both tails of the normal distribution
            p_values.append(math.erfc(difference / deviation / math.sqrt(2.0)))
        else:  # the difference is the same in all resamples
            p_values.append(0.0 if difference > 0.0 else 1.0)
    corrected = zip(pairs, holm(p_values), strict=True)
    return {frozenset(pair) for pair, p_value in corrected if p_value < ALPHA}
