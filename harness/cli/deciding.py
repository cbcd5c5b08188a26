"""Comparisons that end when they are decided: what is asked, the batch that ends, and what is printed of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import pandas as pd

from servobench.harness.analysis.decisions import (
    CLIPPED,
    DECISIONS,
    Answer,
    Question,
    answer_legend,
    answer_table,
    decide_worlds,
    needed_after,
)
from servobench.harness.batch.campaign import Campaign
from servobench.harness.batch.looks import Looks, in_looks
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.cli.terminal import print_tables, say
from servobench.harness.run.request import RunRequest
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import write_csv


def ask(
    until_decided: bool,
    against: str | None,
    names: Sequence[str],
    worlds: int,
    seeds: Sequence[int],
    *,
    first_seed_on: str = "",
) -> Question | None:
    """Return what a command is to decide; None where it has a fixed number of seeds.

    Raises:
        ConfigurationError: options that do not go together, or too few methods or seeds.
    """
    if not until_decided:
        if against is not None:
            raise ConfigurationError(
                "--against chooses the pairs of --until-decided; give both, or statistics --against afterwards"
            )
        return None
    if first_seed_on:
        raise ConfigurationError(
            "--until-decided cannot judge plants with one seed; leave --first-seed-on away"
        )
    return Question.ask(names, against, worlds, seeds)


def ending_when_decided(
    campaign: Campaign,
    question: Question,
    find_answers: Callable[[pd.DataFrame, Question], list[Answer]] = decide_worlds,
) -> Campaign:
    """Return a campaign that ends when its question is decided.

    Args:
        campaign: with all runs of the budget.
        question: what it is to decide.
        find_answers: returns from the table of runs what is decided.
    """
    cells, ends = in_looks(campaign.cells, question.seeds, question.looks)

    def goes_on(runs: pd.DataFrame) -> Callable[[RunRequest], bool]:
        answers = []
        if not runs.empty:
            answers = find_answers(runs, question)
        return needed_after(answers, question)

    return replace(campaign, cells=cells, looks=Looks(ends, goes_on, question.record()))


def save_decisions(folder: ResultsFolder, answers: Sequence[Answer]) -> None:
    """Write what is decided beside the tables of a folder."""
    path = folder.path / DECISIONS
    table = answer_table(answers)
    # A number: a text that begins with a sign would be marked as one that no spreadsheet may compute
    table[CLIPPED] = pd.to_numeric(table[CLIPPED], errors="coerce")
    write_csv(table, path)
    folder.vouch([path])


def print_stored(folder: ResultsFolder) -> None:
    """Print what was decided when a batch ended, if it was one that ends so."""
    path = folder.path / DECISIONS
    if folder.manifest.get("until_decided") and path.exists():
        print_tables([("decided", pd.read_csv(path, dtype=str, keep_default_na=False))])


def print_answers(
    answers: Sequence[Answer], question: Question, carried_out: int, budget: int
) -> None:
    """Print what is decided, and how many of the runs of the budget were saved."""
    print_tables([("decided", answer_table(answers))], answer_legend(question))
    decided = sum(each.decision.verdict != "undecided" for each in answers)
    saved = budget - carried_out
    share = 100.0 * saved / budget
    say(
        f"{decided} of {len(answers)} verdicts decided; {saved} of {budget} runs saved ({share:.0f} %)"
    )
