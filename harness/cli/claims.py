"""The command `servobench claims`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from servobench.harness.cli.options import (
    ResumeOption,
    SchedulerOption,
    TimeoutOption,
    WorkersOption,
    split_names,
)
from servobench.harness.cli.progress import watching
from servobench.harness.cli.terminal import console
from servobench.harness.config.registry import find_plant, plant_names

EXIT_DIFFERENT = 1


def claims(
    out: Annotated[Path, typer.Option(help="Folder for the results; with --resume the one to continue.")],
    plants: Annotated[str, typer.Option(help="Comma-separated names.")] = "kinematic,fmu",
    seeds: Annotated[int, typer.Option(help="Robots for each move; two fifths of them for the circle.")] = 100,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    run_timeout: TimeoutOption = None,
    resume: ResumeOption = False,
    check: Annotated[Path | None, typer.Option(help="Table of answers that must come out the same.")] = None,
) -> None:
    """Answer the paper's seven claims with statistics, and draw the figure behind each answer."""
    from servobench.harness.studies.claims.reproduction import FIGURES, reproduce  # noqa: PLC0415 - draws with matplotlib
    from servobench.harness.studies.claims.table import ANSWERS, differences, read_answers  # noqa: PLC0415

    names = split_names("plants", plants, plant_names(), find_plant)
    wanted = None if check is None else read_answers(check)
    with watching(console, out) as observer:
        answers = reproduce(
            out, names, seeds, workers=workers, scheduler=scheduler, run_timeout=run_timeout, resume=resume,
            observer=observer,
        )  # fmt: skip
    for answer in answers:
        console.print(
            f"[bold]{answer.title} on {answer.plant}: {answer.verdict}[/bold]", soft_wrap=True, highlight=False
        )
        console.print(answer.evidence, markup=False, highlight=False)
    console.print(f"answers in {out / ANSWERS}, figures in {out / FIGURES}", soft_wrap=True)
    if wanted is not None:
        lines = differences(answers, wanted)
        console.print("\n".join(lines) or f"the same answers as in {check}", soft_wrap=True, markup=False)
        if lines:
            sys.exit(EXIT_DIFFERENT)
