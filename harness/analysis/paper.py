"""A results folder in LaTeX: its tables with booktabs, and a paragraph *Methods* with its BibTeX entry."""

import re
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import pandas as pd

from servobench.harness.analysis.folder import describe_folder
from servobench.harness.analysis.tables import PAIR, Tables
from servobench.harness.batch import results

SIGNS: Final = str.maketrans(
    {sign: f"\\{sign}" for sign in "_%&#${}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | dict(zip("\u00a0∞–−×µ²³", ("~", r"$\infty$", "--", "$-$", r"$\times$", r"$\mu$", "$^2$", "$^3$"), strict=True))
)
INTERVAL: Final = re.compile(r" (\[[^\[]*\])$")
NUMBER: Final = re.compile(r"[-+\d∞–]")
MINUS: Final = re.compile(r"(?<![\w.])-(?=\d)")
ONE_COLUMN: Final = 50  # letters of all columns of a table that fits one column of a paper, at most
HEADING: Final = 12  # letters of a line of a heading
MAIN_PACKAGES: Final = ("numpy", "scipy")
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
    body = [" & ".join(map(_cell, row)) for row in rows.itertuples(index=False)]
    lines = [
        rf"\begin{{{kind}}}\centering\footnotesize\setlength{{\tabcolsep}}{{4pt}}",
        rf"\caption{{{title.translate(SIGNS)}}}",
        rf"\begin{{tabular}}{{@{{}}{sides}@{{}}}}\toprule",
        rf"{' & '.join(map(_heading, rows.columns, sides))} \\\midrule",
        *(rf"{line} \\" for line in body),
        rf"\bottomrule\end{{tabular}}\end{{{kind}}}",
    ]
    return "\n".join(lines)


def _heading(name: str, side: str) -> str:
    words, _, unit = name.partition(" [")
    lines = [
        line.translate(SIGNS)
        for line in (*textwrap.wrap(words.replace(" %", "\u00a0%"), HEADING), *([f"[{unit}"] if unit else []))
    ]
    return rf"\begin{{tabular}}[b]{{@{{}}{side}@{{}}}}" + r"\\{}".join(lines) + r"\end{tabular}"


def _cell(text: str) -> str:
    return INTERVAL.sub(r" {\\scriptsize \1}", MINUS.sub("$-$", text.translate(SIGNS)))


def methods_paragraph(folder: Path, runs: pd.DataFrame) -> str:
    """Return a paragraph that says how the runs of a folder were made, from its manifest, and its BibTeX entry.

    Raises:
        ConfigurationError: not a results folder.
    """
    manifest, facts = results.read_manifest(folder), describe_folder(folder, runs)
    packages = manifest.get("packages") or {}
    version = str(packages.get("servobench") or "unknown").translate(SIGNS)
    commit = str(manifest.get("git_commit") or "unknown")[:12].translate(SIGNS)
    used = [f"{name} {packages[name]}" for name in MAIN_PACKAGES if packages.get(name)]
    used += [str(engine) for engine in (manifest.get("engines") or {}).values()]
    robots = ", ".join(str(each.get("title")) for each in manifest.get("robots", [])) or "unknown robot"
    seeds, count = facts["seeds"].partition(" (")[0], runs["seed"].nunique()
    sentences = [
        f"All runs were made with servobench {version}~\\cite{{servobench}} (commit {commit}, "
        + f"Python {manifest.get('python', 'unknown')}, {', '.join(used)})".translate(SIGNS),
        f"Controllers: {facts['controller']}; tasks: {facts['task']}; plant: {facts['plant']} ({robots}); "
        f"sensing: {facts.get('sensing', 'position')}; mismatch between true and nominal robot: {facts['mismatch']}",
        f"Every controller met the same {count} random robot{'s' * (count > 1)} (seeds {seeds}; {len(runs)} runs)",
        "Rates are given with Wilson intervals (95 %), medians with bootstrap intervals (95 %)",
        "Differences are paired by robot, with Student's intervals (90 %) of their means; verdicts are those of a sign "
        "test on lost runs and of two one-sided t-tests (5 %) against the stated margin",
        _settings(manifest.get("changed")),
    ]
    text = [sentences[0], *(each.translate(SIGNS) for each in sentences[1:])]
    year = str(manifest.get("created", ""))[:4].translate(SIGNS)
    return rf"\paragraph{{Methods}} {'. '.join(text)}." + "\n\n" + BIBTEX % (year, f"{version}, commit {commit}")


def _settings(changed: Mapping[str, Any] | None) -> str:
    """Return a sentence on settings that were changed; None if the manifest does not tell."""
    if changed is None:
        return "All settings are in the file manifest.json of the results"
    pairs = ", ".join(f"{key} = {value}" for key, value in changed.items())
    return f"Settings other than the defaults: {pairs}" if pairs else "All settings are the defaults of this version"
