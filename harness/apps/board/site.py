"""The board: a static page that ranks submissions, a table for each kind of world and division."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from markupsafe import Markup

from servobench.controllers.aids import describe_aids
from servobench.harness.apps.board.protocol import KINDS, VERSION, worlds_of
from servobench.harness.apps.board.submission import RUNS, Submission
from servobench.harness.apps.figures.responses import draw_moves
from servobench.harness.apps.figures.style import (
    NARROW,
    TEXT,
    Drawing,
    drawing_of,
    figure_style,
    method_styles,
)
from servobench.harness.apps.figures.tracks import load_ensembles
from servobench.harness.apps.report.page import (
    page_asset,
    page_policy,
    page_template,
    write_report,
)
from servobench.harness.apps.studies.scores import Ranked, ranking
from servobench.harness.apps.studies.suite import judge
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.settings import tuned_settings
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import accessing, writing_together

INDEX = "index.html"
TEMPLATE = "board.html.j2"
OWN = Path(__file__).parent  # folder of template and style
KIND_OF = {name: kind for kind, names in KINDS.items() for name in names}


@dataclass(frozen=True, eq=False)
class Entry:
    """A submission on the board."""

    key: str  # name of its folder within the site
    head: Submission
    order: str  # "2 of 3" where the author submitted the method several times
    tuned: bool  # whether it was judged with values tuned for it
    division: str  # with which aids
    folders: dict[str, ResultsFolder]  # by world
    scores: pd.DataFrame  # its own runs as the suite judges them, with the kind of their world


class Table(NamedTuple):
    """A table of the board."""

    kind: str
    division: str
    rows: list[Ranked]  # best first, by keys


def write_site(folders: Iterable[Path], out: Path) -> Path:
    """Write the board of some submissions, and return its page.

    Raises:
        ConfigurationError: no submission, an unfinished one, or two of one name.
    """
    entries = read_entries(folders)
    style = page_asset("report.css") + (OWN / "board.css").read_text(encoding="utf-8")
    script = page_asset("tables.js")
    page = page_template(TEMPLATE, OWN).render(
        policy=page_policy(style, [script]),
        style=Markup(style),
        script=Markup(script),
        version=VERSION,
        kinds=KINDS,
        tables=list(rank(entries.values())),
        entries=entries,
        pictures={key: list(_pictures(entry)) for key, entry in entries.items()},
    )
    with accessing(out, "site"), writing_together(out) as site:
        for key, entry in entries.items():
            (site / key).mkdir()
            for world, folder in entry.folders.items():
                write_report(folder, site / key / f"{world}.html")
        (site / INDEX).write_text(page, encoding="utf-8")
    return out / INDEX


def read_entries(folders: Iterable[Path]) -> dict[str, Entry]:
    """Return submissions by the names of their folders, first ones first.

    Raises:
        ConfigurationError: as `write_site`.
    """
    heads = [(Submission.read(folder), folder) for folder in folders]
    heads.sort(key=lambda each: each[0].created)
    totals = Counter((head.author, head.method) for head, _ in heads)
    counts: Counter[tuple[str, str]] = Counter()
    entries = {}
    for head, folder in heads:
        author = head.author, head.method
        counts[author] += 1
        order = f"no. {counts[author]} of {totals[author]}" if totals[author] > 1 else ""
        key = folder.resolve().name
        if key in entries:
            raise ConfigurationError(f"two submissions are in folders called {key}; rename one")
        entries[key] = _read_entry(key, head, folder, order)
    return entries


def _read_entry(key: str, head: Submission, folder: Path, order: str) -> Entry:
    opened = {}
    judged = []
    for world in worlds_of(head.kinds):
        runs = ResultsFolder(folder / RUNS / world.name)
        if lack := runs.describe_missing():
            raise ConfigurationError(f"{runs.path}: {lack}")
        opened[world.name] = runs
        judged.append(judge(world, runs.runs()))
        division = describe_aids(runs.configuration.get(head.method, {}))
    scores = pd.concat(judged, ignore_index=True)
    scores = scores[scores["controller"] == head.method]
    kinds = scores["challenge"].map(KIND_OF)
    # Values lie beside the code of other classes, or of an earlier state, too; the runs tell which were used.
    tuned = bool(tuned_settings(head.method) or runs.manifest.get("tuned"))
    return Entry(key, head, order, tuned, division, opened, scores.assign(kind=kinds))


def rank(entries: Iterable[Entry]) -> Iterator[Table]:
    """Yield the tables of the board; submissions that cannot be told apart share a rank.

    Robots of different submissions are independent; `ranking` pairs them by their number, and a test of differences
    between pairs holds however independent samples are paired.
    """
    parts = []
    for entry in entries:
        scores = entry.scores
        number = scores.groupby("challenge").cumcount()
        parts.append(scores.assign(controller=entry.key, seed=number, division=entry.division))
    whole = pd.concat(parts)
    for kind in KINDS:
        for division, own in whole[whole["kind"] == kind].groupby("division", sort=False):
            yield Table(kind, str(division), ranking(own))


def _pictures(entry: Entry) -> Iterator[tuple[str, Drawing]]:
    """Yield the best and the worst run of a submission beside the ceilings: a title, and its error over time."""
    ordered = entry.scores.sort_values("score", kind="stable")
    for word, place in (("best", -1), ("worst", 0)):
        row = ordered.iloc[place]
        folder = entry.folders[row["challenge"]]
        runs = folder.runs()
        shown = runs[runs["seed"] == row["seed"]]
        with figure_style(TEXT):
            tasks = load_ensembles(folder, shown)
            figure = draw_moves(tasks, method_styles(shown["controller"]), NARROW)
            yield (
                f"{word}: {row['challenge']}, score {row['score']:.2f}",
                drawing_of(figure, NARROW),
            )
