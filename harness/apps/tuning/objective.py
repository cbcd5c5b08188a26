"""The objective of tuning, the runs on which it is measured, and the ledgers that keep the scores of points.

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
Points whose settings cannot be built, or whose loop is too close to instability, have the worst cost without a run.

A ledger is a file that a killed process leaves readable. Each line is a JSON object: the first one holds everything
that scores depend on besides the settings, each other one the settings of a point and the cost of every run.
"""

import json
import math
import os
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Self, TypeAlias, final

import numpy as np

from servobench.harness.apps.loops.loop_analysis import delay_margin
from servobench.harness.apps.tuning.spaces import find_tunable
from servobench.harness.batch.blocks import Job, carry_out_blocks, cut, even_size
from servobench.harness.batch.isolation import Workers
from servobench.harness.batch.manifest import named_files, plugins
from servobench.harness.batch.plan import Cell, Survey, tuning_seeds
from servobench.harness.config.registry import find_plant, offered
from servobench.harness.config.settings import (
    TUNING,
    Settings,
    apply_settings,
    file_stem,
    flatten,
)
from servobench.harness.run.lanes import side_by_side_key
from servobench.harness.run.rehearsal import build_once
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.resolution import ResolvedRun, Sections, resolve_sections, select
from servobench.harness.run.result import COMPLETED
from servobench.harness.run.variations import Row, Varied
from servobench.plant.contract.faults import ConfigurationError, RunFault, configuration_errors
from servobench.plant.contract.files import Record, accessing
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import Count, Periods, Section, settings
from servobench.plant.robot.mismatch import Mismatch
from servobench.plant.robot.ur5 import TRAINING_LOWER, TRAINING_UPPER

