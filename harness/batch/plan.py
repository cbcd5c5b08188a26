"""Plans of batches: the runs of a comparison and of a sweep, made when they are needed, and the purposes of seeds.

A run's seed decides its true robot, its task and its noise. Methods are tuned on the seeds `TUNING` and judged on all
others, so that no method is judged by a robot on which it was tuned.
"""

from __future__ import annotations

import hashlib
import math
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from textwrap import shorten
from typing import Any, Generic, Self, TypeVar, overload

import numpy as np

from servobench.harness.config.registry import find_plant
from servobench.harness.config.settings import TUNING, TUNING_WORDS
from servobench.harness.run.request import RunRequest
from servobench.harness.run.variations import SHORT_NAMES, Row, Value, Varied
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import parse_toml, split_words
from servobench.plant.contract.settings import listed, remark
from servobench.plant.contract.units import UNITS, in_own_unit, split_quantity
from servobench.plant.robot.catalogue import DEFAULT_ROBOT
from servobench.plant.robot.mismatch import Magnitude, Mismatch, parse_magnitudes, parse_range

DEFAULT_MISMATCH = "moderate"  # On plants with robots of their own it stands for none.
MAX_SEEDS = 1_000_000  # seeds of a batch
MAX_SEED = 2**63 - 1  # which the tables hold
MAX_SHOWN = 200  # [characters] length of a given text in a message


@dataclass(frozen=True)
class Batch:
    """All combinations of these."""

    plants: tuple[str, ...]
    controllers: tuple[str, ...]
    tasks: tuple[str, ...]
    mismatches: tuple[str, ...]
    seeds: Sequence[int]
    robot: str = DEFAULT_ROBOT
    """a name or the path of a file; all runs of a batch have one"""
    sensings: tuple[str, ...] = (DEFAULT_SENSING,)
    first_seed_on: tuple[str, ...] = ()
    """further plants, which take the first seed only"""

    def requests(self) -> Sequence[RunRequest]:
        """Return the runs, seeds varying fastest; last those of the first seed only."""
        runs = self._grid(self.plants, self.seeds)
        if not self.first_seed_on:
            return runs
        return [*runs, *self._grid(self.first_seed_on, self.seeds[:1])]

    def _grid(self, plants: Sequence[str], seeds: Sequence[int]) -> Grid[RunRequest]:
        is_default = self.mismatches == (DEFAULT_MISMATCH,)
        own = {plant for plant in plants if is_default and find_plant(plant).own_robot}

        def first_run(
            sensing: str, plant: str, task: str, mismatch: Mismatch, controller: str
        ) -> RunRequest:
            if plant in own:
                remark(
                    f"plant {plant} has a robot of its own: the mismatch moderate stands for none there"
                )
                mismatch = Mismatch()
            return RunRequest(
                plant, controller, task, mismatch, seeds[0], robot=self.robot, sensing=sensing
            )

        mismatches = [Mismatch.parse(text) for text in self.mismatches]
        runs = Grid(first_run, self.sensings, plants, self.tasks, mismatches, self.controllers)
        return Grid(RunRequest.with_seed, runs, seeds)


def parse_seeds(text: str) -> Sequence[int]:
    """Return the seeds that `text` names: a count `5`, a list `3,1,4`, or a range `100:120` (end not included).

    Raises:
        ConfigurationError: none of these, or seeds that a batch cannot have.
    """
    came = f"got {shorten(repr(text), MAX_SHOWN, placeholder=' ...')}"
    try:
        if ":" in text:
            begin, end = (int(part) for part in text.split(":"))
            seeds: Sequence[int] = range(begin, max(begin, end))
        elif "," in text:
            seeds = tuple(int(part) for part in text.split(",") if part.strip())
        else:
            seeds = range(max(0, int(text)))
    except ValueError as error:
        raise ConfigurationError(
            f"seeds must be a count (5), a list (3,1,4) or a range (100:120), {came}"
        ) from error
    return check_seeds(seeds, came)


