"""One self-contained page about a results folder: the result in a sentence, tables, figures, paths and every run.

The page holds its pictures, tables, data and scripts itself and its policy forbids it to load anything else; it needs
no network. The template `report.html.j2` writes tables and figures; paths in space and the error of each run are plain
numbers that `space.js` and `report.js` draw. `notebooks/analysis.ipynb` shows the same in a notebook.
"""

import base64
import hashlib
import math
import re
from collections.abc import Iterator
from itertools import groupby, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup, escape

from servobench.controllers.methods import PUBLISHED
from servobench.harness.analysis import comparison, tables
from servobench.harness.analysis.comparison import MISSING
from servobench.harness.analysis.folder import (
    describe_controllers,
    describe_folder,
    describe_settings,
    describe_tuning,
    titled_runs,
)
from servobench.harness.analysis.verdict import judge, leaders
from servobench.harness.apps.figures.figures import KINDS, Choice, folder_figures
from servobench.harness.apps.figures.style import NARROW, WIDE, Drawing, drawing_of, method_styles
from servobench.harness.apps.figures.tracks import (
    ERROR_COLUMNS,
    Shown,
    Tracks,
    label_of,
    load_groups,
    load_tracks,
    longest,
)
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.batch.shares import Share, in_shares
from servobench.harness.run.metrics import METRICS
from servobench.harness.run.outcome import ACHIEVED, FOLLOWING_BANDS
from servobench.harness.run.variations import varied_columns
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.files import accessing, write_atomically
from servobench.plant.robot.catalogue import DEFAULT_ROBOT

NAME = "report.html"
TEMPLATE = "report.html.j2"
OWN = Path(__file__).parent  # folder of template, style and scripts
PICTURE_BYTES = 3_000_000  # size of all figures in the page together
SHOWN_RUNS = 1000  # rows of the table of runs
LONG_TABLE = 30  # rows; of a table that has more, the page shows a line that opens it
COUNTED = {
    "controller": "controllers",
    "task": "tasks",
    "plant": "plants",
    "mismatch": "mismatches",
}
# The scope of a page mentions these columns only where they differ from the default.
USUAL = {"robot": DEFAULT_ROBOT, "sensing": DEFAULT_SENSING}
SWEPT = {
    "noise_factor": "factors of noise",
    "latency_s": "latencies",
    "period_s": "control periods",
}
MAX_PATH_POINTS = 150  # more cannot be distinguished
MAX_VIEWS = 24  # views are counted over plants, mismatches and tasks
MIN_CURVE_POINTS = 40  # points of the error of a run
MAX_CURVE_POINTS = 160
CURVE_BYTES = 1.2e6  # size of all errors together
NUMBER_BYTES = 6  # size of one number in the page
STEPS_AT_ONCE = 64  # runs whose steps are in memory at a time
DIGITS = 4  # significant digits of a number in the page
# [px] Lengths of strokes and gaps of matplotlib's named line styles.
DASHES: dict[str, list[float]] = {
    "-": [],
    "--": [7, 4],
    "-.": [8, 3, 2, 3],
    ":": [2, 3],
}
Json = dict[str, Any]
ESTIMATE = re.compile(r"(?P<value>[^\[\]]+) \[(?P<low>[^,\[\]]+), (?P<high>[^,\[\]]+)\]")
NUMBER = re.compile(r"[-+]?(\d|∞|–$)")
# Signs after which a long name may go on in the next line
BREAKS = re.compile(r"([_:+=/,.])")
TICKED = re.compile(r"`([^`]*)`")
CONTROLLER = (tables.WHICH, "controller")
INFINITE = "∞"
LENGTHY = 24  # letters from which on a word may be broken anywhere
PHONE_COLUMNS = 4  # columns of a table that fit on a phone
TABLET_COLUMNS = 8


class Picture(NamedTuple):
    """A figure of the page."""

    kind: str  # a key of `servobench.harness.apps.figures.figures.KINDS`
    title: str  # alternative text
    tasks: tuple[str, ...]  # the tasks that it shows; empty if it shows all
    wide: Drawing  # for a sheet of paper, a notebook and most screens
    narrow: Drawing  # for a phone

    @property
    def size(self) -> int:
        """Its part of the page [bytes]."""
        return len(self.wide.data) + len(self.narrow.data)


def write_report(folder: ResultsFolder, path: Path | None = None) -> Path:
    """Write the report on a results folder, by default `report.html` in it, and return its path.

    Raises:
        ConfigurationError: not a results folder, no run in it, or the page cannot be written.
    """
    runs = titled_runs(folder)
    folder.check_runs(runs)
    target = path or folder.path / NAME
    with accessing(target, "report"):
        write_atomically(
            target, lambda file: file.write_text(_page(folder, runs), encoding="utf-8")
        )
    return target


