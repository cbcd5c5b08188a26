"""Writes the generated parts of the pages: settings, methods, variables of the exported FMU, and measured tables.

    make tables

It also stores the strings below the fields of settings, for installations without sources.
A generated part of a page is everything between two comments, of which the first says what belongs there:

    <!-- settings: controllers/laws/mfac.py:MfacConfig -->
    <!-- settings: circle=harness/run/tasks.py:CurveTask,line=harness/run/tasks.py:LineTask -->
    <!-- metrics: table -->
    <!-- variables: ur5_mismatched -->
    <!-- table: worlds -->
    <!-- table: challenges:severe,wide -->
    <!-- table: claims_summary:@1,2,4 -->
    <!-- stored: dynamics,dynamics_circle -->
    <!-- studies: docs/page_studies -->
    <!-- methods: table -->
    <!-- methods: presets -->
    <!-- attributes: observation=plant/contract/signals.py:Observation -->
    <!-- interface: servobench.run,servobench.load -->
    <!-- install: report -->
    <!-- end -->

The meaning of a setting is the string below its field, the default that of the class, with the other choices behind it.
Several classes share a table, in which a setting with one meaning stands once. Dimensionless settings show no unit.
A section of settings that has a table of its own on some page is explained there only: other tables list the defaults
in which they differ. A measured table is one of docs/tables, or some of its rows by their first cell, or some of its
columns by number. `make results` writes it; until it exists the part stays as it is.
`stored` links to measured tables of a study instead. `attributes`
and `interface` print docstrings and signatures. `install` shows how to install servobench with extras: once a release
is on a package index, set `RELEASED` and call `make tables`.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import importlib
import inspect
import json
import os
import re
import sys
import textwrap
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pandas as pd

import stored_tables
from page_studies import STUDIES
from servobench.controllers.aids import EQUIPPED, AidsConfig
from servobench.controllers.methods import ESTIMATORS, LAWS, METHODS, PUBLISHED, Part
from servobench.fmus.export import arm_layout
from servobench.harness.config import registry
from servobench.harness.config.description import describe_settings, toml
from servobench.harness.config.installation import CODE_FOLDERS
from servobench.harness.config.settings import flatten
from servobench.harness.run.metrics import BUILT_IN
from servobench.plant.contract.settings import STORED_STRINGS, strings_in

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "fmus" / "ur5_mismatched" / "readme.md",
]
PART = re.compile(
    r"(<!-- (settings|metrics|variables|table|stored|studies|methods|install|attributes|interface): "
    r"(\S+) -->\n)(.*?)(<!-- end -->)",
    re.DOTALL,
)
RELEASED = False  # whether a release is on a package index, from which all pages then install
SETTING = ("setting [unit]", "default", "meaning")


def main() -> None:
    """Write every generated part of every page anew."""
    for page in PAGES:
        page.write_text(renewed(page), encoding="utf-8")
    STORED_STRINGS.write_text(field_strings_of_package(), encoding="utf-8")


def field_strings_of_package() -> str:
    """Return the strings below fields as JSON by class and field, for installations without sources."""
    found = {}
    for folder in CODE_FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            module = ".".join(("servobench", *path.relative_to(ROOT).with_suffix("").parts))
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if strings := strings_in(node):
                    found[f"{module.removesuffix('.__init__')}.{node.name}"] = strings
    return json.dumps(found, indent=1, ensure_ascii=False) + "\n"


def renewed(page: Path) -> str:
    """Return the text of a page with its generated parts made anew from the code and the stored tables."""
    make = {
        "settings": lambda part: settings_table(labelled(part[3])),
        "metrics": lambda _: metrics_table(),
        "variables": lambda _: variables_table(),
        "studies": lambda _: studies_table(),
        "methods": lambda part: presets_table() if part[3] == "presets" else methods_table(),
        "install": lambda part: install_lines(part[3]),
        "attributes": lambda part: attributes_table(labelled(part[3])),
        "interface": lambda part: interface(part[3].split(",")),
        "table": lambda part: measured(part, page.parent),
        "stored": lambda part: measured(part, page.parent),
    }
    text = page.read_text(encoding="utf-8")
    return PART.sub(lambda part: f"{part[1]}\n{make[part[2]](part)}\n\n{part[5]}", text)


def install_lines(extras: str) -> str:
    """Return the lines that install servobench into a new environment; extras have commas between them, or `plain`."""
    brackets = "" if extras == "plain" else f"[{extras}]"
    lines = ["python3 -m venv bench && . bench/bin/activate"]
    if RELEASED:
        lines.append(f"pip install 'servobench{brackets}'")
    else:
        lines = [
            "git clone <this repository> servobench",
            *lines,
            f"pip install './servobench{brackets}'",
        ]
    return "\n".join(f"    {line}" for line in lines)


def studies_table() -> str:
    """Return the table of the studies behind the measured tables and pictures."""
    rows = [(f"`{study.name}`", study.purpose, f"{study.minutes:g}") for study in STUDIES.values()]
    return table(("study", "what it measures", "minutes on two processors"), rows)


def methods_table() -> str:
    """Return the table of the named methods: published ones in the row of their plain name, and those without parts."""
    rows = []
    for name in registry.CONTROLLERS:
        entry = registry.find_controller(name)
        truth = "yes" if entry.needs_truth else "no"
        if name not in METHODS:
            rows.append((f"`{name}`", "–", "–", "–", "none", truth))
        elif not name.endswith(PUBLISHED):
            config = entry.config()
            estimator, law = part_of(config.estimator, ESTIMATORS), part_of(config.law, LAWS)
            called = f"`{name}`" + (f", `{name}{PUBLISHED}`" if name + PUBLISHED in METHODS else "")
            networks = trained(ESTIMATORS[estimator], LAWS[law])
            rows.append(
                (called, f"`{estimator}`", f"`{law}`", aids_in_words(config.aids), networks, truth)
            )
    return table(
        ("controller", "estimator", "law", "aids", "offline networks", "gets the truth"), rows
    )


def presets_table() -> str:
    """Return the table of the settings in which a method differs from the defaults of its parts."""
    rows = [
        (f"`{name}.{section}.{key}`", toml(value))
        for name in METHODS
        for section in ("estimator", "law", "initial", "training")
        for key, value in differences(
            getattr(registry.find_controller(name).config(), section, None)
        ).items()
    ]
    return table(("preset", "default"), rows)


def differences(config: Any) -> dict[str, Any]:  # noqa: ANN401 - any settings
    """Return the settings that differ from the defaults of their class; none of a section that does not exist."""
    if config is None:
        return {}
    usual = flatten(type(config)())
    return {key: value for key, value in flatten(config).items() if value != usual[key]}


def part_of(config: Any, parts: dict[str, Part[Any]]) -> str:  # noqa: ANN401 - any settings
    """Return the name of the part that has these settings."""
    return next(name for name, part in parts.items() if part.config is type(config))


def trained(estimator: Part[Any], law: Part[Any]) -> str:
    """Return which offline networks a method starts from."""
    found = [word for word, part in (("Jacobian", estimator), ("controller", law)) if part.trained]
    return " and ".join(found) or "none"


def aids_in_words(aids: AidsConfig) -> str:
    """Return `none`, `all`, or all with what differs from all."""
    if not differences(aids):
        return "none"
    usual = flatten(AidsConfig(**EQUIPPED))
    other = {key: value for key, value in flatten(aids).items() if value != usual[key]}
    words = (f"`{key}` {value}".replace("False", "off") for key, value in other.items())
    return "all" + (f", but {', '.join(words)}" if other else "")


def measured(part: re.Match[str], folder: Path) -> str:
    """Return a table of docs/tables, or links to several, and how they were made; the part as it is before their study.

    Args:
        part: of the page, which names the tables.
        folder: of the page, from which its links go.
    """
    named, _, selected = part[3].partition(":")
    chosen, _, columns = selected.partition("@")
    paths = [stored_tables.FOLDER / f"{name}.csv" for name in named.split(",")]
    if not all(path.exists() for path in paths):
        return part[4].strip("\n")
    stamp, rows = stored_tables.read(paths[0])
    origin = f"commit {stamp['commit'][:12]}"
    links = {path.stem: Path(os.path.relpath(path, folder)).as_posix() for path in paths}
    if part[2] == "stored":
        listed = ", ".join(f"[`{name}`]({link})" for name, link in links.items())
        return f"All rows: {listed} ({origin})"
    if chosen:
        wanted = [f"`{row}`" for row in chosen.split(",")]
        rows = rows.set_index(rows.columns[0], drop=False).loc[wanted]
    if columns:
        rows = rows.iloc[:, [int(number) - 1 for number in columns.split(",")]]
    stamp_line = f"{origin}; [commands]({links[named]})"
    fine = least_differences(rows)
    if fine and folder != ROOT:  # the first page has no room
        stamp_line += f"; robots are resampled; unpaired cells differ from {fine} on"
    return f"{table(tuple(rows), rows.itertuples(index=False))}\n\n{stamp_line}"


def least_differences(rows: pd.DataFrame) -> str:
    """Return for each column with intervals √2 times the median of their half-widths; columns alike share one."""
    found: dict[str, list[str]] = {}
    for name in rows:
        ends = rows[name].str.extract(r"\[([-+]?[\d.]+), ([-+]?[\d.]+)\]").astype(float).dropna()
        if len(ends):
            reach = (ends[1] - ends[0]).median() / 2.0**0.5
            least = f"{reach:.1g}" if reach else "the last digit"
            found.setdefault(least, []).append(str(name))
    if len(found) < 2:
        return "".join(found)
    return ", ".join(f"{least} ({', '.join(names)})" for least, names in found.items())


def find(place: str) -> Any:  # noqa: ANN401 - whatever has this name
    """Return the object that `place` names, such as `controllers/laws/mfac.py:MfacConfig`."""
    path, _, name = place.partition(":")
    return getattr(
        importlib.import_module("servobench." + path.removesuffix(".py").replace("/", ".")), name
    )


def labelled(places: str) -> dict[str, type[Any]]:
    """Return the classes of a marker by label, as of `ukf=PLACE,kalman=PLACE`; a single place may stand alone."""
    pairs = (each.rpartition("=") for each in places.split(","))
    return {label: find(place) for label, _, place in pairs}


def settings_table(kinds: dict[str, type[Any]]) -> str:
    """Return the table of the settings of classes by label; a setting that not all of them have names its classes."""
    owners: dict[tuple[str, str], dict[str, list[str]]] = {}
    for label, kind in kinds.items():
        for setting, default, meaning in settings_rows(kind):
            defaults = owners.setdefault((setting, meaning), {})
            defaults.setdefault(default, []).append(label)
    rows = []
    for (setting, meaning), defaults in owners.items():
        found = [label for labels in defaults.values() for label in labels]
        usual, *others = defaults
        cells = [usual, *(f"`{'`, `'.join(defaults[each])}`: {each}" for each in others)]
        rows.append((with_owners(setting, found, list(kinds)), "; ".join(cells), meaning, found))
    shared_first = sorted(rows, key=lambda row: -len(row[3]))
    return table(SETTING, [row[:3] for row in shared_first])


def with_owners(setting: str, owners: list[str], labels: list[str]) -> str:
    """Return a setting with the labels that have it, as `label.key`, `key` of several, or `key` where all have it."""
    if len(owners) == len(labels):
        return setting
    if len(owners) == 1:
        return setting.replace("`", f"`{owners[0]}.", 1)
    if 2 * len(owners) <= len(labels):
        return f"{setting} of " + ", ".join(f"`{label}`" for label in owners)
    others = [f"`{label}`" for label in labels if label not in owners]
    return f"{setting} of all but {', '.join(others)}"


def settings_rows(kind: type[Any]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the settings of a class.

    Raises:
        ValueError: a field has no string below it.
    """
    default = kind()
    for each in describe_settings(default):
        section, _, key = each.key.partition(".")
        own = getattr(default, section)
        if key and type(own) in classes_with_tables() and key not in differences(own):
            continue
        if not each.meaning:
            raise ValueError(
                f"{kind.__name__}.{each.key} has no string below it that says its meaning"
            )
        unit = f" [{each.unit}]" if each.unit not in ("", "1") else ""
        value = toml(each.value)
        choices = each.allowed.split(", ") if value in each.allowed.split(", ") else []
        others = ", ".join(choice for choice in choices if choice != value)
        meaning = "see below" if key and type(own) in classes_with_tables() else each.meaning
        yield (f"`{each.key}`{unit}", f"{value}, or {others}" if others else value, meaning)


