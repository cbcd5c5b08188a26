"""The command `servobench figures`, and the figures of a folder that was just written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.harness.cli import selection
from servobench.harness.cli.options import (
    MetricsOption,
    NamesOption,
    ShownOption,
    named_option,
    option,
    switch,
)
from servobench.harness.cli.terminal import console, say
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import accessing, writing_together

if TYPE_CHECKING:
    from servobench.harness.batch.results import ResultsFolder


def draw(opened: ResultsFolder) -> list[Path]:
    """Draw the figures of a folder into it and return their files."""
    from servobench.harness.apps.figures.figures import FOLDER, Order, draw_figures

    return draw_figures(Order(opened, opened.path / FOLDER))


def figures(
    folder: Annotated[Path, typer.Argument(help="Results folder of run, compare or sweep.")],
    kind: Annotated[
        str, option("NAMES", "Comma-separated kinds, such as errors,paths; default: all of them.")
    ] = "all",
    controllers: ShownOption = "all",
    names: NamesOption = "",
    metric: MetricsOption = None,
    width: Annotated[
        str, option("LENGTH", "Width of a column of a paper, such as 252pt, 89mm or 3.5in.")
    ] = "7.2in",
    title: Annotated[bool, switch("--title/--no-title", "Write a title above each figure.")] = True,
    format_: Annotated[
        str,
        named_option(
            "--format",
            "NAMES",
            "Comma-separated: pdf, svg, png, pgf (needs a TeX while it is drawn).",
        ),
    ] = "pdf",
    out: Annotated[
        Path | None, option("FOLDER", "Folder of the figures; default: figures in the folder.")
    ] = None,
) -> None:
    """Draw figures of a folder for a paper.

    They are those of the report, with chosen kinds, controllers, names and width; nothing is simulated for them.
    """
    from servobench.harness.apps.figures.figures import FOLDER, KINDS, Choice, Order, draw_figures
    from servobench.harness.apps.figures.style import ALL_FORMATS, Layout, check_tex
    from servobench.harness.batch.results import ResultsFolder

    formats = selection.split_names("format", format_, ALL_FORMATS)
    kinds = selection.split_names("kind", kind, tuple(KINDS))
    opened = ResultsFolder(folder)
    selection.add_metrics(opened, metric)
    runs = opened.runs()
    opened.check_runs(runs)
    shown = selection.split_shown(controllers, runs)
    labels = selection.split_labels(names, shown)
    if "pgf" in formats:
        check_tex()
    say(opened.describe_missing())
    choice = Choice(kinds, labels, (Layout.of_width(width),), title)
    target = out or folder / FOLDER
    with (
        console.status("drawing the figures"),
        accessing(target),
        writing_together(target) as partial,
    ):
        made = draw_figures(Order(opened, partial, choice, formats, exact_width=True))
    files = [target / path.name for path in made]
    if not files:
        opened.check_steps()
        raise ConfigurationError(
            f"{folder} has no figure of {', '.join(kinds)}: errors and paths are of moves, tracking is of curves, "
            "settling, effort and smoothness are of several runs"
        )
    opened.vouch(files)
    say("\n".join(map(str, files)))
