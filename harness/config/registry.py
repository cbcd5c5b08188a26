"""Plants and controllers by name: those of this package and those that other distributions publish.

A third party publishes a `PlantEntry`, a `ControllerEntry`, or a subclass of `Plant`, `World` or `Controller` under the
entry-point group `servobench.plants` or `servobench.controllers`; a name of this package cannot be taken over. Those
that a user gives as files or objects are offered under a name for as long as a command or call takes.
"""

import contextlib
import pickle
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Generic, TypeAlias

from servobench.controllers.controller import ControllerEntry
from servobench.controllers.methods import ESTIMATORS, LAWS, METHODS, compose, suggest_pair
from servobench.harness.config.entries import (
    CONTROLLER,
    PLANT,
    Entry,
    Kind,
    NoSettings,
    Own,
    own_object,
    read_own,
)
from servobench.harness.config.installation import check_installed, has_no_wheel
from servobench.harness.config.source import describe_at, is_place
from servobench.plant.bench.plant import PlantEntry
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import is_file, user_path
from servobench.plant.contract.settings import suggest

PLANTS = {
    "kinematic": "servobench.plant.kinematic:ENTRY",
    "bullet": "servobench.plant.rendered.plants:BULLET",
    "mujoco": "servobench.plant.rendered.plants:MUJOCO",
    "fmu": "servobench.fmus.ur5_plant:ENTRY",
}
RENDERED = ("bullet", "mujoco")  # a run without a named plant is on the first one that is installed
UNRENDERED = "kinematic"  # its plant where none of them is
MAPPED = "fmu:"
POLICY = "onnx:"
FILES = (MAPPED, POLICY)  # with which names begin that are those of files
ALL = "all"  # stands for every name
RUN = "run"  # the section of settings that all runs share
NOT_COMPOSED = {
    "nmpc_calibrated": "servobench.controllers.nmpc_calibrated:ENTRY",
    "revealed": "servobench.controllers.revealed:ENTRY",
}
CONTROLLERS: Mapping[str, ControllerEntry | str] = {**METHODS, **NOT_COMPOSED}
MAPPINGS = {".fmu": MAPPED, ".toml": MAPPED}  # an FMU, or a mapping of its names

Offer: TypeAlias = Own[Any]
_OFFERED: dict[str, Offer] = {}
DECLARED: dict[
    str, Any
] = {}  # metrics of users by name, as `servobench.harness.run.metrics` declares its own


@contextlib.contextmanager
def offering(given: Iterable[Offer] = ()) -> Iterator[None]:
    """Let controllers and plants be found by name, these and those that are offered within the context."""
    before, declared = dict(_OFFERED), dict(DECLARED)
    _OFFERED.update((each.name, each) for each in given)
    try:
        yield
    finally:
        for mapping, former in ((_OFFERED, before), (DECLARED, declared)):
            mapping.clear()
            mapping.update(former)


def _code_of(own: Offer) -> tuple[str, str, str]:
    """Return which code it is, however a user writes the path of its file."""
    return Path(own.place).name, own.file, own.digest


def offered(names: Iterable[str]) -> tuple[Offer, ...]:
    """Return those of the controllers and plants `names` that users gave."""
    return tuple(_OFFERED[name] for name in names if name in _OFFERED)


def can_travel(own: Sequence[Offer]) -> bool:
    """Return whether a worker process can receive controllers and plants that users gave."""
    try:
        text = pickle.dumps(own)
    except Exception:  # noqa: BLE001 - code of users may raise anything
        return False
    return b"__main__" not in text or hasattr(sys.modules["__main__"], "__file__")


