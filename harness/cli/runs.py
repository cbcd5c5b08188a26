"""The commands that carry runs out, `servobench run | compare | sweep | merge | train`."""

from __future__ import annotations

import itertools
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.harness.cli import options, selection
from servobench.harness.cli.applications import find_command, find_function
from servobench.harness.cli.options import (
    CONTROLLER,
    ESTIMATOR,
    PLANT,
    named_option,
    option,
    switch,
)
from servobench.harness.cli.results import judge, print_faults, say_methods
from servobench.harness.cli.terminal import console, print_rows, print_tables, say
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import point_latest

if TYPE_CHECKING:
    from servobench.harness.analysis.decisions import Question
    from servobench.harness.batch.campaign import Campaign, Execution

DEFAULT_CONTROLLER = "ukf_mfac"  # controller of a run for which none is named

OutOption = Annotated[
    Path | None,
    named_option("--out", "FOLDER", "New folder for the results; default: results/<date-time>."),
]
FiguresOption = Annotated[bool, switch("--figures/--no-figures", "Also draw the figures, as PNG.")]
ReportOption = Annotated[bool, switch("--report/--no-report", "Also make the page report.html.")]

SWEPT = options.Combinations(
    controllers="rbfnn_mfac,ukf_mfac,ukf_mpc,rbf_pid", tasks="random", seeds="10"
)


def run(
    method: Annotated[
        str | None,
        typer.Argument(
            metavar="CONTROLLER",
            help="Short for --controller.",
            show_default=False,
            autocompletion=CONTROLLER.complete,
        ),
    ] = None,
    *,
    plant: Annotated[
        str | None,
        option(
            PLANT,
            "Name or file of the plant; default: the first of bullet, mujoco and kinematic that is installed.",
        ),
    ] = None,
    controller: Annotated[
        str | None,
        option(
            CONTROLLER,
            f"Name or file of the controller, or a law with --estimator; default: {DEFAULT_CONTROLLER}.",
        ),
    ] = None,
    estimator: Annotated[
        str | None, option(ESTIMATOR, "Compose the law --controller with this estimator.")
    ] = None,
    task: options.TaskOption = "exp2",
    mismatch: options.MismatchOption = options.DEFAULT_MISMATCH,
    robot: options.RobotOption = "ur5",
    sensing: options.SensingOption = "position",
    seed: Annotated[int, option("INTEGER", "Seed of everything random in the run.")] = 0,
    overrides: options.RunOverrides,
    view: Annotated[bool, switch("--view", "Watch the bullet plant in a window.")] = False,
    out: OutOption = None,
    with_figures: FiguresOption = True,
    with_report: ReportOption = False,
    limited: options.Limited,
    debug: options.DebugOption = False,
) -> None:
    """Carry out one run and show its results.

    The exit code is 1 if the run failed.
    """
    from servobench.harness.batch.campaign import Execution, comparison
    from servobench.harness.batch.plan import Batch, check_seeds
    from servobench.harness.config.registry import default_plant

    if None not in (method, controller) and method != controller:
        raise ConfigurationError(
            f"two controllers are named, {method} and --controller {controller}; a run has one"
        )
    if plant is None:
        plant, why = default_plant()
        if why:
            say(f"no plant is named, so this run is on {plant}: {why}")
    plant = selection.choose("plants", plant)
    if view and plant != "bullet":
        raise ConfigurationError(f"--view shows the plant bullet only, got --plant {plant}")
    law = next((each for each in (method, controller) if each is not None), DEFAULT_CONTROLLER)
    name = selection.choose("controllers", law if estimator is None else f"{law}+{estimator}")
    seeds = check_seeds((seed,), f"got {seed}")
    batch = Batch(
        (plant,), (name,), (selection.choose("tasks", task),), (mismatch,), seeds, robot, (sensing,)
    )
    campaign = comparison(batch, overrides.settings(*["bullet.view=true"] * view))
    how = Execution(workers=1, bounds=limited.bounds(), debug=debug)
    _carry_out(campaign, out, how, with_figures=with_figures, with_report=with_report, strict=True)


