"""Descriptions of settings: unit, meaning, allowed values and value in TOML; and a commented file of all of them."""

import json
import math
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from servobench.plant.contract.dependence import Only, declared
from servobench.plant.contract.settings import UNIT, field_strings

SIGNS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}


@dataclass(frozen=True)
class Setting:
    """A setting as a reader wants it."""

    key: str  # its dotted name within the section
    value: Any  # as it is
    unit: str  # of the value, such as `s`; empty where none is told
    allowed: str  # the values that may be given, in words; empty where the default shows the type already
    meaning: str  # one line; empty where none is told

    @property
    def group(self) -> str:
        """Dotted name of the nested section; empty for the section itself."""
        return self.key.rpartition(".")[0]

    @property
    def name(self) -> str:
        """The last part of the key."""
        return self.key.rpartition(".")[2]


def describe_settings(config: Any, prefix: str = "") -> Iterator[Setting]:  # noqa: ANN401 - any settings
    """Yield each setting of a configuration dataclass, those of nested sections with their name before theirs."""
    kind: Any = type(config)
    strings, hints = field_strings(kind), get_type_hints(kind, include_extras=True)
    dependences = declared(kind, Only)
    for item in fields(config):
        value = getattr(config, item.name)
        if is_dataclass(value):
            yield from describe_settings(value, f"{prefix}{item.name}.")
        else:
            unit, meaning = UNIT.fullmatch(strings.get(item.name, "")).groups(default="")  # type: ignore[union-attr]
            if meaning and item.name in dependences:
                meaning = f"{meaning.rstrip('.')}. {dependences[item.name]}"
            yield Setting(prefix + item.name, value, unit, allowed(hints[item.name]), meaning)


def allowed(hint: Any) -> str:  # noqa: ANN401 - any annotation
    """Return the values that a type allows, in words; empty where the default shows the type already."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        bounds = [
            f"{sign} {getattr(bound, name):g}"
            for bound in arguments[1:]
            for name, sign in SIGNS.items()
            if hasattr(bound, name)
        ]
        return ", ".join(part for part in (allowed(arguments[0]), *bounds) if part)
    if origin is Literal:
        return ", ".join(map(toml, arguments))
    if origin in (Union, UnionType):
        return " or ".join(
            filter(None, (allowed(each) for each in arguments if each is not NoneType))
        )
    if origin is tuple:
        each = allowed(arguments[0])
        size = "list" if arguments[-1] is Ellipsis else f"{len(arguments)} numbers"
        return size + (f", each {each}" if each else "")
    return "whole" if hint is int else ""


def toml(value: Any) -> str:  # noqa: ANN401 - any setting
    """Return a value as TOML has it; nothing for a value that is absent."""
    if isinstance(value, np.ndarray | tuple | list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, float | np.floating):
        return str(float(value))
    if isinstance(value, str | bool | Path):
        return json.dumps(value if isinstance(value, bool) else str(value), ensure_ascii=False)
    return "" if value is None else str(value)


def plain(value: Any) -> Any:  # noqa: ANN401 - any setting
    """Return a value as JSON can have it: arrays as lists, paths as text, infinity as the text "inf"."""
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray | tuple | list):
        return [plain(each) for each in value]
    if isinstance(value, float):
        if math.isfinite(value):
            return float(value)
        return str(value)
    if isinstance(value, str | bool | int | None):
        return value
    return str(value)


def restored(value: Any) -> Any:  # noqa: ANN401 - any setting
    """Return a value that `plain` made, with numbers for "inf", "-inf" and "nan"."""
    if isinstance(value, dict):
        return {key: restored(each) for key, each in value.items()}
    if isinstance(value, list):
        return [restored(each) for each in value]
    if value in ("inf", "-inf", "nan"):
        return float(value)
    return value


BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
WIDTH = 100  # characters of a line of comment
HEAD = """\
# Settings of servobench, for {use} and other commands.
# Each line has the value in use; leave out unchanged ones. --set SECTION.KEY=VALUE changes one for one call.
"""


def configuration_file(
    sections: Mapping[str, Any], defaults: Mapping[str, Any], titles: Mapping[str, str], use: str
) -> str:
    """Return the text of a TOML file that sets every setting of `sections` to its value there.

    Args:
        sections: configuration dataclasses by section.
        defaults: the same where nothing is set.
        titles: one line about each section.
        use: how the file is used, for the first line.
    """
    parts = [HEAD.format(use=use)]
    for section, config in sections.items():
        settings = list(describe_settings(config))
        normal = {each.key: toml(each.value) for each in describe_settings(defaults[section])}
        # Nested sections follow their own
        for group in dict.fromkeys(["", *(each.group for each in settings)]):
            lines = [
                _line(each, normal.get(each.key, "")) for each in settings if each.group == group
            ]
            heading = f"[{_key(section)}.{group}]"
            if not group:
                heading = f"{_comment(titles[section])}[{_key(section)}]"
            parts.append(f"{heading}\n{''.join(lines)}")
    return "\n".join(parts)


def _line(setting: Setting, default: str) -> str:
    """Return the comment and the line of a setting; one without a value is a comment, too."""
    value, unit = toml(setting.value), f"[{setting.unit}] " if setting.unit else ""
    usual = f"default {default}" if default else "unset by default"
    facts = "; ".join(filter(None, (setting.allowed, usual)))
    words = f"{unit}{setting.meaning or setting.name}".rstrip(".")
    return _comment(f"{words} ({facts})") + (
        f"{setting.name} = {value}\n" if value else f"# {setting.name} =\n"
    )


def _comment(text: str) -> str:
    lines = textwrap.wrap(text, WIDTH - 2, break_long_words=False, break_on_hyphens=False)
    return "".join(f"# {line}\n" for line in lines)


def _key(name: str) -> str:
    if BARE_KEY.fullmatch(name):
        return name
    return json.dumps(name, ensure_ascii=False)
