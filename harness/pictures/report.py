"""One self-contained page about a results folder: tables that sort, figures, and paths in space to turn.

The page holds its pictures, tables and scripts itself; it needs no network. `notebooks/analysis.ipynb` shows the same
tables and figures in a notebook.
"""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pandas as pd
from itables import options, to_html_datatable
from itables.javascript import generate_init_offline_itables_html
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from servobench.harness.analysis.comparison import split_tasks
from servobench.harness.analysis.folder import describe_folder, other_tables
from servobench.harness.analysis.measures import settling_band
from servobench.harness.analysis.tables import (
    cost_table,
    failure_table,
    outcome_table,
    runs_table,
    settling_table,
    tracking_table,
)
from servobench.harness.batch import results
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.pictures.conditions import draw_conditions
from servobench.harness.pictures.draw import folder_figures, picture_of
from servobench.harness.pictures.interactive import interactive_paths, plotly_script
from servobench.harness.pictures.style import figure_style, method_styles
from servobench.harness.run.outcome import FOLLOWING_BANDS
from servobench.plant.files import write_atomically

NAME: Final = "report.html"
TEMPLATE: Final = "report.html.j2"
MAX_PICTURES: Final = 24  # a page stays under 10 MB; all figures are in the folder itself
ROWS_AT_ONCE: Final = 15  # a longer table gets a search field and pages

INFINITE: Final = re.compile(
    r'(\[\\")\s*inf(\\", \\"___Infinity___)'
)  # text and value of a cell of numbers, from itables


@dataclass(frozen=True)
class Picture:
    """A figure as it stands in the page.

    Attributes:
        kind: what it shows; see `harness.pictures.draw`.
        title: alternative text.
        data: the PNG file, base64.
        width: at which it is shown [px].
    """

    kind: str
    title: str
    data: str
    width: int


def write_report(folder: Path, path: Path | None = None) -> Path:
    """Write the report on a results folder.

    Args:
        folder: a results folder.
        path: the page; by default `report.html` in the folder.

    Returns:
        The page's path.

    Raises:
        ConfigurationError: not a results folder, no run in it, or the page cannot be written.
    """
    runs = results.load_runs(folder)
    if runs.empty:
        raise ConfigurationError(f"{folder} holds no finished run")
    target = path or folder / NAME
    page = _page(folder, runs)
    try:
        write_atomically(target, lambda file: file.write_text(page, encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError(f"report {target} cannot be written: {error.strerror}") from error
    return target


def report_pictures(folder: Path, runs: pd.DataFrame) -> list[Picture]:
    """Return the figure of the conditions that a results folder varies, and its first figures of steps."""
    pictures: list[Picture] = []
    with figure_style():
        overview = draw_conditions(split_tasks(runs)[0], method_styles(runs["controller"]))
    if overview is not None:
        pictures.append(_picture("conditions", "share of settled runs over what was varied", overview))
    for named in folder_figures(folder):
        if named.kind != "joint_speeds" and len(pictures) < MAX_PICTURES:
            pictures.append(_picture(named.kind, named.title, named.figure))
    return pictures


def table_options(table: pd.DataFrame) -> dict[str, Any]:
    """Return how itables shows a table: columns sort by a click, a long table has a search field and pages."""
    long = len(table) > ROWS_AT_ONCE
    parts = {"topStart": "search", "topEnd": "pageLength", "bottomStart": "info", "bottomEnd": "paging"}
    return {
        "connected": False,
        "showIndex": False,
        "layout": {place: part if long else None for place, part in parts.items()},
        "lengthMenu": [ROWS_AT_ONCE, 60, 250],
        "maxBytes": "4MB",
        "scrollX": True,
        "classes": "display nowrap compact",
        "text_in_header_can_be_selected": False,
    }


def sortable_table(rows: pd.DataFrame) -> Markup:
    """Return a table as HTML in which infinity is written as the sign ∞ and still sorts behind all numbers."""
    return Markup(INFINITE.sub(r"\1∞\2", to_html_datatable(rows, **table_options(rows))))


def _page(folder: Path, runs: pd.DataFrame) -> str:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    paths = interactive_paths(folder)
    scripts = generate_init_offline_itables_html(options.dt_bundle) + (plotly_script() if paths else "")
    return environment.get_template(TEMPLATE).render(
        folder=folder.resolve().name,
        scripts=Markup(scripts),
        table=sortable_table,
        band=settling_band(runs),
        following=settling_band(runs, FOLLOWING_BANDS),
        outcomes=outcome_table(runs),
        facts=describe_folder(folder, runs),
        others=list(other_tables(folder)),
        pictures=report_pictures(folder, runs),
        max_pictures=MAX_PICTURES,
        paths=Markup(paths),
        settling=settling_table(runs),
        tracking=tracking_table(runs),
        costs=cost_table(runs),
        failures=failure_table(runs),
        runs=runs_table(runs),
    )


def _picture(kind: str, title: str, figure: Figure) -> Picture:
    content, width = picture_of(figure)
    return Picture(kind, title, base64.b64encode(content).decode("ascii"), width)
