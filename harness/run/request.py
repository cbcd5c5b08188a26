"""The request for a run: one cell of a comparison, and the settings that are common to all cells."""

import json
import math
import operator
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

from annotated_types import Ge

from servobench.harness.run.variations import (
    ORDER,
    ROLES,
    SECTIONS,
    SHORT_NAMES,
    Value,
    Varied,
    words_in_name,
)
from servobench.plant.cameras.registry import DEFAULT_SENSING, FIXED
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.settings import (
    NonNegative,
    Number,
    Positive,
    ShareBelowOne,
    Usual,
    native,
    settings,
    with_tuples,
)
from servobench.plant.contract.units import in_own_unit, split_quantity
from servobench.plant.robot.catalogue import DEFAULT_ROBOT, WITH, short_name
from servobench.plant.robot.mismatch import Mismatch

OWN_ROBOT = "own"  # in the column `robot`: the plant brings it
UNFIT_FOR_FILES = re.compile(r"[^A-Za-z0-9.=+_-]")
NAMES = ("plant", "controller", "task", "robot", "sensing")  # fields of a request that are texts


@settings
class RunSettings:
    """The section `run`: settings that all plants, controllers and tasks share."""

    period: Annotated[Number, Ge(1e-4), Usual(1.0)] = 0.05
    """[s] control period"""
    preview_time: NonNegative = 0.5
    """[s] of the future reference that every controller gets, rounded up to control periods"""
    lost_after: Annotated[Positive, Usual(20.0)] = 1.0
    """[s] without a valid feature after which a run ends"""
    camera_moves_at: ShareBelowOne = 0.5
    """share of the run after which a mismatch's `camera_move` happens"""
    full_jacobian: bool = False
    """log every entry of the estimated and the true Jacobian"""
    compiled: bool = False
    """steps of composed controllers in C, without diagnostics; numpy goes on where that cannot be"""

    @property
    def preview_rows(self) -> int:
        """Future rows of the reference that every controller gets."""
        return self._whole_periods(self.preview_time)

    def periods(self, duration: float) -> int:
        """Return how many control periods a run or a part of `duration` [s] has."""
        return max(1, self._whole_periods(duration))

    def _whole_periods(self, time: float) -> int:
        return math.ceil(time / self.period - 1e-9)


