"""The result of a results folder in a sentence or two, and the leading controller in each place.

In one place controllers are told apart by the verdict on their paired difference, see
`servobench.harness.analysis.comparison.paired_difference`, success rates by a sign test over seeds: a seed counts once,
however many tasks it was run on, as runs of one seed share a robot. Controllers that know the true robot are bounds and
are not ranked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from servobench.harness.analysis.comparison import (
    MIN_PAIRS,
    SEQUENCE,
    Difference,
    PageRow,
    achieved_share,
    achievement,
    completed,
    grouped,
    is_majority,
    knows_truth,
    margin,
    median_with_interval,
    number,
    outcomes,
    paired_difference,
    settling_times,
    shown_unit,
    split_conditions,
    split_tasks,
    texts_of,
)
from servobench.harness.run.metrics import METRICS
from servobench.harness.run.outcome import ACHIEVED, FOLLOWED
from servobench.harness.run.result import COMPLETED

NAMED = 3  # controllers or places that a short list names at most
MANY = 6  # those that a long list names at most
MOST_PLACES = 24  # places for which leaders are named


@dataclass(frozen=True)
class Verdict:
    """The result of a results folder, for its first line. Names of controllers stand between backticks."""

    result: str  # one sentence
    cautions: tuple[str, ...]  # limits of the evidence, a sentence each


def judge(runs: pd.DataFrame) -> Verdict:
    """Return the result of at least one run."""
    if len(runs) == 1:
        return Verdict(_of_one_run(runs), ("One run says nothing about other seeds.",))
    ranked = ranked_controllers(runs)
    bounds = [str(name) for name in dict.fromkeys(runs["controller"]) if name not in ranked]
    early = int((runs["status"] != COMPLETED).sum())
    cautions = []
    if early:
        cautions.append(f"{early} of {len(runs)} runs ended early.")
    if bounds:
        know = "knows" if len(bounds) == 1 else "know"
        cautions.append(f"{_listed(bounds)} {know} the true robot: shown, not ranked.")
    chosen = runs[runs["controller"].isin(ranked)]
    if len(ranked) == 1:
        return Verdict(_of_one_controller(chosen), tuple(cautions))
    winners = _winners(runs, ranked)
    rates = _of_several(chosen)
    limits = (_doubts(chosen), *_with_few_seeds(chosen), *cautions)
    if not winners:
        return Verdict(rates, limits)
    return Verdict(winners, (rates, *limits))


def ranked_controllers(runs: pd.DataFrame) -> list[str]:
    """Return the controllers that do not know the true robot; all where there is no other."""
    names = list(dict.fromkeys(runs["controller"].astype(str)))
    return [name for name in names if not knows_truth(name)] or names


def asked_of(runs: pd.DataFrame) -> str:
    """Return the goal of these runs as a verb in the past tense."""
    moves, curves = split_tasks(runs)
    if len(moves) and not len(curves):
        return "settled"
    if len(curves) and not len(moves):
        return "followed the curve"
    return "settled or followed the curve"


def leaders(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the leading controller in each plant, task and condition with its evidence.

    Those that know the true robot are left out. Empty without a competition. First is the controller with the highest
    success rate, then the one that has the smallest median settling time, on a curve the smallest median error.
    """
    return grouped([_leader(*each) for each in _competitions(runs, ranked_controllers(runs))])


def judged_metric(place: pd.DataFrame) -> str:
    """Return the column by which the runs of a place are compared."""
    if achievement(place) == FOLLOWED:
        return "rms_error_evaluated"
    if (texts_of(place, "task_kind") == SEQUENCE).any():
        return "settling_time_later_s"
    return "settling_time_s"


def judged_values(place: pd.DataFrame) -> pd.DataFrame:
    """Return the judged metric in the unit in which it is shown, seeds × controllers.

    It is infinite where a run is lost, and NaN where there is none, as in an unfinished batch.
    """
    table = place.assign(value=judged_column(place))
    return table.pivot_table(index="seed", columns="controller", values="value", sort=False)


def judged_column(runs: pd.DataFrame) -> pd.Series[float]:
    """Return the judged metric of each run in the unit in which it is shown; infinite where the run is lost."""
    metric = judged_metric(runs)
    _, factor = shown_unit(metric, runs)
    return (factor * completed(runs, metric)).fillna(np.inf)


