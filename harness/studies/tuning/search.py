"""One study of one method: first points that are known to matter, trials of a sampler, then a coordinate search.

A study is a generator that yields the points whose scores it needs. Each trial's sampler is seeded by the study's seed
and the number of the trial, so that a study given the same scores asks for the same points: one that was interrupted is
repeated with the scores of the ledger up to where it stopped. There is no pruning.
"""

import math
import warnings
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import optuna
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.exceptions import ExperimentalWarning
from optuna.samplers import TPESampler

from servobench.controllers.controller import ControllerEntry
from servobench.harness.config.settings import apply_settings, flatten, tuned_settings
from servobench.harness.studies.tuning.spaces import (
    SPACES,
    Distribution,
    Point,
    Space,
    default_values,
    find_space,
    find_tunable,
    is_switch,
    nested_settings,
    values_of,
)
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.seeds import named_seed

STEP: Final = 0.2  # [1] share of a number by which it is changed
STEP_FROM_ZERO: Final = 0.05  # [1] share of the range's upper end by which a number of 0 is changed
ACCEPTED: Final = 0.005  # [1] share of the score that a change must gain to be kept


class Found(NamedTuple):
    """Where a coordinate search ended."""

    values: Point
    score: float
    evaluations: int  # requested points
    complete: bool  # whether no change improves the score; False: the budget ended first


@dataclass(frozen=True)
class StudyRecord:
    """The result of a study, as files of tuned values hold it."""

    seed: int  # of the sampler
    trials: int  # of the sampler, the first points included
    best_trial: int  # the number of the best one; 0 is that of the defaults
    best_trial_score: float
    search_points: int  # scored by the coordinate search that began there
    search_complete: bool  # whether no change of one value improves the score; False: its budget ended first
    score: float  # at its end
    second_score: float  # of the same settings on the second set; NaN until they are scored there
    settings: Mapping[str, Any]  # nested values


def study(
    name: str, space: Space, first: Sequence[Point], trials: int, search: int, seed: int
) -> Generator[Point, float, StudyRecord]:
    """Search for the best point of a space.

    Args:
        name: of the controller; with the seed it decides the draws of the sampler.
        space: where.
        first: points that are tried before the sampler is asked, the defaults first.
        trials: number of trials, the first points included; at least 1.
        search: most points that the coordinate search may ask for; 0 for none.
        seed: of the sampler.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampled = optuna.create_study(direction="minimize")
    tried: list[tuple[float, Point]] = []
    for number in range(trials):
        if number < len(first):
            sampled.enqueue_trial(dict(first[number]))
        sampled.sampler = _sampler(named_seed(seed, f"{name}, trial {number}"))
        with np.errstate(all="ignore"):  # the sampler's densities may underflow
            trial = sampled.ask(dict(space))
        score = yield trial.params
        tried.append((score, trial.params))
        sampled.tell(trial, score)
    best = min(range(trials), key=lambda number: tried[number][0])
    found = yield from coordinate_search(space, tried[best][1], tried[best][0], search)
    search_end = (found.evaluations, found.complete, found.score, math.nan, nested_settings(found.values))
    return StudyRecord(seed, trials, best, tried[best][0], *search_end)


def _sampler(seed: int) -> TPESampler:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        return TPESampler(seed=seed, multivariate=True)


def coordinate_search(space: Space, values: Point, score: float, budget: int) -> Generator[Point, float, Found]:
    """Improve a point: a generator that yields the points whose scores it needs, and returns the last one kept.

    Args:
        space: the values that may be changed, in the order in which it is tried.
        values: where to begin.
        score: of that point.
        budget: most points to ask for.
    """
    keys, at, idle, asked = list(space), 0, 0, 0
    seen = {str(nested_settings(values))}
    while idle < len(keys):
        key = keys[at % len(keys)]
        improved = False
        for other in changes(space[key], values[key]):
            candidate = {**values, key: other}
            if str(nested_settings(candidate)) in seen:
                continue
            if asked == budget:
                return Found(values, score, asked, complete=False)
            came = yield candidate
            asked += 1
            seen.add(str(nested_settings(candidate)))
            if came < (1.0 - ACCEPTED) * score:
                values, score, improved = candidate, came, True
                break
        idle = 0 if improved else idle + 1
        at += not improved
    return Found(values, score, asked, complete=True)


def changes(distribution: Distribution, value: Any) -> list[Any]:  # noqa: ANN401 - a number or a choice
    """Return the values that the search and the check try instead of `value`."""
    if isinstance(distribution, CategoricalDistribution):
        return [choice for choice in distribution.choices if choice != value]
    reached = [_step(distribution, value, sign) for sign in (1, -1)]
    return [other for other in dict.fromkeys(reached) if other != value]


def _step(distribution: FloatDistribution | IntDistribution, value: float, sign: int) -> float:
    size = STEP * abs(value) or STEP_FROM_ZERO * distribution.high
    if distribution.step is not None:
        size = distribution.step * max(1, round(size / distribution.step))
    moved = min(max(value + sign * size, distribution.low), distribution.high)
    return int(moved) if isinstance(distribution, IntDistribution) else moved


def neighbours(space: Space, values: Point) -> list[tuple[str, Point]]:
    """Return every point that differs from `values` by one change, with the key that is changed."""
    return [(key, {**values, key: other}) for key in space for other in changes(space[key], values[key])]


def first_points(name: str) -> list[Point]:
    """Return the points that every study of a controller tries first, each once.

    They are the defaults of its class, the tuned values in use, the defaults with each value of each switch, and the
    tuned values with those of other methods for the keys that both have.
    """
    entry, space = find_tunable(name), find_space(name)
    default = default_values(entry)
    own = tuned_point(entry) or default
    switches = [key for key in space if is_switch(space[key])]
    flips = [{**default, key: other} for key in switches for other in changes(space[key], default[key])]
    points = [default, own, *flips, *_borrowed(name, own)]
    return list({str(nested_settings(point)): point for point in points}.values())


def tuned_point(entry: ControllerEntry) -> Point | None:
    """Return the tuned values in use as a point of the controller's space; None if there are none that fit."""
    settings = tuned_settings(entry.name)
    if not settings:
        return None
    try:
        values = values_of(entry.name, apply_settings(entry, settings))
    except ConfigurationError:
        return None  # a file of an earlier version
    return inside(find_space(entry.name), values, default_values(entry))


def _borrowed(name: str, own: Point) -> Iterator[Point]:
    """Yield starting points that reuse another method's tuned values for shared settings."""
    space = find_space(name)
    for other in SPACES:
        settings = {} if other == name else tuned_settings(other)
        shared = {key: value for key, value in flatten(settings).items() if key in space}
        if shared:
            yield inside(space, {**own, **shared}, own)


def inside(space: Space, values: Point, otherwise: Point) -> Point:
    """Return `values` where they lie in the space; a number outside its range becomes the nearest end of the range."""
    return {key: _within(space[key], values[key], otherwise[key]) for key in space}


def _within(distribution: Distribution, value: Any, otherwise: Any) -> Any:  # noqa: ANN401 - a number or a choice
    if isinstance(distribution, CategoricalDistribution):
        return value if value in distribution.choices else otherwise
    within = min(max(value, distribution.low), distribution.high)
    if distribution.step is None:
        return within
    return type(within)(distribution.low + distribution.step * round((within - distribution.low) / distribution.step))
