"""All studies of all methods, advanced in step; the best of each method, chosen on other robots; and its check.

In each round every study asks for the one point that it needs next; all runs of the points that no ledger knows yet are
carried out by the workers, and the ledgers of their methods take the costs. Every decision is made in this process from
the ledgers alone: so the outcome is the same for any number of workers, and for a call that was interrupted and
repeated.

The check of tuned values: on the second set of robots no change of one value may improve the score by much. The changes
are those of the coordinate search: each other value of each switch, and 20 % more and less of each number.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, final

from servobench.harness.batch.lock import LOCK
from servobench.harness.batch.sandbox import Workers
from servobench.harness.config.description import toml
from servobench.harness.config.settings import default_config, file_stem, flatten
from servobench.harness.studies.tuning.objective import (
    LEDGER,
    SECOND,
    WORST,
    Ledger,
    Trial,
    TuningSet,
    Wanted,
    fill,
    open_ledger,
    score,
)
from servobench.harness.studies.tuning.spaces import (
    Point,
    StudyRecord,
    default_values,
    edges,
    find_space,
    find_tunable,
    first_points,
    neighbours,
    nested_settings,
    study,
    tuned_point,
    values_of,
)
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import write_atomically
from servobench.plant.contract.settings import Count, Periods, settings

HEADING = "# Tuned values, made by `servobench tune`: the table [settings] replaces defaults. Scores: less is better.\n"
TOLERANCE: Final = 0.03  # [1] share of the score by which no change may improve it


@settings
class TuningPlan:
    """The settings of a tuning campaign."""

    controllers: tuple[str, ...]
    """names with a search space"""
    trials: Count
    """of the sampler in each study, that of the defaults and of other known settings included"""
    runs: TuningSet
    """on which a point is scored"""
    studies: Count = 3
    """of each method, with samplers of their own"""
    search: Periods = 100
    """most points of the coordinate search that ends a study"""
    study_seed: Periods = 0
    """seed of the first study's sampler; the others count on from it"""


@final
class RunningStudy:
    """A study and where it stands.

    Attributes:
        wanted: the nested settings that it asks for; None once it has ended.
        asked: number of points that it was given the scores of.
        outcome: its result, once it has ended.
    """

    def __init__(self, course: Generator[Point, float, StudyRecord]) -> None:
        """Ask for the first point."""
        self.asked = 0
        self.outcome: StudyRecord | None = None
        self._course = course
        self.wanted: Mapping[str, Any] | None = nested_settings(next(course))

    def advance(self, ledger: Ledger) -> None:
        """Go on up to a point that the ledger does not know, or to the end."""
        while self.wanted is not None and (costs := ledger.costs(self.wanted)) is not None:
            try:
                self.asked += 1
                self.wanted = nested_settings(self._course.send(score(costs)))
            except StopIteration as end:
                self.wanted, self.outcome = None, end.value