def check_seeds(seeds: Sequence[int], came: str) -> Sequence[int]:
    """Return seeds that a batch can have.

    Args:
        seeds: to check.
        came: end of the message, with the text that named them.

    Raises:
        ConfigurationError: none, too many, one negative, too large or named twice.
    """
    if isinstance(seeds, range):
        # len() ends at 2**63
        first, last, size = (seeds.start, seeds.stop - 1, seeds.stop - seeds.start)
    else:
        first, last, size = min(seeds, default=-1), max(seeds, default=-1), len(seeds)
    if first < 0 or last < first:
        raise ConfigurationError(
            f"seeds must name at least one seed, none of them negative; {came}"
        )
    if last > MAX_SEED:
        raise ConfigurationError(f"seeds must be at most {MAX_SEED}, {came}")
    if size > MAX_SEEDS:
        raise ConfigurationError(
            f"seeds must name at most {MAX_SEEDS:,}, {came}; use several folders for more"
        )
    for seed, count in Counter(seeds).items() if isinstance(seeds, tuple) else ():
        if count > 1:
            raise ConfigurationError(f"seeds name {seed} twice, {came}")
    return seeds


def tuning_seeds(count: int, offset: int = 0) -> tuple[int, ...]:
    """Return `count` seeds of the tuning range that begin `offset` after its first.

    Raises:
        ConfigurationError: fewer than one, or some of them outside the range.
    """
    if count < 1:
        raise ConfigurationError(f"the number of tuning seeds must be at least 1, got {count}")
    if offset < 0 or offset + count > len(TUNING):
        raise ConfigurationError(
            f"{count} seeds from {TUNING.start + offset} on leave the tuning range {TUNING_WORDS}; "
            f"count and offset must not be negative and together at most {len(TUNING)}"
        )
    return tuple(TUNING[offset : offset + count])


def refuse_tuning_seeds(seeds: Iterable[int]) -> None:
    """Refuse to judge methods by robots on which they were tuned.

    Raises:
        ConfigurationError: names the first seed of the tuning range and says which to take instead.
    """
    if found := [seed for seed in seeds if seed in TUNING]:
        raise ConfigurationError(
            f"seed {listed(list(map(str, found)), 1)} cannot be used to judge: {TUNING_WORDS} are kept for tuning; "
            f"take seeds below {TUNING.start} or from {TUNING.stop} on"
        )


@dataclass(frozen=True)
class Cell:
    """A run and its further columns in the table of runs."""

    request: RunRequest
    columns: Row = field(
        default_factory=dict
    )  # such as the place along the axis that a sweep varies
    picture: bool = False  # keep the last picture of the camera


Entry_co = TypeVar("Entry_co", covariant=True)


