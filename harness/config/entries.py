"""Controllers and plants of users as entries: classes, objects and entries, given in Python or by their place.

A place is a file, `./mine.py`, with `:NAME` if it defines several, or a module and a name, `package.module:NAME`. An
entry is checked as far as that goes without a robot. A class needs no entry: it is constructed as `Mine(knowledge)`, or
as `Mine(config, knowledge)` where `config` is annotated with a dataclass that has a default for every field. Plants and
worlds get a `PlantSetup` in place of the knowledge; a world is put on a bench.
"""

from __future__ import annotations

import hashlib
import inspect
import re
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Generic, TypeVar, get_type_hints

from servobench.controllers.controller import Controller, ControllerEntry
from servobench.harness.config.adapters import BenchSettings, Build, Copy, Guarded, NoSettings, OnBench, folder_of
from servobench.harness.config.source import PLACE, SourceFile, describe_at, digest_of_module, import_user_module, show
from servobench.plant.bench.plant import Plant, PlantEntry, World
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import suggest

NAME: Final = re.compile(r"\w+(?:[:-]\w+)*")

Entry = TypeVar("Entry", ControllerEntry, PlantEntry)


@dataclass(frozen=True)
class Kind(Generic[Entry]):
    """A kind of object that users may give: controllers, or plants.

    Attributes:
        word: for messages.
        entry: its class of entries.
        bases: classes below which it may be given.
        argument: argument of a constructor beside the settings.
        wanted: the accepted objects, in words.
        of_class: makes an entry of a class and that of its settings, None if it takes none.
        make: makes an entry of a given object, its place and a name or None; None for `make_entry`.
    """

    word: str
    entry: type[Entry]
    bases: tuple[type, ...]
    argument: str
    wanted: str
    of_class: Callable[[type[Any], type[Any] | None], Entry]
    make: Callable[[object, str, str | None], Entry] | None = None


def _controller_of(kind: type[Any], config: type[Any] | None) -> ControllerEntry:
    build = Build(kind, with_config=config is not None)
    return ControllerEntry(kind.__name__, _summary(kind), config or NoSettings, build)


def _plant_of(kind: type[Any], config: type[Any] | None) -> PlantEntry:
    if issubclass(kind, World):
        default: type[Any] = BenchSettings
        build = Build(OnBench(kind, config is not None), Plant)
    else:
        default, build = NoSettings, Build(kind, Plant, with_config=config is not None)
    return PlantEntry(kind.__name__, _summary(kind), config or default, build, own_robot=bool(kind.own_robot))


CONTROLLER: Final = Kind(
    "controller",
    ControllerEntry,
    (Controller,),
    "knowledge",
    "wanted a subclass of servobench.Controller or a servobench.ControllerEntry",
    _controller_of,
)
PLANT: Final = Kind(
    "plant",
    PlantEntry,
    (Plant, World),
    "setup",
    "wanted a subclass of servobench.Plant or servobench.World, or a servobench.PlantEntry",
    _plant_of,
)


def make_entry(kind: Kind[Entry], given: object, place: str, name: str | None = None) -> Entry:
    """Return the entry of a class, an object or an entry, checked as far as it can be without a robot.

    Args:
        kind: `CONTROLLER` or `PLANT`.
        given: by the user.
        place: where it stands, for messages.
        name: its name; None for the name of the entry or of the class.

    Raises:
        ConfigurationError: it cannot be used; says the remedy.
    """
    if isinstance(given, kind.entry):
        if isinstance(given.build, type) and issubclass(given.build, kind.bases):
            check_class(given.build)
        entry = _guard(given)
    elif isinstance(given, type) and issubclass(given, kind.bases):
        check_class(given)
        entry = kind.of_class(given, _config_class(given, kind.argument))
    elif isinstance(given, Controller) and kind.entry is ControllerEntry:
        own = type(given)
        build = Build(Copy(given), with_config=False)
        entry = kind.entry(own.__name__, _summary(own), NoSettings, build)
    elif isinstance(given, kind.bases):
        raise ConfigurationError(
            f"{place} is a {kind.word} that is built already; give its class, as each run needs one"
        )
    else:
        raise ConfigurationError(f"{place} is {_describe(given)}, {kind.wanted}")
    entry = replace(entry, name=name or entry.name)
    _check_entry(entry, place)
    return entry