@final
class Method:
    """A controller with its studies and the ledgers of both sets."""

    def __init__(self, folder: Path, name: str, plan: TuningPlan) -> None:
        """Open its ledgers and begin its studies.

        Raises:
            ConfigurationError: a file of the folder is no ledger, or one of other settings or runs.
        """
        self.name, self._plan = name, plan
        self.ledger = open_ledger(folder, name, plan.runs)
        self.second = open_ledger(folder, name, plan.runs.second(), SECOND)
        entry = find_tunable(name)
        self._default = nested_settings(default_values(entry))
        self._known = [self._default, nested_settings(tuned_point(entry))]
        space, first = find_space(name), first_points(name)
        seeds = range(plan.study_seed, plan.study_seed + plan.studies)
        self.studies = [
            RunningStudy(study(name, space, first, plan.trials, plan.search, seed))
            for seed in seeds
        ]

    @property
    def done(self) -> int:
        """Number of requested points, as if every finished study had used its whole budget."""
        whole = self._plan.trials + self._plan.search
        return sum(each.asked if each.outcome is None else whole for each in self.studies)

    def wanted(self) -> list[Wanted]:
        """Return the points that its studies ask for, after they went on as far as the ledger knows."""
        for each in self.studies:
            each.advance(self.ledger)
        return [
            (self.ledger, self.name, each.wanted)
            for each in self.studies
            if each.wanted is not None
        ]

    def wanted_on_second(self) -> list[Wanted]:
        """Return the points to score on the second set, once all studies have ended: their results and known values."""
        outcomes = [each.outcome for each in self.studies if each.outcome is not None]
        points = (
            [*self._scored(), *(each.settings for each in outcomes)]
            if len(outcomes) == len(self.studies)
            else []
        )
        return [(self.second, self.name, point) for point in points]

    def _scored(self) -> list[Mapping[str, Any]]:
        """Return the defaults and the values in use, as far as they were scored: a study may have a single trial."""
        return [each for each in self._known if self.ledger.costs(each) is not None]

    def result(self) -> TunedValues | None:
        """Return the tuned values; None while a study is not finished or not scored on the second set.

        They are the best ones on the second set: of a study, the defaults, or the values in use so far.
        """
        outcomes = [each.outcome for each in self.studies if each.outcome is not None]
        candidates = [*(each.settings for each in outcomes), *self._scored()]
        costs = [each for each in map(self.second.costs, candidates) if each is not None]
        if len(outcomes) < len(self.studies) or len(costs) < len(candidates):
            return None
        mean = [score(each) for each in costs]
        best, runs = candidates[mean.index(min(mean))], self._plan.runs
        mine, theirs = self.ledger.costs(best), self.ledger.costs(self._default)
        on_second = self.second.costs(self._default)
        if mine is None or theirs is None or on_second is None:
            return None
        checked = runs.checked()
        return TunedValues(
            controller=self.name,
            **asdict(runs),
            runs_a_trial=len(mine),
            runs_of_second_set=len(on_second),
            date=datetime.now(UTC).date().isoformat(),
            version=version("servobench"),
            score=score(mine),
            score_of_defaults=score(theirs),
            second_score=min(mean),
            second_score_of_defaults=score(on_second),
            checked_score=score([mine[i] for i in checked]),
            checked_score_of_defaults=score([theirs[i] for i in checked]),
            settings=best,
            studies=tuple(replace(each, second_score=mean[i]) for i, each in enumerate(outcomes)),
            edges=edge_lines(self.name, best),
        )


def check_study_folder(folder: Path) -> None:
    """Refuse a folder with other things than studies in it.

    Raises:
        ConfigurationError: names the folder.
    """
    names = (
        [path.name for path in folder.iterdir()]
        if folder.is_dir()
        else [folder.name] * folder.exists()
    )
    if set(names) - {LOCK} and not any(name.endswith(LEDGER) for name in names):
        raise ConfigurationError(
            f"{folder} exists already and holds no study; name another folder with --out"
        )


def open_methods(folder: Path, plan: TuningPlan) -> list[Method]:
    """Open the ledgers of a plan's methods and begin their studies.

    Raises:
        ConfigurationError: a ledger of the folder is another one, or a method cannot be built.
    """
    methods = [Method(folder, name, plan) for name in plan.controllers]
    for method in methods:  # an error that no setting can cure is reported before any run
        Trial(method.name, default_config(find_tunable(method.name))).build(plan.runs.runs())
    return methods


def advance(methods: Sequence[Method], plan: TuningPlan, workers: Workers) -> Iterator[Method]:
    """Carry the studies out, and score those of a method on the second set as soon as all of them have ended.

    Yields:
        A method after each of its points.
    """
    by_name = {method.name: method for method in methods}
    under_way = True
    while under_way:
        wanted = [point for method in methods for point in method.wanted()]
        under_way = bool(wanted)
        yield from methods
        chosen = [point for method in methods for point in method.wanted_on_second()]
        for points, runs in ((wanted, plan.runs), (chosen, plan.runs.second())):
            for name in fill(points, runs, workers):
                yield by_name[name]


def write_results(folder: Path, methods: Sequence[Method]) -> Mapping[str, TunedValues]:
    """Return the results of every method whose studies are finished by its name, and write them, `NAME.toml`.

    Results without a run that ended well are of no use and not written.
    """
    results = {method.name: tuned for method in methods if (tuned := method.result()) is not None}
    for name, tuned in results.items():
        if not tuned.lost:
            write_tuned(folder / f"{file_stem(name)}.toml", tuned)
    return results


