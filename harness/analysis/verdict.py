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
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from servobench.harness.analysis.comparison import (
    MIN_PAIRS,
    Difference,
    achieved_share,
    achievement,
    column_of,
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
)
from servobench.harness.run.metrics import METRICS
from servobench.harness.run.outcome import ACHIEVED, FOLLOWED
from servobench.harness.run.result import COMPLETED

NAMED, MANY = 3, 6  # controllers that a sentence names at most
MOST_PLACES: Final = 24  # for which leaders are named


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
    cautions = [f"{early} of {len(runs)} runs ended early."] if early else []
    if bounds:
        know = "knows" if len(bounds) == 1 else "know"
        cautions.append(f"{_listed(bounds)} {know} the true robot: shown, not ranked.")
    chosen = runs[runs["controller"].isin(ranked)]
    if len(ranked) == 1:
        return Verdict(_of_one_controller(chosen), tuple(cautions))
    result, *further = filter(None, (_winners(runs, ranked), _of_several(chosen)))
    return Verdict(result, (*further, _doubts(chosen), *cautions))


def ranked_controllers(runs: pd.DataFrame) -> list[str]:
    """Return the controllers that do not know the true robot; all where there is no other."""
    names = list(dict.fromkeys(runs["controller"].astype(str)))
    return [name for name in names if not knows_truth(name)] or names


def asked_of(runs: pd.DataFrame) -> str:
    """Return the goal of these runs as a verb in the past tense."""
    words: dict[tuple[bool, ...], str] = {
        (True, False): "settled",
        (False, True): "followed the curve",
    }
    return words.get(
        tuple(len(part) > 0 for part in split_tasks(runs)), "settled or followed the curve"
    )