class Grid(Sequence[Entry_co], Generic[Entry_co]):
    """All combinations of the values of some axes, the last axis varying fastest."""

    def __init__(self, make: Callable[..., Entry_co], *axes: Sequence[Any]) -> None:
        """Plan the combinations.

        Args:
            make: returns an entry from a value of each axis.
            axes: the values of each axis; another grid can be one.
        """
        self._make = make
        self._axes = [(axis, len(axis)) for axis in reversed(axes)]
        self._length = math.prod(length for _, length in self._axes)
        self._slower: tuple[int, list[Any]] = (-1, [])

    def __len__(self) -> int:
        """Return the number of combinations."""
        return self._length

    @overload
    def __getitem__(self, index: int) -> Entry_co: ...
    @overload
    def __getitem__(self, index: slice) -> list[Entry_co]: ...
    def __getitem__(self, index: int | slice) -> Entry_co | list[Entry_co]:
        """Make one entry, or those of a slice."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        place = range(self._length)[index]
        if not self._axes:
            return self._make()
        fastest, length = self._axes[0]
        outer, own = divmod(place, length)
        return self._make(*self._values_at(outer), fastest[own])

    def _values_at(self, outer: int) -> list[Any]:
        """Return the values of all axes but the fastest; neighbours share them, so that the last ones are kept."""
        last, values = self._slower
        if outer != last:
            place = outer
            values = []
            for axis, length in self._axes[1:]:
                place, own = divmod(place, length)
                values.append(axis[own])
            values.reverse()
            self._slower = (outer, values)
        return values


@dataclass(frozen=True)
class SweepPlan:
    """The runs of a batch under variations.

    Each axis of the mismatch is put on top of every mismatch by itself, not with the other axes. Settings are varied in
    all combinations, with each other and with all else.
    """

    batch: Batch  # plants, controllers, tasks, mismatches and seeds
    axes: tuple[
        tuple[str, tuple[Magnitude, ...]], ...
    ] = ()  # of the mismatch, with their magnitudes
    settings: tuple[
        tuple[str, tuple[Value, ...]], ...
    ] = ()  # by short name or `SECTION.KEY`, with their values

    @classmethod
    def parse(cls, batch: Batch, variations: Iterable[str]) -> Self:
        """Return the plan of a batch with the variations that a user wrote.

        Args:
            batch: the runs.
            variations: of an axis, `camera_rotation=0:180:30deg`, or of a setting, `run.period=0.02,0.05`.

        Raises:
            ConfigurationError: an unknown axis, values that are malformed, empty or repeated, or one setting twice.
        """
        axes, settings = [], dict[str, tuple[Value, ...]]()
        for text in variations:
            name, _, values = (part.strip() for part in text.partition("="))
            if name in settings:
                raise ConfigurationError(f"--vary gives {name} twice; give all values in one place")
            with configuration_errors("" if name in SHORT_NAMES else "--vary: "):
                if name in SHORT_NAMES or "." in name:
                    settings[name] = parse_values(name, values)
                else:
                    axes.append((name, parse_magnitudes(name, values)))
        in_order = sorted(settings.items(), key=lambda pair: [*SHORT_NAMES, pair[0]].index(pair[0]))
        return cls(batch, tuple(axes), tuple(in_order))

    def cells(self) -> Grid[Cell]:
        """Return the runs, seeds varying fastest.

        Raises:
            ConfigurationError: an axis that is varied and stands in a mismatch, too.
        """
        for axis, _ in self.axes:
            for text in self.batch.mismatches:
                if axis in dict(Mismatch.parse(text).axes):
                    raise ConfigurationError(
                        f"--vary {axis} varies an axis that the mismatch {text!r} has"
                    )

        def cell(place: Place, varied: Varied, request: RunRequest) -> Cell:
            if place.magnitude is not None or varied:
                request = replace(request, mismatch=place.vary(request.mismatch), varied=varied)
            return Cell(request, place.columns)

        places = [
            Place(axis, magnitude) for axis, magnitudes in self.axes for magnitude in magnitudes
        ]
        names = [name for name, _ in self.settings]
        varied = Grid(
            lambda *values: tuple(zip(names, values, strict=True)),
            *(values for _, values in self.settings),
        )
        return Grid(cell, places or [Place()], varied, self.batch.requests())


@dataclass(frozen=True)
class Place:
    """A point on the axis that is varied; without an axis, none is."""

    axis: str = ""
    magnitude: Magnitude | None = None

    @cached_property
    def columns(self) -> Row:
        """The columns of the table of runs that say so; empty and NaN without an axis."""
        number, unit = (
            (math.nan, "")
            if self.magnitude is None
            else (self.magnitude.number, self.magnitude.unit)
        )
        return {"axis": self.axis, "magnitude": number, "unit": unit}

    def vary(self, mismatch: Mismatch) -> Mismatch:
        """Return a mismatch with the axis put on top of it."""
        if self.magnitude is None:
            return mismatch
        return _with_axis(mismatch, self.axis, self.magnitude)


@lru_cache
def _with_axis(mismatch: Mismatch, axis: str, magnitude: Magnitude) -> Mismatch:
    """Return the same object for all runs at one place, so that messages to workers hold it once."""
    return mismatch.with_axis(axis, magnitude)


def parse_values(name: str, text: str) -> tuple[Value, ...]:
    """Return the values of a setting: `begin:end:step` (both ends included) or values as in TOML with commas between.

    Whole numbers become floats where others are floats, so that a column has one type.

    Raises:
        ValueError: there is no value, one stands there twice, or the range is malformed or empty.
    """
    values: Sequence[Any]
    span = re.fullmatch(r"([-+0-9.e]+(?::[-+0-9.e]+){2})\s*([a-zA-Zµ°%/²]*)", text)
    if span is not None:
        values = parse_range(name, span[1])
        values = [f"{each:g}{span[2]}" for each in values] if span[2] else values
    else:
        try:
            values = parse_toml(f"values = [{text}]")["values"]
        except (ValueError, RecursionError):
            words = split_words(text)
            parts = [split_quantity(word) for word in words]
            values = [
                part[0] if part and not part[1] else word
                for part, word in zip(parts, words, strict=True)
            ]
    numeric = all(isinstance(each, int | float) and not isinstance(each, bool) for each in values)
    if numeric and any(isinstance(each, float) for each in values):
        # A whole number beyond all floats is inf as one, and refused as such
        values = [float(str(each)) for each in values]
    found = _in_one_way(name, values)
    if not found or "" in found:
        raise ValueError(
            f"{name} needs values, such as run.period=0.02,0.05 or task.duration=2:8:2"
        )
    sizes = [_size(each) for each in found]
    for k, each in enumerate(found):
        if sizes[k] in sizes[:k]:
            raise ValueError(f"{name} names {each} twice")
    return found


def _in_one_way(name: str, values: Sequence[Any]) -> tuple[Value, ...]:
    """Return values that are all numbers or all texts, so that their column has one type; 0 takes the others' unit."""
    texts = [each for each in values if isinstance(each, str)]
    unit = next((parts[1] for parts in map(split_quantity, texts) if parts), "")
    found = tuple(f"0{unit}" if texts and unit and each == 0 else each for each in values)
    if texts and not all(isinstance(each, str) for each in found):
        raise ValueError(
            f"{name} mixes numbers and texts; write the unit with all values, or with none"
        )
    return found


