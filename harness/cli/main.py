"""The command `servobench`."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer
from rich.table import Table

from servobench.controllers.parts import ESTIMATORS, LAWS
from servobench.harness.analysis.tables import SUMMARY_LEGEND, summary_tables
from servobench.harness.batch import results
from servobench.harness.batch.campaign import Campaign, carry_out, comparison
from servobench.harness.batch.compare import Batch, parse_seeds
from servobench.harness.cli.claims import claims
from servobench.harness.cli.fmu import fmu_app
from servobench.harness.cli.options import (
    INTERRUPTED,
    ConfigOption,
    ResumeOption,
    SchedulerOption,
    SetOption,
    TimeoutOption,
    WorkersOption,
    split_names,
    split_words,
)
from servobench.harness.cli.progress import ConsoleObserver, run_progress
from servobench.harness.cli.robustness import robustness
from servobench.harness.cli.show import make_report, record, report, statistics
from servobench.harness.cli.sweep import sweep
from servobench.harness.cli.terminal import console, print_tables
from servobench.harness.cli.tune import tune
from servobench.harness.config.defaults import default_config
from servobench.harness.config.registry import (
    controller_names,
    find_controller,
    find_plant,
    plant_names,
)
from servobench.harness.config.settings import (
    ConfigurationError,
    flatten,
    read_settings,
)
from servobench.harness.run.experiment import known_sections, train_networks
from servobench.harness.run.network_cache import cache_folder
from servobench.harness.run.tasks import find_task, task_names

app = typer.Typer(
    help="The bench on which uncalibrated visual-servoing controllers are compared.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

OutOption = Annotated[Path | None, typer.Option(help="New folder for the results; default results/<date-time>.")]
ReportOption = Annotated[bool, typer.Option("--report/--no-report", help="Also make the page report.html.")]
NameArgument = Annotated[str | None, typer.Argument(help="Show the settings of this one.")]


app.add_typer(fmu_app, name="fmu")
app.command()(sweep)
app.command()(claims)
app.command()(robustness)
app.command()(statistics)
app.command()(tune)
app.command()(record)
app.command()(report)


@app.command()
def plants(name: NameArgument = None) -> None:
    """List the plants, or show the settings of one."""
    _list_or_show("plants", name, plant_names(), find_plant, lambda entry: entry.config())


@app.command()
def controllers(name: NameArgument = None) -> None:
    """List the controllers, or show the settings of one."""
    _list_or_show("controllers", name, controller_names(), find_controller, default_config)


@app.command()
def tasks(name: NameArgument = None) -> None:
    """List the tasks, or show the settings of one."""
    _list_or_show("tasks", name, task_names(), find_task, lambda entry: entry.default)


@app.command()
def run(
    plant: Annotated[str, typer.Option(help="Name of the plant.")] = "bullet",
    controller: Annotated[str, typer.Option(help="Name of the controller, or of a law with --estimator.")] = "ukf_mfac",
    estimator: Annotated[str | None, typer.Option(help="Compose the law --controller with this estimator.")] = None,
    task: Annotated[str, typer.Option(help="Name of the task.")] = "exp2",
    mismatch: Annotated[str, typer.Option(help="none, factory, moderate, severe, or axes: links=10%+tool=20mm.")] = (
        "moderate"
    ),
    seed: Annotated[int, typer.Option(help="Seed of everything random in the run.")] = 0,
    set_: SetOption = None,
    config: ConfigOption = None,
    view: Annotated[bool, typer.Option("--view", help="Watch the bullet plant in a window.")] = False,
    out: OutOption = None,
    with_report: ReportOption = False,
) -> None:
    """Carry out one run."""
    assignments = list(set_ or [])
    if view:
        if plant != "bullet":
            raise ConfigurationError(f"--view shows the plant bullet only, got --plant {plant}")
        assignments.append("bullet.view=true")
    name = f"{controller}+{estimator}" if estimator else controller
    batch = Batch((plant,), (name,), (task,), (mismatch,), parse_seeds(f"{seed},"))
    _carry_out(comparison(batch, read_settings(config, assignments)), out, with_report=with_report, workers=1)


@app.command()
def compare(
    plants: Annotated[str, typer.Option(help="Comma-separated names, or all.")] = "kinematic",
    controllers: Annotated[str, typer.Option(help="Comma-separated names, or all.")] = "all",
    tasks: Annotated[str, typer.Option(help="Comma-separated names.")] = "exp1,exp2,exp3,exp4,circle",
    mismatch: Annotated[str, typer.Option(help="Comma-separated mismatches.")] = "moderate",
    seeds: Annotated[str, typer.Option(help="A count (5), a list (3,1,4) or a range (100:120).")] = "1",
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    run_timeout: TimeoutOption = None,
    resume: ResumeOption = False,
    set_: SetOption = None,
    config: ConfigOption = None,
    out: OutOption = None,
    with_report: ReportOption = True,
) -> None:
    """Run every combination and compare the controllers."""
    batch = Batch(
        split_names("plants", plants, plant_names(), find_plant),
        split_names("controllers", controllers, controller_names(), find_controller),
        split_names("tasks", tasks, task_names(), find_task),
        split_words(mismatch),
        parse_seeds(seeds),
    )
    if resume and out is None:
        raise ConfigurationError("--resume needs --out, the folder to continue in")
    _carry_out(
        comparison(batch, read_settings(config, set_ or [])), out, with_report=with_report, workers=workers,
        scheduler=scheduler, run_timeout=run_timeout, resume=resume,
    )  # fmt: skip


@app.command()
def train(
    controller: Annotated[str, typer.Option(help="Name of the controller whose networks to train.")] = "rbfnn_mfac",
    set_: SetOption = None,
    config: ConfigOption = None,
) -> None:
    """Train the networks of a controller on the nominal model, or find them trained, and tell their held-out error."""
    settings = read_settings(config, set_ or [])
    settings.check_sections([*known_sections(), controller])
    with run_progress(console) as progress:
        bar = progress.add_task("training", total=1.0)
        trained = train_networks(
            controller, settings, lambda share, what: progress.update(bar, completed=share, description=what)
        )
        progress.update(bar, completed=1.0, description="done")
    table = Table("network", "held-out error")
    table.add_row("Jacobian: RMS of its error over RMS of itself", f"{100 * trained.jacobian_error:.2f} %")
    table.add_row("controller: RMS error of the commanded joint position", f"{trained.controller_error:.2e} rad")
    console.print(table)
    console.print(f"kept in {cache_folder()}", soft_wrap=True)


@app.command()
def collect(folder: Annotated[Path, typer.Argument(help="Results folder of a batch that was killed.")]) -> None:
    """Put the finished runs of a killed batch together into its tables."""
    results.check_folder(folder)
    console.print(f"{results.collect(folder)} runs in {folder / results.RUNS}")


def main() -> None:
    """Run the command line; a bad input is one line on standard error and exit code 2."""
    try:
        app()
    except ConfigurationError as error:
        sys.stderr.write(f"servobench: {error}\n")
        sys.exit(2)
    except KeyboardInterrupt:
        sys.stderr.write("servobench: interrupted\n")
        sys.exit(INTERRUPTED)


def _carry_out(
    campaign: Campaign,
    out: Path | None,
    *,
    with_report: bool,
    workers: int | None = None,
    scheduler: str | None = None,
    run_timeout: float | None = None,
    resume: bool = False,
) -> None:
    """Check everything, run everything, and leave tables, figures and a report behind."""
    folder = out or Path("results") / datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    interrupted = False
    with contextlib.closing(ConsoleObserver(console)) as observer:
        try:
            carry_out(
                campaign, folder, workers=workers, scheduler=scheduler, run_timeout=run_timeout, resume=resume,
                observer=observer,
            )  # fmt: skip
        except KeyboardInterrupt:
            if not folder.exists():
                raise
            interrupted = True
    results.collect(folder)
    runs = results.load_runs(folder)
    print_tables(summary_tables(runs), SUMMARY_LEGEND)
    _print_faults(runs)
    with console.status("drawing the figures"):
        from servobench.harness.pictures.draw import draw_figures  # noqa: PLC0415 - matplotlib takes a third of a second to import

        figures = draw_figures(folder)
    if out is None:
        results.point_latest(folder)
    console.print(f"tables and {len(figures)} figure files in {folder}", soft_wrap=True)
    if interrupted:
        console.print(f"interrupted: {len(runs)} of {len(campaign.cells)} runs were finished and kept")
        sys.exit(INTERRUPTED)
    if with_report:
        try:
            make_report(folder)
        except ConfigurationError as error:  # the runs are safe, and `servobench report` can be called again
            console.print(f"no report: {error}", soft_wrap=True, markup=False)


def _print_faults(runs: pd.DataFrame) -> None:
    for row in runs[runs["reason"] != ""].to_dict("records"):
        console.print(f"{row['run_id']}: {row['status']}: {row['reason']}", soft_wrap=True, markup=False)


def _list_or_show(
    kind: str,
    name: str | None,
    names: Sequence[str],
    find: Callable[[str], Any],
    default: Callable[[Any], Any],
) -> None:
    table = Table("setting", "default") if name else Table(kind, "")
    if name:
        for key, value in flatten(default(find(name))).items():
            table.add_row(f"{name}.{key}", str(value))
    else:
        for known in names:
            table.add_row(known, find(known).summary)
    console.print(table)
    if kind == "controllers" and not name:
        console.print(f"or any law with any estimator, such as mfac+rls: laws {', '.join(LAWS)};", soft_wrap=True)
        console.print(f"estimators {', '.join(ESTIMATORS)}", soft_wrap=True)


if __name__ == "__main__":
    main()
