"""Plants and controllers by name: those of this package and those that other distributions publish.

A third party publishes a `PlantEntry`, a `ControllerEntry`, or a subclass of `Plant`, `World` or `Controller` under the
entry-point group `servobench.plants` or `servobench.controllers`; a name of this package cannot be taken over. Those
that a user gives as files or objects are offered under a name for as long as a command or call takes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from servobench.controllers.controller import ControllerEntry
from servobench.controllers.methods import METHODS, compose, suggest_pair
from servobench.controllers.parts import ESTIMATORS, LAWS
from servobench.harness.config.entries import (
    CONTROLLER,
    PLANT,
    Entry,
    Kind,
    Own,
    make_entry,
    read_own,
)
from servobench.harness.config.installation import check_installed, has_no_wheel
from servobench.harness.config.source import describe_import, is_place
from servobench.plant.bench.plant import PlantEntry
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import user_path
from servobench.plant.contract.settings import suggest

if TYPE_CHECKING:
    from servobench.plant.rendered.engine import OpenScene

PLANT_GROUP = "servobench.plants"
CONTROLLER_GROUP = "servobench.controllers"

PLANTS = {
    "kinematic": "servobench.plant.kinematic:ENTRY",
    "bullet": "servobench.plant.rendered.plants:BULLET",
    "mujoco": "servobench.plant.rendered.plants:MUJOCO",
    "fmu": "servobench.fmus.ur5_plant:ENTRY",
}
RENDERED = ("bullet", "mujoco")  # a run without a named plant is on the first one that is installed
UNRENDERED = "kinematic"  # its plant where none of them is
MAPPED = "fmu:"
ALL = "all"  # stands for every name
RUN = "run"  # the section of settings that all runs share
NOT_COMPOSED = {"nmpc_calibrated": "servobench.controllers.nmpc_calibrated:ENTRY"}
CONTROLLERS = (*METHODS, *NOT_COMPOSED)


Offer: TypeAlias = Own[ControllerEntry] | Own[PlantEntry] | Own[Any]

_OFFERED: dict[str, Offer] = {}


@contextlib.contextmanager
def offering(given: Iterable[Offer] = ()) -> Iterator[None]:
    """Let controllers and plants be found by name, these and those that are offered within the context."""
    before = dict(_OFFERED)
    _OFFERED.update((each.name, each) for each in given)
    try:
        yield
    finally:
        _OFFERED.clear()
        _OFFERED.update(before)


def offer(own: Offer) -> str:
    """Let a controller or plant of a user be found by its name, and return this name.

    Settings stand in sections of these names, so a controller and a plant cannot share one.

    Raises:
        ConfigurationError: another controller or plant has this name.
    """
    name, other = own.name, _OFFERED.get(own.name)
    taken = {RUN: "a section of settings", **dict.fromkeys(plant_names(), "a plant")}
    taken |= dict.fromkeys(controller_names(), "a controller")
    if name in taken:
        raise ConfigurationError(f"{taken[name]} called {name!r} exists already; {_rename(own)}")
    if other is not None and (other.place, other.file, other.digest) != (own.place, own.file, own.digest):
        raise ConfigurationError(f"{other.place} and {own.place} are both called {name!r}; {_rename(own)}")
    _OFFERED[name] = own
    return name


def offered(names: Iterable[str]) -> tuple[Offer, ...]:
    """Return those of the controllers and plants `names` that users gave."""
    return tuple(_OFFERED[name] for name in names if name in _OFFERED)


def choose_controller(text: str) -> str:
    """Return the name of the controller that a user names, or whose place is given: ./mine.py:Mine, ./mine.fmu.

    An FMU, or a mapping of its names (TOML), is called `fmu:PATH`.

    Raises:
        ConfigurationError: there is no such controller, or it cannot be used; one line with file and line number.
    """
    if text.endswith((".fmu", ".toml")) and not text.startswith(MAPPED):
        text = f"{MAPPED}{text}"
    if text not in (*_OFFERED, *controller_names()) and not text.startswith(MAPPED) and is_place(text):
        return offer(read_own(CONTROLLER, text))
    find_controller(text)
    return text


def choose_plant(text: str) -> str:
    """Return the name of the plant that a user names, or whose place is given, such as ./cell.py:Cell.

    Raises:
        ConfigurationError: there is no such plant, or it cannot be used; one line with file and line number.
    """
    if not (text in (*_OFFERED, *plant_names()) or text.startswith(MAPPED)) and is_place(text):
        return offer(read_own(PLANT, text))
    find_plant(text)
    return text


def plant_names() -> list[str]:
    """Return the names of all plants, those of this package first."""
    return list(_points(PLANT_GROUP))


def controller_names() -> list[str]:
    """Return the names of all controllers, those of this package first."""
    return list(dict.fromkeys([*METHODS, *_points(CONTROLLER_GROUP)]))


def find_plant(name: str) -> PlantEntry:
    """Return the plant called `name`, or for a name like `fmu:PATH.toml` the FMU that this mapping describes.

    Raises:
        ConfigurationError: no such plant, a mapping that cannot be used, or a third party's that cannot be loaded.
    """
    if name.startswith(MAPPED):
        from servobench.plant.fmu.world import fmu_entry  # noqa: PLC0415 - loads CasADi

        try:
            return fmu_entry(user_path(name.removeprefix(MAPPED)))
        except ValueError as error:
            raise ConfigurationError(str(error)) from error
    own = _OFFERED.get(name)
    return own.entry if own is not None and isinstance(own.entry, PlantEntry) else _load_plant(name)


def published(entry: type[ControllerEntry | PlantEntry], name: str) -> EntryPoint | None:
    """Return where another distribution has the controller or plant of this name; None where no other has it."""
    group = PLANT_GROUP if entry is PlantEntry else CONTROLLER_GROUP
    return None if name in {*PLANTS, *CONTROLLERS, *_OFFERED} else _points(group).get(name)


def unused_points(entry: type[ControllerEntry | PlantEntry]) -> list[tuple[str, str]]:
    """Return the names of entry points that are not used, each with a line that says why: others have the name."""
    group, kind = (PLANT_GROUP, PLANT) if entry is PlantEntry else (CONTROLLER_GROUP, CONTROLLER)
    own = PLANTS if entry is PlantEntry else CONTROLLERS
    found = dict[tuple[str, str], str]()
    for point in entry_points(group=group):
        used = _points(group).get(point.name)
        if point.name in own:
            why = f"servobench has a {kind.word} of this name, which cannot be taken over"
        elif point.name in (RUN, ALL):
            why = "the command line has another meaning for this name"
        elif used is not None and used.value != point.value:
            why = f"another distribution publishes {used.value} under this name"
        else:
            continue
        found[point.name, point.value] = f"{kind.word} {point.name!r} ({point.value}) is not used: {why}"
    return [(name, line) for (name, _), line in found.items()]


def installed_plant(name: str) -> PlantEntry:
    """Return the plant called `name` if all that it needs is installed.

    Raises:
        ConfigurationError: as `find_plant`, or an extra or a renderer is missing; the message says the remedy.
    """
    entry = find_plant(name)
    check_installed(entry.needs, f"plant {name!r}")
    lack = "" if entry.lacking is None else entry.lacking()
    if lack:
        raise ConfigurationError(f"plant {name!r} cannot run here: {lack}")
    return entry


def find_controller(name: str) -> ControllerEntry:
    """Return the controller called `name`, the one composed for a name like `mfac+rls`, or the FMU of `fmu:PATH`.

    Raises:
        ConfigurationError: no such controller, an FMU or mapping that cannot be used, or a third party's that cannot be
            loaded.
    """
    if name.startswith(MAPPED):
        from servobench.harness.config.fmu_controller import mapped_controller  # noqa: PLC0415 - as of plants

        try:
            return mapped_controller(user_path(name.removeprefix(MAPPED)), name)
        except ValueError as error:
            raise ConfigurationError(str(error)) from error
    law, plus, estimator = name.partition("+")
    if plus:
        try:
            return compose(law, estimator)
        except ValueError as error:
            raise ConfigurationError(f"controller {name!r}: {error}") from error
    own = _OFFERED.get(name)
    if own is not None and isinstance(own.entry, ControllerEntry):
        return own.entry
    if name in METHODS:
        return METHODS[name]
    return _load_controller(name)


def is_foreign_plant(name: str, *, trusted: bool = False) -> bool:
    """Return whether a plant runs code that is not of this package, or of an FMU that the user trusts like it."""
    return name not in PLANTS and not (trusted and name.startswith(MAPPED))


def is_foreign_controller(name: str) -> bool:
    """Return whether a controller runs code that is not of this package; pairs of its laws and estimators do not."""
    law, plus, estimator = name.partition("+")
    return not (law in LAWS and estimator in ESTIMATORS if plus else law in CONTROLLERS)


def own_modules(plants: Iterable[str], controllers: Iterable[str]) -> tuple[str, ...]:
    """Return the modules of this package in which plants and controllers are, as far as they have one of their own."""
    values = [PLANTS.get(name) for name in plants] + [NOT_COMPOSED.get(name) for name in controllers]
    return tuple(value.partition(":")[0] for value in values if value is not None)


def _rename(own: Offer) -> str:
    if own.given:
        return f"give yours another name, as a class of that name or in a {type(own.entry).__name__}"
    return f"give yours another name, such as my_{own.name.replace(':', '_')}={own.place}"


@cache
def _load_plant(name: str) -> PlantEntry:
    given = _load(PLANT_GROUP, PLANT.word, name)
    if name in PLANTS and isinstance(given, PlantEntry):
        return given
    return _published(PLANT_GROUP, PLANT, name, given)


@cache
def _load_controller(name: str) -> ControllerEntry:
    given = _load(CONTROLLER_GROUP, CONTROLLER.word, name)
    if name in NOT_COMPOSED and isinstance(given, ControllerEntry):
        return given
    return _published(CONTROLLER_GROUP, CONTROLLER, name, given)


def _published(group: str, kind: Kind[Entry], name: str, given: object) -> Entry:
    """Return the entry of a published controller or plant."""
    value = _points(group)[name].value
    try:
        return make_entry(kind, given, value, name)
    except ConfigurationError as error:
        raise ConfigurationError(f"{kind.word} {name!r} ({value}) cannot be used: {error}") from error


@cache
def _points(group: str) -> dict[str, EntryPoint]:
    own = PLANTS if group == PLANT_GROUP else NOT_COMPOSED
    points = {name: EntryPoint(name, value, group) for name, value in own.items()}
    for point in entry_points(group=group):
        if point.name not in (RUN, ALL):
            points.setdefault(point.name, point)
    return points


@cache
def _load(group: str, kind: str, name: str) -> object:
    points = _points(group)
    if name not in points:
        known, hint = (plant_names(), "") if group == PLANT_GROUP else (controller_names(), suggest_pair(name))
        if Path(f"{name}.py").is_file():
            raise ConfigurationError(f"unknown {kind} {name!r}: did you mean your file './{name}.py'?")
        raise ConfigurationError(f"unknown {kind} {name!r}: {hint or suggest(name, known)}")
    point = points[name]
    try:
        return point.load()
    except (Exception, SystemExit) as error:
        why = describe_import(error, point.module)
        raise ConfigurationError(f"{kind} {name!r} ({point.value}) cannot be loaded: {why}") from error


def engine_of(name: str) -> str:
    """Return which engine computes or renders a plant, in a line; empty where there is none, or no such plant here."""
    try:
        return _told(find_plant(name))
    except (ConfigurationError, ImportError):
        return ""


@cache
def _told(entry: PlantEntry) -> str:
    return entry.engine() if entry.engine is not None else ""


def default_plant() -> tuple[str, str]:
    """Return the plant of a run for which none is named, and why it is not a first choice; empty if it is.

    Where PyBullet has no wheel, `mujoco` is as good a choice as `bullet`, and the one to install.
    """
    missing = {}
    for name in RENDERED:
        try:
            installed_plant(name)
        except ConfigurationError as error:
            missing[name] = str(error)
        else:
            return name, "" if has_no_wheel() else missing.get(RENDERED[0], "")
    return UNRENDERED, missing[RENDERED[has_no_wheel()]]


def scene_of(plant: str) -> OpenScene:
    """Return the constructor of scenes of a rendered plant's engine; engines load slowly, so only here."""
    if plant == "mujoco":
        from servobench.plant.rendered.mujoco import MujocoScene  # noqa: PLC0415

        return MujocoScene
    from servobench.plant.rendered.bullet import BulletScene  # noqa: PLC0415

    return BulletScene


def rendered_plant(named: str | None = None) -> str:
    """Return the plant whose engine shows runs of the plant `named`: itself if it renders, or else one that is there.

    Raises:
        ConfigurationError: the engine is missing, or all of them are; the message says the remedy.
    """
    name, why = (named, "") if named is not None and named in RENDERED else default_plant()
    if name == UNRENDERED:
        raise ConfigurationError(why)
    return installed_plant(name).name
