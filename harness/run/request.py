"""The request for a run: one cell of a comparison, and the settings that are common to all cells.

Robots and sensing set-ups have names of this package, or are files of the user.
"""

import json
import math
import operator
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, TypeAlias

from annotated_types import Ge

from servobench.harness.config.source import SourceFile, describe_at, find_place
from servobench.plant.cameras.registry import DEFAULT_SENSING, FIXED, HAND, SETUPS, Sensing
from servobench.plant.cameras.setups import SensingSetup
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.settings import (
    NonNegative,
    Number,
    Positive,
    ShareBelowOne,
    Usual,
    native,
    settings,
)
from servobench.plant.contract.units import in_own_unit, split_quantity
from servobench.plant.robot import catalogue, ur5
from servobench.plant.robot.mismatch import Mismatch

DEFAULT_ROBOT: Final = ur5.UR5
OWN_ROBOT: Final = "own"  # in the column `robot`: the plant brings it
UNFIT_FOR_FILES = re.compile(r"[^A-Za-z0-9.=+_-]")
NAMES = ("plant", "controller", "task", "robot", "sensing")  # fields of a request that are texts


class ShortName(NamedTuple):
    """A short name for a setting that sweeps often vary; it has a column of its own, and a part of the run's name."""

    key: str  # key of the setting, `SECTION.KEY`
    column: str  # in the table of runs
    heading: str  # heading of this column where it is shown, with the unit
    usual: float | None = None  # in this column for runs that do not vary the setting
    scale: float = 1e3  # from the value to the number that is shown
    unit: str = "ms"  # unit of this number


SHORT_NAMES: Final[Mapping[str, ShortName]] = {
    "noise": ShortName("plant.sensing.noise_factor", "noise_factor", "noise factor", 1.0, 1.0, ""),
    "latency": ShortName("plant.sensing.latency", "latency_s", "latency [ms]"),
    "period": ShortName("run.period", "period_s", "period [ms]"),
}
ROLES: Final = ("plant", "controller", "task")
# The beginnings of the key of a varied setting.
SECTIONS: Final = ("run.", *(f"{role}." for role in ROLES))
ORDER: Final = {short.key: order for order, short in enumerate(SHORT_NAMES.values())}

Value: TypeAlias = float | int | bool | str | tuple["Value", ...]
Varied: TypeAlias = tuple[tuple[str, Value], ...]


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
            object.__setattr__(self, "mismatch", read_mismatch(given))
        object.__setattr__(self, "sensing", self.sensing.strip().removesuffix(f":{FIXED}"))
        object.__setattr__(self, "varied", self._in_order(dict(self.varied)) if self.varied else ())

    def _in_order(self, varied: Mapping[str, Value]) -> Varied:
        """Return varied settings by role, those with short names first, so that equal runs are equal values."""
        by_role = {self._by_role(key): _frozen(value) for key, value in varied.items()}
        if len(by_role) < len(varied):
            raise ConfigurationError(f"a setting is varied twice in {', '.join(varied)}")
        for short in SHORT_NAMES.values():  # their columns hold numbers
            value = by_role.get(short.key)
            if isinstance(value, str) and (parts := split_quantity(value)):
                with configuration_errors(f"{short.key} = {value!r} must be "):
                    value = in_own_unit(*parts, "s" if short.unit else "1")
            if isinstance(value, int | float):
                by_role[short.key] = float(value)
        return tuple(
            sorted(by_role.items(), key=lambda pair: (ORDER.get(pair[0], len(ORDER)), pair[0]))
        )

    def _by_role(self, key: str) -> str:
        """Return a setting's key with the role of its section in place of a plant's, controller's or task's name."""
        if key in SHORT_NAMES:
            return SHORT_NAMES[key].key
        if key.startswith(SECTIONS):
            return key
        for role in ROLES:
            if key.startswith(f"{getattr(self, role)}."):
                return f"{role}{key.removeprefix(getattr(self, role))}"
        runs = f"runs of {self.controller} on {self.plant}, task {self.task}"
        wanted = f"SECTION.KEY with one of the sections run, {', '.join(ROLES)}, such as plant.sensing.latency"
        raise ConfigurationError(f"the setting {key} cannot be varied in {runs}: wanted {wanted}")

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

    @property
    def run_id(self) -> str:
        """Return a name for the run that is the same wherever it is made, and fit for a file."""
        robot = ""
        if self.robot != DEFAULT_ROBOT:
            robot = f"{short_name(self.robot).replace(catalogue.WITH, '+')}-"
        sensing = "" if self.sensing == DEFAULT_SENSING else f"{Path(self.sensing).name}-"
        varied = "".join(map(_in_name, self.varied))
        method = f"{robot}{sensing}{self.controller}"
        name = f"{self.plant}-{method}-{self.task}-{self.mismatch}{varied}-{self.seed}"
        return UNFIT_FOR_FILES.sub("_", name)

    def as_row(self) -> dict[str, Any]:
        """Return the columns by which a run is found in the table of runs.

        A varied setting is a column: that of its short name, or its key.
        """
        varied = dict(self.varied)
        short = {each.column: varied.pop(each.key, each.usual) for each in SHORT_NAMES.values()}
        names = {name: getattr(self, name) for name in ("run_id", "plant", "controller", "task")}
        names |= {"mismatch": str(self.mismatch), "seed": self.seed, **short}
        others = {
            key: json.dumps(value) if isinstance(value, tuple) else value
            for key, value in varied.items()
        }
        return {**names, "robot": self.robot, "sensing": self.sensing, **others}