MOVE = "random"
# Settings of the tasks, short because a settled run needs no more time
TASKS: Mapping[str, Section] = {
    MOVE: {"duration": 6.0},
    "circle": {"radius": 0.17, "lap_time": 5.0},  # at 0.21 m/s, the whole task at 0.19 m/s
    "lemniscate": {"radius": 0.14, "lap_time": 5.0},
}
# Starts leave the networks' box by 0.5 rad each way.
_LEAVING: Varied = (
    ("task.lower", tuple(low - 0.5 for low in TRAINING_LOWER)),
    ("task.upper", tuple(high + 0.5 for high in TRAINING_UPPER)),
)
KINDS: tuple[tuple[str, Varied], ...] = (
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
LEVELS: Mapping[str, tuple[Any, ...]] = {
    "latency": (0.0, 0.05, 0.1, 0.15),  # [s]
    "noise": (1.0, 4.0),  # factor
    "detector": (
        "",
        "",
        "",
        "",
        "+outliers=5%",
        "+outliers=20%",
        "+jitter=100ms",
        "+lost_frames=50%",
    ),
    "drive": ((), (), (), (), (), (), (("plant.command_delay", 0.0),), (("plant.overshoot", 0.3),)),
}
"""One level of each is that of a world."""
MODELS = (
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


def _weight(task: str) -> float:
    """Return the weight of a task: half of the worlds over those with a task of its kind, a move or a curve."""
    alike = sum((task == MOVE) == (other == MOVE) for other, _ in KINDS)
    return len(KINDS) / 2 / alike


WEIGHTS: Mapping[str, float] = {task: _weight(task) for task, _ in KINDS}
# An error below the floor gains nothing; it is that of `log_error` where the settling band is 5 mm.
FLOOR = 0.0015  # [m]
DECADES = math.log10(1.0 / FLOOR)  # from the floor to 1 m
WORST = 1.0  # cost of a run that did not complete, and the greatest of any run
# Settings whose loop has a smaller delay margin at the usual latency are refused without a run.
MIN_DELAY_MARGIN = 0.05  # [s]
# Where in the tuning range the seeds of the second sets begin
SECOND_OFFSET = len(TUNING) // 2
SECOND_FACTOR = 3  # robots of the second set for each of the first


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
            sensing = getattr(entry.config(), "sensing", None)
            if entry.own_robot or not isinstance(sensing, SensingConfig):
                raise ValueError(
                    f"plant {name} cannot be tuned on: it needs a UR5 and a camera's latency"
                )

    def second(self) -> Self:
        """Return the second, larger set: other robots of the tuning range, which no trial uses.

        Raises:
            ValueError: the range has not that many beside those of this set.
        """
        own = len(KINDS) * self.robots
        count = len(KINDS) * SECOND_FACTOR * self.robots
        offset = (self.offset + SECOND_OFFSET) % len(TUNING)
        # The second set ends at the range's end or, where it begins before this set, at this set.
        end = self.offset if offset < self.offset else len(TUNING)
        room = end - offset
        if count > room or self.offset + own > offset > self.offset:
            raise ValueError(
                f"the tuning range of {len(TUNING)} has no room for {own} seeds from {self.offset} on, of the trials, "
                f"and {count} from {offset} on, of the second set; take fewer robots, or the offset 0"
            )
        return replace(self, robots=SECOND_FACTOR * self.robots, offset=offset)

    def seeds(self) -> str:
        """Return the seeds of the runs, the end not included."""
        first = TUNING[self.offset]
        return f"{first}:{first + len(KINDS) * self.robots}"

    def runs(self) -> list[RunRequest]:
        """Return all runs, still without a controller, the robots of a world one after the other."""
        return list(_runs_of(self))

    def drawn(self, name: str, levels: Sequence[Any], count: int) -> list[Any]:
        """Return `count` levels, each as often as the others as far as possible, in an order drawn for this set."""
        order = named_generator(self.offset, name).permutation(count)
        return [levels[index % len(levels)] for index in order]

    def checked(self) -> list[int]:
        """Return the indices of a subset small enough for a test: two robots on moves, two on a circle."""
        curve = next(world for world, (task, _) in enumerate(KINDS) if task != MOVE)
        robots = range(min(2, self.robots))
        return [world * self.robots + robot for world in (0, curve) for robot in robots]


@cache  # it is asked for every point, and words of a mismatch may name files
def _runs_of(own: TuningSet) -> tuple[RunRequest, ...]:
    """Return the runs of a set; see `TuningSet.runs`."""
    count = len(KINDS) * own.robots
    seeds = tuning_seeds(count, own.offset)
    models = own.drawn("model", MODELS, count)
    level = {name: own.drawn(name, levels, len(KINDS)) for name, levels in LEVELS.items()}
    runs = []
    for plant in own.plants:
        known = flatten(find_plant(plant).config())
        for run, (seed, model) in enumerate(zip(seeds, models, strict=True)):
            world = run // own.robots
            task, varied = KINDS[world]
            # Rendered drives have no setting for their overshoot.
            drive = [
                (key, value)
                for key, value in level["drive"][world]
                if key.removeprefix("plant.") in known
            ]
            noise = ("noise", level["noise"][world])
            latency = ("latency", level["latency"][world])
            values = (*varied, *drive, noise, latency)
            mismatch = Mismatch.parse(model + level["detector"][world])
            runs.append(RunRequest(plant, "", task, mismatch, seed, values))
    return tuple(runs)


@dataclass(frozen=True)
class Trial:
    """A controller with the settings of its class that are to be scored."""

    controller: str
    config: Any

    def resolved(self, runs: Sequence[RunRequest]) -> list[ResolvedRun]:
        """Return runs of this trial, which share their settings; tuned values that are in use do not matter."""
        requests = [replace(run, controller=self.controller) for run in runs]
        given = Settings(TASKS)
        resolved = resolve_sections(requests, given) | {self.controller: self.config}
        sections = Sections(resolved, given, {})
        return [select(request, sections) for request in requests]

    def build(self, runs: Sequence[RunRequest]) -> None:
        """Build the first of some runs and throw it away; its networks are trained before workers need them.

        Raises:
            ConfigurationError: the settings cannot be used. Any other failure is left to the runs, whose cost says so.
        """
        build_once(self.resolved(runs[:1])[0])


def run_cost(task: str, row: Row) -> float:
    """Return the weighted cost of one run from its row of results; see the module's docstring."""
    weight = WEIGHTS[task]
    if row["status"] != COMPLETED:
        return weight * WORST
    if task == MOVE:
        return weight * min(float(row["log_error"]) / DECADES, WORST)
    decades = math.log10(max(row["rms_error_evaluated"] / FLOOR, 1.0))
    return weight * min(decades / DECADES, WORST)


def score(costs: Sequence[float]) -> float:
    """Return the score of a trial from the costs of its runs."""
    return float(np.mean(costs))


def evaluate(
    trials: Sequence[Trial], runs: Sequence[RunRequest], workers: Workers
) -> Iterator[tuple[int, int, float]]:
    """Carry out every run of every trial; yield indices of trial and run with each cost as it is known, in any order.

    Args:
        trials: the trials to score.
        runs: the runs of each.
        workers: the processes that carry them out.

    Raises:
        ConfigurationError: the worker processes cannot be started.
    """
    kinds: dict[Hashable, list[tuple[int, int, ResolvedRun]]] = {}
    for t, trial in enumerate(trials):
        for r, run in enumerate(trial.resolved(runs)):
            kinds.setdefault(side_by_side_key(run), []).append((t, r, run))
    jobs: list[Job] = []
    places: list[tuple[int, int]] = []  # indices of trial and run by the number of the job
    for kind, alike in kinds.items():
        for t, r, run in alike:
            jobs.append(Job(len(jobs), Cell(run.request), run, kind))
            places.append((t, r))
    own = offered([*(run.plant for run in runs), *(trial.controller for trial in trials)])
    blocks = cut(jobs, even_size(len(jobs), workers.count), 1, own)
    for block, outcome in carry_out_blocks(blocks, workers):
        for job, result in zip(block.jobs, outcome, strict=True):
            t, r = places[job.index]
            yield t, r, run_cost(runs[r].task, result.row)


SECOND = ".second"  # in the name of the ledger of the second set
Wanted: TypeAlias = tuple["Ledger", str, Section]
"""A point whose costs are wanted: the ledger that takes them, the controller, its nested settings."""
LEDGER = ".jsonl"
SHOWN = 60  # letters of wrong costs that a message holds


@final
class Ledger:
    """Costs by settings, each written down as soon as it is known."""

    def __init__(self, path: Path, fingerprint: Record) -> None:
        """Open a ledger, or prepare one where there is none; its file is made with the first point.

        Args:
            path: of the file.
            fingerprint: all that costs depend on besides the settings, as JSON has it.

        Raises:
            ConfigurationError: the file is no ledger, or that of something else.
        """
        self.path = path
        self._fingerprint = dict(fingerprint)
        self._costs: dict[str, list[float]] = {}
        self._size = 0  # [bytes] of its whole lines: a process that is killed or interrupted may leave half a line
        if not path.is_file():
            return
        wrong = OSError, KeyError, TypeError, OverflowError, RecursionError
        with configuration_errors(f"study {self.path} cannot be opened: ", *wrong):
            content = self.path.read_bytes()
            self._size = content.rfind(b"\n") + 1
            lines = [json.loads(line) for line in content[: self._size].splitlines()]
            header, *records = lines or [self._fingerprint]
            self._costs = {_key(record["settings"]): _costs(record["costs"]) for record in records}
        known = header if isinstance(header, dict) else {}
        others = [key for key, value in self._fingerprint.items() if known.get(key) != value]
        if others:
            parts = ", ".join(others)
            raise ConfigurationError(
                f"study {self.path} was made with other {parts}; name another folder with --out"
            )

    def best(self) -> float | None:
        """Return the least mean cost, or None while there is none."""
        return min((sum(costs) / len(costs) for costs in self._costs.values()), default=None)

    def costs(self, settings: Section) -> list[float] | None:
        """Return the costs of the runs under nested settings, or None if they are not known."""
        return self._costs.get(_key(settings))

    def add(self, settings: Section, costs: Sequence[float]) -> None:
        """Write the costs of the runs under nested settings down."""
        record = {"settings": settings, "costs": list(costs)}
        text = f"{json.dumps(record)}\n"
        if self._size == 0:
            text = f"{json.dumps(self._fingerprint)}\n{text}"
        with accessing(self.path, "study"), self.path.open("ab") as file:
            file.truncate(self._size)  # half a line of a killed process goes
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
            self._size = file.tell()
        self._costs[_key(settings)] = list(costs)


def _costs(given: object) -> list[float]:
    """Return the costs of a record; a ValueError if they are no numbers."""
    numbers = given if isinstance(given, list) else []
    if not numbers or not all(type(each) in (int, float) for each in numbers):
        raise ValueError(f"costs must be a list of numbers, got {str(given)[:SHOWN]}")
    return [float(each) for each in numbers]


def _key(settings: Section) -> str:
    return json.dumps(settings, sort_keys=True)


def open_ledger(folder: Path, controller: str, runs: TuningSet, kind: str = "") -> Ledger:
    """Return the ledger of a controller on a set of runs.

    Raises:
        ConfigurationError: the file is no ledger, or one of other settings or runs.
    """
    objective = {
        "KINDS": KINDS,
        "LEVELS": LEVELS,
        "MODELS": MODELS,
        "TASKS": TASKS,
        "FLOOR": FLOOR,
        "MIN_DELAY_MARGIN": MIN_DELAY_MARGIN,
        "WORST": WORST,
    }
    plants = Survey(plants=dict.fromkeys(runs.plants))
    files = named_files(plants, {}, offered(runs.plants))
    code = [each["sha256"] for _, each in plugins(plants)]
    defaults = find_tunable(controller).config()
    fingerprint = {
        "defaults": _written(flatten(defaults)),
        "objective": _written(objective),
        "run settings": _written(asdict(RunSettings())),
        "plants": [*runs.plants, *files.values(), *code],
        "robots": [runs.robots, runs.offset],
    }
    for own in offered([controller]):
        fingerprint["code of the controller"] = own.code
    return Ledger(folder / f"{file_stem(controller)}{kind}{LEDGER}", fingerprint)


def _written(values: Section) -> dict[str, str]:
    """Return values as texts that tell any two of them apart."""
    return {key: repr(value) for key, value in values.items()}


def fill(wanted: Sequence[Wanted], runs: TuningSet, workers: Workers) -> Iterator[str]:
    """Score the points that their ledgers lack, each once, and yield the controller of each as soon as it is written.

    Settings that cannot be built or whose loop bears no delay have the worst cost in every run, without a run.
    """
    requests = runs.runs()
    lacking = {}
    for ledger, name, nested in wanted:
        if ledger.costs(nested) is not None or f"{name}{nested}" in lacking:
            continue
        try:
            trial = Trial(name, apply_settings(find_tunable(name), nested))
            trial.build(requests)
            refused = not bears_delay(trial)
        except ConfigurationError:
            refused = True
        if refused:
            ledger.add(nested, [WEIGHTS[run.task] * WORST for run in requests])
            yield name
        else:
            lacking[f"{name}{nested}"] = ledger, trial, nested
    points = list(lacking.values())
    trials = [trial for _, trial, _ in points]
    costs = np.full((len(points), len(requests)), np.nan)
    for point_index, run_index, cost in evaluate(trials, requests, workers):
        costs[point_index, run_index] = cost
        if not np.isnan(costs[point_index]).any():
            ledger, trial, nested = points[point_index]
            ledger.add(nested, costs[point_index].tolist())
            yield trial.controller


def bears_delay(trial: Trial) -> bool:
    """Return whether the loop of a composed controller has the least delay margin, `MIN_DELAY_MARGIN`.

    A controller that identifies the delay changes its loop with it and is left to the runs; so is one whose loop cannot
    be analysed, and one of a user.
    """
    if offered([trial.controller]) or trial.config.aids.delay == "identified":
        return True
    try:
        return delay_margin(trial.config, trial.controller) >= MIN_DELAY_MARGIN
    except (ArithmeticError, ValueError, RunFault):  # it fails in the runs, too, whose cost says so
        return True