def compare(
    *,
    combinations: options.Combinations,
    first_seed_on: Annotated[
        str,
        option("PLANTS", "Further plants, for the first seed only: bullet, for its pictures."),
    ] = "",
    until_decided: options.UntilDecidedOption = False,
    against: options.AgainstOption = None,
    metric: options.MetricsOption = None,
    running: options.Batched,
    overrides: options.RunOverrides,
    out: OutOption = None,
    with_figures: FiguresOption = True,
    with_report: ReportOption = True,
) -> None:
    """Compare controllers: run every combination."""
    from servobench.harness.batch.campaign import comparison
    from servobench.harness.cli.deciding import ask, ending_when_decided

    batch = combinations.batch()
    if first_seed_on:
        further = selection.split("plants", first_seed_on, robot=combinations.robot)
        batch = replace(batch, first_seed_on=further)
    if running.resume and out is None:
        raise ConfigurationError("--resume needs --out, the folder to continue in")
    metrics = selection.choose_metrics(metric)
    campaign = replace(comparison(batch, overrides.settings()), metrics=metrics)
    worlds = len(batch.requests()) // (len(batch.controllers) * len(batch.seeds))
    question = ask(
        until_decided, against, batch.controllers, worlds, batch.seeds, first_seed_on=first_seed_on
    )
    if question is not None:
        campaign = ending_when_decided(campaign, question)
    how = running.execution()
    _carry_out(
        campaign,
        out,
        how,
        with_figures=with_figures,
        with_report=with_report,
        strict=running.strict,
        question=question,
    )


def sweep(
    *,
    out: options.FolderOption,
    combinations: options.Combinations = SWEPT,
    vary: Annotated[
        list[str] | None,
        option(
            "KEY=VALUES",
            "Axis of the mismatch, camera_rotation=0:180:30deg, or setting, plant.lag=0.02,0.05.",
        ),
    ] = None,
    noise: Annotated[
        str, option("NUMBERS", "Factors on the plants' sensor noise: --vary noise=...")
    ] = "",
    latency: Annotated[str, option("SECONDS", "Camera latencies [s]: --vary latency=...")] = "",
    period: Annotated[str, option("SECONDS", "Control periods [s]: --vary period=...")] = "",
    metric: options.MetricsOption = None,
    running: options.Batched,
    overrides: options.RunOverrides,
) -> None:
    """Run a Monte Carlo sweep: many runs, a row each.

    No steps are kept. A sweep that was interrupted is continued with --resume.
    """
    from servobench.harness.analysis.comparison import MISSING
    from servobench.harness.analysis.folder import (
        mark_tuned,
    )
    from servobench.harness.analysis.tables import SWEEP_COLUMNS, outcome_legend, sweep_tables
    from servobench.harness.batch.campaign import Campaign, carry_out
    from servobench.harness.batch.plan import SweepPlan
    from servobench.harness.batch.results import RUNS, ResultsFolder
    from servobench.harness.cli.progress import watching
    from servobench.harness.run.variations import SECTIONS

    short = {"noise": noise, "latency": latency, "period": period}
    variations = [*(vary or []), *(f"{name}={values}" for name, values in short.items() if values)]
    cells = SweepPlan.parse(combinations.batch(), variations).cells()
    metrics = selection.choose_metrics(metric)
    campaign = Campaign(cells, overrides.settings(), metrics=metrics)
    execution = running.execution()
    with watching(console, out, execution) as how:
        carry_out(campaign, out, how)
    columns = (
        *SWEEP_COLUMNS,
        *(name for name in campaign.cells[0].request.as_row() if name.startswith(SECTIONS)),
    )
    folder = ResultsFolder(out)
    outcomes = outcome_legend(folder.iterate_runs(columns))
    legend = f"{outcomes}\n{MISSING} as configured".lstrip()
    parts = (mark_tuned(part, folder.manifest) for part in folder.iterate_runs(columns))
    print_tables(sweep_tables(parts), legend)
    say_methods(folder.manifest)
    say(f"table in {out / RUNS}")
    judge(folder, strict=running.strict, whole=execution.part == (1, 1))