@dataclass(frozen=True, eq=False)
class Registry(Generic[Entry]):
    """Entries of a kind by name: of this package, given by the user, or published by other distributions."""

    kind: Kind[Entry]  # kind of the entries
    group: str  # group of the entry points by which others publish them
    own: Mapping[
        str, Entry | str
    ]  # those of this package, or their place `MODULE:NAME` where that loads slowly
    # makes the entry of a name with a meaning of its own; None for other names
    made: Callable[[str], Entry | None] = lambda _: None
    advice: Callable[[str], str] = lambda _: ""  # about an unknown name; empty for the nearest name
    files: Mapping[str, str] = field(default_factory=dict)  # suffix -> what their name begins with

    def names(self) -> list[str]:
        """Return all names, those of this package first."""
        return list(dict.fromkeys([*self.own, *_points(self.group)]))

    def find(self, name: str) -> Entry:
        """Return the entry of a name.

        Raises:
            ConfigurationError: no such name, or an entry that cannot be made or loaded.
        """
        with configuration_errors():
            made = self.made(name)
        if made is not None:
            return made
        given = _OFFERED.get(name)
        return (
            given.entry if given is not None and given.word == self.kind.word else _load(self, name)
        )

    def choose(self, given: object) -> str:
        """Return the name of an entry by which it is found from now on.

        Args:
            given: a name, the place of a user's code such as ./mine.py:Mine, or an object that a user gave in Python.

        Raises:
            ConfigurationError: there is none, or it cannot be used; one line with file and line number.
        """
        if not isinstance(given, str):
            return self.offer(own_object(self.kind, given))
        prefix = self.files.get(Path(given).suffix.lower())
        if prefix is not None:
            alias, given = _split_alias(given)
            if not given.startswith(prefix):
                given = f"{prefix}{given}"
            if alias:
                entry = self.kind.make_entry(self.find(given), given, alias)
                return self.offer(Own(self.kind.word, entry, given))
        if (
            given not in (*_OFFERED, *self.names())
            and not given.startswith(FILES)
            and is_place(given)
        ):
            return self.offer(read_own(self.kind, given))
        self.find(given)
        return given

    def offer(self, own: Own[Entry]) -> str:
        """Let an entry of a user be found by its name, and return this name.

        Settings stand in sections of these names, so a controller and a plant cannot share one.

        Raises:
            ConfigurationError: another controller or plant has this name.
        """
        name, other = own.name, _OFFERED.get(own.name)
        taken = {RUN: "a section of settings"}
        for registry in (PLANT_REGISTRY, CONTROLLER_REGISTRY, self):
            taken |= dict.fromkeys(registry.names(), f"a {registry.kind.word}")
        if name in taken:
            raise ConfigurationError(
                f"{taken[name]} called {name!r} exists already; {_rename(own)}"
            )
        if other is not None and _code_of(other) != _code_of(own):
            raise ConfigurationError(
                f"{other.place} and {own.place} are both called {name!r}; {_rename(own)}"
            )
        _OFFERED[name] = own
        return name

    def published(self, name: str) -> EntryPoint | None:
        """Return where another distribution has the entry of this name; None where no other has it."""
        if name in self.own or name in _OFFERED:
            return None
        return _points(self.group).get(name)

    def unused_points(self) -> list[tuple[str, str]]:
        """Return the names of entry points that are not used, each with a line that says why: others have the name."""
        found = dict[tuple[str, str], str]()
        for point in _published().select(group=self.group):
            used = _points(self.group).get(point.name)
            if point.name in self.own:
                why = f"servobench has a {self.kind.word} of this name, which cannot be taken over"
            elif used is None:
                why = "the command line has another meaning for this name"
            elif used.value != point.value:
                why = f"another distribution publishes {used.value} under this name"
            else:
                continue
            line = f"{self.kind.word} {point.name!r} ({point.value}) is not used: {why}"
            found[point.name, point.value] = line
        return [(name, line) for (name, _), line in found.items()]


# Entry points of all groups: to find them takes a file of each installed distribution.
_published = cache(entry_points)


