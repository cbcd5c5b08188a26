"""Measurements of which answers are made: paired differences, medians and their intervals, by task and rival."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import pandas as pd

from servobench.harness.analysis.comparison import settling_times
from servobench.harness.analysis.statistics import (
    NO_ESTIMATE,
    Estimate,
    holm,
    median_with_interval,
    signed_rank_p_value,
)
from servobench.harness.run.episode import COMPLETED
from servobench.harness.studies.claims.studies import CIRCLE, MOVES, OTHERS, PROPOSED

LEVEL: Final = 0.05
DURATION: Final = 10.0  # s, of a move
REPRODUCED, NOT_REPRODUCED, DEPENDS = "reproduced", "not reproduced", "depends"


@dataclass(frozen=True)
class Measurement:
    """One number behind an answer.

    Attributes:
        panel: what is measured, with its unit.
        place: task.
        label: controller, reading or pairing.
        estimate: value and interval.
        holds: whether the claim's rule holds here; None for a number beside it.
    """

    panel: str
    place: str
    label: str
    estimate: Estimate
    holds: bool | None = None


@dataclass(frozen=True)
class Answer:
    """What is said about one claim on one plant.

    Attributes:
        claim: its number; readings beside the claims are named.
        statement: the claim in a few words.
        plant: on which it was asked.
        verdict: reproduced, not reproduced, or depends on what.
        evidence: one line.
        measurements: the numbers, for the table and the figure.
    """

    claim: str
    statement: str
    plant: str
    verdict: str
    evidence: str
    measurements: tuple[Measurement, ...]

    @property
    def title(self) -> str:
        """Number and statement, or the statement of a reading."""
        return f"{self.claim}: {self.statement}" if self.claim.isdigit() else self.statement


def pairings(
    runs: pd.DataFrame, metric: str, never: float, panel: str, *, sign: int, factor: float = 1.0
) -> list[Measurement]:
    """Compare the proposed method with each rival in each move; Holm's correction over all of them.

    Args:
        runs: the table of runs.
        metric: column.
        never: what a missing value counts as; NaN leaves the pair out.
        panel: what is measured, with its unit.
        sign: −1 where the claim says less, +1 where it says more.
        factor: from the column's unit to the panel's.
    """
    found = []
    for task in MOVES:
        table = by_seed(runs[runs["task"] == task], metric, never)
        found += [(task, rival, (table[PROPOSED] - table[rival]).dropna() * factor) for rival in OTHERS]
    corrected = holm([signed_rank_p_value(difference.to_numpy()) if len(difference) else 1.0
                      for _, _, difference in found])  # fmt: skip
    measured = []
    for (task, rival, difference), p_value in zip(found, corrected, strict=True):
        middle = median_with_interval(difference) if len(difference) else NO_ESTIMATE
        measured.append(Measurement(panel, task, rival, middle, p_value < LEVEL and sign * difference.mean() > 0.0))
    return measured


def by_seed(runs: pd.DataFrame, metric: str, never: float) -> pd.DataFrame:
    """Return `metric` by seed and controller; `never` where a run has none or did not complete."""
    values = runs[metric].where(runs["status"] == COMPLETED).fillna(never)
    return runs.assign(value=values).pivot(index="seed", columns="controller", values="value")


def medians(runs: pd.DataFrame, panel: str) -> list[Measurement]:
    """Return the median settling time of each method in each move."""
    return [
        Measurement(
            panel,
            task,
            name,
            median_with_interval(settling_times(runs[(runs["task"] == task) & (runs["controller"] == name)])),
        )
        for task in MOVES
        for name in (PROPOSED, *OTHERS)
    ]


def circle_error(runs: pd.DataFrame, controller: str) -> Estimate:
    """Return the median RMS error of the second lap, mm; infinite if half of the runs do not complete."""
    own = runs[(runs["task"] == CIRCLE) & (runs["controller"] == controller)]
    return median_with_interval(1000.0 * own["rms_error_evaluated"].where(own["status"] == COMPLETED))


def listed(medians: Sequence[Measurement]) -> str:
    """Return medians as text, move by move."""
    by_task = {task: [m for m in medians if m.place == task] for task in MOVES}
    return "; ".join(
        f"{task} " + ", ".join(f"{m.label} {m.estimate.value:.2f}" for m in own) + " s" for task, own in by_task.items()
    )


def held(measured: Sequence[Measurement]) -> int:
    """Return in how many cases the rule holds."""
    return sum(bool(m.holds) for m in measured)


def answer(
    claim: str,
    statement: str,
    plant: str,
    judged: Sequence[Measurement],
    evidence: str,
    beside: Sequence[Measurement] = (),
) -> Answer:
    """Return the answer whose verdict follows from the cases in which the rule holds.

    Args:
        claim: its number.
        statement: in a few words.
        plant: on which it was asked.
        judged: the cases.
        evidence: one line.
        beside: further measurements, for the figure.
    """
    count = held(judged)
    if count == len(judged):
        verdict = REPRODUCED
    else:
        verdict = f"{DEPENDS}: holds in {count} of {len(judged)}" if count else NOT_REPRODUCED
    return Answer(claim, statement, plant, verdict, evidence, (*judged, *beside))
