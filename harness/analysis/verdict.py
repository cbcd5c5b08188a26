"""The result of a results folder in a sentence or two, and the leading controller in each place.

In one place controllers are told apart by the verdict on their paired difference, see
`servobench.harness.analysis.statistics.paired_difference`, success rates by a sign test over seeds: a seed counts once,
however many tasks it was run on, as runs of one seed share a robot. Controllers that know the true robot are bounds and
are not ranked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pandas as pd

from servobench.harness.analysis.comparison import (
    achieved_share,
    column_of,
    grouped,
    knows_truth,
    margin,
    outcomes,
    settling_times,
    shown_unit,
    split_conditions,
    split_tasks,
)
from servobench.harness.analysis.statistics import MIN_PAIRS, is_majority, median_with_interval, paired_difference
from servobench.harness.run.metrics import METRICS
from servobench.harness.run.outcome import ACHIEVED
from servobench.harness.run.result import COMPLETED

NOBODY: Final = "nobody"
RIVALS: Final = "not shown to be behind the first"  # heading of a column
BETTER: Final = "faster or more precise"
NAMED: Final = 3  # controllers that a sentence names
MOST_PLACES: Final = 24  # for which leaders are named

Place = tuple[str, pd.DataFrame]  # words, runs


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
        cautions.append(f"{_listed(bounds)} {_verb(bounds, 'knows', 'know')} the true robot: shown, not ranked.")
    chosen = runs[runs["controller"].isin(ranked)]
    if len(ranked) == 1:
        return Verdict(_of_one_controller(chosen), tuple(cautions))
    return Verdict(_of_several(chosen, runs), (_doubts(chosen, runs), *cautions))


def ranked_controllers(runs: pd.DataFrame) -> list[str]:
    """Return the controllers that do not know the true robot; all where there is no other."""
    names = list(dict.fromkeys(runs["controller"].astype(str)))
    return [name for name in names if not knows_truth(name)] or names


def asked_of(runs: pd.DataFrame) -> str:
    """Return the goal of these runs as a verb in the past tense."""
    moves, curves = (len(part) for part in split_tasks(runs))
    return {(True, False): "settled", (False, True): "followed the curve"}.get(
        (moves > 0, curves > 0), "settled or followed the curve"
    )


def leaders(runs: pd.DataFrame, names: Sequence[str] | None = None) -> pd.DataFrame:
    """Return the leading one of some controllers in each plant, task and condition with its evidence.

    Without names, of all that do not know the true robot. Empty without a competition. First is the controller with the
    highest success rate, then the one that has the smallest median settling time, on a curve the smallest median error.
    """
    names = ranked_controllers(runs) if names is None else names
    competitions = [
        (words, place, own)
        for words, place in split_conditions(runs)
        if (own := place[place["controller"].isin(names)])["controller"].nunique() > 1
    ]
    return grouped([_leader(*each) for each in competitions] if len(competitions) <= MOST_PLACES else [])


def judged_metric(place: pd.DataFrame) -> str:
    """Return the column by which the runs of a place are compared."""
    return "rms_error_evaluated" if len(split_tasks(place)[1]) else "settling_time_s"


def judged_values(place: pd.DataFrame) -> pd.DataFrame:
    """Return the judged metric in the unit in which it is shown, seeds × controllers; infinite where a run is lost."""
    metric = judged_metric(place)
    values = shown_unit(metric, place)[1] * column_of(place, metric).where(place["status"] == COMPLETED)
    table = place.assign(value=values.fillna(np.inf))
    return table.pivot_table(index="seed", columns="controller", values="value", sort=False)


def _of_one_run(runs: pd.DataFrame) -> str:
    (row,) = runs.assign(outcome=outcomes(runs)).to_dict("records")
    name, place = row["controller"], f"{row['task']} on {row['plant']}"
    if row["status"] != COMPLETED:
        return f"`{name}` ended {place} early: {row['status']}."
    unit, factor = shown_unit("rms_error_evaluated", runs)
    if len(split_tasks(runs)[1]):
        verb = "followed" if row["outcome"] in ACHIEVED else f"did not follow ({row['outcome']})"
        return f"`{name}` {verb} {place} with an RMS error of {factor * row['rms_error_evaluated']:.1f} {unit}."
    last = f"with an error of {factor * row['steady_state_error']:.1f} {unit} in the last second"
    if row["outcome"] in ACHIEVED:
        return f"`{name}` settled in {place} after {row['settling_time_s']:.2f} s, {last}."
    return f"`{name}` did not settle in {place} ({row['outcome']}): it ended {last}."


def _of_one_controller(runs: pd.DataFrame) -> str:
    name = runs["controller"].iloc[0]
    sentence = f"`{name}` {asked_of(runs)} in {_share(runs)}"
    moves, _ = split_tasks(runs)
    if len(moves) == len(runs) and settling_times(runs).notna().any():
        middle = median_with_interval(settling_times(runs))
        sentence += f", after a median of {middle.value:.2f} s (95 % interval: {middle.low:.2f} to {middle.high:.2f} s)"
        sentence = sentence.replace("inf", "∞")
    return sentence + "."


def _of_several(runs: pd.DataFrame, beside: pd.DataFrame) -> str:
    """Return the result of the runs of ranked controllers; those `beside` include bounds, which set margins."""
    shares = _shares(runs)
    asked, most, least = asked_of(runs), max(shares.values()), min(shares.values())
    best = [name for name, share in shares.items() if share == most]
    if most == 0.0:
        return f"None of the {len(shares)} controllers {asked} in any of {len(runs)} runs."
    if most == least:
        everyone = "Both controllers" if len(shares) == 2 else f"All {len(shares)} controllers"
        often = "every run" if most == 1.0 else f"{100.0 * most:.0f} % of their runs"
        return f"{everyone} {asked} in {often}{_speed(beside, best)}."
    worst = [name for name, share in shares.items() if share == least]
    first, last = (_share(runs[runs["controller"] == names[0]]) for names in (best, worst))
    top = f"{_listed(best)} {'each ' if len(best) > 1 else ''}{asked} in {first}{_speed(beside, best)}"
    return f"{top}; least often {_listed(worst)}, in {last}."


def _speed(runs: pd.DataFrame, names: Sequence[str]) -> str:
    """Return which of equally reliable controllers is shown to be better than each other one of them."""
    table = leaders(runs, names) if len(names) > 1 else pd.DataFrame()
    if table.empty:
        return ""
    clear = table["First", "controller"][table["How sure", RIVALS] == NOBODY]
    if clear.empty:
        none, others = ("neither", "the other") if len(names) == 2 else ("none of them", "the others")
        return f", and {none} is shown to be {BETTER} than {others}"
    best = clear.value_counts().index[0]
    where = "" if len(table) == 1 else f" in {(clear == best).sum()} of {len(table)} places"
    return f", of which `{best}` is shown to be the best{where}"


def _doubts(runs: pd.DataFrame, beside: pd.DataFrame) -> str:
    """Return how far the order of controllers can be trusted."""
    seeds, count = runs["seed"].nunique(), runs["controller"].nunique()
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
    apart = [name for name, each in ahead.items() if is_majority(int((each > 0.0).sum()), int((each < 0.0).sum()))]
    if not apart:
        sentence = "In how often they did so, no controller can be told apart from the first"
        alone = list(shares.values()).count(shares[best]) == 1
        faster = _faster(beside, best, list(shares)) if alone else []
        tail = f", and {_listed(faster)} {_verb(faster, 'is', 'are')} shown to be {BETTER}" if faster else ""
        return f"{sentence}{tail}."
    others = count - 1 - len(apart)
    return f"Told apart from the first: {_listed(apart, 6)}" + (f"; not so the other {others}." if others else ".")


def _faster(runs: pd.DataFrame, best: str, names: Sequence[str]) -> list[str]:
    """Return which of some controllers are shown to be faster or more precise than `best` in every place."""
    places = split_conditions(runs)
    if len(places) > MOST_PLACES:
        return []
    found = [_verdicts(place, [(name, best) for name in names]) for _, place in places]
    return [name for name, told in zip(names, zip(*found, strict=True), strict=True) if set(told) == {"better"}]


def _verdicts(place: pd.DataFrame, pairs: Sequence[tuple[str, str]]) -> list[str]:
    """Return how the first of each pair does beside the second in a place, on the seeds that both have run."""
    table, metric = judged_values(place), judged_metric(place)
    table = table.reindex(columns=sorted({name for pair in pairs for name in pair}))
    known, small = [table[list(pair)].dropna() for pair in pairs], shown_unit(metric, place)[1] * margin(metric, place)
    return [paired_difference(each.iloc[:, 0], each.iloc[:, 1], small).verdict for each in known]


def _leader(words: str, place: pd.DataFrame, own: pd.DataFrame) -> dict[tuple[str, str], Any]:
    table, metric, shares = judged_values(place), judged_metric(place), _shares(own)
    unit, _ = shown_unit(metric, place)
    order = sorted(shares, key=lambda name: (-shares[name], table[name].median()))
    first, second = order[:2]
    told = _verdicts(place, [(first, name) for name in order[1:]])
    rivals = [name for name, verdict in zip(order[1:], told, strict=True) if verdict != "better"]

    def median(name: str) -> str:
        value, *interval = f"{median_with_interval(table[name]):.{METRICS[metric].digits}f}".split(" ", 1)
        lost = f"({100.0 * (1.0 - shares[name]):.0f} % lost)" if shares[name] < 1.0 else ""
        return " ".join([value, unit, *interval, lost]).rstrip()

    return {
        ("", "where"): words,
        ("", "seeds"): str(own["seed"].nunique()),
        ("First", "controller"): first,
        ("First", "median"): median(first),
        ("Next", "controller"): second,
        ("Next", "median"): median(second),
        ("How sure", RIVALS): _listed(rivals, NAMED).replace("`", "") if rivals else NOBODY,
    }


def _shares(runs: pd.DataFrame) -> dict[str, float]:
    good = outcomes(runs).isin(ACHIEVED)
    return {str(name): float(share) for name, share in good.groupby(runs["controller"], sort=False).mean().items()}


def _share(runs: pd.DataFrame) -> str:
    good, share = int(outcomes(runs).isin(ACHIEVED).sum()), achieved_share(runs)
    return f"{good} of {len(runs)} runs (95 % interval: {share.low:.0f} to {share.high:.0f} %)"


def _verb(names: Sequence[str], one: str, many: str) -> str:
    return one if len(names) == 1 else many


def _listed(names: Sequence[str], most: int = NAMED) -> str:
    """Return names as a list of words, of a long one the beginning."""
    words = [f"`{name}`" for name in names]
    if len(words) > most:
        words = [*words[: most - 1], f"{len(words) - most + 1} more"]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