def _of_one_run(runs: pd.DataFrame) -> str:
    (row,) = runs.assign(outcome=outcomes(runs)).to_dict("records")
    name = row["controller"]
    place = f"{row['task']} on {row['plant']}"
    if row["status"] != COMPLETED:
        return f"`{name}` ended {place} early: {row['status']}."
    unit, factor = shown_unit("rms_error_evaluated", runs)
    if achievement(runs) == FOLLOWED:
        verb = "followed" if row["outcome"] in ACHIEVED else f"did not follow ({row['outcome']})"
        error = factor * row["rms_error_evaluated"]
        return f"`{name}` {verb} {place} with an RMS error of {error:.1f} {unit}."
    error = factor * row["steady_state_error"]
    last = f"with an error of {error:.1f} {unit} in the last second"
    if row["outcome"] in ACHIEVED:
        return f"`{name}` settled in {place} after {row['settling_time_s']:.2f} s, {last}."
    return f"`{name}` did not settle in {place} ({row['outcome']}): it ended {last}."


def _of_one_controller(runs: pd.DataFrame) -> str:
    sentence = f"`{runs['controller'].iloc[0]}` {asked_of(runs)} in {_share(runs)}"
    moves, _ = split_tasks(runs)
    if len(moves) == len(runs) and len(split_conditions(runs)) == 1:
        middle = median_with_interval(settling_times(runs))
        if math.isfinite(middle.value):  # else half of the runs or more never settled
            sentence += f", after a median of {middle.value:.2f} s"
        if math.isfinite(middle.value + middle.low):
            sentence += f" (95 % interval: {middle.low:.2f} to {number(middle.high, '.2f')} s)"
    return sentence + "."


def _of_several(runs: pd.DataFrame) -> str:
    """Return how often ranked controllers succeeded."""
    shares = _shares(runs)
    asked = asked_of(runs)
    most = max(shares.values())
    least = min(shares.values())
    if most == 0.0:
        return f"None of the {len(shares)} controllers {asked} in any of {len(runs)} runs."
    if most == least:
        everyone = "Both controllers" if len(shares) == 2 else f"All {len(shares)} controllers"
        often = "every run" if most == 1.0 else f"{100.0 * most:.0f} % of their runs"
        return f"{everyone} {asked} in {often}."
    best = [name for name, share in shares.items() if share == most]
    worst = [name for name, share in shares.items() if share == least]
    each = "each " if len(best) > 1 else ""
    top = f"{_listed(best)} {each}{asked} in {_common_share(runs, best, most)}"
    return f"{top}; least often {_listed(worst)}, in {_common_share(runs, worst, least)}."


def _common_share(runs: pd.DataFrame, names: list[str], share: float) -> str:
    """Return the share of successes that some controllers have in common, with counts where these agree, too."""
    counts = runs["controller"].value_counts()  # they differ in an unfinished batch
    if counts[names].nunique() > 1:
        return f"{100.0 * share:.0f} % of runs"
    return _share(runs[runs["controller"] == names[0]])


class _Standing(NamedTuple):
    """The first of a place and the others in it."""

    where: str
    first: str
    equal: tuple[str, ...]  # the first, and all that are shown to be practically equal to it
    undecided: tuple[str, ...]
    ahead: tuple[str, ...]  # shown to be better than the first, which has the higher success rate
    behind: str  # the next that is shown to be worse; empty without one
    by: float  # mean difference to it [unit]; NaN where only lost runs tell
    metric: str
    unit: str
    margin: float  # difference that does not matter [unit]

    @property
    def result(self) -> tuple[object, ...]:
        """Everything but the place and the numbers: places with the same result share a clause."""
        only_lost = math.isnan(self.by)
        contest = self.first, self.equal, self.undecided, self.ahead, self.behind
        return (*contest, only_lost, self.metric, self.unit)


