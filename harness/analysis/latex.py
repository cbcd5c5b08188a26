"""A results folder for a paper, in LaTeX: tables with booktabs, a paragraph *Methods* and its BibTeX entry."""

import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import NamedTuple

import pandas as pd

from servobench.harness.analysis.folder import (
    describe_controllers,
    describe_folder,
    describe_tuning,
)
from servobench.harness.analysis.tables import DIFFERENCE, Statistics, as_text
from servobench.harness.batch.results import Manifest
from servobench.harness.config.installation import short_commit
from servobench.harness.run.outcome import FOLLOWED, SETTLED
from servobench.harness.run.variations import varied_columns, varied_in_row
from servobench.plant.contract.settings import Section
from servobench.plant.robot.catalogue import read_word

SIGNS = str.maketrans(
    {
        **{sign: f"\\{sign}" for sign in "_%&#${}"},
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "\u00a0": "~",
        "∞": r"$\infty$",
        "–": "--",
        "−": "$-$",
        "×": r"$\times$",
        "†": r"$^\dagger$",
        "<": "$<$",
        ">": "$>$",
        "µ": r"$\mu$",
        "²": "$^2$",
        "³": "$^3$",
    }
)
INTERVAL = re.compile(r" (\[[^\[]*\])$")
NUMBER = re.compile(r"[-+<\d∞–]")
MINUS = re.compile(r"(?<![\w.])-(?=\d)")
MAX_LETTERS_OF_ONE_COLUMN = 50  # a table with wider rows spans both columns of a paper
HEADING = 12  # letters on one line of a heading
BIBTEX = r"""\begin{filecontents*}[overwrite]{servobench.bib}
@misc{servobench,
  author = {{The servobench maintainers}},
  title = {{servobench: a bench for uncalibrated visual-servoing controllers}},
  year = {%s},
  note = {Version %s}
}
\end{filecontents*}"""


def latex_tables(statistics: Statistics, folder: str) -> Iterator[str]:
    """Yield the tables of statistics in LaTeX: places whose tables have the same columns share one.

    Args:
        statistics: of a results folder.
        folder: its name, for the labels `tab:FOLDER-settled`, `tab:FOLDER-followed` and `tab:FOLDER-pairs`.
    """
    name = re.sub(r"[^\w.-]", "-", folder)
    controllers = [_Part(place.words, as_text(place.controllers)) for place in statistics.places]
    for kind in (SETTLED, FOLLOWED):
        parts = [part for part in controllers if f"{kind} [%]" in part.rows]
        if parts:
            caption = f"Share of runs that {kind}, medians and failures"
            yield _table(caption, f"tab:{name}-{kind}", parts)
    pairs = []
    for place in statistics.places:
        if place.pairs:
            measure = f"{DIFFERENCE} in {place.measure}"
            rows = as_text(place.pairs).rename(columns={measure: DIFFERENCE})
            words = f"{place.words}: {place.measure}, margin {place.margin}"
            pairs.append(_Part(words, rows))
    if pairs:
        caption = f"Paired differences, p corrected (Holm) over the {statistics.family}"
        yield _table(caption, f"tab:{name}-pairs", pairs)


class _Part(NamedTuple):
    """The rows of a place in a table."""

    words: str
    rows: pd.DataFrame


def _table(caption: str, label: str, parts: Sequence[_Part]) -> str:
    """Return a table of text for the package booktabs, over both columns of a paper if it is wide.

    A single place is named in the caption, each of several above its rows.
    """
    rows = pd.concat([part.rows for part in parts])
    letters = sum(rows[name].str.len().max() for name in rows)
    kind = "table" if letters <= MAX_LETTERS_OF_ONE_COLUMN else "table*"
    sides = "".join("r" if rows[name].str.match(NUMBER).all() else "l" for name in rows)
    headings = " & ".join(map(_heading, rows.columns, sides))
    body = []
    for part in parts:
        if len(parts) == 1:
            caption += f": {part.words}"
        else:
            place = part.words.translate(SIGNS)
            body.append(rf"\multicolumn{{{len(sides)}}}{{@{{}}l}}{{\itshape {place}}} \\")
        body += [rf"{' & '.join(row)} \\" for row in part.rows.map(_cell).itertuples(index=False)]
        body.append(r"\midrule")
    lines = [
        rf"\begin{{{kind}}}\centering\footnotesize\setlength{{\tabcolsep}}{{4pt}}",
        rf"\caption{{{caption.translate(SIGNS)}}}\label{{{label}}}",
        rf"\begin{{tabular}}{{@{{}}{sides}@{{}}}}\toprule",
        rf"{headings} \\\midrule",
        *body[:-1],
        rf"\bottomrule\end{{tabular}}\end{{{kind}}}",
    ]
    return "\n".join(lines)


def _cell(text: str) -> str:
    """Return a cell with a true minus and its interval in small print."""
    escaped = MINUS.sub("$-$", text.translate(SIGNS))
    return INTERVAL.sub(r" {\\scriptsize \1}", escaped)


