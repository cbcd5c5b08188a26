"""Describes a results folder in words, and in LaTeX: tables with booktabs, a paragraph *Methods*, its BibTeX entry."""

import re
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import pandas as pd

from servobench.controllers.aids import describe_aids
from servobench.harness.analysis.comparison import FROM_TWIN, shown_value
from servobench.harness.analysis.tables import PAIR, Tables
from servobench.harness.batch import results
from servobench.harness.config.registry import MAPPED
from servobench.harness.run.request import varied_columns
from servobench.harness.run.result import COMPLETED
from servobench.plant.contract.settings import listed

# Columns, with settings that are varied
DESCRIBED: Final = ("plant", "sensing", "controller", "task", "mismatch")


def describe_folder(folder: Path, runs: pd.DataFrame) -> dict[str, str]:
    """Return the facts of a folder: runs, controllers, plants, tasks, seeds and versions, as names and texts.

    Raises:
        ConfigurationError: not a results folder.
    """
    manifest = results.read_manifest(folder)
    completed = int((runs["status"] == COMPLETED).sum())
    facts = {"runs": f"{len(runs)}, of which {completed} reached the last period"}
    described = {name: (name, 1.0) for name in DESCRIBED if name in runs} | varied_columns(
        runs.columns
    )
    for name, (heading, factor) in described.items():
        facts[heading] = listed([shown_value(value, factor) for value in runs[name].unique()])
    by = (manifest.get("packages") or {}).get("servobench") or "unknown"
    commit = f", commit {manifest['git_commit']}" if manifest.get("git_commit") else ""
    made = f"{manifest.get('created', 'at an unknown time')} by servobench {by}{commit}"
    made += f", Python {manifest.get('python', 'unknown')}"
    return facts | {"seeds": _seeds(runs["seed"].tolist()), "made": made}


def titled_runs(folder: Path) -> pd.DataFrame:
    """Return a folder's runs as `load_runs`, for titles: the mismatch none of robots drawn from a twin says so."""
    runs, robots = results.load_runs(folder), results.read_manifest(folder).get("robots") or ()
    twins = [each.get("name") for each in robots if str(each.get("title")).endswith(" twin")]
    drawn = (runs["mismatch"] == "none") & runs.get("robot", runs["mismatch"]).isin(twins)
    return runs.assign(mismatch=runs["mismatch"].mask(drawn, FROM_TWIN))


def describe_controllers(folder: Path) -> str:
    """Return one line that says which of several controllers have the aids, by their settings; empty for a single one.

    Raises:
        ConfigurationError: not a results folder.
    """
    manifest = results.read_manifest(folder)
    names, configuration = manifest.get("controllers", ()), manifest.get("configuration", {})
    found: dict[str, list[str]] = {}
    for name in names if len(names) > 1 else ():
        values = configuration.get(name)
        place = manifest.get("own_controllers", {}).get(name, {}).get("place", name)
        known = values is not None and not place.startswith(MAPPED)
        found.setdefault(describe_aids(values) if known else "aids unknown", []).append(name)
    return "; ".join(f"{words}: {', '.join(each)}" for words, each in found.items())


def describe_settings(folder: Path) -> dict[str, str]:
    """Return every setting of the runs by section and name; empty where the folder has none.

    Raises:
        ConfigurationError: not a results folder.
    """
    sections = results.read_manifest(folder).get("configuration", {}).items()
    return {
        f"{section}.{name}": _setting(value)
        for section, values in sections
        for name, value in values.items()
    }


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
    {sign: f"\\{sign}" for sign in "_%&#${}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | dict(
        zip(
            "\u00a0∞–−×µ²³",
            ("~", r"$\infty$", "--", "$-$", r"$\times$", r"$\mu$", "$^2$", "$^3$"),
            strict=True,
        )
    )
)
INTERVAL: Final = re.compile(r" (\[[^\[]*\])$")
NUMBER: Final = re.compile(r"[-+\d∞–]")
MINUS: Final = re.compile(r"(?<![\w.])-(?=\d)")
ONE_COLUMN: Final = 50  # letters of all columns of a table that fits one column of a paper, at most
HEADING: Final = 12  # letters of a line of a heading
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
        place, caption = (place, f"{place}: {title}") if rows.columns[0] == PAIR else (title, title)
        yield _table(caption, rows)


