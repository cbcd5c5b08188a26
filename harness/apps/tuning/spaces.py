"""The search spaces, for each controller its switches and its numbers with their ranges, and one study in them.

Ranges reach about a factor of ten around the defaults, or as far as a method allows; `log` ones are searched by factor.
Everything else keeps the default of its class, and is the same for all: limits, delays, period and the preview.

Every best equipped method has all words of the section `aids` as switches, but for those that its law brings itself,
and the same three numbers of the aids. The posture is no choice: a run of some seconds gains nothing by it, and without
it an arm drifts to its stops in half an hour. A delay or response that is given by a number is no choice: it would be a
guess where latencies differ. `NAME:published` has the numbers of its law as printed and of its estimator, and no aid.
A combination that cannot be built has the worst score without a run.

A number that a study leaves at an edge of its box is reported beside the tuned values, and the next study of the method
searches a box that is wider there (`widened`), unless the end is one of `LIMITS`.

The bounds `constant` and `calibrated` have their gains only, `nmpc_calibrated` has no space: by default it ignores
the camera, and tuned where its model of the delay is exact it gains nothing (0.071 against 0.072) and then cycles
around the target on the rendered plant, whose joints answer one period earlier.

A study tries first points that are known to matter, then trials of a sampler, then a coordinate search. It is a
generator that yields the points whose scores it needs. Each trial's sampler is seeded by the study's seed and the
number of the trial, so that a study given the same scores asks for the same points: one that was interrupted is
repeated with the scores of the ledger up to where it stopped. There is no pruning.
"""

import math
import warnings
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, TypeAlias

import numpy as np
import optuna
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.exceptions import ExperimentalWarning
from optuna.samplers import TPESampler

from servobench.controllers.aids import RANGES, SWITCHES, Switch, Tuned
from servobench.controllers.controller import ControllerEntry
from servobench.harness.config.registry import choose_controller, find_controller, offered
from servobench.harness.config.settings import (
    apply_settings,
    flatten,
    nest,
    tuned_settings,
)
from servobench.plant.contract.dependence import declared
from servobench.plant.contract.facts import read_beside
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import Record
from servobench.plant.contract.seeds import named_seed
from servobench.plant.contract.settings import Section, check_field, suggest

Distribution: TypeAlias = CategoricalDistribution | FloatDistribution | IntDistribution
Space: TypeAlias = Mapping[str, Distribution]
Point: TypeAlias = Mapping[str, Any]
"""A value for each key of a space."""

DIGITS = 3  # significant digits of a tuned number; no study is more precise
EDGE = 0.05  # [1] share of a box, by factor where it is searched so, within which a value is at its edge
WIDER = 4.0  # factor by which a box is widened; one with a linear scale gets as much again at its upper end
_TABLES = read_beside(__file__, "spaces.toml")
LIMITS: Mapping[str, float] = _TABLES["limits"]
"""Upper ends of boxes that are no choice; a lower end of 0, or of one step, is none either."""


def _aids() -> dict[str, Distribution]:
    """Return the boxes of the aids, as they are declared."""
    boxes: dict[str, Any] = {
        f"aids.{name}": CategoricalDistribution(aid.tuned)  # type: ignore[arg-type]
        for name, aid in SWITCHES.items()
        if aid.tuned
    }
    for name, each in RANGES.items():
        boxes[f"aids.{name}"] = FloatDistribution(each.low, each.high, log=each.log)
    return boxes


def _spaces() -> dict[str, Space]:
    """Return the search space of each method by its name."""
    parts = {"aids": _aids()}
    for part, boxes in _TABLES["parts"].items():
        parts[part] = {key: _box(given) for key, given in boxes.items()}
    spaces: dict[str, Space] = {}
    for name, method in _TABLES["methods"].items():
        space: dict[str, Distribution] = {}
        for part in method["parts"]:
            space |= parts[part]
        for key in method.get("without", ()):
            del space[key]
        spaces[name] = space
    return spaces


def _box(given: Any) -> Distribution:  # noqa: ANN401 - a table or a list of TOML
    """Return the box of a range, of whole numbers where its ends are such, or of choices."""
    if isinstance(given, list):
        return CategoricalDistribution(given)
    if isinstance(given["low"], int):
        return IntDistribution(**given)
    return FloatDistribution(**given)


SPACES: Mapping[str, Space] = _spaces()


