"""Which of the pairs that a batch is to decide are decided, from its table of runs.

A pair is compared in each world by `servobench.harness.analysis.sequential.decide`; its level is that of the batch over
the number of pairs in all worlds. A look counts where both methods have all of its seeds. The margin is that of the
runs up to the first look, so that it does not depend on where one stops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import pandas as pd

from servobench.harness.analysis.comparison import (
    ALPHA,
    Pair,
    knows_truth,
    margin,
    metric_heading,
    number,
    shown_unit,
    split_conditions,
)
from servobench.harness.analysis.sequential import CLIP, Decision, decide
from servobench.harness.analysis.verdict import judged_column, judged_metric
from servobench.harness.run.request import RunRequest
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import Record
from servobench.plant.contract.settings import suggest

EVERY = 16  # seeds from look to look
DECISIONS = "decisions.csv"
CLIPPED = "mean clipped difference"  # column of it; each difference counts up to `CLIP` margins


@dataclass(frozen=True)
class Question:
    """What a batch is to decide."""

    pairs: tuple[Pair, ...]  # controllers, two and two
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

    def record(self) -> Record:
        """Return the entry of the manifest."""
        return {"pairs": [list(pair) for pair in self.pairs], "worlds": self.worlds}


@dataclass(frozen=True)
class Answer:
    """What is decided of a pair in one world."""

    world: str  # in words
    pair: Pair
    decision: Decision
    measure: str  # metric by which they are compared, with its unit
    margin: float  # difference that does not matter [unit]
    needed: frozenset[str]  # names of the first runs of the controllers that this answer needs

    def row(self) -> dict[str, str]:
        """Return it as a row of text."""
        verdict = str(self.decision.verdict)
        if self.decision.told_by_lost:
            verdict += ", by lost runs"
        lost_first, lost_second = self.decision.lost
        return {
            "world": self.world,
            "A − B": " − ".join(self.pair),
            "verdict": verdict,
            "seeds": str(self.decision.robots),
            "runs lost": f"{lost_first} : {lost_second}",
            CLIPPED: number(self.decision.mean * self.margin, "+.2f"),
            "margin": f"{self.margin:.2g}",
            "measure": self.measure,
        }


def answer(
    place: pd.DataFrame, words: str, measure: str, small: float, question: Question
) -> list[Answer]:
    """Return what is decided of each pair in one world.

    Args:
        place: its runs, with a column `value`: less is better, +∞ of a lost run.
        words: which world it is.
        measure: metric of the values, with its unit.
        small: the margin.
        question: which pairs, and when one looks.
    """
    values = place.pivot_table(index="seed", columns="controller", values="value")
    ordered = values.reindex(index=list(question.seeds))
    asked = {name for pair in question.pairs for name in pair}
    first_runs = place[place["seed"] == question.seeds[0]]
    found = []
    for pair in question.pairs:
        own = ordered.reindex(columns=list(pair))
        is_there = own.notna().all(axis=1).cummin()
        looks = [robots for robots in question.looks if robots <= is_there.sum()]
        both = own[is_there]
        decision = decide(both[pair[0]], both[pair[1]], small, question.level, looks)
        # Bounds, which nobody asks about, go on with any pair
        others = asked.difference(pair)
        needed = first_runs.loc[~first_runs["controller"].isin(others), "run_id"]
        found.append(Answer(words, pair, decision, measure, small, frozenset(needed)))
    return found


def decide_worlds(runs: pd.DataFrame, question: Question) -> list[Answer]:
    """Return what is decided in each world of a table of runs."""
    answers = []
    for words, place in split_conditions(runs):
        metric = judged_metric(place)
        _, factor = shown_unit(metric, place)
        at_first = place[place["seed"].isin(question.seeds[:EVERY])]
        judged = place.assign(value=judged_column(place))
        measure = metric_heading(metric, place)
        small = factor * margin(metric, at_first)
        answers += answer(judged, words, measure, small, question)
    return answers


def needed_after(answers: Sequence[Answer], question: Question) -> Callable[[RunRequest], bool]:
    """Return whether a run is still needed: its controller is in a pair of its world that is not decided."""
    first = question.seeds[0]
    known = {name for each in answers for name in each.needed}
    is_open = [each for each in answers if each.decision.verdict == "undecided"]
    closed = known.difference(*(each.needed for each in is_open))
    return lambda request: replace(request, seed=first).run_id not in closed


def answer_table(answers: Sequence[Answer]) -> pd.DataFrame:
    """Return a row of text for each world and pair."""
    return pd.DataFrame([each.row() for each in answers])


def answer_legend(question: Question) -> str:
    """Return what verdicts hold for."""
    verdicts = question.worlds * len(question.pairs)
    return (
        f"at most {100.0 * ALPHA:.0f} % of such batches have a false one among {verdicts} verdicts, wherever they end; "
        f"differences count up to {CLIP:g} margins"
    )
