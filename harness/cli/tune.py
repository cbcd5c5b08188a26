"""The command `servobench tune`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import TextColumn
from rich.table import Table

from servobench.harness.batch.results import locked
from servobench.harness.batch.workers import Workers, open_workers
from servobench.harness.cli.options import (
    INTERRUPTED,
    SchedulerOption,
    TimeoutOption,
    WorkersOption,
    split_names,
    split_words,
)
from servobench.harness.cli.progress import run_progress

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servobench.harness.studies.tuning.files import TunedValues
    from servobench.harness.studies.tuning.study import MethodStudy, TuningPlan

console = Console()


def tune(
    controllers: Annotated[str, typer.Option(help="Comma-separated names, or all that have a search space.")] = "all",
    trials: Annotated[int, typer.Option(help="Trials of each method, that of the defaults included.")] = 100,
    seeds: Annotated[int, typer.Option(help="Moves of a trial on each plant; half as many circles are added.")] = 8,
    plants: Annotated[str, typer.Option(help="Comma-separated names.")] = "kinematic",
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    run_timeout: TimeoutOption = None,
    offset: Annotated[int, typer.Option(help="First seed, counted from the begin of the tuning range.")] = 0,
    study_seed: Annotated[int, typer.Option(help="Seed of the sampler.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder of the studies; interrupted ones are continued.")] = (
        Path("results") / "tuning"
    ),
) -> None:
    """Search for the best settings of each method, with the same budget on the same training plants."""
    from servobench.harness.studies.tuning.objective import TuningSet  # noqa: PLC0415 - the optimiser costs half a second, for tune alone
    from servobench.harness.studies.tuning.study import TuningPlan, check_study_folder, open_studies, write_outcomes  # noqa: PLC0415

    plan = TuningPlan(_controllers(controllers), trials, TuningSet(split_words(plants), seeds, offset), study_seed)
    check_study_folder(out)
    names = {"plants": plan.runs.plants, "controllers": plan.controllers}
    with open_workers(workers, scheduler, run_timeout, **names) as place, locked(out):
        studies = open_studies(out, plan)
        interrupted = not _carry_out(studies, plan, place)
    console.print(_table(write_outcomes(out, studies)))
    console.print(f"studies and tuned values in {out}; copy its .toml files to controllers/tuned", soft_wrap=True)
    if interrupted:
        console.print("interrupted; the same call continues where it stopped")
        sys.exit(INTERRUPTED)


def _carry_out(studies: Sequence[MethodStudy], plan: TuningPlan, workers: Workers) -> bool:
    """Advance the studies to their end and show how far they are; return whether they got there."""
    from servobench.harness.studies.tuning.study import advance  # noqa: PLC0415 - as above

    runs = len(plan.runs.runs())
    with run_progress(console, TextColumn("runs, best {task.fields[best]}")) as progress:
        bars = {
            study.controller: progress.add_task(
                study.controller, total=plan.trials * runs, completed=len(study.finished()) * runs, best="–"
            )
            for study in studies
        }
        try:
            for finished in advance(studies, plan, workers):
                best = "–" if finished.best is None else f"{finished.best:.4f}"
                progress.update(bars[finished.controller], advance=1, best=best)
        except KeyboardInterrupt:
            return False
    return True


def _table(outcomes: Mapping[str, TunedValues]) -> Table:
    table = Table("controller", "trials", "score of defaults", "score tuned", "best trial")
    for name, tuned in outcomes.items():
        table.add_row(
            name, str(tuned.trials), f"{tuned.score_of_defaults:.4f}", f"{tuned.score:.4f}", str(tuned.best_trial)
        )
    return table


def _controllers(text: str) -> tuple[str, ...]:
    from servobench.harness.studies.tuning.spaces import SPACES, find_tunable  # noqa: PLC0415 - as above

    return split_names("controllers", text, tuple(SPACES), find_tunable)