def _guard(entry: Entry) -> Entry:
    """Return an entry whose functions, which are a user's, tell their errors as one line."""
    if isinstance(entry.build, Build):
        return entry
    if isinstance(entry, ControllerEntry):
        return replace(entry, build=Build(entry.build))
    code: Any = entry.build
    is_world = isinstance(code, type) and issubclass(code, World)
    build = Build(OnBench(code, with_config=True) if is_world else code, Plant)
    engine, config_for = (None if code is None else Guarded(code) for code in (entry.engine, entry.config_for))
    return replace(entry, build=build, engine=engine, config_for=config_for)


def check_class(kind: type[Any]) -> None:
    """Refuse a class that lacks methods.

    Raises:
        ConfigurationError: names the class and the methods.
    """
    missing = sorted(getattr(kind, "__abstractmethods__", ()))
    if missing:
        lacking = " and ".join(", ".join(missing).rsplit(", ", 1))
        raise ConfigurationError(f"{_class_place(kind)}: class {kind.__name__} lacks {lacking}, which it must define")


def _check_entry(entry: ControllerEntry | PlantEntry, place: str) -> None:
    if not (isinstance(entry.name, str) and NAME.fullmatch(entry.name)):
        raise ConfigurationError(f"{place}: the name must be letters, digits and _, got {entry.name!r}")
    if not callable(entry.config):
        raise ConfigurationError(f"{place}: config must be a dataclass or a function, got {entry.config!r}")
    check_settings(entry.config, place)
    needs: object = entry.needs if isinstance(entry, PlantEntry) else ()
    if not isinstance(needs, tuple):
        raise ConfigurationError(f"{place}: needs must be a tuple of names of modules, got {needs!r}")


def check_settings(config: Callable[[], Any], place: str) -> None:
    """Refuse settings that cannot be made without arguments, or that are no dataclass.

    Raises:
        ConfigurationError: says the remedy.
    """
    where, name = (_class_place(config), config.__name__) if isinstance(config, type) else (place, "config")
    needed = _without_default(config)
    if needed:
        raise ConfigurationError(f"{where}: every field of {name} needs a default; {', '.join(needed)} has none")
    try:
        made = config()
    except (Exception, SystemExit) as error:
        raise ConfigurationError(describe_at(error, folder_of(config)) or f"{where}: {error}") from error
    if isinstance(made, type) or not is_dataclass(made):
        remedy = f"put @dataclass(frozen=True) above class {name}" if isinstance(config, type) else "return a dataclass"
        raise ConfigurationError(f"{where}: the settings {name} are no dataclass; {remedy}")


def _without_default(config: object) -> list[str]:
    if not (isinstance(config, type) and is_dataclass(config)):
        return []
    return [each.name for each in fields(config)
            if each.init and each.default is MISSING and each.default_factory is MISSING]  # fmt: skip


def _config_class(kind: type[Any], argument: str) -> type[Any] | None:
    """Return the class of the settings that a constructor takes before `argument`; None if it takes none."""
    try:
        parameters = list(inspect.signature(kind).parameters.values())
    except (TypeError, ValueError):  # of compiled code
        return None
    positional = [each for each in parameters if each.kind in (each.POSITIONAL_ONLY, each.POSITIONAL_OR_KEYWORD)]
    needed = [each for each in positional if each.default is each.empty]
    only_by_name = [each for each in parameters if each.kind is each.KEYWORD_ONLY and each.default is each.empty]
    where = f"{_class_place(kind)}: {kind.__name__}"
    if len(needed) > 2 or only_by_name or not parameters:
        got = ", ".join(["self", *(each.name for each in parameters)])
        raise ConfigurationError(
            f"{where}.__init__ must take (self, {argument}) or (self, config, {argument}), got ({got})"
        )
    if len(needed) < 2:
        return None
    wanted = (
        f"{where}.__init__ must name the dataclass of its settings, such as {needed[0].name}: {kind.__name__}Config"
    )
    try:
        config = get_type_hints(kind.__init__).get(needed[0].name)
    except Exception as error:  # annotations are code of the user
        raise ConfigurationError(f"{wanted}; {describe_at(error, folder_of(kind))}") from error
    if not isinstance(config, type):
        raise ConfigurationError(wanted)
    return config


def _summary(kind: type[Any]) -> str:
    lines = (kind.__doc__ or "").strip().splitlines()
    return lines[0] if lines else kind.__name__


def _class_place(kind: type[Any]) -> str:
    """Return `FILE:LINE` of a class, or the name of its module."""
    try:
        file, line = inspect.getfile(kind), inspect.getsourcelines(kind)[1]
    except (OSError, TypeError):
        return kind.__module__
    return f"{show(Path(file))}:{line}"