def _size(value: Value) -> object:
    """Return a value for comparison: a quantity with a unit in its base unit, so that 2s and 2000ms are equal."""
    parts = split_quantity(value) if isinstance(value, str) else None
    own = next(
        (own for own, units in UNITS.items() if parts and parts[1] and parts[1] in units), ""
    )
    if parts and own:
        return (own, round(in_own_unit(*parts, own), 12))
    return value


@dataclass
class Survey:
    """Names and settings of all runs of a batch, found in one pass; names in the order in which they come first."""

    count: int = 0
    plants: dict[str, None] = field(default_factory=dict)
    controllers: dict[str, None] = field(default_factory=dict)
    tasks: dict[str, None] = field(default_factory=dict)
    mismatches: dict[str, None] = field(default_factory=dict)
    robots: dict[str, None] = field(default_factory=dict)
    sensings: dict[str, None] = field(default_factory=dict)
    seeds: list[range] = field(default_factory=list)  # in order, without gaps within each
    examples: list[RunRequest] = field(default_factory=list)
    """With every plant in every condition (mismatch, varied settings) and with every controller, and every task."""
    digest: str = ""  # digest of all runs in their order

    @property
    def sections(self) -> list[str]:
        """The sections of settings that the runs read, apart from `run`."""
        return [*self.plants, *self.controllers, *self.tasks]


def survey(requests: Sequence[RunRequest]) -> Survey:
    """Look at every run once.

    Raises:
        ConfigurationError: a run is asked for twice.
    """
    found = Survey(len(requests))
    digest, names, seeds = hashlib.sha256(), array("q"), array("q")
    kind: tuple[object, ...] = ()
    seen: set[tuple[object, ...]] = set()
    for request in requests:
        run_id = request.run_id
        digest.update(f"{run_id}\n".encode())
        names.append(hash(run_id.casefold()))
        seeds.append(request.seed)
        condition = (request.mismatch, request.varied, request.robot, request.sensing)
        last, kind = kind, (request.plant, request.controller, request.task, condition)
        if kind == last:
            continue
        own = request.controller, request.varied_in("controller")
        new = {
            (request.plant, condition),
            (request.plant, *own),
            (request.task, request.varied_in("task")),
        } - seen
        if new:
            seen |= new
            found.examples.append(request)
    for example in found.examples:
        found.plants[example.plant] = found.controllers[example.controller] = found.tasks[
            example.task
        ] = None
        found.mismatches[str(example.mismatch)] = found.sensings[example.sensing] = None
        if not find_plant(example.plant).own_robot:
            found.robots[example.robot] = None
    found.digest, found.seeds = digest.hexdigest(), _ranges(seeds)
    _refuse_repetition(requests, names)
    return found


def _refuse_repetition(requests: Iterable[RunRequest], hashes: array[int]) -> None:
    """Refuse runs whose names differ in capitals at most; where two of the hashes are equal the names are looked at."""
    different = np.unique(np.frombuffer(hashes, dtype=np.int64))
    if len(different) < len(hashes):
        names = Counter(request.run_id.casefold() for request in requests)
        name, count = names.most_common(1)[0]
        if count > 1:
            name = next(request.run_id for request in requests if request.run_id.casefold() == name)
            raise ConfigurationError(
                f"the run {name} is asked for twice: leave one out, or rename a file (NAME=FILE)"
            )


def _ranges(numbers: array[int]) -> list[range]:
    """Return whole numbers as ranges, in order."""
    found = np.unique(np.frombuffer(numbers, dtype=np.int64))
    parts = np.split(found, np.flatnonzero(np.diff(found) > 1) + 1) if len(found) else []
    return [range(int(part[0]), int(part[-1]) + 1) for part in parts]
