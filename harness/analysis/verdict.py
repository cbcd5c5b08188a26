"""The result of a results folder in a sentence or two, and the leading controller in each place.

Two controllers count as different where a paired signed-rank test over seeds, corrected for all pairs after Holm, stays
below 5 %. A seed counts once, however many tasks it was run on: runs of one seed share a robot. Controllers that know
the true robot are bounds and are not ranked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Final

import numpy as np
import pandas as pd

from servobench.harness.analysis.comparison import (
    achieved_share,
    column_of,
    outcomes,
    settling_times,
    shown_unit,
    split_conditions,
    split_tasks,
)
from servobench.harness.analysis.statistics import holm, median_with_interval, signed_rank_p_value
from servobench.harness.config.registry import CONTROLLERS, find_controller
from servobench.harness.run.metrics import METRICS
from servobench.harness.run.outcome import ACHIEVED
from servobench.harness.run.result import COMPLETED
from servobench.plant.contract.faults import ConfigurationError

LEVEL: Final = 0.05  # of significance
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
    return Verdict(_of_several(chosen), (_doubts(chosen), *cautions))


def ranked_controllers(runs: pd.DataFrame) -> list[str]:
    """Return the controllers that do not know the true robot; all where there is no other."""
    names = list(dict.fromkeys(runs["controller"].astype(str)))
    return [name for name in names if not knows_truth(name)] or names


def knows_truth(name: str) -> bool:
    """Return whether a controller of this package needs the true robot; a third party's is not loaded for this."""
    if name not in CONTROLLERS and "+" not in name:
        return False
    try:
        return find_controller(name).needs_truth
    except ConfigurationError:
        return False


def asked_of(runs: pd.DataFrame) -> str:
    """Return the goal of these runs as a verb in the past tense."""
    moves, curves = (len(part) for part in split_tasks(runs))
    return {(True, False): "settled", (False, True): "followed the curve"}.get(
        (moves > 0, curves > 0), "settled or followed the curve"
    )