@functools.cache
def classes_with_tables() -> frozenset[type[Any]]:
    """Return the classes of settings that have a table on some page."""
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    parts = (labelled(places) for _, kind, places, *_ in PART.findall(text) if kind == "settings")
    return frozenset(kind for part in parts for kind in part.values())


def attributes_table(kinds: dict[str, type[Any]]) -> str:
    """Return the table of the attributes of objects by name; those of the true robot are for bounds and left out."""
    rows = [
        (f"`{label}.{name}`", meaning)
        for label, kind in kinds.items()
        for name, meaning in attributes(kind).items()
        if not name.startswith("true_")
    ]
    return table(("attribute", "content"), rows)


def attributes(kind: type[Any]) -> dict[str, str]:
    """Return the fields of a dataclass and its properties, each with its meaning from the docstrings.

    Raises:
        ValueError: a field has no entry below `Attributes:`.
    """
    text = inspect.getdoc(kind) or ""
    entries = re.findall(
        r"^    (\w+): (.*(?:\n {8}.*)*)", text.partition("Attributes:\n")[2], re.MULTILINE
    )
    found = {name: " ".join(meaning.split()) for name, meaning in entries}
    missing = [each.name for each in dataclasses.fields(kind) if each.name not in found]
    if missing:
        raise ValueError(f"{kind.__name__} has no line on {', '.join(missing)} below Attributes:")
    properties = {name: value for name, value in vars(kind).items() if isinstance(value, property)}
    for name, value in properties.items():
        text = inspect.getdoc(value) or ""
        found[name] = text[:1].lower() + text[1:]
    return {name: meaning.rstrip(".") for name, meaning in found.items()}


