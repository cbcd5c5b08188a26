"""The objective of tuning, and the runs on which it is measured.

For each plant, `robots` runs in each of eight worlds: a task at a control rate, of `KINDS`, with one level of each of
`LEVELS`. Every run has a robot of its own with one of `MODELS`. Levels and models occur equally often, as far as their
number allows, in an order that the set's seed draws: nobody chooses which meet, and the second set has other worlds.

    score = mean over the runs of weight · cost                              (0 is perfect, 1 the worst)

    weight: the same for all moves and for all curves, such that both kinds count alike; their mean is 1

    move:   cost = mean over the run of log₁₀(e / 1.5 mm) / log₁₀(1 m / 1.5 mm)
    curve:  the same of the RMS error of the second lap
    1 if the run did not complete

Errors e below the floor of 1.5 mm cost nothing, and above 1 m all the same. The cost is continuous in the error: a run
that leaves the settling band late costs hardly more than one that does not. Each instant of a move counts alike, so the
cost of an approach grows in proportion to its settling time. A curve's cost is the logarithm of its judged error.
"""

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self, TypeAlias

import numpy as np

from servobench.harness.batch.blocks import Job, carry_out_blocks, cut, even_size
from servobench.harness.batch.plan import TUNING, Cell, tuning_seeds
from servobench.harness.batch.sandbox import Workers
from servobench.harness.config.registry import find_plant
from servobench.harness.config.settings import Settings, flatten
from servobench.harness.run.lanes import side_by_side_key
from servobench.harness.run.request import RunRequest, Varied, read_mismatch
from servobench.harness.run.resolution import ResolvedRun, Sections, resolve_sections, select
from servobench.harness.run.result import COMPLETED
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import Count, Periods, settings
from servobench.plant.robot.ur5 import TRAINING_LOWER, TRAINING_UPPER

MOVE: Final = "random"
TASKS: Final[Mapping[str, Mapping[str, Any]]] = {
    MOVE: {"duration": 6.0},
    "circle": {"radius": 0.17, "lap_time": 5.0},  # at 0.21 m/s, the whole task at 0.19 m/s
    "lemniscate": {"radius": 0.14, "lap_time": 5.0},
}  # settings of the tasks, short because a settled run needs no more time
_LEAVING: Final[Varied] = (  # the networks' box by 0.5 rad each way
    ("task.lower", tuple(low - 0.5 for low in TRAINING_LOWER)),
    ("task.upper", tuple(high + 0.5 for high in TRAINING_UPPER)),
)
KINDS: Final[tuple[tuple[str, Varied], ...]] = (
    (MOVE, ()),
    (MOVE, ()),
    (MOVE, _LEAVING),
    (MOVE, (("period", 0.2),)),
    (MOVE, (("period", 0.008), ("task.duration", 2.0))),
    ("circle", ()),
    ("circle", (("period", 0.1),)),
    ("lemniscate", (("period", 0.1),)),
)
"""Task and varied settings of each world."""
LEVELS: Final[Mapping[str, tuple[Any, ...]]] = {
    "latency": (0.0, 0.05, 0.1, 0.15),  # [s]
    "noise": (1.0, 4.0),  # factor
    "detector": ("", "", "", "", "+outliers=5%", "+outliers=20%", "+jitter=100ms", "+lost_frames=50%"),
    "drive": ((), (), (), (), (), (), (("plant.command_delay", 0.0),), (("plant.overshoot", 0.3),)),
}
"""One level of each is that of a world."""
MODELS: Final = (
    "moderate",
    "moderate+camera_rotation=30deg",
    "moderate+camera_rotation=60deg",
    "moderate+camera_rotation=120deg",
    "moderate+joint_offsets=45deg",
    "moderate+joint_offsets=90deg",
    "moderate+joint_offsets=180deg",
    "moderate+gear_ratio=50%",
)
"""The mismatch of a robot."""
WEIGHTS: Final[Mapping[str, float]] = {
    task: len(KINDS) / 2 / sum((task == MOVE) == (other == MOVE) for other, _ in KINDS) for task, _ in KINDS
}
FLOOR: Final = 0.0015  # [m] error below which nothing is gained; that of `log_error` where the band is 5 mm
DECADES: Final = math.log10(1.0 / FLOOR)  # from the floor to 1 m
WORST: Final = 1.0  # cost of a run that did not complete, and most of any run
MIN_DELAY_MARGIN: Final = 0.05  # [s] of the loop at the usual latency; settings with less are refused without a run
SECOND_OFFSET: Final = len(TUNING) // 2  # where in the tuning range the seeds of the second sets begin
SECOND_FACTOR: Final = 3  # robots of the second set for each of the first


@settings
class TuningSet:
    """The runs on which every trial of every method is scored."""

    plants: tuple[str, ...] = ("kinematic",)
    """names of plants whose latency can be set"""
    robots: Count = 12
    """in each world on each plant"""
    offset: Periods = 0
    """where in the tuning range the seeds begin; it also draws the worlds"""

    def __post_init__(self) -> None:
        """Refuse seeds outside the tuning range, and a plant without latency."""
        tuning_seeds(len(KINDS) * self.robots, self.offset)
        if not self.plants:
            raise ValueError("no plant to tune on; name one with --plants kinematic")
        for name in self.plants:
            entry = find_plant(name)
            if entry.own_robot or not isinstance(getattr(entry.config(), "sensing", None), SensingConfig):
                raise ValueError(f"plant {name} cannot be tuned on: it needs a UR5 and a camera's latency")

    def second(self) -> Self:
        """Return the second, larger set: other robots of the tuning range, which no trial uses."""
        offset = (self.offset + SECOND_OFFSET) % len(TUNING)
        return replace(self, robots=SECOND_FACTOR * self.robots, offset=offset)

    def runs(self) -> list[RunRequest]:
        """Return all runs, still without a controller, the robots of a world one after the other."""
        count = len(KINDS) * self.robots
        seeds, models = tuning_seeds(count, self.offset), self._drawn("model", MODELS, count)
        level = {name: self._drawn(name, levels, len(KINDS)) for name, levels in LEVELS.items()}
        runs = []
        for plant in self.plants:
            known = flatten(find_plant(plant).config())  # rendered drives have no setting for their overshoot
            drives = [[pair for pair in drive if pair[0].partition(".")[2] in known] for drive in level["drive"]]
            for run, (seed, model) in enumerate(zip(seeds, models, strict=True)):
                world = run // self.robots
                task, varied = KINDS[world]
                own = *varied, *drives[world], *((key, level[key][world]) for key in ("noise", "latency"))
                mismatch = read_mismatch(model + level["detector"][world])
                runs.append(RunRequest(plant, "", task, mismatch, seed, own))
        return runs

    def _drawn(self, name: str, levels: Sequence[Any], count: int) -> list[Any]:
        """Return `count` levels, each as often as the others as far as possible, in an order drawn for this set."""
        order = named_generator(self.offset, name).permutation(count)
        return [levels[index % len(levels)] for index in order]

    def checked(self) -> list[int]:
        """Return the indices of a subset small enough for a test: two robots on moves, two on a circle."""
        curve = next(world for world, (task, _) in enumerate(KINDS) if task != MOVE)
        return sorted({world * self.robots + robot for world in (0, curve) for robot in range(min(2, self.robots))})


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
    decades = float(row["log_error"]) if task == MOVE else math.log10(max(row["rms_error_evaluated"] / FLOOR, 1.0))
    return weight * min(decades / DECADES, WORST)


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
