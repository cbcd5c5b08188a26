"""The command `servobench claims`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from servobench.harness.batch import results
from servobench.harness.cli.options import split_names
from servobench.harness.cli.sweep import carry_out_sweep
from servobench.harness.config.registry import find_plant, plant_names
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.studies.claims.answers import answer_all
from servobench.harness.studies.claims.studies import MAIN, studies
from servobench.harness.studies.claims.table import (
    ANSWERS,
    differences,
    markdown_table,
    read_answers,
    write_tables,
)

DIFFERENT = 1
FEWEST = 6  # robots: below, Wilcoxon's test cannot come to any conclusion

console = Console()


def claims(
    out: Annotated[Path, typer.Option(help="Folder for the results; with --resume the one to go on with.")],
    plants: Annotated[str, typer.Option(help="Names by comma.")] = "kinematic,fmu",
    seeds: Annotated[int, typer.Option(help="Robots for each move; two fifths of them for the circle.")] = 100,
    workers: Annotated[int | None, typer.Option(min=1, help="Worker processes; default: the processors.")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler to send the runs to.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with runs that were killed.")] = False,
    check: Annotated[Path | None, typer.Option(help="Table of answers that must come out the same.")] = None,
) -> None:
    """Answer the paper's seven claims with statistics, and draw the figure behind each answer."""
    from servobench.harness.studies.claims.figures import draw_answers  # noqa: PLC0415 - matplotlib takes a third of a second to import

    if seeds < FEWEST:
        raise ConfigurationError(f"--seeds must be at least {FEWEST} to tell methods apart, got {seeds}")
    names = split_names("plants", plants, plant_names(), find_plant)
    if any(find_plant(name).own_robot for name in names):
        raise ConfigurationError("the claims are about a UR5; --plants names a plant with a robot of its own")
    wanted = None if check is None else read_answers(check)
    todo = studies(names, seeds)
    for study in todo:
        folder = out / study.name
        carry_out_sweep(study.cells, study.settings, folder, workers, scheduler, resume=resume and folder.exists())
    tables = {study.name: results.load_runs(out / study.name) for study in todo}
    answers = sorted(
        (answer for plant in names for answer in answer_all(tables, plant)),
        key=lambda a: (not a.claim.isdigit(), a.claim),
    )
    results.write_summary(out, {MAIN: tables[MAIN]}, results.read_manifest(out / MAIN))
    write_tables(answers, out)
    (out / "answers.md").write_text(markdown_table(answers), encoding="utf-8")
    figures = draw_answers(answers, out / "figures")
    for answer in answers:
        console.print(
            f"[bold]{answer.title} on {answer.plant}: {answer.verdict}[/bold]", soft_wrap=True, highlight=False
        )
        console.print(answer.evidence, markup=False, highlight=False)
    console.print(f"answers in {out / ANSWERS}, {len(figures)} figures in {out / 'figures'}", soft_wrap=True)
    if wanted is not None:
        lines = differences(answers, wanted)
        console.print("\n".join(lines) or f"the same answers as in {check}", soft_wrap=True, markup=False)
        if lines:
            sys.exit(DIFFERENT)