@dataclass(frozen=True)
class TunedValues:
    """The results of all studies of a method, and the values that were best on the second set."""

    controller: str
    plants: tuple[str, ...]  # on which the runs took place
    robots: int  # under each condition (`--robots`)
    offset: int  # of the seeds in the tuning range (`--offset`)
    runs_a_trial: int
    runs_of_second_set: int
    date: str  # day on which the file was written, UTC
    version: str  # of servobench
    score: float  # of these values
    score_of_defaults: float  # of the defaults of the controller's class
    second_score: float  # of these values on the second set of robots
    second_score_of_defaults: float
    checked_score: float  # of these values on the subset `TuningSet.checked`
    checked_score_of_defaults: float
    settings: Mapping[str, Any]  # nested values
    studies: tuple[
        StudyRecord, ...
    ]  # empty for values that were found under another objective and only scored anew
    edges: tuple[
        str, ...
    ] = ()  # a line for each number at an edge of its box, which is wider in the next study

    @property
    def lost(self) -> bool:
        """Whether every run has the worst cost, also with the best values."""
        return math.isclose(self.second_score, WORST)


def edge_lines(name: str, nested: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a line for each of a controller's numbers that lies at an edge of the box in which it was searched."""
    values, boxes = flatten(nested), dict[str, Any](find_space(name))
    ends = ((key, end, boxes[key]) for key, end in edges(boxes, values).items())
    return tuple(
        f"{key} = {values[key]:.4g} is at the {end} edge of {b.low:g} to {b.high:g}"
        for key, end, b in ends
    )


def write_tuned(path: Path, tuned: TunedValues) -> None:
    """Write the file atomically."""
    values = asdict(tuned)
    records = values.pop("studies")
    text = HEADING + _table(values if records else {**values, "studies": ()})
    text += "".join(_table(record, "studies.", "\n[[studies]]\n") for record in records)
    write_atomically(path, lambda file: file.write_text(text, encoding="utf-8"))


def _table(values: Mapping[str, Any], before: str = "", heading: str = "") -> str:
    """Return a table in TOML, those in it after its own values; `before` stands before their names."""
    nested = {key: value for key, value in values.items() if isinstance(value, Mapping)}
    lines = "".join(
        f"{key} = {toml(value)}\n" for key, value in values.items() if key not in nested
    )
    tables = (
        _table(value, f"{before}{key}.", f"\n[{before}{key}]\n") for key, value in nested.items()
    )
    return heading * bool(lines or not nested) + lines + "".join(tables)


@dataclass(frozen=True)
class Change:
    """A change of one value of a method's settings in use, and its effect on the score."""

    controller: str
    key: str
    before: Any
    after: Any
    score_before: float
    score_after: float

    @property
    def gain(self) -> float:
        """Share of the score that the change gains; negative if it loses."""
        return 1.0 - self.score_after / self.score_before


class Check:
    """The settings in use of some methods with all their changes, on one set of runs."""

    def __init__(self, folder: Path, controllers: Sequence[str], runs: TuningSet) -> None:
        """Open the ledgers, in which a check goes on where it stopped.

        Args:
            folder: of the ledgers.
            controllers: names of methods with a search space.
            runs: the runs on which changes are judged.

        Raises:
            ConfigurationError: a name or a file that cannot be used.
        """
        self._runs = runs
        self._changes: list[tuple[Ledger, list[dict[str, Any]], partial[Change]]] = []
        points: dict[str, Wanted] = {}
        for name in controllers:
            config = default_config(find_tunable(name))
            Trial(name, config).build(runs.runs())
            ledger = open_ledger(folder, name, runs, SECOND)
            space, values = find_space(name), values_of(name, config)
            for key, other in neighbours(space, values):
                both = [nested_settings(values), nested_settings(other)]
                if both[0] != both[1]:
                    self._changes.append(
                        (ledger, both, partial(Change, name, key, values[key], other[key]))
                    )
                    points |= {f"{name}{each}": (ledger, name, each) for each in both}
        self._points = list(points.values())

    def __len__(self) -> int:
        """Return the number of points to score, those known already included."""
        return len(self._points)

    def known(self) -> int:
        """Return how many of the points the ledgers know."""
        return sum(ledger.costs(point) is not None for ledger, _, point in self._points)

    def carry_out(self, workers: Workers) -> Iterator[str]:
        """Score the points that the ledgers lack, and yield the controller of each point."""
        yield from fill(self._points, self._runs, workers)

    def changes(self) -> list[Change]:
        """Return every change whose scores are known."""
        known = [
            (change, ledger.costs(both[0]), ledger.costs(both[1]))
            for ledger, both, change in self._changes
        ]
        return [
            change(score(before), score(after))
            for change, before, after in known
            if before and after
        ]


def improvements(changes: Sequence[Change]) -> list[Change]:
    """Return the changes that gain more than the tolerance, the largest first."""
    return sorted(
        (change for change in changes if change.gain > TOLERANCE), key=lambda change: -change.gain
    )
