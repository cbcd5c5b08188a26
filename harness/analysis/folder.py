"""Describes a results folder in words, and in LaTeX: tables with booktabs, a paragraph *Methods*, its BibTeX entry."""

import re
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any, Final

import pandas as pd

from servobench.controllers.aids import describe_aids
from servobench.harness.analysis.comparison import FROM_TWIN, shown_value
from servobench.harness.analysis.tables import PAIR, Tables
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.registry import MAPPED
from servobench.harness.run.result import COMPLETED
from servobench.harness.run.variations import varied_columns
from servobench.plant.contract.settings import listed

# Columns, with settings that are varied
DESCRIBED: Final = ("plant", "sensing", "controller", "task", "mismatch")


def describe_folder(manifest: Mapping[str, Any], runs: pd.DataFrame) -> dict[str, str]:
    """Return the facts of a folder: runs, controllers, plants, tasks, seeds and versions, as names and texts."""
    completed = int((runs["status"] == COMPLETED).sum())
    facts = {"runs": f"{len(runs)}, of which {completed} reached the last period"}
    described = {name: (name, 1.0) for name in DESCRIBED if name in runs}
    described |= varied_columns(runs.columns)
    for name, (heading, factor) in described.items():
        facts[heading] = listed([shown_value(value, factor) for value in runs[name].unique()])
    facts["seeds"] = _seeds(runs["seed"].tolist())
    facts["made"] = _made(manifest)
    return facts


def _made(manifest: Mapping[str, Any]) -> str:
    """Return when and with which versions the runs of a manifest were made."""
    packages = manifest.get("packages") or {}
    created = manifest.get("created", "at an unknown time")
    made = f"{created} by servobench {packages.get('servobench') or 'unknown'}"
    if manifest.get("git_commit"):
        made += f", commit {manifest['git_commit']}"
    return f"{made}, Python {manifest.get('python', 'unknown')}"


def titled_runs(folder: ResultsFolder) -> pd.DataFrame:
    """Return a folder's runs for titles: the mismatch none of robots drawn from a twin says so."""
    runs = folder.runs()
    robots = folder.manifest.get("robots") or ()
    twins = [each.get("name") for each in robots if str(each.get("title")).endswith(" twin")]
    names = runs.get("robot", runs["mismatch"])  # an old table has no column of robots
    drawn = (runs["mismatch"] == "none") & names.isin(twins)
    return runs.assign(mismatch=runs["mismatch"].mask(drawn, FROM_TWIN))


def describe_controllers(manifest: Mapping[str, Any]) -> str:
    """Return one line that says which of several controllers have the aids; empty for a single one."""
    names = manifest.get("controllers", ())
    if len(names) < 2:
        return ""
    configuration = manifest.get("configuration", {})
    own = manifest.get("own_controllers", {})
    found: dict[str, list[str]] = {}
    for name in names:
        values = configuration.get(name)
        place = own.get(name, {}).get("place", name)
        known = values is not None and not place.startswith(MAPPED)
        words = describe_aids(values) if known else "aids unknown"
        found.setdefault(words, []).append(name)
    return "; ".join(f"{words}: {', '.join(each)}" for words, each in found.items())