def choose_tunable(word: str) -> str:
    """Return the name of a controller that has a search space, given its name or the place of a user's.

    Raises:
        ConfigurationError: as `find_space`, or code that cannot be used.
    """
    name = choose_controller(word)
    with configuration_errors("", NameError):  # types of settings are code of the user
        find_space(name)
    return name


def find_tunable(name: str) -> ControllerEntry:
    """Return the entry of a controller that has a search space.

    Raises:
        ConfigurationError: an unknown controller, or one without a space.
    """
    if name not in SPACES and not offered([name]):
        raise ConfigurationError(f"controller {name} has no search space: {suggest(name, SPACES)}")
    return find_controller(name)


def find_space(name: str) -> Space:
    """Return the search space of a controller, its switches first.

    Boxes of this package's are widened around the values in use; a user knows how far his own may reach.

    Raises:
        ConfigurationError: an unknown controller, or one without a space.
    """
    entry = find_tunable(name)
    if name in SPACES:
        space = widened(SPACES[name], flatten(tuned_settings(name)))
    else:
        space = declared_space(name, entry.config())
    if not space:
        raise ConfigurationError(
            f"controller {name} declares no range: write for instance gain: Annotated[float, servobench.Tuned(1, 20)] "
            "= 3.0 in the dataclass of its settings"
        )
    return {**_switches(space), **space}


def declared_space(name: str, config: Any) -> Space:  # noqa: ANN401 - any configuration dataclass
    """Return the search space that the types of settings declare: ranges of numbers, and aids that are switched on.

    Args:
        name: of the section, for messages.
        config: the default settings.

    Raises:
        ValueError: a range without the default, or one that the type of its field refuses.
    """
    kind: Any = type(config)
    ranges = declared(kind, Tuned)
    switches = declared(kind, Switch)
    space: dict[str, Distribution] = {}
    for field in fields(config):
        key = field.name
        value = getattr(config, key)
        if is_dataclass(value):
            inner = declared_space(f"{name}.{key}", value)
            space |= {f"{key}.{each}": box for each, box in inner.items()}
        elif key in switches and switches[key].tuned and value != field.default:
            space[key] = CategoricalDistribution(switches[key].tuned)
        elif key in ranges:
            space[key] = _declared_box(f"{name}.{key}", kind, key, value, ranges[key])
    return space


def _declared_box(name: str, kind: type, key: str, default: Any, given: Tuned) -> Distribution:  # noqa: ANN401 - any setting
    """Return the range of a field of a settings class; a ValueError if it does not fit the field."""
    if type(default) not in (int, float) or not given.low <= default <= given.high:
        raise ValueError(f"{name}: {given} must hold the default, a number; it is {default!r}")
    low, high = (check_field(name, kind, key, end) for end in (given.low, given.high))
    if type(low) is int:
        return IntDistribution(low, high, log=given.log)
    return FloatDistribution(low, high, log=given.log)


def _switches(space: Space) -> dict[str, CategoricalDistribution]:
    """Return the parameters of a space that are a choice, not a number."""
    return {
        key: choice for key, choice in space.items() if isinstance(choice, CategoricalDistribution)
    }


def _flips(space: Space, values: Point) -> Iterator[Point]:
    """Yield every point that differs from `values` by another choice of one switch."""
    for key, switch in _switches(space).items():
        for other in switch.choices:
            if other != values[key]:
                yield {**values, key: other}


def edges(space: Space, values: Point) -> dict[str, str]:
    """Return which numbers lie at an edge of their box, or beyond: by key the word lower or upper.

    Args:
        space: the boxes.
        values: of some of its keys.
    """
    found = {}
    for key, value in values.items():
        box = space.get(key)
        if box is None or isinstance(box, CategoricalDistribution):
            continue
        low, high, at = (math.log(each) if box.log else each for each in (box.low, box.high, value))
        share = (at - low) / (high - low)
        if share < EDGE and box.low > (box.step or 0.0):
            found[key] = "lower"
        elif share > 1.0 - EDGE and box.high < LIMITS.get(key, math.inf):
            found[key] = "upper"
    return found


def widened(space: Space, values: Point) -> Space:
    """Return the space with wider boxes for those of `values` that lie at an edge; see `edges`."""
    wider = dict(space)
    for key, end in edges(space, values).items():
        box: Any = space[key]
        low = min(box.low, values[key])
        high = max(box.high, values[key])
        if end == "upper":
            high = min(high * WIDER if box.log else 2 * high - low, LIMITS.get(key, math.inf))
        else:
            low = low / WIDER if box.step is None else max(2 * low - high, box.step)
        wider[key] = type(box)(low, high, log=box.log, step=box.step)
    return wider