def leaders(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the leading controller in each plant, task and condition with its evidence.

    Those that know the true robot are left out. Empty without a competition. First is the controller with the highest
    success rate, then the one that has the smallest median settling time, on a curve the smallest median error.
    """
    return grouped([_leader(*each) for each in _competitions(runs, ranked_controllers(runs))])


def judged_metric(place: pd.DataFrame) -> str:
    """Return the column by which the runs of a place are compared."""
    return "rms_error_evaluated" if achievement(place) == FOLLOWED else "settling_time_s"


def judged_values(place: pd.DataFrame) -> pd.DataFrame:
    """Return the judged metric in the unit in which it is shown, seeds × controllers.

    It is infinite where a run is lost, and NaN where there is none, as in an unfinished batch.
    """
    table = place.assign(value=judged_column(place))
    return table.pivot_table(index="seed", columns="controller", values="value", sort=False)


def judged_column(runs: pd.DataFrame) -> pd.Series[float]:
    """Return the judged metric of each run in the unit in which it is shown; infinite where the run is lost."""
    metric = judged_metric(runs)
    values = shown_unit(metric, runs)[1] * column_of(runs, metric).where(
        runs["status"] == COMPLETED
    )
    return values.fillna(np.inf)


def _of_one_run(runs: pd.DataFrame) -> str:
    (row,) = runs.assign(outcome=outcomes(runs)).to_dict("records")
    name, place = row["controller"], f"{row['task']} on {row['plant']}"
    if row["status"] != COMPLETED:
        return f"`{name}` ended {place} early: {row['status']}."
    unit, factor = shown_unit("rms_error_evaluated", runs)
    if achievement(runs) == FOLLOWED:
        verb = "followed" if row["outcome"] in ACHIEVED else f"did not follow ({row['outcome']})"
        return f"`{name}` {verb} {place} with an RMS error of {factor * row['rms_error_evaluated']:.1f} {unit}."
    last = f"with an error of {factor * row['steady_state_error']:.1f} {unit} in the last second"
    if row["outcome"] in ACHIEVED:
        return f"`{name}` settled in {place} after {row['settling_time_s']:.2f} s, {last}."
    return f"`{name}` did not settle in {place} ({row['outcome']}): it ended {last}."


def _of_one_controller(runs: pd.DataFrame) -> str:
    sentence = f"`{runs['controller'].iloc[0]}` {asked_of(runs)} in {_share(runs)}"
    if len(split_tasks(runs)[0]) == len(runs) and len(split_conditions(runs)) == 1:
        middle = median_with_interval(settling_times(runs))
        if math.isfinite(middle.value):  # else half of the runs or more never settled
            sentence += f", after a median of {middle.value:.2f} s"
        if math.isfinite(middle.value + middle.low):
            sentence += f" (95 % interval: {middle.low:.2f} to {number(middle.high, '.2f')} s)"
    return sentence + "."


def _of_several(runs: pd.DataFrame) -> str:
    """Return how often ranked controllers succeeded."""
    shares = _shares(runs)
    asked, most, least = asked_of(runs), max(shares.values()), min(shares.values())
    best, worst = (
        [name for name, share in shares.items() if share == each] for each in (most, least)
    )
    if most == 0.0:
        return f"None of the {len(shares)} controllers {asked} in any of {len(runs)} runs."
    if most == least:
        everyone = "Both controllers" if len(shares) == 2 else f"All {len(shares)} controllers"
        often = "every run" if most == 1.0 else f"{100.0 * most:.0f} % of their runs"
        return f"{everyone} {asked} in {often}."
    counts = runs["controller"].value_counts()  # they differ in an unfinished batch
    first, last = (
        _share(runs[runs["controller"] == names[0]])
        if counts[names].nunique() == 1
        else f"{100.0 * share:.0f} % of runs"
        for names, share in ((best, most), (worst, least))
    )
    top = f"{_listed(best)} {'each ' if len(best) > 1 else ''}{asked} in {first}"
    return f"{top}; least often {_listed(worst)}, in {last}."


class _Standing(NamedTuple):
    """The first of a place and the others in it."""

    where: str
    equal: tuple[str, ...]  # the first, and all that are shown to be practically equal to it
    undecided: tuple[str, ...]
    ahead: tuple[str, ...]  # shown to be better than the first, which has the higher success rate
    behind: str  # the next that is shown to be worse; empty without one
    by: float  # mean difference to it [unit]; NaN where only lost runs tell
    metric: str
    unit: str
    margin: float  # [unit] that does not matter


def _winners(runs: pd.DataFrame, names: Sequence[str]) -> str:
    """Return a sentence that names the best in each place, and by how much; empty where nothing is shown."""
    known = [_standing(*each) for each in _competitions(runs, names)]
    if not any(len(each.equal) > 1 or each.behind or each.ahead for each in known):
        return ""
    groups: dict[tuple[object, ...], list[_Standing]] = {}
    for each in known:
        told = (
            each.equal,
            each.undecided,
            each.ahead,
            each.behind,
            math.isnan(each.by),
            each.metric,
            each.unit,
        )
        groups.setdefault(told, []).append(each)
    return "; ".join(_clause(own, len(known)) for own in groups.values()) + "."


def _standing(words: str, place: pd.DataFrame, own: pd.DataFrame) -> _Standing:
    order, against, metric = *_ranked(place, own), judged_metric(place)
    unit, factor = shown_unit(metric, place)
    having = {
        verdict: tuple(name for name, each in against.items() if each.verdict == verdict)
        for verdict in ("equivalent", "undecided", "worse", "better")
    }
    behind = next(iter(having["better"]), "")
    small = factor * margin(metric, place)
    by = -against[behind].mean.value if behind and against[behind].mean.high < -small else math.nan
    best = (order[0], *having["equivalent"])
    equal = tuple(name for name in dict.fromkeys(own["controller"]) if name in best)
    return _Standing(
        words, equal, having["undecided"], having["worse"], behind, by, metric, unit, small
    )


def _clause(places: Sequence[_Standing], count: int) -> str:
    """Return the result of places with the same winners, of `count` places in all."""
    one, label = places[0], METRICS[places[0].metric].label
    where = f" in {_listed([each.where for each in places], MANY)}" if count > 1 else ""
    many, parts = len(one.equal) > 1, []
    if many:
        parts.append(f"equal within {max(each.margin for each in places):.2g} {one.unit}")
    low, high = (f"{end(each.by for each in places):.2f}" for end in (min, max))
    fewer_lost = one.behind and "nan" in (low, high)
    if one.behind and not fewer_lost:
        parts.append(
            f"{low if low == high else f'{low} to {high}'} {one.unit} ahead of `{one.behind}`"
        )
    words = f"{_listed(one.equal, MANY)} {'are' if many else 'is'} {'first' if one.undecided else 'best'}{where}"
    words += f": {' and '.join(parts)} in {label}" if parts else ""
    words += f", losing fewer runs than `{one.behind}`" if fewer_lost else ""
    if one.undecided:
        words += f", undecided against {_listed(one.undecided, MANY)}"
    return words + (f", though {_listed(one.ahead, MANY)} had less {label}" if one.ahead else "")


def _doubts(runs: pd.DataFrame) -> str:
    """Return how far the order of controllers can be trusted."""
    shared = runs.groupby("seed")["controller"].nunique() > 1  # they differ in an unfinished batch
    seeds, count = int(shared.sum()), runs["controller"].nunique()
    if seeds < MIN_PAIRS:
        had = "One seed is" if seeds == 1 else f"{seeds} seeds are"
        which = "the two" if count == 2 else f"any two of {count}"
        return (
            f"{had} too few to tell {which} controllers apart with a paired test "
            f"(it takes at least {MIN_PAIRS}): the order is a hint, not a finding."
        )
    achieved = runs.assign(score=outcomes(runs).isin(ACHIEVED).astype(float))
    table = achieved.pivot_table(index="seed", columns="controller", values="score", sort=False)
    best = max((shares := _shares(runs)), key=lambda name: shares[name])
    ahead = {name: table[best] - table[name] for name in shares}
    apart = [
        name
        for name, each in ahead.items()
        if is_majority(int((each > 0.0).sum()), int((each < 0.0).sum()))
    ]
    if not apart:
        return "The success rates do not differ significantly."
    less = f"{_listed(apart, MANY)} succeed{'s' if len(apart) == 1 else ''} significantly less often than `{best}`"
    return f"{less} (sign test over seeds)."


def _competitions(
    runs: pd.DataFrame, names: Sequence[str]
) -> list[tuple[str, pd.DataFrame, pd.DataFrame]]:
    """Return each place with more than one of some controllers: words, its runs, and those of these controllers."""
    places = split_conditions(runs)
    alone = len(places) == runs["task"].nunique()
    found = [
        (str(place["task"].iloc[0]) if alone else words, place, own)
        for words, place in places
        if (own := place[place["controller"].isin(names)])["controller"].nunique() > 1
    ]
    return found if len(found) <= MOST_PLACES else []


def _ranked(place: pd.DataFrame, own: pd.DataFrame) -> tuple[list[str], dict[str, Difference]]:
    """Return the controllers of a place, best first, and how the first one differs from each other one."""
    table, shares = judged_values(place), _shares(own)
    order = sorted(shares, key=lambda name: (-shares[name], table[name].median()))
    small = shown_unit(judged_metric(place), place)[1] * margin(judged_metric(place), place)
    pairs = {name: table[[order[0], name]].dropna() for name in order[1:]}
    return order, {
        name: paired_difference(each.iloc[:, 0], each.iloc[:, 1], small)
        for name, each in pairs.items()
    }


def _leader(words: str, place: pd.DataFrame, own: pd.DataFrame) -> dict[tuple[str, str], Any]:
    table, metric, shares = judged_values(place), judged_metric(place), _shares(own)
    unit, _ = shown_unit(metric, place)
    (first, second, *_), against = _ranked(place, own)
    rivals = [name for name, each in against.items() if each.verdict != "better"]

    def median(name: str) -> str:
        value, *interval = (
            f"{median_with_interval(table[name].dropna()):.{METRICS[metric].digits}f}".split(" ", 1)
        )
        lost = f"({100.0 * (1.0 - shares[name]):.0f} % lost)" if shares[name] < 1.0 else ""
        return " ".join([value, unit, *interval, lost]).rstrip()

    return {
        ("", "where"): words,
        ("", "seeds"): str(own["seed"].nunique()),
        ("First", "controller"): first,
        ("First", "median"): median(first),
        ("Next", "controller"): second,
        ("Next", "median"): median(second),
        ("How sure", "not shown to be behind the first"): _listed(rivals).replace("`", "")
        if rivals
        else "none",
    }


def _shares(runs: pd.DataFrame) -> dict[str, float]:
    good = outcomes(runs).isin(ACHIEVED)
    return {
        str(name): float(share)
        for name, share in good.groupby(runs["controller"], sort=False).mean().items()
    }


def _share(runs: pd.DataFrame) -> str:
    good, share = int(outcomes(runs).isin(ACHIEVED).sum()), achieved_share(runs)
    return f"{good} of {len(runs)} runs (95 % interval: {share.low:.0f} to {share.high:.0f} %)"


def _listed(names: Sequence[str], most: int = NAMED) -> str:
    """Return names as a list of words, of a long one the beginning."""
    words = [f"`{name}`" for name in names]
    if len(words) > most:
        words = [*words[: most - 1], f"{len(words) - most + 1} more"]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
