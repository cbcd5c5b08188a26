"""The commands on results folders: `statistics | collect`; the verdict on failed runs."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.harness.cli import selection
from servobench.harness.cli.options import (
    AgainstOption,
    JsonOption,
    NamesOption,
    ShownOption,
    option,
    switch,
)
from servobench.harness.cli.terminal import (
    FAILED,
    print_json,
    print_markdown,
    print_tables,
    say,
)
from servobench.plant.contract.faults import ConfigurationError

if TYPE_CHECKING:
    import pandas as pd

    from servobench.harness.batch.results import Manifest, ResultsFolder

MAX_SATURATED = 0.8  # share of the periods
MAX_FAULTS = 10  # runs that failed, each on a line of its own


def statistics(
    folder: Annotated[Path, typer.Argument(help="Results folder of a run, comparison or sweep.")],
    metric: Annotated[
        str | None,
        option(
            "COLUMN",
            "Column of the table of runs by which pairs are compared, or a metric of yours, ./mine.py:itae; default: "
            "settling time, in sequences of later moves, on curves RMS error.",
        ),
    ] = None,
    controllers: ShownOption = "all",
    names: NamesOption = "",
    against: AgainstOption = None,
    markdown: Annotated[bool, switch("--markdown", "Print the tables as Markdown.")] = False,
    latex: Annotated[
        bool,
        switch(
            "--latex", "Print them for LaTeX (booktabs), with a paragraph on methods and BibTeX."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Judge the controllers of a folder, with intervals and p-values.

    Rates, medians, tails, failures and paired differences.
    """
    from servobench.harness.analysis.folder import marked, titled_runs
    from servobench.harness.analysis.latex import latex_tables, methods_paragraph
    from servobench.harness.analysis.tables import Selection, as_plain, judge_places
    from servobench.harness.batch.measuring import add_metric
    from servobench.harness.batch.results import ResultsFolder
    from servobench.harness.cli.deciding import print_stored
    from servobench.harness.config.source import find_place
    from servobench.plant.contract.settings import suggest

    if markdown + latex + as_json > 1:
        raise ConfigurationError(
            "--markdown, --latex and --json are ways to print the same; give one of them"
        )
    opened = ResultsFolder(folder)
    if metric is not None and find_place(metric):
        metric = add_metric(opened, metric)
    runs = titled_runs(opened)
    opened.check_runs(runs)
    shown = selection.split_shown(controllers, runs)
    if against is not None and against not in shown:
        raise ConfigurationError(f"--against: unknown {against!r}: {suggest(against, shown)}")
    labels = selection.split_labels(names, shown)
    wanted = Selection(labels, metric, against)
    if not as_json:
        wanted = wanted._replace(names=marked(labels, opened.manifest))
    missing = opened.describe_missing()
    found = judge_places(runs, wanted)
    if as_json:
        if missing:
            sys.stderr.write(f"{missing}\n")
        places = [
            {
                "place": place.words,
                "controllers": as_plain(place.controllers),
                "pairs": [
                    {**row, "margin": place.margin, "least difference": place.least}
                    for row in as_plain(place.pairs)
                ],
            }
            for place in found.places
        ]
        print_json(places)
        return
    say(f"% {missing}" if latex and missing else missing)
    if latex:
        tables = latex_tables(found, folder.resolve().name)
        say("\n\n".join([*tables, methods_paragraph(opened.manifest, runs, found, labels)]))
        return
    if markdown:
        print_markdown(found.tables())
    else:
        print_tables(found.tables())
    say(found.legend)
    print_stored(opened)
    say_methods(opened.manifest, labels)


def collect(
    folder: Annotated[Path, typer.Argument(help="Results folder of a batch that was killed.")],
) -> None:
    """Make the tables of a batch that was killed."""
    from servobench.harness.batch import store
    from servobench.harness.batch.lock import locked
    from servobench.harness.batch.results import RUNS, ResultsFolder

    opened = ResultsFolder(folder)
    opened.check_finished()
    with locked(folder):
        count = store.collect(opened)
    say(opened.describe_missing())
    say(f"{count} runs in {folder / RUNS}")


def say_methods(manifest: Manifest, names: Mapping[str, str] | None = None) -> None:
    """Print which controllers of a folder have the aids, and which were tuned; `names` are those that tables show."""
    from servobench.harness.analysis.folder import describe_controllers, describe_tuning

    say(describe_controllers(manifest, names))
    say("\n".join(describe_tuning(manifest)))


def print_faults(folder: ResultsFolder, runs: pd.DataFrame) -> None:
    """Print which controllers of the user's command too much, and why runs failed, a line each; the first of many."""
    from servobench.harness.run.result import COMPLETED
    from servobench.plant.contract.settings import remark

    commanded = runs.reindex(columns=["controller", "saturation_fraction"])
    for name in folder.manifest.get("own_controllers", {}):
        share = commanded.loc[commanded["controller"] == name, "saturation_fraction"].median()
        if share > MAX_SATURATED:
            remark(
                f"{name} commands more than a joint's limit in {share:.0%} of its periods; commands are in rad/s"
            )
    for row in runs[runs["status"] != COMPLETED].head(MAX_FAULTS).to_dict("records"):
        say(f"{row['run_id']}: {row['status']}: {row['reason']}")


def print_lacking(folder: ResultsFolder) -> None:
    """Print in how many completed runs a metric of the user's has no value, and why in the first of them."""
    from servobench.harness.run.result import COMPLETED

    lacking = []
    for table in folder.iterate_runs(("run_id", "status", "reason")):
        lacking += table[(table["status"] == COMPLETED) & (table["reason"] != "")].to_dict(
            "records"
        )
    if lacking:
        first = lacking[0]
        say(f"in {len(lacking)} runs, first in {first['run_id']}: {first['reason']}")


def judge(folder: ResultsFolder, *, strict: bool, whole: bool = True) -> None:
    """Say how many runs of a batch lack or failed and where their traces are; end with exit code 1 if that counts.

    Args:
        folder: its results.
        strict: whether a run that failed or lacks makes the command fail.
        whole: whether the command was to carry out all runs of the batch.
    """
    from servobench.harness.batch.results import FAILURES, missing_line
    from servobench.harness.run.result import COMPLETED

    print_lacking(folder)
    completed = [table["status"] == COMPLETED for table in folder.iterate_runs(("status",))]
    count = sum(map(len, completed))
    failed = sum(int((~each).sum()) for each in completed)
    lack = missing_line(count, folder.run_count)
    if whole:
        say(lack)
    if failed:
        say(
            f"{failed} of {count} run{'s' if count > 1 else ''} failed; why: {folder.path / FAILURES}"
        )
    if strict and (failed or (whole and lack)):
        sys.exit(FAILED)