def _describe(given: object) -> str:
    if isinstance(given, type):
        return f"the class {given.__name__}"
    return f"the function {given.__name__}" if inspect.isroutine(given) else f"of type {type(given).__name__}"


@dataclass(frozen=True)
class Own(Generic[Entry]):
    """A controller or plant that is no part of servobench and no entry point.

    Attributes:
        word: "controller" or "plant".
        entry: which builds it.
        place: where it stands, for messages.
        source: its file; None where other processes import its module.
        file: path of the code; empty for code that was typed into an interpreter.
        digest: SHA-256 of the code; empty where it cannot be read.
        given: whether it was given as an object in Python.
    """

    word: str
    entry: Entry
    place: str
    source: SourceFile | None = None
    file: str = ""
    digest: str = ""
    given: bool = False

    @property
    def name(self) -> str:
        """Its name in tables."""
        return self.entry.name

    def record(self) -> dict[str, str]:
        """Return its record in the manifest of a results folder."""
        return {"place": self.place, "file": self.file, "sha256": self.digest}


def read_own(kind: Kind[Entry], text: str) -> Own[Entry]:
    """Return the controller or plant at a place, `[NAME=]FILE.py[:NAME]` or `[NAME=]MODULE:NAME`.

    Raises:
        ConfigurationError: it cannot be used; one line with file and line number.
    """
    found = PLACE.fullmatch(text)
    if found is None:
        raise ConfigurationError(f"{text!r} is no place of a {kind.word}, such as ./mine.py or ./mine.py:Mine")
    place = text.partition("=")[2] if found["alias"] else text
    if found["file"]:
        source = SourceFile.read(found["file"])
        given = _pick(kind, source.load(), found["file"], found["name"])
        file, digest = source.path, source.digest
    else:
        source, module = None, import_user_module(found["module"])
        given = _pick(kind, module, found["module"], found["attribute"])
        file, digest = Path(module.__file__ or found["module"]), digest_of_module(found["module"])
    if kind.make is None:
        entry = make_entry(kind, given, place, found["alias"])
    else:
        entry = kind.make(given, place, found["alias"])
    return Own(kind.word, entry, place, source, str(file), digest)


def own_object(kind: Kind[Entry], given: object) -> Own[Entry]:
    """Return a controller or plant that is given in Python: a class, an object or an entry.

    Raises:
        ConfigurationError: it is none of these, or cannot be used.
    """
    code = given.build if isinstance(given, kind.entry) else given
    built = code if isinstance(code, type) else type(code)
    entry = make_entry(kind, given, kind.word)
    try:
        file, text = inspect.getfile(built), inspect.getsource(built)
    except (OSError, TypeError):  # typed into an interpreter
        return Own(kind.word, entry, built.__qualname__, given=True)
    digest = hashlib.sha256(text.encode()).hexdigest()
    return Own(kind.word, entry, built.__qualname__, None, file, digest, given=True)


def _pick(kind: Kind[Any], module: ModuleType, where: str, name: str | None) -> object:
    """Return the object called `name` in a module, or without a name its only controller or plant."""
    found = _members(kind, module)
    if name is not None:
        if not hasattr(module, name):
            hint = suggest(name, found) if found else f"it defines no {kind.word}"
            raise ConfigurationError(f"{where} has no {name!r}: {hint}")
        return getattr(module, name)
    entry = getattr(module, "ENTRY", None)
    if isinstance(entry, kind.entry) or not isinstance(entry, ControllerEntry | PlantEntry | None):
        return entry
    if len(found) == 1:
        return next(iter(found.values()))
    if not found:
        bases = " or ".join(f"servobench.{each.__name__}" for each in kind.bases)
        others = [f"the {other.word} {each}" for other in (CONTROLLER, PLANT) for each in _members(other, module)]
        hint = f"; it defines {' and '.join(others)}" if others else ""
        raise ConfigurationError(f"{where} defines no {kind.word}: no subclass of {bases} and no ENTRY{hint}")
    first, *_ = found
    raise ConfigurationError(f"{where} defines {', '.join(found)}; name one of them, such as {where}:{first}")


def _members(kind: Kind[Any], module: ModuleType) -> dict[str, object]:
    """Return the objects of a kind that a module defines; classes that lack methods only if there are no others."""
    found: dict[str, object] = {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, kind.entry)
        or (isinstance(value, type) and issubclass(value, kind.bases) and value.__module__ == module.__name__)
    }
    whole = {name: value for name, value in found.items() if not inspect.isabstract(value)}
    return whole or found
