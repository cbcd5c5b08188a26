"""All studies of all methods, advanced in step; the best of each method, chosen on other robots; and its check.

In each round every study asks for the one point that it needs next; all runs of the points that no ledger knows yet are
carried out by the workers, and the ledgers of their methods take the costs. Every decision is made in this process from
the ledgers alone: so the outcome is the same for any number of workers, and for a call that was interrupted and
repeated.

The check of tuned values: on the second set of robots no change of one value may improve the score by much. The changes
are those of the coordinate search: each other value of each switch, and 20 % more and less of each number.
"""

from __future__ import annotations

import json
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, final

from servobench.harness.batch.lock import LOCK
from servobench.harness.batch.sandbox import Workers
from servobench.harness.config.defaults import default_config, file_stem
from servobench.harness.studies.tuning.objective import TuningSet, score
from servobench.harness.studies.tuning.scoring import (
    LEDGER,
    SECOND,
    Ledger,
    Wanted,
    fill,
    open_ledger,
    refuse_broken_defaults,
)
from servobench.harness.studies.tuning.search import StudyOutcome, first_points, neighbours, study
from servobench.harness.studies.tuning.spaces import (
    Point,
    default_values,
    find_space,
    find_tunable,
    nested_settings,
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

    def __post_init__(self) -> None:
        """Refuse an unknown controller and one without a search space."""
        for name in self.controllers:
            find_tunable(name)


@final
class RunningStudy:
    """A study and where it stands.

    Attributes:
        seed: of its sampler.
        wanted: the point that it asks for; None once it has ended.
        asked: number of points that it was given the scores of.
        outcome: its result, once it has ended.
    """

    def __init__(self, seed: int, course: Generator[Point, float, StudyOutcome]) -> None:
        """Ask for the first point."""
        self.seed, self.asked = seed, 0
        self.outcome: StudyOutcome | None = None
        self._course = course
        self.wanted: Point | None = next(course)

    def advance(self, ledger: Ledger) -> None:
        """Go on up to a point that the ledger does not know, or to the end."""
        while self.wanted is not None and (costs := ledger.costs(nested_settings(self.wanted))) is not None:
            try:
                self.asked += 1
                self.wanted = self._course.send(score(costs))
            except StopIteration as end:
                self.wanted, self.outcome = None, end.value


@final
class Method:
    """A controller with its studies and the ledgers of both sets."""

    def __init__(self, folder: Path, name: str, plan: TuningPlan) -> None:
        """Open its ledgers.

        Raises:
            ConfigurationError: a file of the folder is no ledger, or one of other settings or runs.
        """
        self.name, self._plan, second = name, plan, plan.runs.second()
        self.ledger = open_ledger(folder, name, plan.runs)
        self.second = open_ledger(folder, name, second, SECOND)
        self.studies: list[RunningStudy] = []

    def begin(self) -> None:
        """Begin its studies."""
        plan, space, first = self._plan, find_space(self.name), first_points(self.name)
        seeds = range(plan.study_seed, plan.study_seed + plan.studies)
        self.studies = [
            RunningStudy(seed, study(self.name, space, first, plan.trials, plan.search, seed)) for seed in seeds
        ]

    @property
    def done(self) -> int:
        """Number of requested points, as if every finished study had used its whole budget."""
        whole = self._plan.trials + self._plan.search
        return sum(each.asked if each.outcome is None else whole for each in self.studies)

    def chosen(self) -> list[Point]:
        """Return the points to score on the second set: the defaults and the results of the studies; none before."""
        found = [each.outcome.found.values for each in self.studies if each.outcome is not None]
        return [default_values(find_tunable(self.name)), *found] if len(found) == len(self.studies) else []

    def result(self) -> TunedValues | None:
        """Return the tuned values; None while a study is not finished or not scored on the second set."""
        records = [record for each in self.studies if (record := self._record(each)) is not None]
        if len(records) < len(self.studies):
            return None
        best, runs = min(records, key=lambda record: record.second_score), self._plan.runs
        default = nested_settings(default_values(find_tunable(self.name)))
        mine, theirs = self.ledger.costs(best.settings), self.ledger.costs(default)
        on_second = self.second.costs(default)
        if mine is None or theirs is None or on_second is None:
            return None
        checked = runs.checked()
        return TunedValues(
            controller=self.name,
            robots=runs.robots,
            offset=runs.offset,
            plants=runs.plants,
            runs_a_trial=len(mine),
            runs_of_second_set=len(on_second),
            date=datetime.now(UTC).date().isoformat(),
            version=version("servobench"),
            score=score(mine),
            score_of_defaults=score(theirs),
            second_score=best.second_score,
            second_score_of_defaults=score(on_second),
            checked_score=score([mine[i] for i in checked]),
            checked_score_of_defaults=score([theirs[i] for i in checked]),
            settings=best.settings,
            studies=tuple(records),
        )

    def _record(self, running: RunningStudy) -> StudyRecord | None:
        if running.outcome is None:
            return None
        outcome, chosen = running.outcome, nested_settings(running.outcome.found.values)
        second = self.second.costs(chosen)
        if second is None:
            return None
        return StudyRecord(
            seed=running.seed,
            trials=outcome.trials,
            best_trial=outcome.best_trial,
            best_trial_score=outcome.best_trial_score,
            search_points=outcome.found.evaluations,
            search_complete=outcome.found.complete,
            score=outcome.found.score,
            second_score=score(second),
            settings=chosen,
        )


def check_study_folder(folder: Path) -> None:
    """Refuse a folder with other things than studies in it.

    Raises:
        ConfigurationError: names the folder.
    """
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else [folder.name] * folder.exists()
    if set(names) - {LOCK} and not any(name.endswith(LEDGER) for name in names):
        raise ConfigurationError(f"{folder} exists already and holds no study; name another folder with --out")


def open_methods(folder: Path, plan: TuningPlan) -> list[Method]:
    """Open the ledgers of a plan's methods and begin their studies.

    Raises:
        ConfigurationError: the folder has other things in it or cannot be made, or a ledger of it is another one.
    """
    check_study_folder(folder)
    make_folder(folder)
    methods = [Method(folder, name, plan) for name in plan.controllers]
    for method in methods:
        refuse_broken_defaults(method.name, plan.runs)
        method.begin()
    return methods


def make_folder(folder: Path) -> None:
    """Make the folder of studies.

    Raises:
        ConfigurationError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"study folder {folder} cannot be made: {error.strerror}") from error


def advance(methods: Sequence[Method], plan: TuningPlan, workers: Workers) -> Iterator[Method]:
    """Carry the studies out, and score those of a method on the second set as soon as all of them have ended.

    Yields:
        A method after each of its points.
    """
    by_name = {method.name: method for method in methods}
    under_way = True
    while under_way:
        wanted = _wanted(methods)
        under_way = bool(wanted)
        yield from methods
        chosen = [(method.second, method.name, point) for method in methods for point in method.chosen()]
        for points, runs in ((wanted, plan.runs), (chosen, plan.runs.second())):
            for name in fill(points, runs, workers):
                yield by_name[name]


def _wanted(methods: Sequence[Method]) -> list[Wanted]:
    wanted: list[Wanted] = []
    for method in methods:
        for each in method.studies:
            each.advance(method.ledger)
            if each.wanted is not None:
                wanted.append((method.ledger, method.name, each.wanted))
    return wanted


def write_results(folder: Path, methods: Sequence[Method]) -> Mapping[str, TunedValues]:
    """Write `NAME.toml` for every method whose studies are finished, and return their contents by name."""
    results = {method.name: tuned for method in methods if (tuned := method.result()) is not None}
    for name, tuned in results.items():
        write_tuned(folder / f"{file_stem(name)}.toml", tuned)
    return results


@dataclass(frozen=True)
class StudyRecord:
    """One of the studies of a method."""

    seed: int  # of the sampler
    trials: int  # of the sampler, known settings included
    best_trial: int  # the number of the best one; 0 is that of the defaults
    best_trial_score: float
    search_points: int  # scored by the coordinate search that began there
    search_complete: bool  # whether no change of one value improves the score; False: its budget ended first
    score: float  # at its end
    second_score: float  # of the same settings on the second set
    settings: Mapping[str, Any]  # nested values


@dataclass(frozen=True)
class TunedValues:
    """The results of all studies of a method; the best one on the second set is in use."""

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
    studies: tuple[StudyRecord, ...]  # empty for values that were found under another objective and only scored anew

    def tuning_set(self) -> TuningSet:
        """Return the runs on which the values were found."""
        return TuningSet(self.plants, self.robots, self.offset)


def write_tuned(path: Path, tuned: TunedValues) -> None:
    """Write the file atomically."""
    tables = ("settings", "studies")
    header = {item.name: getattr(tuned, item.name) for item in fields(tuned) if item.name not in tables}
    if not tuned.studies:
        header["studies"] = ()
    text = HEADING + _table("", header)
    text += _table("settings", tuned.settings)
    for record in tuned.studies:
        values = {item.name: getattr(record, item.name) for item in fields(record)}
        text += "\n[[studies]]\n" + _table("", {key: value for key, value in values.items() if key != "settings"})
        text += _table("studies.settings", record.settings)
    write_atomically(path, lambda partial: partial.write_text(text, encoding="utf-8"))


def _table(name: str, values: Mapping[str, Any]) -> str:
    plain = {key: value for key, value in values.items() if not isinstance(value, Mapping)}
    nested = {key: value for key, value in values.items() if isinstance(value, Mapping)}
    heading = f"\n[{name}]\n" if name and (plain or not nested) else ""
    lines = "".join(f"{key} = {_value(value)}\n" for key, value in plain.items())
    return heading + lines + "".join(_table(f"{name}.{key}", value) for key, value in nested.items())


def _value(value: object) -> str:
    """Return a number, a switch, a text or a list of these as TOML; JSON writes them in the same way."""
    return json.dumps(list(value) if isinstance(value, tuple) else value)


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

    def __init__(self, folder: Path, controllers: Sequence[str], runs: TuningSet, keys: Sequence[str] = ()) -> None:
        """Open the ledgers, in which a check goes on where it stopped.

        Args:
            folder: of the ledgers; made if needed.
            controllers: names of methods with a search space.
            runs: the runs on which changes are judged.
            keys: the keys that are changed; none for all.

        Raises:
            ConfigurationError: a name or a file that cannot be used.
        """
        make_folder(folder)
        self._runs = runs
        self._changes: list[tuple[Ledger, str, str, Point, Point]] = []
        for name in controllers:
            refuse_broken_defaults(name, runs)
            ledger = open_ledger(folder, name, runs, SECOND)
            space, values = find_space(name), values_of(name, default_config(find_tunable(name)))
            self._changes += [
                (ledger, name, key, values, other)
                for key, other in neighbours(space, values)
                if (not keys or key in keys) and nested_settings(other) != nested_settings(values)
            ]

    def __len__(self) -> int:
        """Return the number of points to score, those known already included."""
        return len(self._scored())

    def known(self) -> int:
        """Return how many of the points the ledgers know."""
        return sum(self._scored().values())

    def _scored(self) -> dict[str, bool]:
        """Return whether a point is known, for each."""
        points = [(ledger, name, nested_settings(point)) for ledger, name, point in self._points()]
        return {f"{name}{nested}": ledger.costs(nested) is not None for ledger, name, nested in points}

    def _points(self) -> list[Wanted]:
        return [(ledger, name, point) for ledger, name, _, *points in self._changes for point in points]

    def carry_out(self, workers: Workers) -> Iterator[str]:
        """Score the points that the ledgers lack, and yield the controller of each point."""
        yield from fill(self._points(), self._runs, workers)

    def changes(self) -> list[Change]:
        """Return every change whose scores are known."""
        known = []
        for ledger, name, key, values, other in self._changes:
            before, after = (ledger.costs(nested_settings(point)) for point in (values, other))
            if before is not None and after is not None:
                known.append(Change(name, key, values[key], other[key], score(before), score(after)))
        return known


def improvements(changes: Sequence[Change]) -> list[Change]:
    """Return the changes that gain more than the tolerance, the largest first."""
    return sorted((change for change in changes if change.gain > TOLERANCE), key=lambda change: -change.gain)