def _table(title: str, rows: pd.DataFrame) -> str:
    """Return a table of text for the package booktabs, over both columns of a paper if it is wide."""
    letters = sum(rows[name].str.len().max() for name in rows)
    kind = "table" if letters <= ONE_COLUMN else "table*"
    sides = "".join("r" if rows[name].str.match(NUMBER).all() else "l" for name in rows)
    cells = rows.map(
        lambda text: INTERVAL.sub(r" {\\scriptsize \1}", MINUS.sub("$-$", text.translate(SIGNS)))
    )
    lines = [
        rf"\begin{{{kind}}}\centering\footnotesize\setlength{{\tabcolsep}}{{4pt}}",
        rf"\caption{{{title.translate(SIGNS)}}}",
        rf"\begin{{tabular}}{{@{{}}{sides}@{{}}}}\toprule",
        rf"{' & '.join(map(_heading, rows.columns, sides))} \\\midrule",
        *(rf"{' & '.join(row)} \\" for row in cells.itertuples(index=False)),
        rf"\bottomrule\end{{tabular}}\end{{{kind}}}",
    ]
    return "\n".join(lines)


def _heading(name: str, side: str) -> str:
    words, _, unit = name.partition(" [")
    lines = textwrap.wrap(words.replace(" %", "\u00a0%"), HEADING) + [f"[{unit}"] * bool(unit)
    text = r"\\{}".join(line.translate(SIGNS) for line in lines)
    return rf"\begin{{tabular}}[b]{{@{{}}{side}@{{}}}}{text}\end{{tabular}}"


def methods_paragraph(folder: Path, runs: pd.DataFrame) -> str:
    """Return a paragraph that says how the runs of a folder were made, from its manifest, and its BibTeX entry.

    Raises:
        ConfigurationError: not a results folder.
    """
    manifest, facts, aids = (
        results.read_manifest(folder),
        describe_folder(folder, runs),
        describe_controllers(folder),
    )
    packages = manifest.get("packages") or {}
    version = str(packages.get("servobench") or "unknown").translate(SIGNS)
    commit = str(manifest.get("git_commit") or "unknown")[:12].translate(SIGNS)
    used = [f"{name} {packages[name]}" for name in ("numpy", "scipy") if packages.get(name)]
    used += [str(engine) for engine in (manifest.get("engines") or {}).values()]
    robots = (
        ", ".join(str(each.get("title")) for each in manifest.get("robots", [])) or "unknown robot"
    )
    seeds, count = facts["seeds"].partition(" (")[0], runs["seed"].nunique()
    sentences = [
        f"All runs were made with servobench {version}~\\cite{{servobench}} (commit {commit}, "
        + f"Python {manifest.get('python', 'unknown')}, {', '.join(used)})".translate(SIGNS),
        f"Controllers: {facts['controller']}; tasks: {facts['task']}; plant: {facts['plant']} ({robots}); "
        f"sensing: {facts.get('sensing', 'position')}; mismatch between true and nominal robot: {facts['mismatch']}",
        *[f"Aids (stages around the law, which any controller can have): {aids}"] * bool(aids),
        *_varied(facts, runs),
        f"Every controller met the same {count} random robot{'s' * (count > 1)} (seeds {seeds}; {len(runs)} runs)",
        "Rates are given with Wilson intervals (95 %), medians with bootstrap intervals (95 %)",
        "Differences are paired by robot, with Student's intervals (90 %) of their means; verdicts are those of a sign "
        "test on lost runs, which ended early or have no value, and of two one-sided t-tests (5 %) against the margin",
        _settings(manifest.get("changed")),
    ]
    text = [sentences[0], *(each.translate(SIGNS) for each in sentences[1:])]
    year = str(manifest.get("created", ""))[:4].translate(SIGNS)
    return (
        rf"\paragraph{{Methods}} {'. '.join(text)}."
        + "\n\n"
        + BIBTEX % (year, f"{version}, commit {commit}")
    )


def _varied(facts: Mapping[str, str], runs: pd.DataFrame) -> list[str]:
    """Return a sentence with the values of each setting that the runs vary; none if they vary none."""
    columns = varied_columns(runs.columns).items()
    heads = [heading for name, (heading, _) in columns if runs[name].nunique(dropna=False) > 1]
    return [f"Varied: {'; '.join(f'{head} {facts[head]}' for head in heads)}"] if heads else []


def _settings(changed: Mapping[str, Any] | None) -> str:
    """Return a sentence on settings that were changed; None if the manifest does not tell."""
    if changed is None:
        return "All settings are in the file manifest.json of the results"
    pairs = ", ".join(f"{key} = {value}" for key, value in changed.items())
    return (
        f"Settings other than the defaults: {pairs}"
        if pairs
        else "All settings are the defaults of this version"
    )
