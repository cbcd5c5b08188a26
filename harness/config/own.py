"""Controllers and plants of users: classes, objects and entries, given in Python or by the place of their code.

A place is a file, `./mine.py`, with `:NAME` if it defines several, or a module and a name, `package.module:NAME`. What
stands there is a `ControllerEntry`, a subclass of `Controller`, or an object of one; or a `PlantEntry`, or a subclass
of `Plant` or `World`.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import inspect
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Generic

from servobench.controllers.controller import ControllerEntry
from servobench.harness.config.entries import CONTROLLER, PLANT, Entry, Kind, make_entry
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.config.source import SourceFile, describe_at, make_importable
from servobench.plant.bench.plant import PlantEntry
from servobench.plant.contract.settings import suggest

PLACE: Final = re.compile(
    r"(?:(?P<alias>\w+)=)?(?:(?P<file>.+\.py)(?::(?P<name>\w+))?|(?P<module>[\w.]+):(?P<attribute>\w+))"
)


@dataclass(frozen=True)
class Own(Generic[Entry]):
    """A controller or plant that is no part of servobench and no entry point.

    Attributes:
        word: "controller" or "plant".
        entry: what it is built by.
        place: where it stands, for messages.
        source: its file; None where other processes import its module.
        file: path of the code; empty for what was typed into an interpreter.
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
        """What it is called in tables."""
        return self.entry.name

    def record(self) -> dict[str, str]:
        """Return what the manifest of a results folder says about it."""
        return {"place": self.place, "file": self.file, "sha256": self.digest}


def is_place(text: str) -> bool:
    """Return whether a text says where code stands, and is no name; of a module, whether there is such a one."""
    found = PLACE.fullmatch(text)
    if found is None:
        return False
    return found["file"] is not None or _can_import(found["module"])


def read_own(kind: Kind[Entry], text: str) -> Own[Entry]:
    """Return the controller or plant at a place, `[NAME=]FILE.py[:NAME]` or `[NAME=]MODULE:NAME`.

    Raises:
        ConfigurationError: whatever is wrong with it, as one line with file and line number.
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
        source, module = None, _import(found["module"])
        given = _pick(kind, module, found["module"], found["attribute"])
        file, digest = Path(module.__file__ or found["module"]), digest_of_module(found["module"])
    entry = make_entry(kind, given, place, found["alias"])
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
    """Return what a module calls `name`, or without a name its only controller or plant."""
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
    """Return what a module defines of a kind itself; classes that lack methods only if there are no others."""
    found: dict[str, object] = {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, kind.entry)
        or (isinstance(value, type) and issubclass(value, kind.bases) and value.__module__ == module.__name__)
    }
    whole = {name: value for name, value in found.items() if not inspect.isabstract(value)}
    return whole or found


def _can_import(module: str) -> bool:
    make_importable(Path.cwd())
    try:
        return importlib.util.find_spec(module.partition(".")[0]) is not None
    except (ImportError, ValueError):
        return False


def _import(module: str) -> ModuleType:
    make_importable(Path.cwd())
    try:
        return importlib.import_module(module)
    except (Exception, SystemExit) as error:
        raise ConfigurationError(describe_import(error, module)) from error


def describe_import(error: BaseException, module: str) -> str:
    """Return why a module cannot be imported, as one line with the place in it where there is one."""
    return describe_at(error, folder_of_module(module))


def digest_of_module(module: str) -> str:
    """Return the SHA-256 of the file of a module that is imported; empty where it has none."""
    file = Path(getattr(sys.modules.get(module), "__file__", None) or "")
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""


def folder_of_module(module: str) -> Path:
    """Return the folder of the top-level package of a module, or of a module without one; else the present folder."""
    spec = None
    with contextlib.suppress(ImportError, ValueError):
        spec = importlib.util.find_spec(module.partition(".")[0])
    return Path(spec.origin).parent if spec is not None and spec.has_location and spec.origin else Path.cwd()