def _heading(name: str, side: str) -> str:
    """Return a heading over several lines, its unit on the last one."""
    words, _, unit = name.partition(" [")
    lines = textwrap.wrap(words.replace(" %", "\u00a0%"), HEADING)
    if unit:
        lines.append(f"[{unit}")
    text = r"\\{}".join(line.translate(SIGNS) for line in lines)
    return rf"\begin{{tabular}}[b]{{@{{}}{side}@{{}}}}{text}\end{{tabular}}"


def methods_paragraph(
    manifest: Manifest,
    runs: pd.DataFrame,
    statistics: Statistics,
    names: Mapping[str, str],
) -> str:
    """Return a paragraph that says how the runs of a folder were made and judged, and its BibTeX entry.

    Args:
        manifest: of the folder.
        runs: all of its runs.
        statistics: those that are shown.
        names: the controllers that are shown, with their names in tables.
    """
    shown = runs[runs["controller"].isin(list(names))]
    titles = []
    for name, label in names.items():
        if label == name:
            titles.append(name)
        else:
            titles.append(f"{label} ({name})")
    facts = describe_folder(manifest, shown) | {"controller": ", ".join(titles)}
    packages = manifest.get("packages") or {}
    version = str(packages.get("servobench") or "unknown").translate(SIGNS)
    commit = short_commit(manifest.get("git_commit") or "unknown").translate(SIGNS)
    python = manifest.get("python", "unknown")
    tools = ", ".join([f"Python {python}", *_used_libraries(manifest)]).translate(SIGNS)
    # The first sentence is LaTeX already, with a citation; the others are plain text.
    first = f"All runs were made with servobench {version}~\\cite{{servobench}} (commit {commit}, {tools})"
    sentences = [
        _combinations(manifest, facts),
        _aids(manifest, names),
        *describe_tuning(manifest, command=False),
        _varied(facts, shown),
        _robots(facts, shown),
        "Rates are given with Wilson intervals (95 %), medians with bootstrap intervals (95 %)",
        "Differences are paired by robot, with Student's intervals (90 %) of their means; verdicts are those of a sign "
        "test on lost runs, which ended early or have no value, and of two one-sided t-tests (5 %) against the margin",
        "p-values are those of two-sided exact sign tests over robots, where a lost run is worse than any other; in "
        f"brackets after Holm's correction ({statistics.family}); on average: the sign test does not show the verdict "
        "of the means (5 %)",
        _settings(manifest.get("changed")),
    ]
    text = ". ".join([first, *(each.translate(SIGNS) for each in sentences if each)])
    year = str(manifest.get("created", ""))[:4].translate(SIGNS)
    entry = BIBTEX % (year, f"{version}, commit {commit}")
    return rf"\paragraph{{Methods}} {text}." + f"\n\n{entry}"


def _used_libraries(manifest: Manifest) -> list[str]:
    """Return the numerical libraries and the engines with their versions, as far as known."""
    packages = manifest.get("packages") or {}
    libraries = [f"{name} {packages[name]}" for name in ("numpy", "scipy") if packages.get(name)]
    engines = manifest.get("engines") or {}
    return [*libraries, *map(str, engines.values())]


def _combinations(manifest: Manifest, facts: Mapping[str, str]) -> str:
    """Return a sentence on controllers, tasks, plant, sensing and mismatch."""
    titles = []
    for robot in manifest.get("robots", []):
        title = str(robot.get("title"))
        camera = read_word(str(robot.get("name"))).camera
        if camera:
            title += f" with {PurePath(camera).name}"
        titles.append(title)
    robots = ", ".join(titles) or "unknown robot"
    return (
        f"Controllers: {facts['controller']}; tasks: {facts['task']}; plant: {facts['plant']} ({robots}); "
        f"sensing: {facts.get('sensing', 'position')}; mismatch between true and nominal robot: {facts['mismatch']}"
    )


def _aids(manifest: Manifest, names: Mapping[str, str]) -> str:
    """Return a sentence on the aids of several controllers, by their names in tables; empty for a single one."""
    aids = describe_controllers(manifest, names)
    if not aids:
        return ""
    return f"Aids (stages around the law, which any controller can have): {aids}"


def _robots(facts: Mapping[str, str], runs: pd.DataFrame) -> str:
    """Return a sentence on the robots that the seeds draw."""
    count = runs["seed"].nunique()
    robots = f"{count} random robots" if count > 1 else f"{count} random robot"
    seeds, _, _ = facts["seeds"].partition(" (")
    return f"Every controller met the same {robots} (seeds {seeds}; {len(runs)} runs)"


def _varied(facts: Mapping[str, str], runs: pd.DataFrame) -> str:
    """Return a sentence with the values of each setting that runs have of their own; empty if they have none."""
    own = []
    for name, (heading, _) in varied_columns(runs.columns).items():
        values = runs[name].unique()
        if len(values) > 1 or varied_in_row({name: values[0]}):
            own.append(f"{heading} {facts[heading]}")
    if not own:
        return ""
    return f"Settings of the runs: {'; '.join(own)}"


def _settings(changed: Section | None) -> str:
    """Return a sentence on settings that were changed; None if the manifest does not say which."""
    if changed is None:
        return "All settings are in the file manifest.json of the results"
    if not changed:
        return "Settings that are not named are the defaults of this version"
    pairs = ", ".join(f"{key} = {value}" for key, value in changed.items())
    return f"Settings other than the defaults: {pairs}"