@dataclass(frozen=True)
class RunRequest:
    """One cell of a comparison.

    Raises:
        ConfigurationError: a text that is no mismatch, a name that is no text, a bad seed, or a varied setting of a
            section that the run does not read.
    """

    plant: str
    controller: str
    task: str
    mismatch: Mismatch  # how far the true robot may be from the nominal one; its text is read, too
    seed: int  # seed of everything random in the run
    varied: Varied = ()
    """settings of this run alone, by short name or `SECTION.KEY`; a mapping is read, too. Sections are `run`, `plant`,
    `controller` and `task`, or the names of these three"""
    robot: str = DEFAULT_ROBOT  # a name, or the path of a file
    sensing: str = DEFAULT_SENSING  # a set-up, or the path of a file with one; with `:hand` for cameras on the hand

    def __post_init__(self) -> None:
        """Check the names and the seed, and read a mismatch that came as text and settings of any order."""
        for name in NAMES:
            if not isinstance(getattr(self, name), str):
                raise ConfigurationError(f"{name} must be a name, got {getattr(self, name)!r}")
        object.__setattr__(self, "seed", read_seed(self.seed))
        given: object = self.mismatch
        if isinstance(given, str):
            object.__setattr__(self, "mismatch", Mismatch.parse(given))
        object.__setattr__(self, "sensing", self.sensing.strip().removesuffix(f":{FIXED}"))
        object.__setattr__(self, "varied", self._in_order(dict(self.varied)) if self.varied else ())

    def _in_order(self, varied: Mapping[str, Value]) -> Varied:
        """Return varied settings by role, those with short names first, so that equal runs are equal values."""
        by_role = {self._by_role(key): with_tuples(value) for key, value in varied.items()}
        if len(by_role) < len(varied):
            raise ConfigurationError(f"a setting is varied twice in {', '.join(varied)}")
        for short in SHORT_NAMES.values():  # their columns hold numbers
            value = by_role.get(short.key)
            if isinstance(value, str) and (parts := split_quantity(value)):
                with configuration_errors(f"{short.key} = {value!r} must be "):
                    value = in_own_unit(*parts, "s" if short.unit else "1")
            if isinstance(value, int | float):
                by_role[short.key] = float(value)
        return tuple(sorted(by_role.items(), key=_rank))

    def _by_role(self, key: str) -> str:
        """Return a setting's key with the role of its section in place of a plant's, controller's or task's name."""
        if key in SHORT_NAMES:
            return SHORT_NAMES[key].key
        if key.startswith(SECTIONS):
            return key
        for role in ROLES:
            if key.startswith(f"{getattr(self, role)}."):
                return f"{role}{key.removeprefix(getattr(self, role))}"
        raise ConfigurationError(
            f"the setting {key} cannot be varied in runs of {self.controller} on {self.plant}, task {self.task}: "
            f"wanted SECTION.KEY with one of the sections run, {', '.join(ROLES)}, such as plant.sensing.latency"
        )

    def varied_in(self, role: str) -> Varied:
        """Return the varied settings of a section, `run` or one of `ROLES`, by dotted key within it."""
        return tuple(
            (key.removeprefix(f"{role}."), each)
            for key, each in self.varied
            if key.startswith(f"{role}.")
        )

    def varies(self, key: str) -> bool:
        """Return whether this run varies the setting of a key such as `kinematic.lag`."""
        return bool(self.varied) and self._by_role(key) in dict(self.varied)

    def with_seed(self, seed: int) -> Self:
        """Return the same run with another seed."""
        other = object.__new__(type(self))
        kept = {"_stem": self._stem, "_row": self._row}
        vars(other).update(vars(self), **kept, seed=read_seed(seed))
        return other

    @property
    def run_id(self) -> str:
        """Return a name for the run that is the same wherever it is made, and fit for a file."""
        return f"{self._stem}-{self.seed}"

    @cached_property
    def _stem(self) -> str:
        """The name without the seed, which is kept: most runs of a batch have that of another one."""
        robot = ""
        if self.robot != DEFAULT_ROBOT:
            robot = f"{short_name(self.robot).replace(WITH, '+')}-"
        sensing = "" if self.sensing == DEFAULT_SENSING else f"{Path(self.sensing).name}-"
        varied = "".join(map(words_in_name, self.varied))
        name = f"{self.plant}-{robot}{sensing}{self.controller}-{self.task}-{self.mismatch}{varied}"
        return UNFIT_FOR_FILES.sub("_", name)

    def as_row(self) -> dict[str, Any]:
        """Return the columns by which a run is found in the table of runs.

        A varied setting is a column: that of its short name, or its key.
        """
        return {**self._row, "run_id": self.run_id, "seed": self.seed}

    @cached_property
    def _row(self) -> dict[str, Any]:
        """The columns of this run or of one with another seed."""
        varied = dict(self.varied)
        short = {each.column: varied.pop(each.key, each.usual) for each in SHORT_NAMES.values()}
        others = {}
        for key, value in varied.items():
            others[key] = json.dumps(value) if isinstance(value, tuple) else value
        return {
            "run_id": self.run_id,
            "plant": self.plant,
            "controller": self.controller,
            "task": self.task,
            "mismatch": str(self.mismatch),
            "seed": self.seed,
            **short,
            "robot": self.robot,
            "sensing": self.sensing,
            **others,
        }


def _rank(varied: tuple[str, Value]) -> tuple[int, str]:
    """Return the rank of a varied setting: those with short names first, then by key."""
    key, _ = varied
    return ORDER.get(key, len(ORDER)), key


def read_seed(seed: Any) -> int:  # noqa: ANN401 - as a user gave it
    """Return a seed, a whole number from 0 on, as a Python integer, which numpy's integers become.

    Raises:
        ConfigurationError: it is no such number.
    """
    whole = (
        hasattr(seed, "__index__") and not isinstance(seed, bool) and not getattr(seed, "ndim", 0)
    )
    if not whole or operator.index(seed) < 0:
        raise ConfigurationError(f"seed must be a non-negative integer, got {native(seed)!r}")
    return operator.index(seed)