def merge(
    folders: Annotated[
        list[Path], typer.Argument(help="Results folders of the parts of a batch, of --part.")
    ],
    out: Annotated[Path, option("FOLDER", "New folder for all of their runs.")],
) -> None:
    """Put the parts of a batch into one folder.

    The parts of compare or sweep with --part. Where runs are missing, the same call with --resume carries them out.
    """
    from servobench.harness.batch import merging
    from servobench.harness.batch.results import RUNS, ResultsFolder

    count = merging.merge(folders, out, say)
    say(ResultsFolder(out).describe_missing())
    say(f"{count} runs in {out / RUNS}")


def train(
    *,
    controller: Annotated[
        str, option(CONTROLLER, "Name of the controller whose networks to train.")
    ] = "rbfnn_mfac",
    robot: options.RobotOption = "ur5",
    sensing: options.SensingOption = "position",
    overrides: options.Overrides,
) -> None:
    """Train the networks of a controller.

    They are trained on the nominal model and kept for later runs. Prints their errors.
    """
    from servobench.harness.cli.progress import telling
    from servobench.harness.run.resolution import check_settings
    from servobench.harness.run.result import NETWORKS
    from servobench.harness.run.training import train_networks
    from servobench.plant.contract.cache import cache_folder

    settings, controller = overrides.settings(), selection.choose("controllers", controller)
    check_settings(settings, [controller])
    with telling(console, "training") as tell:
        trained = train_networks(controller, settings, tell, robot, sensing)
    errors = {
        "Jacobian: RMS of its error over RMS of itself": f"{100 * trained.jacobian_error:.2f} %",
        "controller: RMS error of the commanded joint position": f"{trained.controller_error:.2e} rad",
    }
    print_rows(("network", "held-out error"), errors.items())
    say(f"kept in {cache_folder(NETWORKS)}")


def new_folder() -> Path:
    """Return a new folder below `results`, named after the time; a second one of the same second ends in _2."""
    named = Path("results") / datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    further = (named.with_name(f"{named.name}_{number}") for number in itertools.count(2))
    return next(each for each in itertools.chain([named], further) if not each.exists())


def _carry_out(
    campaign: Campaign,
    out: Path | None,
    how: Execution,
    *,
    with_figures: bool,
    with_report: bool,
    strict: bool,
    question: Question | None = None,
) -> None:
    """Check everything, run everything, leave tables, figures and a report behind, and judge failed runs."""
    from servobench.harness.analysis.folder import (
        mark_tuned,
        titled_runs,
    )
    from servobench.harness.analysis.tables import summary_legend, summary_tables
    from servobench.harness.analysis.verdict import judge as find_verdict
    from servobench.harness.batch.campaign import carry_out
    from servobench.harness.batch.results import ResultsFolder
    from servobench.harness.cli.progress import watching
    from servobench.harness.config.installation import missing_extra

    folder = out or new_folder()
    if question is not None and how.part != (1, 1):
        question = None
        say("parts decide nothing: merge them, and decide by the same call with --resume")
    with watching(console, folder, how) as watched:
        carry_out(campaign, folder, watched)
        opened = ResultsFolder(folder)
        runs = titled_runs(opened)
        shown = mark_tuned(runs, opened.manifest)
        print_tables(summary_tables(shown), summary_legend(runs))
        say_methods(opened.manifest)
        print_faults(opened, runs)
        if question is not None:
            from servobench.harness.analysis.decisions import decide_worlds
            from servobench.harness.cli.deciding import print_answers, save_decisions

            answers = decide_worlds(runs, question)
            save_decisions(opened, answers)
        if out is None:
            point_latest(folder)
        if with_figures:
            draw = find_function("figures", "draw")
            with console.status("drawing the figures"):
                figures = draw(opened)
                opened.vouch(figures)
        say(
            f"tables and {len(figures)} figures in {folder}"
            if with_figures
            else f"tables in {folder}"
        )
        if with_report:
            try:
                find_command("report")(folder)
            except (
                ConfigurationError,
                ImportError,
            ) as error:  # the runs are safe, and the report can be made again
                missing = (
                    missing_extra(error, "the page") if isinstance(error, ImportError) else None
                )
                say(f"no report: {missing or error}")
        if question is not None:
            print_answers(answers, question, len(runs), len(campaign.cells))
        elif len(runs) > 1:
            finding = find_verdict(runs)
            say("\n".join(["", finding.result, *finding.cautions, ""]).replace("`", ""))
    judge(opened, strict=strict, whole=how.part == (1, 1))
