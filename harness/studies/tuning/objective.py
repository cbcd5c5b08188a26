"""The objective of tuning, and the runs on which it is measured.

For each plant, `robots` runs under each of seven conditions: latencies of 0 to 150 ms, usual and fourfold noise, four
times moves (the task `random`, cut to 6 s), twice a circle and once a figure of eight, both smaller and shorter than
those of the tasks. On one circle the whole delay is that of the camera and commands take effect at once. Every run is
another robot of `moderate` mismatch; of each second one the camera is turned by 30° or 60°.

    score = mean over the runs of weight · cost                              (0 is perfect, 2 the worst)

    weight: 7/8 of each of the many moves, 7/6 of each of the few curves; their mean is 1

    move:   cost = settling time / duration
                   1 + e / (e + 50 mm), e the RMS error of the last quarter, if it never settled
    curve:  cost = 2 e / (e + 50 mm), e the RMS error of the second lap
    2 if the run did not complete

So moves and curves have the same weight: a second of settling time on all moves counts about as much as 4 mm on all
curves.
Overshoot has no term of its own: it lengthens the settling time, since the error must come back and stay within 5 mm.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, TypeAlias

import numpy as np

from servobench.harness.batch.blocks import Job, carry_out_blocks, cut, even_size
from servobench.harness.batch.plan import TUNING, Cell, tuning_seeds
from servobench.harness.batch.sandbox import Workers
from servobench.harness.config.registry import find_plant
from servobench.harness.config.settings import Settings
from servobench.harness.run.lanes import side_by_side_key
from servobench.harness.run.request import RunRequest, Varied, read_mismatch
from servobench.harness.run.resolution import ResolvedRun, Sections, resolve_sections, select
from servobench.harness.run.result import COMPLETED
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import Periods, settings


@dataclass(frozen=True)
class Condition:
    """The condition that the runs of a block share."""

    task: str
    latency: float  # [s] of the camera
    noise_factor: float  # of the sensor
    weight: float  # of a run in the score
    command_delay: float | None = None  # [s] None for the plant's own

    @property
    def varied(self) -> Varied:
        """Settings of the plant in these runs."""
        delay = () if self.command_delay is None else (("plant.command_delay", self.command_delay),)
        return (("noise", self.noise_factor), ("latency", self.latency), *delay)


MOVE: Final = "random"
CONDITIONS: Final = (
    Condition(MOVE, 0.0, 1.0, weight=7 / 8),
    Condition(MOVE, 0.05, 4.0, weight=7 / 8),
    Condition(MOVE, 0.1, 1.0, weight=7 / 8),
    Condition(MOVE, 0.15, 4.0, weight=7 / 8),
    Condition("circle", 0.0, 1.0, weight=7 / 6),
    Condition("circle", 0.05, 1.0, weight=7 / 6, command_delay=0.0),
    Condition("lemniscate", 0.1, 4.0, weight=7 / 6),
)
WEIGHTS: Final[Mapping[str, float]] = {condition.task: condition.weight for condition in CONDITIONS}
MISMATCHES: Final = (
    "moderate",
    "moderate+camera_rotation=60deg",
    "moderate",
    "moderate+camera_rotation=30deg",
)  # of the robots of a condition, in turn
MOVE_DURATION: Final = 6.0  # [s]
TASKS: Final[Mapping[str, Mapping[str, Any]]] = {
    MOVE: {"duration": MOVE_DURATION},
    "circle": {"radius": 0.2, "lap_time": 6.0},  # at 0.21 m/s, the whole task at 0.19 m/s
    "lemniscate": {"radius": 0.17, "lap_time": 6.0},
}  # settings of the tasks, short because a settled run needs no more time
ERROR_SCALE: Final = 0.05  # [m] error at which half of the worst cost of errors is reached
WORST: Final = 2.0  # cost of a run that did not complete, and most of any run
MIN_DELAY_MARGIN: Final = 0.05  # [s] of the loop at the usual latency; settings with less are refused without a run
SECOND_OFFSET: Final = len(TUNING) // 2  # where in the tuning range the seeds of the second sets begin
SECOND_FACTOR: Final = 3  # robots of the second set for each of the first


@settings
class TuningSet:
    """The runs on which every trial of every method is scored."""

    plants: tuple[str, ...] = ("kinematic",)
    """names of plants whose latency can be set"""
    robots: int = 4
    """under each condition on each plant: 2, 4, 6, …, so that cameras as they are and turned ones have equal shares"""
    offset: Periods = 0
    """where in the tuning range the seeds begin"""

    def __post_init__(self) -> None:
        """Refuse an odd share of cameras, seeds outside the tuning range, and a plant without latency."""
        if self.robots < 2 or self.robots % 2:
            raise ValueError(f"robots must be 2, 4, 6, …, so that half of the cameras are turned; got {self.robots}")
        tuning_seeds(len(CONDITIONS) * self.robots, self.offset)
        if not self.plants:
            raise ValueError("no plant to tune on; name one with --plants kinematic")
        for name in self.plants:
            entry = find_plant(name)
            if entry.own_robot or not isinstance(getattr(entry.config(), "sensing", None), SensingConfig):
                raise ValueError(f"plant {name} cannot be tuned on: it needs a UR5 and a camera's latency")

    def second(self) -> TuningSet:
        """Return the second, larger set: other robots of the tuning range, which no trial uses."""
        return TuningSet(self.plants, SECOND_FACTOR * self.robots, (self.offset + SECOND_OFFSET) % len(TUNING))

    def runs(self) -> list[RunRequest]:
        """Return all runs, still without a controller, the robots of a condition one after the other."""
        seeds = tuning_seeds(len(CONDITIONS) * self.robots, self.offset)
        mismatches = [read_mismatch(text) for text in MISMATCHES]
        return [
            RunRequest(
                plant,
                "",
                condition.task,
                mismatches[robot % len(mismatches)],
                seeds[c * self.robots + robot],
                condition.varied,
            )
            for plant in self.plants
            for c, condition in enumerate(CONDITIONS)
            for robot in range(self.robots)
        ]

    def checked(self) -> list[int]:
        """Return the indices of a subset small enough for a test: two robots on moves, two on a circle."""
        curves = next(c for c, condition in enumerate(CONDITIONS) if condition.task != MOVE)
        return [c * self.robots + robot for c in (1, curves) for robot in (0, 1)]


@dataclass(frozen=True)
class Trial:
    """A controller with the settings of its class that are to be scored."""

    controller: str
    config: Any

    def resolved(self, runs: Sequence[RunRequest]) -> list[ResolvedRun]:
        """Return runs of this trial, which share their settings; tuned values that are in use do not matter."""
        requests = [replace(run, controller=self.controller) for run in runs]
        sections = Sections(resolve_sections(requests, Settings(TASKS)) | {self.controller: self.config})
        return [select(request, sections) for request in requests]


Cost: TypeAlias = tuple[int, int, float]  # index of the trial, index of the run, its cost


def run_cost(task: str, row: Mapping[str, Any]) -> float:
    """Return the weighted cost of one run from its row of results; see the module's docstring."""
    weight = WEIGHTS[task]
    if row["status"] != COMPLETED:
        return weight * WORST
    error = float(row["rms_error_evaluated"])
    saturated = error / (error + ERROR_SCALE)
    if task != MOVE:
        return weight * WORST * saturated
    settling_time = float(row["settling_time_s"])
    return weight * (1.0 + saturated if math.isnan(settling_time) else settling_time / MOVE_DURATION)


def score(costs: Sequence[float]) -> float:
    """Return the score of a trial from the costs of its runs."""
    return float(np.mean(costs))


def evaluate(trials: Sequence[Trial], runs: Sequence[RunRequest], workers: Workers) -> Iterator[Cost]:
    """Carry out every run of every trial and yield each cost as it is known, in any order.

    Args:
        trials: the trials to score.
        runs: the runs of each.
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
