"""Settings from TOML files and `--set section.key=value`, mapped onto the frozen dataclasses beside each class.

A section is the name of a plant, a controller or a task, or `run`; keys below it are the fields of its dataclass,
nested with dots. Nothing else is read from the files, and an unknown section or key is refused.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

import cattrs
import cattrs.errors

Config = TypeVar("Config")


class ConfigurationError(ValueError):
    """A setting or name that cannot be used; the message is one line for the user."""


def suggest(word: str, known: Iterable[str]) -> str:
    """Return what to say after an unknown word: the nearest known one, then all of them."""
    names = sorted(known)
    nearest = difflib.get_close_matches(word, names, n=1)
    hint = f"did you mean {nearest[0]!r}? " if nearest else ""
    return f"{hint}valid: {', '.join(names)}"


@dataclass(frozen=True)
class Settings:
    """Overrides of defaults, by section.

    Attributes:
        sections: section -> nested keys -> plain values as TOML gives them.
    """

    sections: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def check_sections(self, known: Iterable[str]) -> None:
        """Refuse sections that nothing would read.

        Raises:
            ConfigurationError: names the section and the valid ones.
        """
        names = set(known)
        for section in self.sections:
            if section not in names:
                raise ConfigurationError(f"unknown section {section!r}: {suggest(section, names)}")

    def resolve(self, section: str, default: Config) -> Config:
        """Return the configuration `default` with the overrides of `section` applied.

        Raises:
            ConfigurationError: an unknown key, a value of the wrong type, or one that the dataclass refuses.
        """
        return _override(section, default, self.sections.get(section, {}))


def read_settings(path: Path | None, assignments: Iterable[str]) -> Settings:
    """Read a TOML file and apply `section.key=value` assignments on top of it.

    Raises:
        ConfigurationError: an unreadable or malformed file, or a malformed assignment.
    """
    sections: dict[str, Any] = {}
    if path is not None:
        try:
            sections = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigurationError(f"configuration file {path} cannot be read: {error}") from error
        except tomllib.TOMLDecodeError as error:
            raise ConfigurationError(f"configuration file {path} is not valid TOML: {error}") from error
        for name, section in sections.items():
            if not isinstance(section, dict):
                raise ConfigurationError(f"configuration file {path}: {name!r} stands outside a [section]")
    for assignment in assignments:
        _assign(sections, assignment)
    return Settings(sections)


def flatten(config: Any, prefix: str = "") -> dict[str, Any]:  # noqa: ANN401 - any configuration dataclass
    """Return the fields of a configuration dataclass by dotted key."""
    flat: dict[str, Any] = {}
    for item in fields(config):
        value = getattr(config, item.name)
        if is_dataclass(value):
            flat.update(flatten(value, f"{prefix}{item.name}."))
        else:
            flat[prefix + item.name] = value
    return flat


def _assign(sections: dict[str, Any], assignment: str) -> None:
    key, equals, text = assignment.partition("=")
    mapped = re.fullmatch(r"\s*(.+?\.toml)\.(.+)", key)  # a plant's name may be that of a file, fmu:crane.toml
    path = [mapped[1], *mapped[2].strip().split(".")] if mapped else key.strip().split(".")
    if not equals or len(path) < 2 or not all(path):
        raise ConfigurationError(f"--set needs section.key=value, such as kinematic.lag=0.1; got {assignment!r}")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()  # a bare word is a string
    target = sections
    for name in path[:-1]:
        target = target.setdefault(name, {})
        if not isinstance(target, dict):
            raise ConfigurationError(f"--set {assignment}: {name!r} is a value, not a section")
    target[path[-1]] = value


def _override(path: str, default: Config, values: Mapping[str, Any]) -> Config:
    hints = get_type_hints(type(default))
    names = [item.name for item in fields(cast(Any, default))]
    changes: dict[str, Any] = {}
    for key, value in values.items():
        if key not in names:
            raise ConfigurationError(
                f"{path} has no setting {key!r}: {suggest(key, names) if names else 'it has none'}"
            )
        present = getattr(default, key)
        if is_dataclass(present) != isinstance(value, Mapping):
            kind = "a section of its own" if is_dataclass(present) else "a plain value"
            raise ConfigurationError(f"{path}.{key} is {kind}, got {value!r}")
        if is_dataclass(present):
            changes[key] = _override(f"{path}.{key}", present, value)
        else:
            changes[key] = _structure(f"{path}.{key}", value, hints[key])
    try:
        return replace(cast(Any, default), **changes) if changes else default
    except ValueError as error:
        raise ConfigurationError(f"{path}: {error}") from error


def _structure(path: str, value: object, hint: Any) -> Any:  # noqa: ANN401 - the hint decides
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise ConfigurationError(f"{path}: wanted one of {', '.join(map(str, get_args(hint)))}, got {value!r}")
        return value
    try:
        return _CONVERTER.structure(value, hint)
    except (cattrs.errors.CattrsError, cattrs.BaseValidationError, ValueError, TypeError) as caught:
        error: BaseException = caught
        while isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        raise ConfigurationError(f"{path}: {' '.join(str(error).split())}") from caught


def _structure_float(value: object, _: type) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"wanted a number, got {value!r}")
    return float(value)


def _structure_int(value: object, _: type) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"wanted a whole number, got {value!r}")
    return value


def _structure_bool(value: object, _: type) -> bool:
    if not isinstance(value, bool):
        raise TypeError(f"wanted true or false, got {value!r}")
    return value


def _structure_str(value: object, _: type) -> str:
    if not isinstance(value, str):
        raise TypeError(f"wanted text, got {value!r}")
    return value


_CONVERTER = cattrs.Converter(forbid_extra_keys=True)
_CONVERTER.register_structure_hook(float, _structure_float)
_CONVERTER.register_structure_hook(int, _structure_int)
_CONVERTER.register_structure_hook(bool, _structure_bool)
_CONVERTER.register_structure_hook(str, _structure_str)