def describe_settings(configuration: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return every setting of the runs, given by section and name, as `section.name` and its text."""
    settings = {}
    for section, values in configuration.items():
        for name, value in values.items():
            settings[f"{section}.{name}"] = _setting(value)
    return settings


def _setting(value: Any) -> str:  # noqa: ANN401 - a value of JSON
    if isinstance(value, list):
        return ", ".join(map(_setting, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return {"inf": "no limit", "None": "not set"}.get(str(value), str(value))


def _seeds(seeds: list[int]) -> str:
    unique = sorted(set(seeds))
    if len(unique) > 2 and unique[-1] - unique[0] == len(unique) - 1:
        return f"{unique[0]} to {unique[-1]} ({len(unique)})"
    return listed(list(map(str, unique)))


SIGNS: Final = str.maketrans(
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
        "µ": r"$\mu$",
        "²": "$^2$",
        "³": "$^3$",
    }
)
INTERVAL: Final = re.compile(r" (\[[^\[]*\])$")
NUMBER: Final = re.compile(r"[-+\d∞–]")
MINUS: Final = re.compile(r"(?<![\w.])-(?=\d)")
MAX_LETTERS_OF_ONE_COLUMN: Final = 50  # a table with wider rows spans both columns of a paper
HEADING: Final = 12  # letters on one line of a heading
BIBTEX: Final = r"""\begin{filecontents*}[overwrite]{servobench.bib}
@misc{servobench,
  author = {{The servobench maintainers}},
  title = {{servobench: a bench for uncalibrated visual-servoing controllers}},
  year = {%s},
  note = {Version %s}
}
\end{filecontents*}"""


def latex_tables(tables: Tables) -> Iterator[str]:
    """Yield tables of statistics in LaTeX; the caption of paired differences names their place, too."""
    place = ""
    for title, rows in tables:
        caption = title
        if rows.columns[0] == PAIR:
            caption = f"{place}: {title}"
        else:
            place = title
        yield _table(caption, rows)


def _table(title: str, rows: pd.DataFrame) -> str:
    """Return a table of text for the package booktabs, over both columns of a paper if it is wide."""
    letters = sum(rows[name].str.len().max() for name in rows)
    kind = "table" if letters <= MAX_LETTERS_OF_ONE_COLUMN else "table*"
    sides = "".join("r" if rows[name].str.match(NUMBER).all() else "l" for name in rows)
    headings = " & ".join(map(_heading, rows.columns, sides))
    body = [rf"{' & '.join(row)} \\" for row in rows.map(_cell).itertuples(index=False)]
    lines = [
        rf"\begin{{{kind}}}\centering\footnotesize\setlength{{\tabcolsep}}{{4pt}}",
        rf"\caption{{{title.translate(SIGNS)}}}",
        rf"\begin{{tabular}}{{@{{}}{sides}@{{}}}}\toprule",
        rf"{headings} \\\midrule",
        *body,
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


def methods_paragraph(manifest: Mapping[str, Any], runs: pd.DataFrame) -> str:
    """Return a paragraph that says how the runs of a folder were made, from its manifest, and its BibTeX entry."""
    facts = describe_folder(manifest, runs)
    packages = manifest.get("packages") or {}
    version = str(packages.get("servobench") or "unknown").translate(SIGNS)
    commit = str(manifest.get("git_commit") or "unknown")[:12].translate(SIGNS)
    python = manifest.get("python", "unknown")
    tools = f"Python {python}, {', '.join(_used_libraries(manifest))}".translate(SIGNS)
    # The first sentence is LaTeX already, with a citation; the others are plain text.
    first = f"All runs were made with servobench {version}~\\cite{{servobench}} (commit {commit}, {tools})"
    sentences = [
        _combinations(manifest, facts),
        *_aids(manifest),
        *_varied(facts, runs),
        _robots(facts, runs),
        "Rates are given with Wilson intervals (95 %), medians with bootstrap intervals (95 %)",
        "Differences are paired by robot, with Student's intervals (90 %) of their means; verdicts are those of a sign "
        "test on lost runs, which ended early or have no value, and of two one-sided t-tests (5 %) against the margin",
        _settings(manifest.get("changed")),
    ]
    text = ". ".join([first, *(each.translate(SIGNS) for each in sentences)])
    year = str(manifest.get("created", ""))[:4].translate(SIGNS)
    entry = BIBTEX % (year, f"{version}, commit {commit}")
    return rf"\paragraph{{Methods}} {text}." + f"\n\n{entry}"


def _used_libraries(manifest: Mapping[str, Any]) -> list[str]:
    """Return the numerical libraries and the engines with their versions, as far as known."""
    packages = manifest.get("packages") or {}
    libraries = [f"{name} {packages[name]}" for name in ("numpy", "scipy") if packages.get(name)]
    engines = manifest.get("engines") or {}
    return [*libraries, *map(str, engines.values())]


def _combinations(manifest: Mapping[str, Any], facts: Mapping[str, str]) -> str:
    """Return a sentence on controllers, tasks, plant, sensing and mismatch."""
    titles = [str(each.get("title")) for each in manifest.get("robots", [])]
    robots = ", ".join(titles) or "unknown robot"
    return (
        f"Controllers: {facts['controller']}; tasks: {facts['task']}; plant: {facts['plant']} ({robots}); "
        f"sensing: {facts.get('sensing', 'position')}; mismatch between true and nominal robot: {facts['mismatch']}"
    )


def _aids(manifest: Mapping[str, Any]) -> list[str]:
    """Return a sentence on the aids of several controllers; none for a single one."""
    aids = describe_controllers(manifest)
    if not aids:
        return []
    return [f"Aids (stages around the law, which any controller can have): {aids}"]


def _robots(facts: Mapping[str, str], runs: pd.DataFrame) -> str:
    """Return a sentence on the robots that the seeds draw."""
    count = runs["seed"].nunique()
    robots = f"{count} random robots" if count > 1 else f"{count} random robot"
    seeds, _, _ = facts["seeds"].partition(" (")
    return f"Every controller met the same {robots} (seeds {seeds}; {len(runs)} runs)"


def _varied(facts: Mapping[str, str], runs: pd.DataFrame) -> list[str]:
    """Return a sentence with the values of each setting that the runs vary; none if they vary none."""
    varied = []
    for name, (heading, _) in varied_columns(runs.columns).items():
        if runs[name].nunique(dropna=False) > 1:
            varied.append(f"{heading} {facts[heading]}")
    if not varied:
        return []
    return [f"Varied: {'; '.join(varied)}"]


def _settings(changed: Mapping[str, Any] | None) -> str:
    """Return a sentence on settings that were changed; None if the manifest does not say which."""
    if changed is None:
        return "All settings are in the file manifest.json of the results"
    if not changed:
        return "All settings are the defaults of this version"
    pairs = ", ".join(f"{key} = {value}" for key, value in changed.items())
    return f"Settings other than the defaults: {pairs}"
