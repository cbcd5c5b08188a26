"""The commands `servobench robustness | claims | tune`: studies of many runs."""

from __future__ import annotations

import sys
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.harness.cli import options
from servobench.harness.cli.terminal import console

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.table import Table

    from servobench.harness.batch.workers import Workers
    from servobench.harness.studies.tuning.files import TunedValues
    from servobench.harness.studies.tuning.study import MethodStudy, TuningPlan

DEFAULT_CONTROLLERS = "rbfnn_mfac_plus,rbfnn_mfac,ukf_mfac,ukf_mpc,rbf_pid"
EXIT_DIFFERENT = 1


def robustness(
    out: options.FolderOption,
    plant: Annotated[str, typer.Option(help="Name of the plant.")] = "fmu",
    controllers: options.NamesOption = DEFAULT_CONTROLLERS,
    seeds: options.SeedsOption = "40",
    running: options.Running = options.RUNNING,
    overrides: options.Overrides = options.OVERRIDES,
) -> None:
    """Draw the robustness map: success and settling time along seven axes, each varied by itself."""
    from servobench.harness.batch.compare import parse_seeds
    from servobench.harness.cli.progress import watching
    from servobench.harness.studies.robustness import make_map

    settings = overrides.settings()
    names = options.split_controllers(controllers)
    where = options.split_plants(plant, "plant")[0]
    with watching(console, out) as observer:
        files = make_map(out, where, names, parse_seeds(seeds), settings, running.execution(observer))
    console.print(f"the map is in {files[0]}; its runs are in {out}", soft_wrap=True)


def claims(
    out: options.FolderOption,
    plants: options.NamesOption = "kinematic,fmu",
    seeds: Annotated[int, typer.Option(help="Robots for each move; two fifths of them for the circle.")] = 500,
    division: Annotated[str, typer.Option(help="How methods are equipped: equipped, published or both.")] = "both",
    running: options.Running = options.RUNNING,
    check: Annotated[Path | None, typer.Option(help="Table of answers that must come out the same.")] = None,
) -> None:
    """Answer the paper's seven claims with statistics, and draw the figure behind each answer."""
    from servobench.harness.cli.progress import watching
    from servobench.harness.studies.claims.reproduction import FIGURES, reproduce
    from servobench.harness.studies.claims.studies import find_divisions
    from servobench.harness.studies.claims.table import ANSWERS, differences, read_answers

    names = options.split_plants(plants)
    divisions = find_divisions(division)
    wanted = None if check is None else read_answers(check)
    with watching(console, out) as observer:
        answers = reproduce(out, names, seeds, running.execution(observer), divisions)
    for answer in answers:
        title = f"{answer.title} on {answer.plant}, {answer.division}"
        console.print(f"[bold]{title}: {answer.verdict}[/bold]", soft_wrap=True, highlight=False)
        console.print(answer.evidence, markup=False, highlight=False)
    console.print(f"answers in {out / ANSWERS}, figures in {out / FIGURES}", soft_wrap=True)
    if wanted is not None:
        lines = differences(answers, wanted)
        console.print("\n".join(lines) or f"the same answers as in {check}", soft_wrap=True, markup=False)
        if lines:
            sys.exit(EXIT_DIFFERENT)


def tune(
    controllers: Annotated[str, typer.Option(help="Comma-separated names, or all that have a search space.")] = "all",
    trials: Annotated[int, typer.Option(help="Trials of each method, that of the defaults included.")] = 100,
    seeds: Annotated[int, typer.Option(help="Moves of a trial on each plant; half as many circles are added.")] = 8,
    plants: options.NamesOption = "kinematic",
    place: options.Place = options.PLACE,
    offset: Annotated[int, typer.Option(help="First seed, counted from the begin of the tuning range.")] = 0,
    study_seed: Annotated[int, typer.Option(help="Seed of the sampler.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder of the studies; interrupted ones are continued.")] = (
        Path("results") / "tuning"
    ),
) -> None:
    """Search for the best settings of each method, with the same budget on the same training plants."""
    from servobench.harness.batch.lock import locked
    from servobench.harness.batch.workers import open_workers
    from servobench.harness.config.settings import ConfigurationError
    from servobench.harness.studies.tuning.objective import TuningSet
    from servobench.harness.studies.tuning.spaces import SPACES, find_tunable
    from servobench.harness.studies.tuning.study import TuningPlan, check_study_folder, open_studies, write_outcomes

    names = options.split_names("controllers", controllers, tuple(SPACES), find_tunable)
    try:
        plan = TuningPlan(names, trials, TuningSet(options.split_words(plants), seeds, offset), study_seed)
    except ValueError as error:
        raise ConfigurationError(str(error)) from error
    check_study_folder(out)
    opening = open_workers(*astuple(place), plants=plan.runs.plants, controllers=names)
    with opening as opened, locked(out):
        studies = open_studies(out, plan)
        interrupted = not _advance(studies, plan, opened)
    console.print(_tuned_table(write_outcomes(out, studies)))
    console.print(f"studies and tuned values in {out}; copy its .toml files to controllers/tuned", soft_wrap=True)
    if interrupted:
        console.print("interrupted; the same call continues where it stopped")
        sys.exit(options.INTERRUPTED)


def _advance(studies: Sequence[MethodStudy], plan: TuningPlan, workers: Workers) -> bool:
    """Advance the studies to their end and show how far they are; return whether they got there."""
    from rich.progress import TextColumn

    from servobench.harness.cli.progress import run_progress
    from servobench.harness.studies.tuning.study import advance

    runs = len(plan.runs.runs())
    with run_progress(console, TextColumn("runs, best {task.fields[best]}")) as progress:
        bars = {
            study.controller: progress.add_task(
                study.controller, total=plan.trials * runs, completed=len(study.finished()) * runs, best="–"
            )
            for study in studies
        }
        try:
            for controller, best in advance(studies, plan, workers):
                progress.update(bars[controller], advance=1, best="–" if best is None else f"{best:.4f}")
        except KeyboardInterrupt:
            return False
    return True


def _tuned_table(outcomes: Mapping[str, TunedValues]) -> Table:
    from rich.table import Table

    table = Table("controller", "trials", "score of defaults", "score tuned", "best trial")
    for name, tuned in outcomes.items():
        table.add_row(
            name, str(tuned.trials), f"{tuned.score_of_defaults:.4f}", f"{tuned.score:.4f}", str(tuned.best_trial)
        )
    return table