def default_values(entry: ControllerEntry) -> Point:
    """Return the point of the search space that is the default of the controller's class, untuned."""
    return values_of(entry.name, entry.config())


def values_of(name: str, config: Any) -> Point:  # noqa: ANN401 - any configuration dataclass
    """Return the point of a controller's search space that its settings are."""
    flat = flatten(config)
    return {key: flat[key] for key in find_space(name)}


def nested_settings(values: Point) -> Record:
    """Return the nested settings of a point of a search space, numbers rounded to three digits."""
    rounded = {
        key: float(f"{each:.{DIGITS}g}") if isinstance(each, float) else each
        for key, each in values.items()
    }
    return nest(rounded)


@dataclass(frozen=True)
class StudyRecord:
    """The result of a study, as files of tuned values hold it."""

    seed: int  # seed of the sampler
    trials: int  # trials of the sampler, the first points included
    best_trial: int  # the number of the best one; 0 is that of the defaults
    score: float  # that trial's
    second_score: float  # score on the second set; NaN until the settings are scored there
    settings: Section  # nested values


def study(
    name: str, space: Space, first: Sequence[Point], trials: int, seed: int
) -> Generator[Point, float, StudyRecord]:
    """Search for the best point of a space.

    Args:
        name: of the controller; with the seed it decides the draws of the sampler.
        space: where.
        first: points that are tried before the sampler is asked, the defaults first.
        trials: number of trials, the first points included; at least 1.
        seed: of the sampler.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampled = optuna.create_study(direction="minimize")
    scores = []
    points = []
    for number in range(trials):
        if number < len(first):
            sampled.enqueue_trial(dict(first[number]))
        own_seed = named_seed(seed, f"{name}, trial {number}")
        with warnings.catch_warnings(action="ignore", category=ExperimentalWarning):
            sampled.sampler = TPESampler(seed=own_seed, multivariate=True)
        with np.errstate(all="ignore"):  # the sampler's densities may underflow
            trial = sampled.ask(dict(space))
        score = yield trial.params
        scores.append(score)
        points.append(trial.params)
        sampled.tell(trial, score)
    best = scores.index(min(scores))
    return StudyRecord(
        seed=seed,
        trials=trials,
        best_trial=best,
        score=scores[best],
        second_score=math.nan,
        settings=nested_settings(points[best]),
    )


def first_points(name: str) -> list[Point]:
    """Return the points that every study of a controller tries first, each once.

    They are the defaults of its class, the tuned values in use, the defaults with each value of each switch, and the
    tuned values with those of other methods for the keys that both have; of a user's, whose settings may have the names
    of ours and another meaning, for the aids alone.
    """
    entry = find_tunable(name)
    space = find_space(name)
    default = default_values(entry)
    own = tuned_point(entry)
    points = [default, own, *_flips(space, default)]
    common = [key for key in space if name in SPACES or key.startswith("aids.")]
    for other in SPACES:
        tuned = flatten(tuned_settings(other))
        shared = {key: tuned[key] for key in common if key in tuned}
        if shared and other != name:
            points.append(inside(space, {**own, **shared}, own))
    return list({str(nested_settings(point)): point for point in points}.values())


def tuned_point(entry: ControllerEntry) -> Point:
    """Return the tuned values in use as a point of the controller's space; the defaults if there are none that fit."""
    default = default_values(entry)
    settings = entry.tuned or tuned_settings(entry.name)
    if not settings:
        return default
    try:
        values = values_of(entry.name, apply_settings(entry, settings))
    except ConfigurationError:
        return default  # a file of an earlier version
    return inside(find_space(entry.name), values, default)


def inside(space: Space, values: Point, otherwise: Point) -> Point:
    """Return `values` where they lie in the space; a number outside its range becomes the nearest end of the range."""
    return {key: _within(space[key], values[key], otherwise[key]) for key in space}


def _within(distribution: Distribution, value: Any, otherwise: Any) -> Any:  # noqa: ANN401 - a number or a choice
    if isinstance(distribution, CategoricalDistribution):
        if value in distribution.choices:
            return value
        return otherwise
    within = min(max(value, distribution.low), distribution.high)
    if distribution.step is None:
        return within
    steps = round((within - distribution.low) / distribution.step)
    return type(within)(distribution.low + distribution.step * steps)
