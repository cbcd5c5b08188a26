"""Settings from TOML files and `--set section.key=value`, mapped onto the frozen dataclasses beside each class.

A section is the name of a plant, a controller or a task, or `run`; keys below it are the fields of its dataclass,
nested with dots. Nothing else is read from the files, and an unknown section or key is refused.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from servobench.plant.settings import override, suggest

Config = TypeVar("Config")


class ConfigurationError(ValueError):
    """A setting or name that cannot be used; the message is one line for the user."""


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
        try:
            return override(section, default, self.sections.get(section, {}))
        except ValueError as error:
            raise ConfigurationError(str(error)) from error


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
