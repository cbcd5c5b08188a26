"""The commands `servobench run | compare | train | collect`."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.harness.cli import completion, options, selection
from servobench.harness.cli.results import judge, make_report, print_faults
from servobench.harness.cli.terminal import console, print_tables, say

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servobench.harness.batch.campaign import Campaign, Execution

DEFAULT_CONTROLLER = "ukf_mfac"  # of a run for which none is named

OutOption = Annotated[Path | None, typer.Option(help="New folder for the results; default: results/<date-time>.")]
ReportOption = Annotated[bool, typer.Option("--report/--no-report", help="Also make the page report.html.")]


def run(
    method: Annotated[
        str | None,
        typer.Argument(
            metavar="CONTROLLER",
            help="Short for --controller.",
            show_default=False,
            autocompletion=completion.controllers,
        ),
    ] = None,
    plant: Annotated[
        str | None,
        typer.Option(
            help=f"Name or file of the plant; default: {options.DEFAULT_PLANT}.", autocompletion=completion.plants
        ),
    ] = None,
    controller: Annotated[
        str | None,
        typer.Option(
            help=f"Name or file of the controller, or a law with --estimator; default: {DEFAULT_CONTROLLER}.",
            autocompletion=completion.controllers,
        ),
    ] = None,
    estimator: Annotated[
        str | None,
        typer.Option(help="Compose the law --controller with this estimator.", autocompletion=completion.estimators),
    ] = None,
    task: options.TaskOption = "exp2",
    mismatch: options.MismatchOption = "moderate",
    robot: options.RobotOption = "ur5",
    sensing: options.SensingOption = "position",
    seed: Annotated[int, typer.Option(help="Seed of everything random in the run.")] = 0,
    overrides: options.Overrides = options.OVERRIDES,
    view: Annotated[bool, typer.Option("--view", help="Watch the bullet plant in a window.")] = False,
    out: OutOption = None,
    with_report: ReportOption = False,
    limited: options.Limited = options.LIMITED,
    debug: options.DebugOption = False,
) -> None:
    """Carry out one run and show what came of it.

    The exit code is 1 if the run failed.
    """
    from servobench.harness.batch.campaign import Execution, comparison
    from servobench.harness.batch.compare import Batch, parse_seeds

    batch = Batch(
        (_one_plant(plant, view=view),),
        (_one_controller(method, controller, estimator),),
        (task,),
        (mismatch,),
        parse_seeds(f"{seed},"),
        selection.known_robot(robot),
        (selection.one_sensing(sensing),),
    )
    campaign = comparison(batch, overrides.settings(*["bullet.view=true"] * view))
    how = Execution(workers=1, bounds=limited.bounds(), debug=debug)
    judge(_carry_out(campaign, out, how, with_report=with_report), strict=True)


def _one_plant(plant: str | None, *, view: bool) -> str:
    """Return the name of the plant of a run."""
    from servobench.harness.batch.apart import choose_plants
    from servobench.harness.config.settings import ConfigurationError
    from servobench.plant.bench.plant import PlantEntry

    (name,) = [selection.default_plant()] if plant is None else choose_plants([plant])
    if view and name != "bullet":
        raise ConfigurationError(f"--view shows the plant bullet only, got --plant {name}")
    selection.tell_unused(PlantEntry, [name])
    return name


def _one_controller(method: str | None, controller: str | None, estimator: str | None) -> str:
    """Return the name of the controller of a run, which may be named as an argument or as an option."""
    from servobench.controllers.controller import ControllerEntry
    from servobench.harness.batch.apart import choose_controllers
    from servobench.harness.config.settings import ConfigurationError

    if None not in (method, controller) and method != controller:
        raise ConfigurationError(f"two controllers are named, {method} and --controller {controller}; a run has one")
    law = next((each for each in (method, controller) if each is not None), DEFAULT_CONTROLLER)
    (name,) = choose_controllers([law if estimator is None else f"{law}+{estimator}"])
    selection.tell_unused(ControllerEntry, [name])
    return name


def compare(
    plants: options.PlantsOption = "kinematic",
    controllers: options.ControllersOption = "all",
    tasks: options.TasksOption = "exp1,exp2,exp3,exp4,circle",
    mismatch: options.MismatchesOption = "moderate",
    robot: options.RobotOption = "ur5",
    sensing: options.SensingsOption = "position",
    seeds: options.SeedsOption = "1",
    running: options.Running = options.RUNNING,
    overrides: options.Overrides = options.OVERRIDES,
    out: OutOption = None,
    with_report: ReportOption = True,
    judging: options.Judging = options.JUDGING,
) -> None:
    """Compare controllers: run every combination."""
    from servobench.harness.batch.campaign import comparison
    from servobench.harness.batch.compare import Batch, parse_seeds
    from servobench.harness.config.settings import ConfigurationError

    batch = Batch(
        selection.split_plants(plants, robot=robot),
        selection.split_controllers(controllers, robot),
        selection.split_tasks(tasks),
        selection.split_mismatches(mismatch),
        parse_seeds(seeds),
        selection.known_robot(robot),
        selection.split_sensings(sensing),
    )
    if running.resume and out is None:
        raise ConfigurationError("--resume needs --out, the folder to continue in")
    campaign = comparison(batch, overrides.settings())
    folder = _carry_out(campaign, out, judging.execution(running), with_report=with_report)
    judge(folder, strict=judging.strict)


def train(
    controller: Annotated[str, typer.Option(help="Name of the controller whose networks to train.")] = "rbfnn_mfac",
    robot: options.RobotOption = "ur5",
    sensing: options.SensingOption = "position",
    overrides: options.Overrides = options.OVERRIDES,
) -> None:
    """Train the networks of a controller.

    They are trained on the nominal model and kept for later runs. Prints their errors.
    """
    from rich.table import Table

    from servobench.harness.batch.apart import choose_controllers
    from servobench.harness.cli.progress import telling
    from servobench.harness.run.experiment import train_networks
    from servobench.harness.run.network_cache import NETWORKS
    from servobench.harness.run.resolved import check_settings
    from servobench.plant.contract.cache import cache_folder

    settings, (controller,) = overrides.settings(), choose_controllers([controller])
    check_settings(settings, [controller])
    with telling(console, "training") as tell:
        trained = train_networks(controller, settings, tell, robot, sensing)
    table = Table("network", "held-out error")
    table.add_row("Jacobian: RMS of its error over RMS of itself", f"{100 * trained.jacobian_error:.2f} %")
    table.add_row("controller: RMS error of the commanded joint position", f"{trained.controller_error:.2e} rad")
    console.print(table)
    console.print(f"kept in {cache_folder(NETWORKS)}", soft_wrap=True)


def collect(folder: Annotated[Path, typer.Argument(help="Results folder of a batch that was killed.")]) -> None:
    """Make the tables of a batch that was killed."""
    from servobench.harness.batch import results
    from servobench.harness.batch.lock import locked

    results.check_folder(folder)
    with locked(folder):
        count = results.collect(folder)
    console.print(f"{count} runs in {folder / results.RUNS}")


@contextlib.contextmanager
def _ending_at_once(folder: Path, wanted: int) -> Iterator[None]:
    """End at Ctrl-C, also while something is drawn, with a line that says how to go on if runs were finished."""
    from servobench.harness.batch import results

    try:
        yield
    except KeyboardInterrupt:
        whole = (folder / results.RUNS).is_file()
        count = wanted if whole else sum(map(len, results.finished_runs(folder))) if folder.exists() else 0
        if not count:
            raise
        line = f"interrupted: {count} of {wanted} runs were finished and kept in {folder}; "
        line += "the same call with --resume and this --out continues"
        say(line)
        sys.exit(options.INTERRUPTED)


def _carry_out(campaign: Campaign, out: Path | None, how: Execution, *, with_report: bool) -> Path:
    """Check everything, run everything, leave tables, figures and a report behind, and return the folder."""
    from servobench.harness.batch.campaign import carry_out
    from servobench.harness.cli.progress import ConsoleObserver

    folder = out or Path("results") / datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    with _ending_at_once(folder, len(campaign.cells)):
        with contextlib.closing(ConsoleObserver(console, bar=not how.debug)) as observer:
            carry_out(campaign, folder, replace(how, observer=observer))
        _show(folder, latest=out is None, with_report=with_report)
    return folder


def _show(folder: Path, *, latest: bool, with_report: bool) -> None:
    """Print the tables of a folder whose runs are finished, and draw its figures and its report."""
    from servobench.harness.analysis.summary import summary_legend, summary_tables
    from servobench.harness.batch import results
    from servobench.harness.config.installation import missing_extra
    from servobench.harness.config.settings import ConfigurationError
    from servobench.harness.pictures.draw import draw_figures
    from servobench.plant.contract.files import point_latest

    runs = results.load_runs(folder)
    print_tables(summary_tables(runs), summary_legend(runs))
    print_faults(runs)
    if latest:
        point_latest(folder)
    with console.status("drawing the figures"):
        figures = draw_figures(folder)
    console.print(f"tables and {len(figures)} figure files in {folder}", soft_wrap=True)
    if with_report:
        try:
            make_report(folder)
        except (ConfigurationError, ImportError) as error:  # the runs are safe; `servobench report` can be called again
            missing = missing_extra(error, "the page") if isinstance(error, ImportError) else None
            console.print(f"no report: {missing or error}", soft_wrap=True, markup=False)
