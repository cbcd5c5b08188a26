"""What users give as a controller, made into an entry and checked as far as that goes without a robot.

A class needs no entry: it is constructed as `Mine(knowledge)`, or as `Mine(config, knowledge)` where `config` is
annotated with a dataclass that has a default for every field.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from copy import deepcopy
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Final, get_type_hints

from servobench.controllers.controller import Controller, ControllerEntry, RobotKnowledge
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.config.source import describe_at, show
from servobench.plant.faults import RunFault
from servobench.plant.settings import settings

NAME: Final = re.compile(r"\w+(?:[:-]\w+)*")
WANTED: Final = "wanted a subclass of servobench.Controller or a servobench.ControllerEntry"


@settings
class NoSettings:
    """The settings of a controller that is given as a class: none."""


@dataclass(frozen=True, eq=False)
class Build:
    """Builds a controller by code of a user, whose errors are one line."""

    make: Callable[..., Any]
    with_config: bool = True

    def __call__(self, config: object, knowledge: RobotKnowledge) -> Controller:
        """Return the controller.

        Raises:
            ConfigurationError: the code raises anything but a `RunFault`, or returns no controller.
        """
        arguments = (config, knowledge) if self.with_config else (knowledge,)
        try:
            controller = self.make(*arguments)
        except RunFault:
            raise
        except (Exception, SystemExit) as error:
            raise ConfigurationError(describe_at(error, folder_of(self.make))) from error
        if not isinstance(controller, Controller):
            raise ConfigurationError(f"it is built as {type(controller).__name__}, wanted a servobench.Controller")
        return controller


@dataclass(frozen=True, eq=False)
class Copy:
    """Builds a controller from one that is there."""

    original: Controller

    def __call__(self, _knowledge: RobotKnowledge) -> Controller:
        """Return a copy, so that no run sees what another left behind."""
        return deepcopy(self.original)


def make_entry(given: object, place: str, name: str | None = None) -> ControllerEntry:
    """Return the entry of a class, an object or an entry, checked as far as it can be without a robot.

    Args:
        given: what a user gives.
        place: where it stands, for messages.
        name: what it is to be called; None for the name of the entry or of the class.

    Raises:
        ConfigurationError: it cannot be used; says what to change.
    """
    if isinstance(given, ControllerEntry):
        entry = given
        if isinstance(given.build, type) and issubclass(given.build, Controller):
            check_class(given.build)
        if not isinstance(given.build, Build):
            entry = replace(given, build=Build(given.build))
    elif isinstance(given, type) and issubclass(given, Controller):
        check_class(given)
        config = _config_class(given)
        entry = ControllerEntry(
            given.__name__, _summary(given), config or NoSettings, Build(given, with_config=config is not None)
        )
    elif isinstance(given, Controller):
        kind = type(given)
        entry = ControllerEntry(kind.__name__, _summary(kind), NoSettings, Build(Copy(given), with_config=False))
    else:
        raise ConfigurationError(f"{place} is {_describe(given)}, {WANTED}")
    entry = replace(entry, name=name or entry.name)
    _check_entry(entry, place)
    return entry


def check_class(kind: type[Controller]) -> None:
    """Refuse a class that lacks methods.

    Raises:
        ConfigurationError: names the class and the methods.
    """
    missing = sorted(getattr(kind, "__abstractmethods__", ()))
    if missing:
        lacking = " and ".join(", ".join(missing).rsplit(", ", 1))
        raise ConfigurationError(f"{_class_place(kind)}: class {kind.__name__} lacks {lacking}, which it must define")


def folder_of(code: object) -> Path:
    """Return the folder of the file that holds a class, a function or an object's class; that of none is the root."""
    code = getattr(code, "original", code)
    try:
        return Path(inspect.getfile(code if isinstance(code, type) or inspect.isroutine(code) else type(code))).parent
    except (TypeError, OSError):
        return Path.cwd()


def _check_entry(entry: ControllerEntry, place: str) -> None:
    if not (isinstance(entry.name, str) and NAME.fullmatch(entry.name)):
        raise ConfigurationError(f"{place}: the name must be letters, digits and _, got {entry.name!r}")
    if not callable(entry.config):
        raise ConfigurationError(f"{place}: config must be a dataclass or a function, got {entry.config!r}")
    check_settings(entry.config, place)


def check_settings(config: Callable[[], Any], place: str) -> None:
    """Refuse settings that cannot be made without arguments, or that are no dataclass.

    Raises:
        ConfigurationError: says what to change.
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


def _config_class(kind: type[Controller]) -> type[Any] | None:
    """Return the class of the settings that the constructor of a controller takes first; None if it takes none."""
    parameters = list(inspect.signature(kind).parameters.values())
    positional = [each for each in parameters if each.kind in (each.POSITIONAL_ONLY, each.POSITIONAL_OR_KEYWORD)]
    needed = [each for each in positional if each.default is each.empty]
    only_by_name = [each for each in parameters if each.kind is each.KEYWORD_ONLY and each.default is each.empty]
    where = f"{_class_place(kind)}: {kind.__name__}"
    if len(needed) > 2 or only_by_name or not parameters:
        got = ", ".join(["self", *(each.name for each in parameters)])
        raise ConfigurationError(
            f"{where}.__init__ must take (self, knowledge) or (self, config, knowledge), got ({got})"
        )
    if len(needed) < 2:
        return None
    try:
        config = get_type_hints(kind.__init__).get(needed[0].name)
    except (NameError, TypeError):
        config = None
    if not isinstance(config, type):
        raise ConfigurationError(
            f"{where}.__init__ must name the dataclass of its settings, such as {needed[0].name}: {kind.__name__}Config"
        )
    return config


def _summary(kind: type[Controller]) -> str:
    return (kind.__doc__ or kind.__name__).strip().splitlines()[0]


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
