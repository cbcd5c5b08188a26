"""Which of the pairs that a batch is to decide are decided, from its table of runs.

A pair is compared in each world by `servobench.harness.analysis.sequential.decide`; its level is that of the batch over
the number of pairs in all worlds. A look counts where both methods have all of its seeds. The margin is that of the
runs up to the first look, so that it does not depend on where one stops.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from servobench.harness.analysis.comparison import (
    ALPHA,
    column_of,
    knows_truth,
    margin,
    metric_heading,
    number,
    shown_unit,
    split_conditions,
)
from servobench.harness.analysis.sequential import CLIP, Decision, decide
from servobench.harness.analysis.verdict import judged_metric
from servobench.harness.run.request import RunRequest
from servobench.harness.run.result import COMPLETED
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import suggest

EVERY = 16  # seeds from look to look
DECISIONS = "decisions.csv"
Pair = tuple[str, str]


@dataclass(frozen=True)
class Question:
    """What a batch is to decide."""

    pairs: tuple[Pair, ...]  # two controllers each
    worlds: int  # number of worlds in which each is compared
    seeds: tuple[int, ...]  # the budget, ascending

    @classmethod
    def ask(
        cls, names: Sequence[str], against: str | None, worlds: int, seeds: Sequence[int]
    ) -> Question:
        """Return the question which of some controllers are better, or that about one and each other.

        Controllers that know the true robot are bounds: they are compared only where one is named.

        Raises:
            ConfigurationError: too few controllers or seeds, or an unknown one.
        """
        if against is not None and against not in names:
            raise ConfigurationError(f"--against: unknown {against!r}: {suggest(against, names)}")
        methods = [name for name in names if not knows_truth(name)]
        pairs = list(combinations(methods, 2))
        if against is not None:
            pairs = [(against, name) for name in methods if name != against]
        if not pairs:
            raise ConfigurationError(
                f"--until-decided compares methods, and {', '.join(names)} are too few: "
                "name another one that does not know the true robot"
            )
        if len(seeds) < EVERY:
            raise ConfigurationError(
                f"--until-decided looks after every {EVERY} seeds, and --seeds is its budget: "
                f"got {len(seeds)}; give 200, for instance"
            )
        return cls(tuple(pairs), worlds, tuple(sorted(seeds)))

    @property
    def level(self) -> float:
        """The largest probability of a false verdict on one pair in one world."""
        return ALPHA / (self.worlds * len(self.pairs))

    @property
    def looks(self) -> list[int]:
        """Numbers of seeds after which one looks."""
        return [*range(EVERY, len(self.seeds), EVERY), len(self.seeds)]

    def record(self) -> dict[str, Any]:
        """Return the entry of the manifest."""
        return {"pairs": [list(pair) for pair in self.pairs], "worlds": self.worlds}


@dataclass(frozen=True)
class World:
    """What is decided of the pairs in one world."""

    words: str  # which one it is
    measure: str  # metric by which pairs are compared, with its unit
    margin: float  # difference that does not matter [unit]
    decisions: Mapping[Pair, Decision]
    runs: pd.DataFrame

    def closed(self, first: int) -> set[str]:
        """Return, for each controller of which no more runs are needed, the name of its run with the first seed."""
        is_open = [pair for pair, each in self.decisions.items() if each.verdict == "undecided"]
        own = self.runs[self.runs["seed"] == first]
        if is_open:
            compared = {name for pair in self.decisions for name in pair}
            still = {name for pair in is_open for name in pair}
            own = own[own["controller"].isin(compared - still)]
        return set(own["run_id"])


def decide_pairs(values: pd.DataFrame, small: float, question: Question) -> dict[Pair, Decision]:
    """Return what is decided of each pair in one world.

    Args:
        values: seeds × controllers, less is better; +∞ of a lost run, NaN of one that is not there.
        small: the margin.
        question: which pairs, and when one looks.
    """
    ordered = values.reindex(index=list(question.seeds))
    found = {}
    for first, second in question.pairs:
        pair = ordered.reindex(columns=[first, second])
        is_there = pair.notna().all(axis=1).to_numpy()
        count = len(pair) if is_there.all() else int(np.argmin(is_there))
        own = pair.iloc[:count]
        looks = [robots for robots in question.looks if robots <= count]
        found[first, second] = decide(own[first], own[second], small, question.level, looks)
    return found


def decide_worlds(runs: pd.DataFrame, question: Question) -> list[World]:
    """Return what is decided in each world of a table of runs."""
    first_look = question.seeds[:EVERY]
    worlds = []
    for words, place in split_conditions(runs):
        metric = judged_metric(place)
        _, factor = shown_unit(metric, place)
        completed = column_of(place, metric).where(place["status"] == COMPLETED)
        judged = place.assign(value=completed.fillna(np.inf))
        values = judged.pivot_table(index="seed", columns="controller", values="value")
        small = margin(metric, place[place["seed"].isin(first_look)])
        decisions = decide_pairs(values, small, question)
        worlds.append(World(words, metric_heading(metric, place), factor * small, decisions, place))
    return worlds


def needed_after(worlds: Sequence[World], question: Question) -> Callable[[RunRequest], bool]:
    """Return whether a run is still needed: its controller is in a pair of its world that is not decided."""
    first = question.seeds[0]
    closed = {name for world in worlds for name in world.closed(first)}
    return lambda request: replace(request, seed=first).run_id not in closed


def decision_rows(worlds: Sequence[World]) -> pd.DataFrame:
    """Return a row for each world and pair."""
    rows = []
    for world in worlds:
        for (first, second), each in world.decisions.items():
            row = {
                "world": world.words,
                "first": first,
                "second": second,
                "verdict": each.verdict,
                "seeds": each.robots,
                "told by lost runs": each.told_by_lost,
                "lost by first": each.lost[0],
                "lost by second": each.lost[1],
                "measure": world.measure,
                "margin": world.margin,
                "clipped mean difference": each.mean * world.margin,
            }
            rows.append(row)
    return pd.DataFrame(rows)


def decision_tables(rows: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Return a title and a table of text for each world of `decision_rows`."""
    tables = []
    for world, own in rows.groupby("world", sort=False):
        facts = own.iloc[0]
        differences = own["clipped mean difference"]
        table = pd.DataFrame(
            {
                "A − B": own["first"] + " − " + own["second"],
                "verdict": own["verdict"],
                "after seeds": own["seeds"].astype(str),
                "runs lost": own["lost by first"].astype(str)
                + " : "
                + own["lost by second"].astype(str),
                f"mean difference in {facts['measure']}": [
                    number(each, "+.2f") for each in differences
                ],
            }
        )
        tables.append((f"{world}: margin {facts['margin']:.2g}", table))
    return tables


def decision_legend(question: Question) -> str:
    """Return what the verdicts hold for."""
    verdicts = question.worlds * len(question.pairs)
    return (
        f"verdicts: at most {100.0 * ALPHA:.0f} % of such batches have a false one among {verdicts}, "
        f"wherever they end; differences count up to {CLIP:g} margins"
    )
