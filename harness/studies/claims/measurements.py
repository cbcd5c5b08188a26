"""Measurements of which answers are made: paired differences, medians and their intervals, by task and rival."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd

from servobench.harness.analysis.comparison import differences_of_pairs, settling_times
from servobench.harness.analysis.statistics import (
    NO_ESTIMATE,
    Estimate,
    holm,
    median_with_interval,
    signed_rank_p_value,
)
from servobench.harness.run.result import COMPLETED
from servobench.harness.studies.claims.studies import CIRCLE, MOVES, OTHERS, PROPOSED

LEVEL: Final = 0.05
DURATION: Final = 10.0  # [s] of a move
REPRODUCED, NOT_REPRODUCED, DEPENDS = "reproduced", "not reproduced", "depends"
UNDECIDED: Final = "too few robots to tell"


@dataclass(frozen=True)
class Measurement:
    """One number behind an answer.

    Attributes:
        panel: what is measured, with its unit.
        place: task.
        label: controller, reading or pairing.
        estimate: value and interval.
        holds: whether the claim's rule holds here; None for a number that no rule judges, and where the robots are so
            few that it could not hold whatever came out.
    """

    panel: str
    place: str
    label: str
    estimate: Estimate
    holds: bool | None = None


@dataclass(frozen=True)
class Answer:
    """The answer to one claim on one plant.

    Attributes:
        claim: its number; readings of the paper have a name instead.
        statement: the claim in a few words.
        plant: on which the claim was tested.
        verdict: reproduced, not reproduced, or depends on what.
        evidence: one line.
        measurements: the numbers, for the table and the figure.
        division: how the methods were equipped.
    """

    claim: str
    statement: str
    plant: str
    verdict: str
    evidence: str
    measurements: tuple[Measurement, ...]
    division: str = "best equipped"

    @property
    def title(self) -> str:
        """Number and statement, or the statement of a reading."""
        return f"{self.claim}: {self.statement}" if self.claim.isdigit() else self.statement


def significant(differences: Sequence[pd.Series[float]]) -> list[bool | None]:
    """Return for each sample of paired differences whether Wilcoxon's test rejects 0, after Holm over all of them.

    None where not even differences of one sign would be rejected: their two-sided p-value is 2/2ⁿ with n pairs.
    """
    p_values = [signed_rank_p_value(values.to_numpy()) if len(values) else 1.0 for values in differences]
    return [
        p_value < LEVEL if 2.0 ** (1 - len(values)) < LEVEL else None
        for p_value, values in zip(holm(p_values), differences, strict=True)
    ]


def pairings(
    runs: pd.DataFrame, metric: str, panel: str, *, sign: int, never: float = np.nan, factor: float = 1.0
) -> list[Measurement]:
    """Compare the proposed method with each rival in each move.

    Args:
        runs: the table of runs.
        metric: column.
        panel: what is measured, with its unit.
        sign: −1 where the claim says less, +1 where it says more.
        never: replaces a missing value; NaN leaves the pair out.
        factor: from the column's unit to the panel's.
    """
    tables = {task: by_seed(runs, task, metric, never) for task in MOVES}
    found = {
        (task, rival): differences_of_pairs(table[PROPOSED], table[rival]).dropna() * factor
        for task, table in tables.items()
        for rival in OTHERS
    }
    return [
        Measurement(
            panel,
            task,
            rival,
            median_with_interval(difference) if len(difference) else NO_ESTIMATE,
            clear and sign * difference.mean() > 0.0,
        )
        for ((task, rival), difference), clear in zip(found.items(), significant(list(found.values())), strict=True)
    ]


def by_seed(runs: pd.DataFrame, task: str, metric: str, never: float) -> pd.DataFrame:
    """Return `metric` by seed and controller; `never` where a run has none or did not complete."""
    own = runs[runs["task"] == task]
    values = own[metric].where(own["status"] == COMPLETED).fillna(never)
    return own.assign(value=values).pivot(index="seed", columns="controller", values="value")


def medians(runs: pd.DataFrame, panel: str) -> list[Measurement]:
    """Return the median settling time of each method in each move [s]."""
    times = settling_times(runs).groupby([runs["task"], runs["controller"]])
    estimates = {key: median_with_interval(values) for key, values in times}
    return [Measurement(panel, task, name, estimates[task, name]) for task in MOVES for name in (PROPOSED, *OTHERS)]


def circle_error(runs: pd.DataFrame, controller: str, label: str = "") -> Measurement:
    """Return the median RMS error of the second lap [mm]; infinite if half of the runs do not complete."""
    own = runs[(runs["task"] == CIRCLE) & (runs["controller"] == controller)]
    error = median_with_interval(1000.0 * own["rms_error_evaluated"].where(own["status"] == COMPLETED))
    return Measurement("circle, RMS of the second lap, mm", CIRCLE, label or controller, error)


def held(measured: Sequence[Measurement]) -> int:
    """Return in how many cases the rule holds."""
    return sum(bool(m.holds) for m in measured)


def answer(
    claim: str,
    statement: str,
    plant: str,
    judged: Sequence[Measurement],
    evidence: str,
    further: Sequence[Measurement] = (),
) -> Answer:
    """Return the answer whose verdict follows from the cases `judged`; `further` measurements are for the figure."""
    count, decided = held(judged), sum(m.holds is not None for m in judged)
    if count == len(judged):
        verdict = REPRODUCED
    elif count == decided:
        verdict = UNDECIDED
    else:
        verdict = f"{DEPENDS}: holds in {count} of {decided}" if count else NOT_REPRODUCED
    return Answer(claim, statement, plant, verdict, evidence, (*judged, *further))