@cache
def _points(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group that have a name of their own, the first one of each name."""
    points: dict[str, EntryPoint] = {}
    for point in _published().select(group=group):
        if point.name not in (RUN, ALL):
            points.setdefault(point.name, point)
    return points


@cache
def _load(registry: Registry[Any], name: str) -> Any:  # noqa: ANN401 - an entry of the registry
    own, kind = registry.own.get(name), registry.kind.word
    if own is not None and not isinstance(own, str):
        return own
    point = (
        _points(registry.group).get(name) if own is None else EntryPoint(name, own, registry.group)
    )
    if point is None:
        if Path(f"{name}.py").is_file():
            raise ConfigurationError(
                f"unknown {kind} {name!r}: did you mean your file './{name}.py'?"
            )
        raise ConfigurationError(
            f"unknown {kind} {name!r}: {registry.advice(name) or suggest(name, registry.names())}"
        )
    try:
        given = point.load()
    except (Exception, SystemExit) as error:
        raise ConfigurationError(
            f"{kind} {name!r} ({point.value}) cannot be loaded: {describe_at(error)}"
        ) from error
    if own is not None:
        return given
    with configuration_errors(f"{kind} {name!r} ({point.value}) cannot be used: "):
        return registry.kind.make_entry(given, point.value, name)


def _mapped_plant(name: str) -> PlantEntry | None:
    """Return the plant of a name `fmu:PATH.toml`: the FMU that this mapping describes."""
    if not name.startswith(MAPPED):
        return None
    from servobench.plant.fmu.world import fmu_entry  # noqa: PLC0415 - loads CasADi

    return fmu_entry(user_path(name.removeprefix(MAPPED)))


def _made_controller(name: str) -> ControllerEntry | None:
    """Return the controller of a name `fmu:PATH` or `onnx:PATH`, or that of a pair such as `mfac+rls`."""
    if name.startswith(MAPPED):
        from servobench.harness.config.fmu_controller import mapped_controller  # noqa: PLC0415 - as of plants

        return mapped_controller(user_path(name.removeprefix(MAPPED)), name)
    if name.startswith(POLICY):
        check_installed(("onnxruntime", "gymnasium"), f"controller {name!r}")
        module = import_module("servobench.harness.gym.policy")  # an application, so no import
        path = user_path(name.removeprefix(POLICY))
        return ControllerEntry(
            name, f"the policy {path.name}", NoSettings, partial(module.Policy, path)
        )
    law, plus, estimator = name.partition("+")
    if not plus:
        return None
    with configuration_errors(f"controller {name!r}: "):
        return compose(law, estimator)


PLANT_REGISTRY = Registry(PLANT, "servobench.plants", PLANTS, _mapped_plant, files=MAPPINGS)
CONTROLLER_REGISTRY = Registry[ControllerEntry](
    CONTROLLER,
    "servobench.controllers",
    CONTROLLERS,
    _made_controller,
    suggest_pair,
    {**MAPPINGS, ".onnx": POLICY},
)
REGISTRIES: Mapping[str, Registry[Any]] = {
    "plant": PLANT_REGISTRY,
    "controller": CONTROLLER_REGISTRY,
}
find_plant, choose_plant, plant_names = (
    PLANT_REGISTRY.find,
    PLANT_REGISTRY.choose,
    PLANT_REGISTRY.names,
)
find_controller, choose_controller = CONTROLLER_REGISTRY.find, CONTROLLER_REGISTRY.choose
controller_names = CONTROLLER_REGISTRY.names


def installed_plant(name: str, *, load: bool = True) -> PlantEntry:
    """Return the plant called `name` if all that it needs is installed.

    Args:
        name: of the plant.
        load: also load its engine and try its renderer; without, only look for the packages.

    Raises:
        ConfigurationError: as `find_plant`, or an extra or a renderer is missing; the message says the remedy.
    """
    entry = find_plant(name)
    check_installed(entry.needs, f"plant {name!r}")
    lack = "" if entry.lacking is None or not load else entry.lacking()
    if lack:
        raise ConfigurationError(f"plant {name!r} cannot run here: {lack}")
    return entry


def is_foreign_plant(name: str, *, trusted: bool = False) -> bool:
    """Return whether a plant runs code that is not of this package, or of an FMU that the user trusts like it."""
    own = _OFFERED.get(name)
    place = name if own is None else own.place
    return name not in PLANTS and not (trusted and place.startswith(MAPPED))


def is_foreign_controller(name: str) -> bool:
    """Return whether a controller runs code that is not of this package; pairs of its laws and estimators do not."""
    law, plus, estimator = name.partition("+")
    return not (law in LAWS and estimator in ESTIMATORS if plus else law in CONTROLLERS)


def own_modules(plants: Iterable[str], controllers: Iterable[str]) -> tuple[str, ...]:
    """Return the modules of this package in which plants and controllers are, as far as they have one of their own."""
    places = PLANTS | NOT_COMPOSED
    known = [places[name] for name in (*plants, *controllers) if name in places]
    return tuple(place.partition(":")[0] for place in known)


def _split_alias(given: str) -> tuple[str, str]:
    """Return name and path of `NAME=PATH`; no name where there is none, or where the whole is a file that exists."""
    alias, equals, file = given.partition("=")
    if not equals or not alias.isidentifier() or is_file(given):
        return "", given
    return alias, file


def _rename(own: Offer) -> str:
    if own.given:
        return (
            f"give yours another name, as a class of that name or in a {type(own.entry).__name__}"
        )
    return f"give yours another name, such as my_{own.name.replace(':', '_')}={own.place}"


def engine_of(name: str) -> str:
    """Return which engine computes or renders a plant, in a line; empty where there is none, or no such plant here."""
    try:
        entry = find_plant(name)
        if entry.engine is None:
            return ""
        return _told(entry.engine)
    except (ConfigurationError, ImportError):
        return ""


@cache
def _told(engine: Callable[[], str]) -> str:
    return engine()


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


def rendered_plant(named: str | None = None) -> str:
    """Return the plant whose engine shows runs of the plant `named`: itself if it renders, or else one that is there.

    Raises:
        ConfigurationError: the engine is missing, or all of them are; the message says the remedy.
    """
    name, why = (named, "") if named is not None and named in RENDERED else default_plant()
    if name == UNRENDERED:
        raise ConfigurationError(why)
    return installed_plant(name).name
