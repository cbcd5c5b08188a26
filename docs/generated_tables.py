"""Writes the generated parts of the pages: settings, methods, variables of the exported FMU, and measured tables.

    make tables

A generated part of a page is everything between two comments, of which the first says what belongs there:

    <!-- settings: controllers/laws/mfac.py:MfacConfig -->
    <!-- variables: ur5_mismatched -->
    <!-- table: worlds -->
    <!-- studies: docs/page_studies -->
    <!-- methods: table -->
    <!-- methods: presets -->
    <!-- end -->

The meaning of a setting is the string below its field, what is allowed is its type, the default is that of the class.
A measured table is that of docs/tables, which `make results` writes; until it is there the part stays as it is.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import json
import os
import re
import sys
import textwrap
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import methods_table
import stored_tables
from page_studies import STUDIES
from servobench.fmus.export import arm_layout

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), ROOT / "fmus" / "ur5_mismatched" / "readme.md"]
PART = re.compile(r"(<!-- (settings|variables|table|studies|methods): (\S+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
UNIT = re.compile(r"(?:\[(.+?)\] ?)?(.*)")  # what a string below a field begins with
SIGNS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}


def main() -> None:
    """Write every generated part of every page anew."""
    for page in PAGES:
        page.write_text(renewed(page), encoding="utf-8")


def renewed(page: Path) -> str:
    """Return the text of a page with its generated parts made anew from the code and the stored tables."""
    make = {
        "settings": lambda part: settings_table(find(part[3])),
        "variables": lambda _: variables_table(),
        "studies": lambda _: studies_table(),
        "methods": lambda part: named_methods(part[3]),
        "table": lambda part: measured_table(part[3], page.parent) or part[4].strip("\n"),
    }
    text = page.read_text(encoding="utf-8")
    return PART.sub(lambda part: f"{part[1]}\n{make[part[2]](part)}\n\n{part[5]}", text)


def studies_table() -> str:
    """Return the table of the studies behind the measured tables and pictures."""
    rows = [(f"`{study.name}`", study.purpose, f"{study.minutes:g}") for study in STUDIES.values()]
    return table(("study", "what it measures", "minutes on two processors"), rows)


def named_methods(kind: str) -> str:
    """Return the table of the named methods, or for the kind "presets" that of their own defaults."""
    if kind == "presets":
        rows = [(f"`{name}.{key}`", toml(value)) for name, key, value in methods_table.presets_rows()]
        return table(methods_table.PRESETS_HEADER, rows)
    return table(methods_table.METHODS_HEADER, methods_table.methods_rows())


def measured_table(name: str, folder: Path) -> str:
    """Return a table of docs/tables with a line that says when it was made; nothing if it is not there.

    Args:
        name: of the table.
        folder: of the page, from which its links go.
    """
    path = stored_tables.FOLDER / f"{name}.csv"
    if not path.exists():
        return ""
    stamp, rows = stored_tables.read(path)
    place = Path(os.path.relpath(path, folder)).as_posix()
    made = f"commit {stamp['commit'][:12]}, {stamp['date']}, version {stamp['version']}"
    cells = [tuple(row) for row in rows.itertuples(index=False)]
    return f"{table(tuple(rows.columns), cells)}\n\n`make results ONLY={stamp['study']}`: {made}; [commands]({place})"


def find(place: str) -> Any:  # noqa: ANN401 - whatever has this name
    """Return the object that `place` names, such as `controllers/laws/mfac.py:MfacConfig`."""
    path, _, name = place.partition(":")
    return getattr(importlib.import_module("servobench." + path.removesuffix(".py").replace("/", ".")), name)


def settings_table(kind: type[Any]) -> str:
    """Return the table of the settings of a class; settings of a nested section have its name before theirs.

    Raises:
        ValueError: a field has no string below it.
    """
    rows = []
    for name, value, wanted, string in settings_rows(kind(), ""):
        unit, meaning = UNIT.fullmatch(string).groups(default="")  # type: ignore[union-attr]
        rows.append((f"`{name}`", toml(value), unit, wanted, meaning))
    return table(("setting", "default", "unit", "allowed", "meaning"), rows)


def settings_rows(config: Any, prefix: str) -> Iterator[tuple[str, Any, str, str]]:  # noqa: ANN401 - any settings
    """Yield name, default, what is allowed, and the meaning of each setting of `config`."""
    meanings, hints = field_strings(type(config)), get_type_hints(type(config), include_extras=True)
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from settings_rows(value, f"{prefix}{item.name}.")
        elif item.name not in meanings:
            raise ValueError(f"{type(config).__name__}.{item.name} has no string below it that says its meaning")
        else:
            yield prefix + item.name, value, allowed(hints[item.name]), meanings[item.name]


def field_strings(kind: type[Any]) -> dict[str, str]:
    """Return the strings below the fields of a class and of those that it inherits from, as one line each, by field."""
    strings = {}
    for each in reversed(kind.__mro__[:-1]):
        body = ast.parse(textwrap.dedent(inspect.getsource(each))).body[0].body  # type: ignore[attr-defined]
        for field, below in pairwise(body):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(below, ast.Expr)
                and isinstance(below.value, ast.Constant)
            ):
                strings[field.target.id] = " ".join(below.value.value.split())
    return strings


def allowed(hint: Any) -> str:  # noqa: ANN401 - any annotation
    """Return what a type allows, in words; nothing for what the default shows already."""
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
        return " or ".join(filter(None, (allowed(each) for each in arguments if each is not NoneType)))
    if origin is tuple:
        each = allowed(arguments[0])
        size = "list" if arguments[-1] is Ellipsis else f"{len(arguments)} numbers"
        return size + (f", each {each}" if each else "")
    return "whole" if hint is int else ""


def variables_table() -> str:
    """Return the table of the variables of the exported FMU."""
    rows = [
        (f"`{group.name}`", " × ".join(map(str, group.shape)), group.role, group.unit, group.description)
        for group in arm_layout(6).groups
    ]
    return table(("variable", "size", "role", "unit", "meaning"), rows)


def toml(value: Any) -> str:  # noqa: ANN401 - any setting
    """Return a value as TOML has it; nothing for a value that is absent."""
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return (
        "" if value is None else json.dumps(value, ensure_ascii=False) if isinstance(value, str | bool) else str(value)
    )


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a Markdown table."""
    lines = [header, ("---",) * len(header), *(tuple(cell.replace("|", "\\|") for cell in row) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


if __name__ == "__main__":
    sys.exit(main())