def leaders(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the leading controller of each plant, task and condition with its evidence; empty without a competition.

    First is the controller with the highest success rate, then the one that has the smallest median settling time, on
    a curve the smallest median error.
    """
    places = split_conditions(runs[runs["controller"].isin(ranked_controllers(runs))])
    if len(places) > MOST_PLACES:
        return pd.DataFrame()
    rows = [_leader(words, place) for words, place in places if place["controller"].nunique() > 1]
    return pd.DataFrame(rows)


def seeds_needed(controllers: int) -> int:
    """Return the least number of seeds with which the test can distinguish two of so many controllers."""
    pairs = controllers * (controllers - 1) // 2
    return 1 + int(np.ceil(np.log2(pairs / LEVEL)))


def scores(place: pd.DataFrame) -> tuple[pd.DataFrame, str, int]:
    """Return the scores of a place, seeds × controllers, with their unit and digits; infinite where a run failed.

    That is the settling time of a move, and the error of the judged part of a curve.
    """
    if len(split_tasks(place)[1]):
        unit, factor = shown_unit("rms_error_evaluated", place)
        values = factor * column_of(place, "rms_error_evaluated").where(place["status"] == COMPLETED)
        digits = METRICS["rms_error_evaluated"].digits
    else:
        values, unit, digits = settling_times(place), "s", METRICS["settling_time_s"].digits
    table = place.assign(score=values.fillna(np.inf))
    return table.pivot_table(index="seed", columns="controller", values="score", sort=False), unit, digits


def shown_smaller(table: pd.DataFrame) -> set[tuple[str, str]]:
    """Return the pairs of columns of which the first is shown to be smaller; an infinite value is larger than any."""
    known = table.dropna()
    finite = known.to_numpy()[np.isfinite(known.to_numpy())]
    known = known.replace(np.inf, 2.0 * float(finite.max(initial=0.5)))
    pairs = list(combinations([str(name) for name in known.columns], 2))
    if known.empty or not pairs:
        return set()
    differences = {(a, b): known[a] - known[b] for a, b in pairs}
    corrected = holm([signed_rank_p_value(difference) for difference in differences.values()])
    return {
        (a, b) if (np.sign(difference) * difference.abs().rank()).sum() < 0.0 else (b, a)  # the sum of signed ranks
        for ((a, b), difference), p_value in zip(differences.items(), corrected, strict=True)
        if p_value < LEVEL
    }


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


def _of_several(runs: pd.DataFrame) -> str:
    shares = _shares(runs)
    asked, most, least = asked_of(runs), max(shares.values()), min(shares.values())
    best = [name for name, share in shares.items() if share == most]
    if most == 0.0:
        return f"None of the {len(shares)} controllers {asked} in any of {len(runs)} runs."
    if most == least:
        everyone = "Both controllers" if len(shares) == 2 else f"All {len(shares)} controllers"
        often = "every run" if most == 1.0 else f"{100.0 * most:.0f} % of their runs"
        return f"{everyone} {asked} in {often}{_speed(runs, best)}."
    worst = [name for name, share in shares.items() if share == least]
    first, last = (_share(runs[runs["controller"] == names[0]]) for names in (best, worst))
    top = f"{_listed(best)} {'each ' if len(best) > 1 else ''}{asked} in {first}{_speed(runs, best)}"
    return f"{top}; least often {_listed(worst)}, in {last}."


def _speed(runs: pd.DataFrame, names: Sequence[str]) -> str:
    """Return which of equally reliable controllers is shown to be better than each other one of them."""
    table = leaders(runs[runs["controller"].isin(names)]) if len(names) > 1 else pd.DataFrame()
    if table.empty:
        return ""
    clear = table["First", "controller"][table["How sure", RIVALS] == NOBODY]
    if clear.empty:
        none, others = ("neither", "the other") if len(names) == 2 else ("none of them", "the others")
        return f", and {none} is shown to be {BETTER} than {others}"
    best = clear.value_counts().index[0]
    where = "" if len(table) == 1 else f" in {(clear == best).sum()} of {len(table)} places"
    return f", of which `{best}` is shown to be the best{where}"


def _doubts(runs: pd.DataFrame) -> str:
    """Return how far the order of controllers can be trusted."""
    seeds, count = runs["seed"].nunique(), runs["controller"].nunique()
    needed = seeds_needed(count)
    if seeds < needed:
        had = "One seed is" if seeds == 1 else f"{seeds} seeds are"
        which = "the two" if count == 2 else f"any two of {count}"
        return (
            f"{had} too few to tell {which} controllers apart with a paired test "
            f"(it takes at least {needed}): the order is a hint, not a finding."
        )
    achieved = runs.assign(score=outcomes(runs).isin(ACHIEVED).astype(float))
    table = achieved.pivot_table(index="seed", columns="controller", values="score", sort=False)
    best = max((shares := _shares(runs)), key=lambda name: shares[name])
    less = shown_smaller(table)
    apart = [name for name in shares if (name, best) in less]
    if not apart:
        sentence = "In how often they did so, no controller can be told apart from the first"
        alone = list(shares.values()).count(shares[best]) == 1
        faster = _faster(runs, best) if alone else []
        tail = f", and {_listed(faster)} {_verb(faster, 'is', 'are')} shown to be {BETTER}" if faster else ""
        return f"{sentence}{tail}."
    others = count - 1 - len(apart)
    return f"Told apart from the first: {_listed(apart, 6)}" + (f"; not so the other {others}." if others else ".")


def _faster(runs: pd.DataFrame, best: str) -> list[str]:
    """Return the controllers that are shown to be faster or more precise than `best` in every place."""
    places = split_conditions(runs)
    if len(places) > MOST_PLACES:
        return []
    smaller = [{name for name, other in shown_smaller(scores(place)[0]) if other == best} for _, place in places]
    return [name for name in _shares(runs) if all(name in each for each in smaller)]


def _leader(words: str, place: pd.DataFrame) -> dict[tuple[str, str], Any]:
    table, unit, digits = scores(place)
    shares = _shares(place)
    order = sorted(table.columns, key=lambda name: (-shares[name], table[name].median()))
    first, second = order[:2]
    smaller = shown_smaller(table)
    rivals = [name for name in order[1:] if (first, name) not in smaller]

    def median(name: str) -> str:
        value, *interval = f"{median_with_interval(table[name].to_numpy()):.{digits}f}".split(" ", 1)
        return " ".join([value, unit, *interval])

    return {
        ("", "where"): words,
        ("", "seeds"): str(len(table)),
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