def report_pictures(folder: ResultsFolder) -> list[Picture]:
    """Return the figure of the conditions that a results folder varies, and those of its first figures that fit in."""
    pictures = []
    size = 0
    for _, kind, title, tasks, wide, narrow in in_shares(_draw_share, folder):
        picture = Picture(kind, title, tuple(tasks), Drawing(*wide), Drawing(*narrow))
        size += picture.size
        if size > PICTURE_BYTES:
            break
        pictures.append(picture)
    return pictures


def _draw_share(folder: ResultsFolder, share: Share) -> Iterator[tuple[Any, ...]]:
    """Draw a share of the figures, until it alone fills a page; yield their numbers and what a `Picture` holds."""
    kinds = [name for name, kind in KINDS.items() if kind.in_page]
    figures = folder_figures(folder, Choice(kinds, layouts=(WIDE, NARROW), title=False), share)
    size = 0
    for named, slim in zip(figures, figures, strict=True):
        wide = drawing_of(named.figure, WIDE)
        narrow = drawing_of(slim.figure, NARROW)
        picture = Picture(named.kind, named.title, named.tasks, wide, narrow)
        yield named.number, *picture
        size += picture.size
        if size > PICTURE_BYTES:
            return


def _page(folder: ResultsFolder, runs: pd.DataFrame) -> str:
    views = path_views(folder, runs)
    style = page_asset("report.css")
    scripts = [page_asset("tables.js"), page_asset("report.js")]
    if views:
        scripts.append(page_asset("space.js"))
    shown = _shown(runs)
    numbered = tables.runs_table(shown)
    numbered.insert(0, (tables.WHICH, "run"), shown.index.to_list())
    manifest = folder.manifest
    facts = describe_folder(manifest, runs)
    return page_template(TEMPLATE).render(
        folder=folder.path.resolve().name,
        policy=page_policy(style, scripts),
        style=Markup(style),
        scripts=[Markup(script) for script in scripts],
        tables=tables,
        long_table=LONG_TABLE,
        missing=folder.describe_missing(),
        verdict=judge(runs),
        leaders=leaders(runs),
        scope=_scope(runs, facts),
        aids=describe_controllers(manifest),
        tuning=describe_tuning(manifest),
        tuned=manifest.get("tuned", {}),
        band=comparison.settling_band(runs),
        following=comparison.settling_band(runs, FOLLOWING_BANDS),
        published=PUBLISHED,
        pictures=report_pictures(folder),
        views=views,
        runs=runs,
        numbered=numbered,
        others=list(folder.other_tables()),
        facts=facts,
        settings=describe_settings(folder.manifest),
        data=_data(folder, shown, views),
    )