def _winners(runs: pd.DataFrame, names: Sequence[str]) -> str:
    """Return a sentence that names the best in each place, and by how much; empty where nothing is shown."""
    places = _competitions(runs, names)
    known = [_standing(*each) for each in places if _can_decide(each[2])]
    if not any(len(each.equal) > 1 or each.behind or each.ahead for each in known):
        return ""
    groups: dict[tuple[object, ...], list[_Standing]] = {}
    for each in known:
        groups.setdefault(each.result, []).append(each)
    return "; ".join(_clause(own, len(places)) for own in groups.values()) + "."


def _can_decide(place: pd.DataFrame) -> bool:
    return place["seed"].nunique() >= MIN_PAIRS


def _with_few_seeds(runs: pd.DataFrame) -> list[str]:
    """Return a sentence on the places that have too few seeds for a verdict where others have enough."""
    places = split_conditions(runs)
    few = [words for words, place in places if not _can_decide(place)]
    if len(few) in (0, len(places)):
        return []
    return [f"Shown, not judged, with fewer than {MIN_PAIRS} seeds: {_listed(few)}."]


def _standing(words: str, place: pd.DataFrame, own: pd.DataFrame) -> _Standing:
    first, against, small = _ranked(place, own)
    metric = judged_metric(place)
    unit, _ = shown_unit(metric, place)
    # Verdicts are on the first: those against which it is better are behind it.
    having: dict[str, list[str]] = {}
    for name, difference in against.items():
        having.setdefault(difference.verdict, []).append(name)
    best = [first, *having.get("equivalent", [])]
    behind = next(iter(having.get("better", [])), "")
    by = math.nan
    if behind and against[behind].mean.high < -small:
        by = -against[behind].mean.value
    return _Standing(
        where=words,
        first=first,
        equal=tuple(name for name in dict.fromkeys(own["controller"]) if name in best),
        undecided=tuple(having.get("undecided", ())),
        ahead=tuple(having.get("worse", ())),
        behind=behind,
        by=by,
        metric=metric,
        unit=unit,
        margin=small,
    )


def _clause(places: Sequence[_Standing], count: int) -> str:
    """Return the result of places with the same winners, of `count` places in all."""
    one = places[0]
    label = METRICS[one.metric].label
    many = len(one.equal) > 1
    verb = "are" if many else "is"
    rank = "first" if one.undecided else "best"
    words = f"{_listed(one.equal, MANY)} {verb} {rank}"
    if count > 1:
        words += f" in {_listed([each.where for each in places], MANY)}"
    parts = []
    if many:
        widest = max(each.margin for each in places)
        parts.append(f"equal within {widest:.2g} {one.unit}")
    only_lost = math.isnan(one.by)  # the same in all of these places
    if one.behind and not only_lost:
        lead = f"{_range([each.by for each in places])} {one.unit} ahead of `{one.behind}`"
        if many:
            lead = f"and `{one.first}` is {lead}"
        parts.append(lead)
    if parts:
        words += f": {', '.join(parts)} in {label}"
    if one.behind and only_lost:
        words += f", losing fewer runs than `{one.behind}`"
    if one.undecided:
        words += f", undecided against {_listed(one.undecided, MANY)}"
    if one.ahead:
        words += f", though {_listed(one.ahead, MANY)} had less {label}"
    return words


def _range(numbers: Sequence[float]) -> str:
    """Return the least and the greatest of some numbers, or one number where both are written alike."""
    low = f"{min(numbers):.2f}"
    high = f"{max(numbers):.2f}"
    if low == high:
        return low
    return f"{low} to {high}"


def _doubts(runs: pd.DataFrame) -> str:
    """Return how far the order of controllers can be trusted."""
    shared = runs.groupby("seed")["controller"].nunique() > 1  # they differ in an unfinished batch
    seeds = int(shared.sum())
    count = runs["controller"].nunique()
    if seeds < MIN_PAIRS:
        had = "One seed is" if seeds == 1 else f"{seeds} seeds are"
        which = "the two" if count == 2 else f"any two of {count}"
        return (
            f"{had} too few to tell {which} controllers apart with a paired test "
            f"(it takes at least {MIN_PAIRS}): the order is a hint, not a finding."
        )
    achieved = runs.assign(score=outcomes(runs).isin(ACHIEVED).astype(float))
    table = achieved.pivot_table(index="seed", columns="controller", values="score", sort=False)
    shares = _shares(runs)
    best = max(shares, key=lambda name: shares[name])
    less_often = []
    for name in shares:
        ahead = table[best] - table[name]  # by seed, in the share of its tasks
        better = int((ahead > 0.0).sum())
        worse = int((ahead < 0.0).sum())
        if is_majority(better, worse):
            less_often.append(name)
    if not less_often:
        return "The success rates do not differ significantly."
    verb = "succeeds" if len(less_often) == 1 else "succeed"
    less = f"{_listed(less_often, MANY)} {verb} significantly less often than `{best}`"
    return f"{less} (sign test over seeds)."


