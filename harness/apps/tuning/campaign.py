"""All studies of all methods, advanced in step; and the best of each method, chosen on other robots.

In each round every study asks for the one point that it needs next; all runs of the points that no ledger knows yet are
carried out by the workers, and the ledgers of their methods take the costs. Every decision is made in this process from
the ledgers alone: so the outcome is the same for any number of workers, and for a call that was interrupted and
repeated.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, final

from servobench.harness.apps.tuning.objective import (
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
from servobench.harness.apps.tuning.spaces import (
    Point,
    StudyRecord,
    default_values,
    edges,
    find_space,
    find_tunable,
    first_points,
    nested_settings,
    study,
    tuned_point,
)
from servobench.harness.batch.isolation import Workers
from servobench.harness.batch.lock import LOCK
from servobench.harness.config.description import toml
from servobench.harness.config.installation import read_checkout
from servobench.harness.config.registry import offered
from servobench.harness.config.settings import default_config, file_stem, flatten
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import accessing, write_text
from servobench.plant.contract.settings import Count, Periods, Section, settings

HEADING = "# Tuned values, made by `servobench tune`: the table [settings] replaces defaults. Scores: less is better.\n"


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
        self.wanted: Section | None = nested_settings(next(course))

    def advance(self, ledger: Ledger) -> None:
        """Go on up to a point that the ledger does not know, or to the end."""
        while self.wanted is not None and (costs := ledger.costs(self.wanted)) is not None:
            try:
                self.asked += 1
                self.wanted = nested_settings(self._course.send(score(costs)))
            except StopIteration as end:
                self.wanted = None
                self.outcome = end.value


@final
class Method:
    """A controller with its studies and the ledgers of both sets."""

    def __init__(self, folder: Path, name: str, plan: TuningPlan) -> None:
        """Open its ledgers and begin its studies.

        Raises:
            ConfigurationError: a file of the folder is no ledger, or one of other settings or runs.
        """
        self.name = name
        self._plan = plan
        self.ledger = open_ledger(folder, name, plan.runs)
        self.second = open_ledger(folder, name, plan.runs.second(), SECOND)
        entry = find_tunable(name)
        self._default = nested_settings(default_values(entry))
        self._known = [self._default, nested_settings(tuned_point(entry))]
        space = find_space(name)
        first = first_points(name)
        self.studies = []
        for seed in range(plan.study_seed, plan.study_seed + plan.studies):
            course = study(name, space, first, plan.trials, seed)
            self.studies.append(RunningStudy(course))

    @property
    def done(self) -> int:
        """Number of points that its studies were given the scores of."""
        return sum(each.asked for each in self.studies)

    def wanted(self) -> list[Wanted]:
        """Return the points that its studies ask for, after they went on as far as the ledger knows."""
        wanted = []
        for each in self.studies:
            each.advance(self.ledger)
            if each.wanted is not None:
                wanted.append((self.ledger, self.name, each.wanted))
        return wanted

    def wanted_on_second(self) -> list[Wanted]:
        """Return the points to score on the second set, once all studies have ended: their results and known values."""
        outcomes = self._outcomes()
        if len(outcomes) < len(self.studies):
            return []
        points = [*self._scored(), *(each.settings for each in outcomes)]
        return [(self.second, self.name, point) for point in points]

    def _outcomes(self) -> list[StudyRecord]:
        """Return the results of the studies that have ended."""
        return [each.outcome for each in self.studies if each.outcome is not None]

    def _scored(self) -> list[Section]:
        """Return the defaults and the values in use, as far as they were scored: a study may have a single trial."""
        return [each for each in self._known if self.ledger.costs(each) is not None]

    def result(self) -> TunedValues | None:
        """Return the tuned values; None while a study is not finished or not scored on the second set.

        They are the best ones on the second set: of a study, the defaults, or the values in use so far.
        """
        outcomes = self._outcomes()
        if len(outcomes) < len(self.studies):
            return None
        candidates = [*(each.settings for each in outcomes), *self._scored()]
        second_costs = [each for each in map(self.second.costs, candidates) if each is not None]
        if len(second_costs) < len(candidates):
            return None
        second_scores = [score(each) for each in second_costs]
        best = candidates[second_scores.index(min(second_scores))]
        own = self.ledger.costs(best)
        of_defaults = self.ledger.costs(self._default)
        second_of_defaults = self.second.costs(self._default)
        if own is None or of_defaults is None or second_of_defaults is None:
            return None
        plan = self._plan
        runs = plan.runs
        checked = runs.checked()
        seeds = runs.seeds(), runs.second().seeds()
        records = [
            replace(each, second_score=second)
            for each, second in zip(outcomes, second_scores, strict=False)
        ]
        return TunedValues(
            controller=self.name,
            **asdict(runs),
            runs_a_trial=len(own),
            runs_of_second_set=len(second_of_defaults),
            date=datetime.now(UTC).date().isoformat(),
            version=version("servobench"),
            commit=read_checkout()[0] or "unknown",
            seeds=seeds,
            budget=f"{plan.studies} × {plan.trials} trials on robots {' and '.join(seeds)}",
            sha256="".join(own.code for own in offered([self.name])),
            score=score(own),
            score_of_defaults=score(of_defaults),
            second_score=min(second_scores),
            second_score_of_defaults=score(second_of_defaults),
            checked_score=score([own[i] for i in checked]),
            checked_score_of_defaults=score([of_defaults[i] for i in checked]),
            settings=best,
            studies=tuple(records),
            edges=edge_lines(self.name, best),
        )


def check_study_folder(folder: Path) -> None:
    """Refuse a folder with other things than studies in it.

    Raises:
        ConfigurationError: names the folder.
    """
    names = []
    if folder.is_dir():
        names = [path.name for path in folder.iterdir()]
    elif folder.exists():
        names = [folder.name]
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
        config = default_config(find_tunable(method.name))
        Trial(method.name, config).build(plan.runs.runs())
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
        for name in fill(wanted, plan.runs, workers):
            yield by_name[name]
        for name in fill(chosen, plan.runs.second(), workers):
            yield by_name[name]


def write_results(folder: Path, methods: Sequence[Method]) -> Mapping[str, TunedValues]:
    """Return the results of every method whose studies are finished by its name, and write them.

    Those of a controller of the user go beside its code, those of the others into the folder, `NAME.toml`. Results
    without a run that ended well are of no use and not written.
    """
    results = {}
    for method in methods:
        tuned = method.result()
        if tuned is not None:
            results[method.name] = tuned
    for name, tuned in results.items():
        path = folder / f"{file_stem(name)}.toml"
        for own in offered([name]):
            path = own.tuned_path
        if not tuned.lost:
            write_tuned(path, tuned)
    return results


@dataclass(frozen=True)
class TunedValues:
    """The results of all studies of a method, and the values that were best on the second set."""

    controller: str
    plants: tuple[str, ...]  # plants on which the runs took place
    robots: int  # robots under each condition (`--robots`)
    offset: int  # where in the tuning range the seeds begin (`--offset`)
    runs_a_trial: int
    runs_of_second_set: int
    date: str  # day on which the file was written, UTC
    version: str  # servobench's version
    score: float  # score of these values
    score_of_defaults: float  # score of the defaults of the controller's class
    second_score: float  # score of these values on the second set of robots
    second_score_of_defaults: float
    checked_score: float  # score of these values on the subset `TuningSet.checked`
    checked_score_of_defaults: float
    settings: Section  # nested values
    # Empty for values that were found under another objective and only scored anew.
    studies: tuple[StudyRecord, ...]
    # A line for each number at an edge of its box, which is wider in the next study
    edges: tuple[str, ...] = ()
    seeds: tuple[str, ...] = ()  # robots of the trials and of the second set
    budget: str = ""  # studies × trials, and the seeds
    commit: str = "unknown"  # servobench's
    sha256: str = ""  # a user's code; empty for a controller of this package

    @property
    def lost(self) -> bool:
        """Whether every run has the worst cost, also with the best values."""
        return math.isclose(self.second_score, WORST)


def edge_lines(name: str, nested: Section) -> tuple[str, ...]:
    """Return a line for each of a controller's numbers that lies at an edge of the box in which it was searched."""
    values = flatten(nested)
    boxes: dict[str, Any] = dict(find_space(name))
    lines = []
    for key, end in edges(boxes, values).items():
        lines.append(
            f"{key} = {values[key]:.4g} is at the {end} edge of {boxes[key].low:g} to {boxes[key].high:g}"
        )
    return tuple(lines)


def write_tuned(path: Path, tuned: TunedValues) -> None:
    """Write the file atomically."""
    values = asdict(tuned)
    records = values.pop("studies")
    if not records:
        values["studies"] = ()
    text = HEADING + _table(values)
    for record in records:
        text += _table(record, "studies.", "\n[[studies]]\n")
    with accessing(path, "tuned values"):
        write_text(path, text)


def _table(values: Section, before: str = "", heading: str = "") -> str:
    """Return a table in TOML, those in it after its own values; `before` stands before their names."""
    lines = ""
    tables = ""
    for key, value in values.items():
        if isinstance(value, Mapping):
            name = f"{before}{key}"
            tables += _table(value, f"{name}.", f"\n[{name}]\n")
        else:
            lines += f"{key} = {toml(value)}\n"
    if tables and not lines:  # TOML needs no heading of a table that only holds tables
        return tables
    return heading + lines + tables
