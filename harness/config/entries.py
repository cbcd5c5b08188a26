"""Controllers and plants of users as entries: classes, objects and entries, given in Python or by their place.

A place is a file, `./mine.py`, with `:NAME` if it defines several, or a module and a name, `package.module:NAME`. An
entry is checked as far as that goes without a robot. A class needs no entry: it is constructed as `Mine(knowledge)`, or
as `Mine(config, knowledge)` where `config` is annotated with a dataclass that has a default for every field. Plants and
worlds get a `PlantSetup` in place of the knowledge; a world is put on a bench. Errors of the user's code become one
line with their place, and answers of a world are checked.
"""

import contextlib
import hashlib
import inspect
import re
from collections.abc import Callable
from copy import deepcopy
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import partial
from inspect import Parameter
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, Protocol, TypeVar, get_type_hints

import numpy as np

from servobench.controllers.aided import with_aids
from servobench.controllers.controller import Controller, ControllerEntry, RobotKnowledge
from servobench.harness.config.settings import read_tuned
from servobench.harness.config.source import (
    SourceFile,
    code_digest,
    describe_at,
    digest_of_module,
    find_place,
    import_user_module,
    show,
)
from servobench.plant.bench.bench import Bench, build_bench
from servobench.plant.bench.plant import Plant, PlantEntry, PlantSetup, World
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import (
    ConfigurationError,
    PlantDiverged,
    RunFault,
    configuration_errors,
)
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import NonNegative, Section, nested, settings, suggest
from servobench.plant.contract.signals import PlantSpec

NAME = re.compile(r"\w+(?:[:-]\w+)*")


@settings
class NoSettings:
    """The settings of a controller or plant that is a class without a dataclass of settings: none."""


@settings
class BenchSettings:
    """The settings of a world that is given as a class without a dataclass of settings: those of its bench."""

    command_delay: NonNegative = 0.0
    """[s] between a command and its first effect"""
    sensing: SensingConfig = nested(SensingConfig)
    """noise, latency and lost frames"""


@dataclass(frozen=True, eq=False)
class Guarded:
    """A function of a user, whose errors are one line and whose result is of a known kind."""

    make: Callable[..., Any]  # called with the settings and a `RobotKnowledge` or `PlantSetup`
    kind: type[Controller | Plant | World] | None = None  # class of the result; None for any
    with_config: bool = True  # whether it takes the settings

    def __call__(self, *arguments: object) -> Any:  # noqa: ANN401 - an object of `kind`
        """Return the result.

        Raises:
            ConfigurationError: the code raises anything but a `RunFault`, or returns something else.
        """
        try:
            made = self.make(*arguments[0 if self.with_config else 1 :])
        except (RunFault, ConfigurationError):
            raise
        except (Exception, SystemExit) as error:
            raise ConfigurationError(describe_at(error)) from error
        if self.kind is not None and not isinstance(made, self.kind):
            raise ConfigurationError(
                f"it is built as {type(made).__name__}, wanted a servobench.{self.kind.__name__}"
            )
        if isinstance(made, Plant | World):
            _check_spec(made)
        return made


def copy_of(original: Controller, _knowledge: RobotKnowledge) -> Controller:
    """Return a copy of a controller that is there, so that no run sees the state of another."""
    return deepcopy(original)


def on_bench(world: type[World], with_config: bool, config: object, setup: PlantSetup) -> Bench:
    """Return the bench around a world, with delay and sensing of the settings where they have these fields.

    Args:
        world: its class.
        with_config: whether its constructor takes the settings.
        config: the settings.
        setup: of the plant.
    """
    build = partial(Guarded(add_checks(world), World, with_config), config)
    delay, sensing = (
        getattr(config, "command_delay", 0.0),
        getattr(config, "sensing", SensingConfig()),
    )
    return build_bench(build, setup, delay, sensing)