def _competitions(
    runs: pd.DataFrame, names: Sequence[str]
) -> list[tuple[str, pd.DataFrame, pd.DataFrame]]:
    """Return each place with more than one of some controllers: words, its runs, and those of these controllers."""
    places = split_conditions(runs)
    alone = len(places) == runs["task"].nunique()
    found = []
    for words, place in places:
        own = place[place["controller"].isin(names)]
        if own["controller"].nunique() > 1:
            where = str(place["task"].iloc[0]) if alone else words
            found.append((where, place, own))
    if len(found) <= MOST_PLACES:
        return found
    return []


def _ranked(place: pd.DataFrame, own: pd.DataFrame) -> tuple[str, dict[str, Difference], float]:
    """Return the best controller of a place, how it differs from each other one, best first, and the margin."""
    table = judged_values(place)
    shares = _shares(own)
    metric = judged_metric(place)
    _, factor = shown_unit(metric, place)
    small = factor * margin(metric, place)
    first, *others = sorted(shares, key=lambda name: (-shares[name], table[name].median()))
    against = {}
    for name in others:
        pair = table[[first, name]].dropna()
        against[name] = paired_difference(pair.iloc[:, 0], pair.iloc[:, 1], small)
    return first, against, small


def _leader(words: str, place: pd.DataFrame, own: pd.DataFrame) -> PageRow:
    """Return a row of `leaders`: the first two controllers of a place, and those that are not shown to be behind."""
    table = judged_values(place)
    shares = _shares(own)
    metric = judged_metric(place)
    unit, _ = shown_unit(metric, place)
    spec = f".{METRICS[metric].digits}f"
    first, against, _ = _ranked(place, own)
    second = next(iter(against))
    rivals = [name for name, each in against.items() if each.verdict != "better"]
    sure = _listed(rivals).replace("`", "") if rivals else "none"

    def median(name: str) -> str:
        """Return a controller's median with unit, interval and the share of its lost runs."""
        text = format(median_with_interval(table[name].dropna()), spec)
        value, *interval = text.split(" ", 1)
        parts = [value, unit, *interval]
        if shares[name] < 1.0:
            parts.append(f"({100.0 * (1.0 - shares[name]):.0f} % lost)")
        return " ".join(parts).rstrip()

    return {
        ("", "where"): words,
        ("", "seeds"): str(own["seed"].nunique()),
        ("First", "controller"): first,
        ("First", "median"): median(first),
        ("Next", "controller"): second,
        ("Next", "median"): median(second),
        ("How sure", "not shown to be behind the first"): sure,
    }


def _shares(runs: pd.DataFrame) -> dict[str, float]:
    """Return the share of successful runs of each controller."""
    good = outcomes(runs).isin(ACHIEVED)
    means = good.groupby(runs["controller"], sort=False).mean()
    return {str(name): float(share) for name, share in means.items()}


def _share(runs: pd.DataFrame) -> str:
    """Return how many runs of a controller were successful.

    The interval of their share is told where no two of them share a robot.
    """
    good = int(outcomes(runs).isin(ACHIEVED).sum())
    counts = f"{good} of {len(runs)} runs"
    if not runs["seed"].is_unique:
        return counts
    share = achieved_share(runs)
    return f"{counts} (95 % interval: {share.low:.0f} to {share.high:.0f} %)"


def _listed(names: Sequence[str], most: int = NAMED) -> str:
    """Return names as a list of words, of a long one the beginning."""
    words = [f"`{name}`" for name in names]
    if len(words) > most:
        words = [*words[: most - 1], f"{len(words) - most + 1} more"]
    if len(words) == 1:
        return words[0]
    return f"{', '.join(words[:-1])} and {words[-1]}"
