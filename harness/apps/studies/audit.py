"""Four diagnostics of a suite: shortcuts, significance of ranks, overfitting, dependence on the source.

They are those of an audit of manipulation benchmarks (arXiv 2606.04233, 2026), for challenges that are scored.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
import pandas as pd

from servobench.harness.analysis.comparison import (
    ALPHA,
    holm,
    mean_with_interval,
    paired_difference,
)
from servobench.harness.apps.studies.challenge import MEASURES, Challenge
from servobench.harness.batch.plan import tuning_seeds
from servobench.harness.config.registry import choose_controller

SOLVED = 0.5  # share of the best method's score at which a shortcut solves a challenge
HERE = "servobench.harness.apps.studies.probes"
# Shortcuts, as controllers are named
PROBES = ("constant", f"open_loop={HERE}:OpenLoop", f"held={HERE}:HeldCommand")
TUNED_ON = 48  # robots on which the methods of the bench were tuned: 12 of trials, 36 of the choice among them
LEGEND = "a challenge is solved by a shortcut that reaches half of the best score"
AUDIT = "audit.csv"
ROBOTS = "tuned_on"


def name_of(probe: str) -> str:
    """Return the name of a probe in tables."""
    return probe.partition("=")[0]


def with_probes(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of methods with those of the shortcuts."""
    probes = [choose_controller(place) for place in PROBES if name_of(place) not in names]
    return (*names, *probes)


def robots_of_tuning(judged: pd.DataFrame) -> tuple[int, ...]:
    """Return seeds of robots on which methods were tuned, as many as have scores, at most `TUNED_ON`."""
    scored = judged.loc[judged["score"].notna(), "seed"].nunique()
    return tuning_seeds(min(TUNED_ON, scored))


class Finding(NamedTuple):
    """What a diagnostic says."""

    diagnostic: str
    where: str
    finding: str
    numbers: str = ""


def mean_scores(judged: pd.DataFrame, by: str = "challenge") -> pd.DataFrame:
    """Return the mean score of each controller, a row for each value of a column."""
    return judged.pivot_table("score", by, "controller", sort=False)


def bounds_of(challenges: Sequence[Challenge]) -> list[str]:
    """Return the names of all controllers that are no methods: references and probes."""
    references = [name for each in challenges for name in each.reference]
    return [*references, *map(name_of, PROBES)]


def find_shortcuts(judged: pd.DataFrame, challenges: Sequence[Challenge]) -> pd.DataFrame:
    """Return for each challenge with scores its best shortcut, what that reaches, the best method, and `solved`."""
    means = mean_scores(judged)
    shortcuts = means.reindex(columns=list(map(name_of, PROBES))).fillna(0.0)
    reached = shortcuts.max(axis=1)
    best = means.drop(columns=bounds_of(challenges), errors="ignore").max(axis=1)
    return pd.DataFrame(
        {
            "shortcut": shortcuts.idxmax(axis=1),
            "reached": reached,
            "best": best,
            "solved": (reached > 0.0) & (reached >= SOLVED * best),
        }
    )


def mark_solved(judged: pd.DataFrame, challenges: Sequence[Challenge]) -> pd.DataFrame:
    """Return judged runs with the shortcut that solves their challenge, if one does, in the column `solved`."""
    found = find_shortcuts(judged, challenges)
    solving = found.loc[found["solved"], "shortcut"].to_dict()
    return judged.assign(solved=[solving.get(name, "") for name in judged["challenge"]])


def significance(judged: pd.DataFrame) -> Iterator[Finding]:
    """Yield how many rank claims within challenges are significant, of neighbours and of all pairs.

    A claim says that of two methods that with the higher mean score is better; it is significant where a two-sided sign
    test over the robots says so at 5 % after Holm's correction over all claims.
    """
    p_values = []
    near = []
    for _, place in judged.groupby(["challenge", "plant"], sort=False):
        losses = -place.pivot_table("score", "seed", "controller")
        order = list(losses.mean().sort_values(kind="stable").index)
        neighbours = set(pairwise(order))
        for pair in combinations(order, 2):
            both = losses[list(pair)].dropna()
            found = paired_difference(both[pair[0]], both[pair[1]], 0.0)
            p_values.append(found.p_value)
            near.append(pair in neighbours)
    if not p_values:
        return
    sure = np.array(holm(p_values)) < ALPHA
    chosen = np.array(near)
    for words, own in (("neighbours", sure[chosen]), ("all pairs", sure)):
        share = f"{own.sum()} of {len(own)} ({100.0 * own.mean():.0f} %)"
        yield Finding("significance", words, "significant claims", share)


def overfitting(fresh: pd.DataFrame, tuned_on: pd.DataFrame) -> Iterator[Finding]:
    """Yield for each method how much higher its score is on robots on which methods were tuned.

    The interval of 90 % is from the robots: one counts once, whatever challenges it was in.
    """
    tuned, other = (each.pivot_table("score", "seed", "controller") for each in (tuned_on, fresh))
    for name in tuned:
        one = mean_with_interval(tuned[name].to_numpy())
        two = mean_with_interval(other[name].to_numpy())
        gain = one.value - two.value
        reach = 0.5 * float(np.hypot(one.high - one.low, two.high - two.low))
        word = "higher where tuned" if gain > reach else "no higher score"
        robots = f"{one.count} and {two.count} robots"
        yield Finding("overfitting", str(name), word, f"{gain:+.3f} ± {reach:.3f}, {robots}")


def dependence(judged: pd.DataFrame, challenges: Sequence[Challenge]) -> Iterator[Finding]:
    """Yield how alike methods are ordered by mean score in kinds of tasks, and on plants: Kendall's τ."""
    kinds = {each.name: MEASURES[each.measure].tasks or "curves" for each in challenges}
    sources = {"tasks": judged["challenge"].map(kinds), "plants": judged["plant"]}
    for word, source in sources.items():
        means = mean_scores(judged.assign(source=source), "source")
        likeness = means.T.corr(method="kendall")
        for one, other in combinations(means.index, 2):
            tau = likeness.loc[one, other]
            finding = "order differs"
            if tau == 1.0:
                finding = "same order"
            yield Finding("source", f"{one}, {other}", finding, f"Kendall's τ {tau:+.2f}")
        if len(means) < 2:
            yield Finding("source", word, "unknown: a single one")
    yield Finding("source", "arms", "unknown: a single one")


def audit(
    judged: pd.DataFrame, tuned_on: pd.DataFrame, challenges: Sequence[Challenge]
) -> pd.DataFrame:
    """Return the findings of all four diagnostics, a row each.

    Args:
        judged: runs of methods, references and probes on fresh robots.
        tuned_on: those of methods and references on robots on which methods were tuned.
        challenges: their worlds.
    """
    bounds = bounds_of(challenges)
    fresh, tuned = (
        each[~each["controller"].isin(bounds) & each["score"].notna()]
        for each in (judged, tuned_on)
    )
    findings = []
    for name, own in find_shortcuts(judged, challenges).iterrows():
        word = "no shortcut"
        if own["solved"]:
            word = "solved by a shortcut"
        numbers = f"{own['shortcut']} {own['reached']:.2f}, best method {own['best']:.2f}"
        findings.append(Finding("shortcut", str(name), word, numbers))
    findings += significance(fresh)
    findings += overfitting(fresh, tuned)
    findings += dependence(fresh, challenges)
    return pd.DataFrame(findings)