def interface(names: list[str]) -> str:
    """Return the source of definitions with their docstrings, of `CLASS(*)` with its methods, of a class its fields."""
    parts = []
    for name in names:
        place, _, word = name.removesuffix("(*)").rpartition(".")
        thing = getattr(importlib.import_module(place), word)
        source, signature, node = definition(thing)
        text = node.body[0]
        lines = [*signature, *source.splitlines()[text.lineno - 1 : text.end_lineno]]
        if name.endswith("(*)"):
            methods = (
                each
                for key, each in vars(thing).items()
                if inspect.isfunction(each) and key[0] != "_"
            )
            lines += [textwrap.indent(f"\n{in_brief(each)}", "    ") for each in methods]
        elif isinstance(thing, type):
            fields = (each for each in node.body if isinstance(each, ast.AnnAssign))
            lines += ["", *(f"    {ast.get_source_segment(source, each)}" for each in fields)]
        parts.append("```python\n" + "\n".join(lines) + "\n```")
    return "\n\n".join(parts)


def definition(thing: Any) -> tuple[str, list[str], Any]:  # noqa: ANN401 - a function or a class
    """Return the source of a function or a class, the lines before its docstring, and its node in the syntax tree.

    In these lines comments are left out, and a named constant is replaced by its value.
    """
    source = textwrap.dedent(inspect.getsource(thing))
    node: Any = ast.parse(source).body[0]
    constants = vars(sys.modules[thing.__module__])
    lines = (
        line.partition("  # ")[0]
        for line in source.splitlines()[node.lineno - 1 : node.body[0].lineno - 1]
    )
    return (
        source,
        [
            re.sub(r"\b[A-Z]+_[A-Z_]+\b", lambda word: toml(constants[word[0]]), line)
            for line in lines
        ],
        node,
    )


def in_brief(method: Any) -> str:  # noqa: ANN401 - a function
    """Return the signature of a method with the first line of its docstring."""
    return "\n".join(
        [*definition(method)[1], f'    """{inspect.getdoc(method).splitlines()[0]}"""']
    )


def metrics_table() -> str:
    """Return the table of the metrics of a run."""
    rows = [(f"`{metric.column}`", metric.meaning) for metric in BUILT_IN.values()]
    return table(("column", "definition"), rows)


def variables_table() -> str:
    """Return the table of the variables of the exported FMU."""
    rows = [
        (
            f"`{group.name}`",
            " × ".join(map(str, group.shape)),
            group.role,
            group.unit,
            group.description,
        )
        for group in arm_layout(6).groups
    ]
    return table(("variable", "size", "role", "unit", "meaning"), rows)


def table(header: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Return a Markdown table."""
    cells = [header, *(tuple(cell.replace("|", "\\|") for cell in row) for row in rows)]
    lines = ["| " + " | ".join(line) + " |" for line in cells]
    lines.insert(1, "|---" * len(header) + "|")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
