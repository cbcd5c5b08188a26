"""What tuning minimises, and the runs that it is measured on.

For each plant, `seeds` moves of the task `random` and half as many runs of the task `circle`, every one on another
robot of `moderate` mismatch. Every other run has a camera latency of 50 ms, as the rendered plant has.

    score = mean over random of c_random + mean over circle of c_circle         (0 is perfect, 4 the worst)

    c_random = settling time / duration; 1 if it never settled; 2 if the run did not complete
    c_circle = min(RMS error of the second lap / 0.05 m, 1);     2 if the run did not complete

Overshoot has no term of its own: it lengthens the settling time, since the error must come back and stay within 5 mm.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from typing import Any, Final, TypeAlias

import numpy as np

from servobench.harness.batch.blocks import Cell, Job, carry_out_blocks, cut, even_size
from servobench.harness.batch.compare import tuning_seeds
from servobench.harness.batch.workers import Workers
from servobench.harness.config.registry import find_plant
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import COMPLETED
from servobench.harness.run.request import RunRequest, read_mismatch
from servobench.harness.run.resolved import ResolvedRun, resolve_sections, select
from servobench.harness.run.tasks import find_task
from servobench.harness.run.together import side_by_side_key
from servobench.plant.sensing import can_vary_sensing
from servobench.plant.settings import Periods, settings

MOVE: Final = "random"
CURVE: Final = "circle"
MISMATCH: Final = "moderate"
LATENCIES: Final = (0.0, 0.05)  # [s] between exposure and delivery of the feature, in turn
RMS_SATURATION: Final = 0.05  # [m] on the circle; the cost saturates at 1 here
FAULT_PENALTY: Final = 1.0  # added to the cost 1 of a run that did not complete
CHECKED: Final = len(LATENCIES)  # runs of each task in the subset that a test scores again


@settings
class TuningSet:
    """The runs on which every trial of every method is scored."""

    plants: tuple[str, ...] = ("kinematic",)
    """names of plants whose latency can be set"""
    seeds: int = 8
    """moves on each plant: 4, 8, 12, …, so that each delay has its share of moves and circles"""
    offset: Periods = 0
    """where in the tuning range the seeds begin"""

    def __post_init__(self) -> None:
        """Refuse an odd share of delays, seeds outside the tuning range, and a plant without latency."""
        if self.seeds < 4 or self.seeds % 4:
            raise ValueError(
                f"seeds must be 4, 8, 12, …, so that each delay has its share of moves and circles; got {self.seeds}"
            )
        tuning_seeds(self.seeds + self.seeds // 2, self.offset)
        if not self.plants:
            raise ValueError("no plant to tune on; name one with --plants kinematic")
        for name in self.plants:
            entry = find_plant(name)
            if entry.own_robot or not can_vary_sensing(entry.config()):
                raise ValueError(f"plant {name} cannot be tuned on: it needs a UR5 and a camera's latency")

    def runs(self) -> list[RunRequest]:
        """Return all runs, still without a controller: for each plant the moves, then the circles on further seeds."""
        seeds = tuning_seeds(self.seeds + self.seeds // 2, self.offset)
        tasks = [MOVE] * self.seeds + [CURVE] * (self.seeds // 2)
        return [
            RunRequest(plant, "", task, read_mismatch(MISMATCH), seed, latency=latency)
            for plant in self.plants
            for task, seed, latency in zip(tasks, seeds, cycle(LATENCIES), strict=False)
        ]

    def checked(self) -> list[int]:
        """Return the indices of a subset with both tasks and both delays, small enough for a test."""
        return [first + i for first in (0, self.seeds) for i in range(CHECKED)]


@dataclass(frozen=True)
class Trial:
    """A controller with the settings of its class that are to be scored."""

    controller: str
    config: Any

    def resolved(self, runs: Sequence[RunRequest]) -> list[ResolvedRun]:
        """Return runs of this trial, which share their settings; tuned values that are in use do not matter."""
        requests = [replace(run, controller=self.controller) for run in runs]
        sections = resolve_sections(requests, Settings()) | {self.controller: self.config}
        return [select(request, sections) for request in requests]


Cost: TypeAlias = tuple[int, int, float]  # index of the trial, index of the run, its cost


def run_cost(task: str, row: Mapping[str, Any]) -> float:
    """Return the cost of one run from its row of results; see the module's docstring."""
    if row["status"] != COMPLETED:
        return 1.0 + FAULT_PENALTY
    if task == CURVE:
        return min(float(row["rms_error_evaluated"]) / RMS_SATURATION, 1.0)
    settling_time = float(row["settling_time_s"])
    return 1.0 if math.isnan(settling_time) else settling_time / float(find_task(MOVE).default.duration)


def score(runs: Sequence[RunRequest], costs: Sequence[float]) -> float:
    """Return the score of a trial from the costs of its runs."""
    pairs = list(zip(runs, costs, strict=True))
    return float(sum(np.mean([cost for run, cost in pairs if run.task == task]) for task in (MOVE, CURVE)))


def evaluate(trials: Sequence[Trial], runs: Sequence[RunRequest], workers: Workers) -> Iterator[Cost]:
    """Carry out every run of every trial and yield each cost as it is known, in any order.

    Args:
        trials: what to score.
        runs: on what.
        workers: where.

    Raises:
        ConfigurationError: the worker processes cannot be started.
    """
    kinds: dict[Hashable, list[tuple[int, int, ResolvedRun]]] = {}
    for t, trial in enumerate(trials):
        for r, run in enumerate(trial.resolved(runs)):
            kinds.setdefault(side_by_side_key(run), []).append((t, r, run))
    order = [(kind, *each) for kind, same in kinds.items() for each in same]
    jobs = [Job(index, Cell(run.request), run, kind) for index, (kind, _, _, run) in enumerate(order)]
    for block, outcome in carry_out_blocks(cut(jobs, even_size(len(jobs), workers.count), chunk=1), workers):
        for job, result in zip(block.jobs, outcome, strict=True):
            _, t, r, _ = order[job.index]
            yield t, r, run_cost(runs[r].task, result.row)