def add_checks(world: type[World]) -> type[World]:
    """Return a class of worlds whose joint positions and features are copied, checked and float64.

    Its methods raise a `ValueError` about an answer that is no such array, and `PlantDiverged` about one that is not
    finite.
    """

    class Checked(world):  # type: ignore[misc, valid-type] # a class of a user
        def reset(self, seed: int) -> FloatArray:
            return as_answer("reset", super().reset(seed), self.spec.n, "joint positions")

        def advance(self, joint_velocity: FloatArray) -> FloatArray:
            return as_answer(
                "advance", super().advance(joint_velocity), self.spec.n, "joint positions"
            )

        def see(self) -> FloatArray | None:
            seen = super().see()
            if seen is None:
                return None
            return as_answer("see", seen, self.spec.m, "features, or None")

    def as_answer(method: str, answer: object, size: int, content: str) -> FloatArray:
        wanted = f"{world.__name__}.{method} must return {size} {content}"
        try:
            values = np.array(answer, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{wanted}, got {answer!r}") from error
        if values.shape != (size,):
            raise ValueError(f"{wanted}, got shape {values.shape}")
        if not np.isfinite(values).all():
            raise PlantDiverged(
                f"{world.__name__}.{method} returned {values.tolist()}, which is not finite"
            )
        return values

    Checked.__name__ = world.__name__
    return Checked


def _check_spec(made: Plant | World) -> None:
    """Refuse a plant or world whose constructor left out its sizes, limits and period."""
    spec, name = getattr(made, "spec", None), type(made).__name__
    if not isinstance(spec, PlantSpec):
        came = "nothing" if spec is None else type(spec).__name__
        raise ConfigurationError(
            f"{name}.__init__ must set self.spec to a servobench.PlantSpec, got {came}; PlantSpec.of_joints(...) "
            "makes one"
        )


class Named(Protocol):
    """An entry: a frozen dataclass with a name."""

    @property
    def name(self) -> str:
        """The word by which users name it."""


Entry = TypeVar("Entry", bound=Named)


@dataclass(frozen=True)
class Kind(Generic[Entry]):
    """A kind of object that users may give: controllers, plants, or tasks."""

    word: str
    """for messages"""
    entry: type[Any]
    """its class of entries"""
    bases: tuple[type, ...]
    """classes below which it may be given; empty for functions"""
    wanted: str
    """the accepted objects, in words"""
    of_class: Callable[[type[Any]], Entry]
    """returns the entry of a class"""
    check: Callable[[Entry, str], Entry]
    """returns an entry that was checked, with a guard around the functions of a user; the text is its place, for the
    `ConfigurationError` of one that cannot be used, which says the remedy"""
    of_object: Callable[[Any], Entry] | None = None
    """returns the entry of an object that is built already; None where each run needs one of its own"""

    def make_entry(self, given: object, place: str, name: str | None = None) -> Entry:
        """Return the entry of a class, an object or an entry, checked as far as it can be without a robot.

        Args:
            given: by the user.
            place: where it stands, for messages.
            name: its name; None for the name of the entry or of the class.

        Raises:
            ConfigurationError: it cannot be used; says the remedy.
        """
        if isinstance(given, self.entry):
            entry = given
            if isinstance(build := getattr(given, "build", None), type):
                check_class(build)
        elif isinstance(given, type) and issubclass(given, self.bases):
            check_class(given)
            entry = self.of_class(given)
        elif isinstance(given, self.bases) and self.of_object is not None:
            entry = self.of_object(given)
        elif isinstance(given, self.bases):
            raise ConfigurationError(
                f"{place} is a {self.word} that is built already; give its class, as each run needs one"
            )
        else:
            raise ConfigurationError(f"{place} is {_describe(given)}, {self.wanted}")
        named: Entry = replace(entry, name=name or entry.name)
        if not (isinstance(named.name, str) and NAME.fullmatch(named.name)):
            raise ConfigurationError(
                f"{place}: the name must be letters, digits and _, got {named.name!r}"
            )
        return self.check(named, place)


def _controller_of_class(given: type[Any]) -> ControllerEntry:
    config = _config_class(given, "knowledge")
    build = Guarded(given, Controller, with_config=config is not None)
    return ControllerEntry(given.__name__, summary_of(given), config or NoSettings, build)


def _controller_of_object(given: Controller) -> ControllerEntry:
    own, build = type(given), Guarded(partial(copy_of, given), Controller, with_config=False)
    return ControllerEntry(own.__name__, summary_of(own), NoSettings, build)


def _checked_controller(entry: ControllerEntry, place: str) -> ControllerEntry:
    check_settings(entry.config, place)
    build = _guarded(entry.build, Controller)
    guarded = replace(entry, build=build)
    aids = getattr(build.make, "aids", None)
    with configuration_errors(f"{place}: "):
        if aids is None:
            return guarded
        return with_aids(guarded, aids)


def _plant_of_class(given: type[Any]) -> PlantEntry:
    config = _config_class(given, "setup")
    default: type[Any] = NoSettings
    build = Guarded(given, Plant, with_config=config is not None)
    if issubclass(given, World):
        build, default = Guarded(partial(on_bench, given, config is not None), Plant), BenchSettings
    own_robot = bool(given.own_robot)
    no_model = own_robot and given.nominal_jacobian is Plant.nominal_jacobian
    return PlantEntry(
        given.__name__,
        summary_of(given),
        config or default,
        build,
        own_robot=own_robot,
        no_model=no_model,
    )


def _checked_plant(entry: PlantEntry, place: str) -> PlantEntry:
    check_settings(entry.config, place)
    needs: object = entry.needs
    if not isinstance(needs, tuple):
        raise ConfigurationError(
            f"{place}: needs must be a tuple of names of modules, got {needs!r}"
        )
    code = entry.build
    if isinstance(code, type) and issubclass(code, World):
        code = partial(on_bench, code, True)
    engine, config_for = (
        None if each is None else Guarded(each) for each in (entry.engine, entry.config_for)
    )
    return replace(entry, build=_guarded(code, Plant), engine=engine, config_for=config_for)


CONTROLLER = Kind(
    "controller", ControllerEntry, (Controller,),
    "wanted a subclass of servobench.Controller or a servobench.ControllerEntry",
    _controller_of_class, _checked_controller, _controller_of_object,
)  # fmt: skip
PLANT = Kind(
    "plant", PlantEntry, (Plant, World),
    "wanted a subclass of servobench.Plant or servobench.World, or a servobench.PlantEntry",
    _plant_of_class, _checked_plant,
)  # fmt: skip


def _guarded(build: Callable[..., Any], kind: type[Controller | Plant]) -> Guarded:
    if isinstance(build, Guarded):
        return build
    return Guarded(build, kind)


def check_class(kind: type[Any]) -> None:
    """Refuse a class that lacks methods.

    Raises:
        ConfigurationError: names the class and the methods.
    """
    missing = sorted(getattr(kind, "__abstractmethods__", ()))
    if missing:
        lacking = " and ".join(", ".join(missing).rsplit(", ", 1))
        raise ConfigurationError(
            f"{_class_place(kind)}: class {kind.__name__} lacks {lacking}, which it must define"
        )


def check_settings(config: Callable[[], Any], place: str) -> None:
    """Refuse settings that cannot be made without arguments, or that are no dataclass.

    Raises:
        ConfigurationError: says the remedy.
    """
    if not callable(config):
        raise ConfigurationError(
            f"{place}: config must be a dataclass or a function, got {config!r}"
        )
    where, name = (
        (_class_place(config), config.__name__) if isinstance(config, type) else (place, "config")
    )
    known = fields(config) if isinstance(config, type) and is_dataclass(config) else ()
    needed = [each.name for each in known
              if each.init and each.default is MISSING and each.default_factory is MISSING]  # fmt: skip
    if needed:
        raise ConfigurationError(
            f"{where}: every field of {name} needs a default; {', '.join(needed)} has none"
        )
    try:
        made = config()
    except (Exception, SystemExit) as error:
        raise ConfigurationError(describe_at(error) or f"{where}: {error}") from error
    if isinstance(made, type) or not is_dataclass(made):
        remedy = (
            f"put @dataclass(frozen=True) above class {name}"
            if isinstance(config, type)
            else "return a dataclass"
        )
        raise ConfigurationError(f"{where}: the settings {name} are no dataclass; {remedy}")


def _config_class(kind: type[Any], argument: str) -> type[Any] | None:
    """Return the class of the settings that a constructor takes before `argument`; None if it takes none."""
    try:
        parameters = list(inspect.signature(kind).parameters.values())
    except (TypeError, ValueError):  # compiled code has no signature
        return None
    positional = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
    required = [each for each in parameters if each.default is each.empty]
    needed = [each for each in required if each.kind in positional]
    only_by_name = any(each.kind is each.KEYWORD_ONLY for each in required)
    must = f"{_class_place(kind)}: {kind.__name__}.__init__ must"
    if len(needed) > 2 or only_by_name or not parameters:
        got = ", ".join(["self", *(each.name for each in parameters)])
        raise ConfigurationError(
            f"{must} take (self, {argument}) or (self, config, {argument}), got ({got})"
        )
    if len(needed) < 2:
        return None
    wanted = f"{must} name the dataclass of its settings, such as {needed[0].name}: {kind.__name__}Config"
    try:
        config = get_type_hints(kind.__init__).get(needed[0].name)
    except Exception as error:  # annotations are code of the user
        raise ConfigurationError(f"{wanted}; {describe_at(error)}") from error
    if not isinstance(config, type):
        raise ConfigurationError(wanted)
    return config


def summary_of(kind: type[Any]) -> str:
    """Return the first line of the docstring of a class, or its name."""
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
    if inspect.isroutine(given):
        return f"the function {given.__name__}"
    return f"of type {type(given).__name__}"


@dataclass(frozen=True)
class Own(Generic[Entry]):
    """A controller or plant that is no part of servobench and no entry point."""

    word: str  # "controller" or "plant"
    entry: Entry  # which builds it
    place: str  # where it stands, for messages
    source: SourceFile | None = None  # its file; None where other processes import its module
    file: str = ""  # path of the code; empty for code that was typed into an interpreter
    digest: str = ""  # SHA-256 of the code; empty where it cannot be read
    given: bool = False  # whether it was given as an object in Python
    code: str = ""  # SHA-256 of the code and the modules beside it; empty where no file holds it
    tuned_path: Path = Path()  # the file of its tuned values, beside its code
    # Content of that file; empty for a controller that is not tuned
    tuned: Section = field(default_factory=dict, compare=False)

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
    found = find_place(text)
    if found is None:
        raise ConfigurationError(
            f"{text!r} is no place of a {kind.word}, such as ./mine.py or ./mine.py:Mine"
        )
    place = text.partition("=")[2] if found["alias"] else text
    if found["file"]:
        source = SourceFile.read(found["file"])
        given = _pick(kind, source.load(), found["file"], found["name"])
        file, digest = source.path, source.digest
    else:
        source, module = None, import_user_module(found["module"])
        given = _pick(kind, module, found["module"], found["attribute"])
        file, digest = Path(module.__file__ or found["module"]), digest_of_module(found["module"])
    entry = kind.make_entry(given, place, found["alias"])
    own = Own(kind.word, entry, place, source, str(file), digest)
    return _with_tuned_values(own, getattr(given, "__name__", None) or entry.name)


def own_object(kind: Kind[Entry], given: object) -> Own[Entry]:
    """Return a controller or plant that is given in Python: a class, an object or an entry.

    Raises:
        ConfigurationError: it is none of these, or cannot be used.
    """
    code = given.build if isinstance(given, kind.entry) else given
    built = code if isinstance(code, type) else type(code)
    entry = kind.make_entry(given, kind.word)
    try:
        file, text = inspect.getfile(built), inspect.getsource(built)
    except (OSError, TypeError):  # typed into an interpreter
        return Own(kind.word, entry, built.__qualname__, given=True)
    digest = hashlib.sha256(text.encode()).hexdigest()
    own = Own(kind.word, entry, built.__qualname__, None, file, digest, given=True)
    if isinstance(given, kind.bases):  # an object that is built already has no settings
        return own
    return _with_tuned_values(own, entry.name)


def _with_tuned_values(own: Own[Any], name: str) -> Own[Any]:
    """Return a controller with the tuned values that lie beside its code, if there are any of this version of it.

    Args:
        own: anything of a user.
        name: of it in its code.
    """
    file = Path(own.file)
    if own.word != CONTROLLER.word or not file.is_file():
        return own
    path = file.with_name(f"{file.stem}.{name}.tuned.toml")
    code = code_digest(file)
    tuned = read_tuned(path, own.entry, own.place, code)
    entry = replace(own.entry, tuned=tuned.get("settings", {}))
    return replace(own, entry=entry, code=code, tuned_path=path, tuned=tuned)


def _pick(kind: Kind[Any], module: ModuleType, where: str, name: str | None) -> object:
    """Return the object called `name` in a module, or without a name its only controller or plant."""
    found = _members(kind, module)
    if name is not None:
        if not hasattr(module, name):
            hint = (
                suggest(name, found) if found else f"it defines no {kind.word}{_guard_hint(module)}"
            )
            raise ConfigurationError(f"{where} has no {name!r}: {hint}")
        return getattr(module, name)
    entry = getattr(module, "ENTRY", None)
    if isinstance(entry, kind.entry) or not isinstance(entry, ControllerEntry | PlantEntry | None):
        return entry
    if len(found) == 1:
        return next(iter(found.values()))
    if not found:
        bases = " or ".join(f"servobench.{each.__name__}" for each in kind.bases)
        lack = f"no subclass of {bases} and no ENTRY"
        if not kind.bases:
            lack = kind.wanted
        others = [
            f"the {other.word} {each}"
            for other in (CONTROLLER, PLANT)
            for each in _members(other, module)
        ]
        hint = f"; it defines {' and '.join(others)}" if others else _guard_hint(module)
        raise ConfigurationError(f"{where} defines no {kind.word}: {lack}{hint}")
    first, *_ = found
    raise ConfigurationError(
        f"{where} defines {', '.join(found)}; name one of them, such as {where}:{first}"
    )


def _guard_hint(module: ModuleType) -> str:
    """Return the remedy for a script whose classes may be in the part that only runs as a script; else empty."""
    with contextlib.suppress(OSError, TypeError):  # no file with source
        if re.search(r"__main__.*^\s+class ", inspect.getsource(module), re.DOTALL | re.MULTILINE):
            return "; define it above `if __name__ == '__main__':`"
    return ""


def _members(kind: Kind[Any], module: ModuleType) -> dict[str, object]:
    """Return the objects of a kind that a module defines; classes that lack methods only if there are no others."""
    found = {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, kind.entry)
        or (
            isinstance(value, type)
            and issubclass(value, kind.bases)
            and value.__module__ == module.__name__
        )
    }
    whole = {name: value for name, value in found.items() if not inspect.isabstract(value)}
    return whole or found