def page_template(name: str, folder: Path = OWN) -> Template:
    """Return a template of a folder, with the filters of this page and its macros for tables and pictures."""
    environment = Environment(
        loader=FileSystemLoader([folder, OWN]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"breakable": breakable, "cell": cell, "marked": marked, "sheet": sheet}
    return environment.get_template(name)


def page_asset(name: str) -> str:
    """Return the text of a style or script that pages share."""
    return (OWN / name).read_text(encoding="utf-8")


def page_policy(style: str, scripts: list[str]) -> str:
    """Return a page's Content-Security-Policy: its own style and scripts by their digests, pictures, nothing else."""

    def digests(texts: list[str]) -> str:
        sources = []
        for text in texts:
            digest = hashlib.sha256(text.encode()).digest()
            sources.append(f"'sha256-{base64.b64encode(digest).decode('ascii')}'")
        return " ".join(sources)

    return (
        f"default-src 'none'; img-src data:; style-src {digests([style])}; script-src {digests(scripts)}; "
        "base-uri 'none'; form-action 'none'"
    )


def _scope(runs: pd.DataFrame, facts: dict[str, str]) -> str:
    """Return one line that names the controllers, tasks, plants and conditions compared."""
    words = []
    for name, plural in COUNTED.items():
        different = runs[name].nunique()
        words.append(f"{different} {plural}" if different > 1 else str(runs[name].iloc[0]))
    for name, usual in USUAL.items():
        if name in runs and (runs[name] != usual).any():
            named = [Path(str(each)).name for each in runs[name].unique()]
            words.append(f"{name} {' and '.join(named)}")
    for name in varied_columns(runs.columns):
        values = runs[name].nunique(dropna=False)
        if values > 1:
            words.append(f"{values} {SWEPT.get(name, f'values of {name}')}")
    count = "1 run" if len(runs) == 1 else f"{len(runs)} runs"
    seeds = "seeds" if runs["seed"].nunique() > 1 else "seed"
    return f"{count}: {', '.join(words)}; {seeds} {facts['seeds']}."


def _shown(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the runs that have a row, with their place in the table: of many, those that went wrong before others."""
    known = runs.reset_index(drop=True)
    wrong = ~comparison.outcomes(known).isin(ACHIEVED)
    wrong_first = wrong.sort_values(ascending=False, kind="stable").index
    return known.loc[wrong_first[:SHOWN_RUNS]].sort_index()


def _data(folder: ResultsFolder, shown: pd.DataFrame, views: list[Json]) -> Json:
    """Return the data of the scripts: runs by their number, with the error over time of those whose steps are kept."""
    curves = error_curves(folder, shown)
    shown = comparison.in_handy_units(shown)
    known = [name for name in METRICS if name in shown and shown[name].notna().any()]
    scales = {name: comparison.shown_unit(name, shown)[1] for name in known}
    # Runs of one controller under the same conditions, over all seeds, have one place.
    keys = ("controller", "task", *tables.CONDITIONS, *varied_columns(shown.columns))
    place = shown.groupby([name for name in keys if name in shown], dropna=False).ngroup()
    runs = {}
    for number, row in zip(shown.index, shown.to_dict("records"), strict=True):
        runs[str(number)] = {
            "id": str(row["run_id"]),
            "controller": str(row["controller"]),
            "place": int(place[number]),
            "reason": str(row.get("reason") or ""),
            "band": rounded(Shown(row).settling_band),
            "values": [rounded(scales[name] * float(row[name])) for name in known],
        }
    numbers = {str(run_id): str(number) for number, run_id in shown["run_id"].items()}
    styles = method_styles(shown["controller"].astype(str))
    return {
        "measures": [comparison.metric_heading(name, shown) for name in known],
        "runs": runs,
        "curves": {numbers[name]: curve for name, curve in curves.items()},
        "swatches": {
            name: {"colour": style.colour, "dash": _dashes(style.line)}
            for name, style in styles.items()
        },
        "views": views,
    }


def _dashes(line: Any) -> list[float]:  # noqa: ANN401 - a line style of matplotlib
    """Return the lengths [px] of strokes and gaps of a line style in the page."""
    if line in DASHES:
        return DASHES[line]
    _, lengths = line
    return [2.0 * length for length in lengths]


def path_views(folder: ResultsFolder, runs: pd.DataFrame) -> list[Json]:
    """Return the paths in space of each plant, mismatch and task; none where no run has one.

    Raises:
        ConfigurationError: not a results folder.
    """
    views = (
        _view(f"{task} on {group.plant}, mismatch {group.mismatch}, seed {group.seed}", tracks)
        for group in load_groups(folder, runs)
        for task, tracks in group.tasks.items()
        if all(len(track.features) >= 3 for track in tracks.values())
    )
    return list(islice(views, MAX_VIEWS))


def error_curves(folder: ResultsFolder, runs: pd.DataFrame) -> dict[str, Json]:
    """Return the true error of each run over time, by its identifier, as far as its steps are kept.

    Of many runs each has few points: each is the largest error of the periods for which it stands. Of more runs than
    fit into a page, the first ones have a curve.
    """
    wanted = runs.head(int(CURVE_BYTES / (NUMBER_BYTES * MIN_CURVE_POINTS)))
    fitting = CURVE_BYTES / (NUMBER_BYTES * max(1, len(wanted)))
    points = int(np.clip(fitting, MIN_CURVE_POINTS, MAX_CURVE_POINTS))
    curves = {}
    for first in range(0, len(wanted), STEPS_AT_ONCE):
        some = wanted[first : first + STEPS_AT_ONCE]
        for track in load_tracks(folder, some, ERROR_COLUMNS):
            bins = np.array_split(track.error(), min(points, len(track.table)))
            curves[track.row["run_id"]] = {
                "end": rounded(float(track.time[-1])),
                "unit": track.error_unit[0],
                "error": [_largest(part) for part in bins],
            }
    return curves


def _largest(errors: FloatArray) -> float | None:
    """Return the largest known error for JSON, None where none is finite."""
    if np.isfinite(errors).any():
        return rounded(float(np.nanmax(errors)))
    return None


def rounded(value: float) -> float | None:
    """Return a number with few digits for JSON, None where it is not finite."""
    if np.isfinite(value):
        return float(f"{value:.{DIGITS}g}")
    return None


def _view(title: str, tracks: Tracks) -> Json:
    few = {name: track.for_path() for name, track in tracks.items()}
    whole = longest(few)
    reference = whole.vectors("reference_")[:, :3]
    if whole.point_to_point:  # a fixed target is one point
        reference = reference[:1]
    true = {name: track.vectors("true_feature_")[:, :3] for name, track in few.items()}
    start = whole.vectors("true_feature_")[:1, :3]
    return {
        "title": title,
        "axes": [label_of(name).replace("z [", "depth z [") for name in whole.features[:3]],
        "reference": _points(reference),
        "start": _points(start),
        "paths": {name: _points(path) for name, path in true.items()},
    }


def _points(points: FloatArray) -> list[list[float | None]]:
    """Return up to `MAX_PATH_POINTS` points and the last one, as rows of numbers with few digits."""
    step = max(1, math.ceil(len(points) / MAX_PATH_POINTS))
    known = points[np.isfinite(points).all(axis=1)]
    kept = list(range(0, len(known), step))
    if kept and kept[-1] != len(known) - 1:
        kept.append(len(known) - 1)
    return [[rounded(float(x)) for x in known[i]] for i in kept]


class Cell(NamedTuple):
    """A cell of a table."""

    text: str
    interval: str = ""  # interval of the number; empty without one
    number: bool = False  # whether it is to be read as a number

    @property
    def lengthy(self) -> bool:
        """Whether it has a word that has to be broken where there is little room."""
        return any(len(word) > LENGTHY for word in BREAKS.sub(" ", self.text).split())


class Sheet(NamedTuple):
    """The columns of a table."""

    # Title and number of columns of each group of columns; empty without groups.
    groups: list[tuple[str, int]]
    headings: list[tuple[str, str]]  # name and unit of each column
    size: str  # `few`, `some` or `many` columns, for the width at which rows become cards
    pairs: bool  # whether every group has two columns, which stay side by side in a card
    controller: int | None  # the column with the controller's name, if there is one


def sheet(table: pd.DataFrame) -> Sheet:
    """Return the columns of a table, which are headings or pairs (group, heading)."""
    columns = [name if isinstance(name, tuple) else (tables.WHICH, str(name)) for name in table]
    groups = [str(group) for group, _ in columns]
    spans = [(group, len(list(own))) for group, own in groupby(groups)]
    headings = []
    for _, heading in columns:
        name, _, unit = str(heading).partition(" [")
        headings.append((name, unit.removesuffix("]")))
    grouped = len(spans) > 1
    first, *others = [count for _, count in spans] or [0]
    return Sheet(
        groups=spans if grouped else [],
        headings=headings,
        size=_size(len(columns)),
        pairs=grouped and first == 1 and all(count == 2 for count in others),
        controller=columns.index(CONTROLLER) if CONTROLLER in columns else None,
    )


def _size(columns: int) -> str:
    """Return the word for a number of columns, as the page's style knows it."""
    if columns <= PHONE_COLUMNS:
        return "few"
    if columns <= TABLET_COLUMNS:
        return "some"
    return "many"


def cell(value: Any) -> Cell:  # noqa: ANN401 - a cell of any table
    """Return a value as the page shows it, with its interval apart."""
    text = plain(value)
    match = ESTIMATE.fullmatch(text)
    if match is None:
        return Cell(text, number=NUMBER.match(text) is not None)
    parts = {match["value"][0], match["low"], match["high"]}
    if parts == {INFINITE}:  # an interval from ∞ to ∞ says nothing
        return Cell(INFINITE, number=True)
    return Cell(match["value"], f"{match['low']} to {match['high']}", number=True)


def plain(value: Any) -> str:  # noqa: ANN401 - a cell of any table
    """Return a value as a reader wants it: no name of Python's for nothing, infinity or truth."""
    if isinstance(value, list | tuple | set | dict | np.ndarray):
        return str(value)
    if pd.isna(value):
        return MISSING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}".replace("inf", "∞")
    return str(value)


def breakable(text: object) -> Markup:
    """Return escaped text that may be broken after signs such as `_` and `:`."""
    parts = BREAKS.sub("\\1\0", str(text)).split("\0")
    return Markup("<wbr>").join(escape(part) for part in parts)


def marked(text: object) -> Markup:
    """Return escaped text in which words between backticks are set as code."""
    code = Markup("<code>{}</code>")
    pieces = []
    for i, part in enumerate(TICKED.split(str(text))):
        between_ticks = i % 2 == 1
        pieces.append(code.format(part) if between_ticks else escape(part))
    return Markup("").join(pieces)