def varied_in_row(row: Mapping[str, Any]) -> Varied:
    """Return the settings that a run varies, by key, from its row in a table of runs."""
    columns = [(short.column, short.key, short.usual) for short in SHORT_NAMES.values()]
    columns += [(key, key, None) for key in row if "." in key]
    varied = {}
    for column, key, usual in columns:
        value = row.get(column)
        if value in (None, usual):
            continue
        if str(value).startswith("["):  # the JSON text of a list
            value = json.loads(value)
        if not (isinstance(value, float) and math.isnan(value)):
            varied[key] = value
    return tuple(varied.items())


def varied_columns(columns: Iterable[str]) -> dict[str, tuple[str, float]]:
    """Return the columns of settings that a run may vary with their headings and scales, those of short names first.

    Args:
        columns: of a table of runs.
    """
    known = {short.column: (short.heading, short.scale) for short in SHORT_NAMES.values()}
    known |= {name: (name, 1.0) for name in columns if name.startswith(SECTIONS)}
    return {name: known[name] for name in known if name in set(columns)}


def _in_name(varied: tuple[str, Value]) -> str:
    """Return the part of a run's name that says one varied setting; empty for the usual value of a short name."""
    key, value = varied
    for name, short in SHORT_NAMES.items():
        if short.key == key and isinstance(value, int | float):
            if value == short.usual:
                return ""
            return f"-{name}{short.scale * value:.12g}{short.unit}"
    return f"-{key}={value}"


def _frozen(value: Value | list[Value]) -> Value:
    if isinstance(value, list | tuple):
        return tuple(map(_frozen, value))
    return value


def read_mismatch(text: str) -> Mismatch:
    """Return the mismatch that a user wrote.

    Raises:
        ConfigurationError: it cannot be read.
    """
    if not isinstance(text, str):
        raise ConfigurationError(
            f"mismatch must be a text such as 'moderate' or 'links=10%', got {text!r}"
        )
    with configuration_errors():
        return Mismatch.parse(text)


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


# A ConfigurationError for a name that cannot be used
find_robot = configuration_errors()(catalogue.find_robot)


def with_camera(robot: str, camera: Path) -> str:
    """Return the word for a robot with the camera of a file in place of the bench's.

    Raises:
        ConfigurationError: a robot or a file that cannot be used.
    """
    for path in (camera, camera.absolute()):  # a file may be called "ur5 with my_camera.toml"
        word = f"{robot}{catalogue.WITH}{path}"
        if catalogue.read_word(word).camera == str(path):
            find_robot(word)
            return word
    raise ConfigurationError(
        f"{word!r} is also the name of a file; give robot or camera another name"
    )


def short_name(robot: str) -> str:
    """Return the word for a robot, and for its camera, without the folders of files."""
    return catalogue.with_files(robot, lambda file: Path(file).name)


def sensing_names() -> list[str]:
    """Return the words of all sensing set-ups of this package, each with fixed cameras and with cameras on the hand."""
    return [str(Sensing(setup, mount)) for setup in SETUPS.values() for mount in (FIXED, HAND)]


def find_sensing(word: str) -> Sensing:
    """Return the sensing that a word stands for, such as `pixel`, `stereo:hand` or `./polar.py:hand`.

    Raises:
        ConfigurationError: an unknown word, or a file that cannot be used.
    """
    return _find(word, sensing_file(word))


@lru_cache(maxsize=64)
def _find(word: str, file: SourceFile | None) -> Sensing:
    place = sensing_place(word)
    found = find_place(place)
    own = {}
    if file is not None and found is not None:
        own[place] = _pick(file, found["file"], found["name"])
        try:
            own[place].check()
        except ConfigurationError:
            raise
        except Exception as error:
            raise ConfigurationError(describe_at(error)) from error
    with configuration_errors():
        return Sensing.parse(word, {**SETUPS, **own})


def sensing_file(word: str) -> SourceFile | None:
    """Return the file of a user's own set-up; None for one of this package."""
    found = find_place(sensing_place(word))
    if found is not None and found["file"]:
        return SourceFile.read(found["file"])
    return None


def sensing_place(word: str) -> str:
    """Return a word without its mount."""
    place, _, mount = word.rpartition(":")
    if mount in (FIXED, HAND):
        return place
    return word


def _pick(source: SourceFile, file: str, name: str | None) -> SensingSetup:
    """Return the set-up called `name` that a file defines, or without a name its only one."""
    setups = {
        key: value for key, value in vars(source.load()).items() if isinstance(value, SensingSetup)
    }
    found = {key: value for key, value in setups.items() if value not in SETUPS.values()}
    if not found:
        wanted = "no object of servobench.plant.cameras.setups.SensingSetup"
        raise ConfigurationError(f"{file} defines no sensing set-up: {wanted}")
    first, *others = found
    if name in found or (name is None and not others):
        return found[name or first]
    wrong = f"has no sensing set-up {name!r}" if name else "has several sensing set-ups"
    raise ConfigurationError(
        f"{file} {wrong}: it defines {', '.join(found)}; name one, such as {file}:{first}"
    )
