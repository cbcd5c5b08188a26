"""The commands `sweep | robustness | suite | claims | tune`, studies of many runs, and `analyse`, of loops."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn

import typer

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import CHALLENGE, CONTROLLER, PLANT, option, switch
from servobench.harness.cli.results import judge
from servobench.harness.cli.terminal import (
    FAILED,
    console,
    end_interrupted,
    print_rows,
    print_tables,
    say,
)
from servobench.plant.contract.faults import ConfigurationError, RunFault, configuration_errors
from servobench.plant.contract.files import split_words

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pandas as pd

    from servobench.harness.batch.isolation import Workers
    from servobench.harness.config.settings import Settings
    from servobench.harness.run.resolution import ResolvedRun
    from servobench.harness.studies.tuning.campaign import Method, TunedValues, TuningPlan
    from servobench.harness.studies.tuning.objective import TuningSet

DEFAULT_CONTROLLERS = (
    "regression_mfac, rbfnn_mfac, ukf_mfac, ukf_mpc, rbf_pid"  # spaces let the help break lines
)
SWEPT = options.Combinations(
    controllers="rbfnn_mfac,ukf_mfac,ukf_mpc,rbf_pid", tasks="random", seeds="10"
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
    running: options.Batched,
    overrides: options.Overrides,
) -> None:
    """Run a Monte Carlo sweep: many runs, a row each.

    No steps are kept. A sweep that was interrupted is continued with --resume.
    """
    from servobench.harness.analysis.comparison import MISSING
    from servobench.harness.analysis.folder import describe_controllers
    from servobench.harness.analysis.tables import SWEEP_COLUMNS, outcome_legend, sweep_tables
    from servobench.harness.batch import results
    from servobench.harness.batch.campaign import Campaign, carry_out
    from servobench.harness.batch.plan import SweepPlan
    from servobench.harness.cli.progress import watching
    from servobench.harness.run.request import SECTIONS

    short = {"noise": noise, "latency": latency, "period": period}
    variations = [*(vary or []), *(f"{name}={values}" for name, values in short.items() if values)]
    campaign = Campaign(
        SweepPlan.parse(combinations.batch(), variations).cells(), overrides.settings()
    )
    execution = running.execution()
    with watching(console, out, execution) as how:
        carry_out(campaign, out, how)
    columns = (
        *SWEEP_COLUMNS,
        *(name for name in campaign.cells[0].request.as_row() if name.startswith(SECTIONS)),
    )
    legend = (
        f"{outcome_legend(results.iterate_runs(out, columns))}\n{MISSING} as configured".lstrip()
    )
    print_tables(sweep_tables(results.iterate_runs(out, columns)), legend)
    say(describe_controllers(out))
    say(f"table in {out / results.RUNS}")
    judge(out, strict=running.strict, whole=execution.part == (1, 1))


def robustness(
    *,
    out: options.FolderOption,
    plant: Annotated[str, option(PLANT, "Name or file of the plant.")] = "fmu",
    controllers: options.ControllersOption = DEFAULT_CONTROLLERS,
    seeds: options.SeedsOption = "40",
    robot: options.RobotOption = "ur5",
    sensing: options.SensingOption = "position",
    axes: Annotated[
        str,
        option(
            "NAMES", "Comma-separated axes, such as outliers,jitter; default: the seven of the map."
        ),
    ] = "",
    running: options.Running,
    overrides: options.Overrides,
) -> None:
    """Draw success and settling time along seven axes.

    The robustness map; each axis of the mismatch or of the sensor is varied by itself.
    """
    from servobench.harness.batch.plan import Batch, parse_seeds
    from servobench.harness.cli.progress import watching
    from servobench.harness.run.request import find_robot
    from servobench.harness.studies.robustness import BASE, TASK, find_lines, make_map

    settings = overrides.settings()
    lines = find_lines(split_words(axes))
    names = selection.split("controllers", controllers, robot=robot)
    where = selection.split("plants", plant, option="plant", robot=robot)[0]
    base = "none" if find_robot(robot).twin else BASE
    batch = Batch((where,), names, (TASK,), (base,), parse_seeds(seeds), robot, (sensing,))
    with watching(console, out, running.execution()) as how:
        files = make_map(out, batch, settings, how, lines)
    say(f"the map is in {files[0]}; its runs are in {out}")
    judge(out, strict=False)


def suite(
    *,
    out: options.FolderOption,
    challenges: Annotated[
        str,
        option(
            CHALLENGE.several(),
            "Comma-separated names, or .toml files of your own; default: all names.",
        ),
    ] = selection.ALL,
    grade: Annotated[
        str,
        option("NAMES", "Comma-separated grades, I, II or III, of the challenges; default: all."),
    ] = "",
    controllers: options.ControllersOption = DEFAULT_CONTROLLERS,
    plants: Annotated[
        str, option(PLANT.several(), "Comma-separated names or files; default: those of each file.")
    ] = "",
    seeds: options.SeedsOption = "40",
    reference_seeds: Annotated[
        int | None,
        option(
            "COUNT", "Robots on which references run and scores are given; default: all.", min=1
        ),
    ] = None,
    running: options.Running,
    overrides: options.Overrides,
) -> None:
    """Score methods over challenges, worlds that tell them apart.

    A score is the error or time of a method that knows the true robot over that of the method; a lost run has 0.
    """
    from servobench.harness.batch.plan import parse_seeds
    from servobench.harness.cli.progress import watching
    from servobench.harness.studies.challenge import choose_challenges
    from servobench.harness.studies.suite import carry_out_suite, suite_tables

    worlds = choose_challenges(selection.split("challenges", challenges), split_words(grade))
    names = selection.split("controllers", controllers)
    where = selection.split("plants", plants) if plants else ()
    robots = parse_seeds(seeds)
    runs = {world.name: world.cells(where, names, robots, reference_seeds) for world in worlds}
    with watching(console, out, running.execution()) as how:
        judged = carry_out_suite(out, worlds, runs, overrides.settings(), how)
    print_tables(suite_tables(judged), "score: reference over method, at most 1; 0 for a lost run")
    say(f"tables and pictures in {out}; the runs of each challenge in a folder of its name")


def claims(
    *,
    out: options.FolderOption,
    plants: options.PlantsOption = "kinematic,fmu",
    seeds: Annotated[
        int, option("COUNT", "Robots for each move; two fifths of them for the circle.")
    ] = 500,
    division: Annotated[
        Literal["equipped", "published", "both"],
        option(
            "NAME",
            "Form of the methods: equipped (all aids), published (the law as printed) or both.",
        ),
    ] = "both",
    mismatch: options.MismatchOption = "moderate",
    running: options.Running,
    check: Annotated[
        Path | None,
        option(
            "FILE",
            "Table of answers that must come out the same; the exit code is 1 if they differ.",
        ),
    ] = None,
) -> None:
    """Answer the paper's seven claims with statistics.

    The figure behind each answer is drawn as well.
    """
    from servobench.harness.cli.progress import watching
    from servobench.harness.studies import reproduction
    from servobench.harness.studies.claims import DIVISIONS

    names = selection.split("plants", plants)
    divisions = [name for name in DIVISIONS if division in ("both", name.split()[-1])]
    wanted = None if check is None else reproduction.read_answers(check)
    with watching(console, out, running.execution()) as how:
        answers = reproduction.reproduce(out, names, seeds, how, divisions, mismatch)
    for answer in answers:
        title = f"{answer.title} on {answer.plant}, {answer.division}"
        verdict = answer.verdict + reproduction.elsewhere(answer, answers)
        console.print(f"[bold]{title}: {verdict}[/bold]", soft_wrap=True, highlight=False)
        console.print(answer.evidence, markup=False, highlight=False)
    say(f"answers in {out / reproduction.ANSWERS}, figures in {out / reproduction.FIGURES}")
    if wanted is not None:
        lines = reproduction.differences(answers, wanted)
        say("\n".join(lines) or f"the same answers as in {check}")
        if lines:
            sys.exit(FAILED)


def tune(
    *,
    controllers: Annotated[
        str, option(CONTROLLER.several(), "Comma-separated names, or all that have a search space.")
    ] = "all",
    studies: Annotated[
        int,
        option(
            "COUNT",
            "Studies of each method; their results and the values in use meet on a second set of robots.",
        ),
    ] = 3,
    trials: Annotated[int, option("COUNT", "Trials of each study, known settings included.")] = 100,
    search: Annotated[
        int,
        option("COUNT", "Upper limit on the points of the coordinate search that ends a study."),
    ] = 100,
    robots: Annotated[int, option("COUNT", "Robots under each condition of a trial.")] = 12,
    plants: options.PlantsOption = "kinematic",
    place: options.Place,
    offset: Annotated[
        int,
        option("INTEGER", "First seed, counted from the beginning of the range kept for tuning."),
    ] = 0,
    study_seed: Annotated[int, option("INTEGER", "Seed of the first study's sampler.")] = 0,
    check: Annotated[
        bool,
        switch(
            "--check",
            "Change each tuned value in use one by one instead, and name changes that are better.",
        ),
    ] = False,
    out: Annotated[
        Path, option("FOLDER", "Folder of the studies; interrupted ones are continued.")
    ] = (Path("results") / "tuning"),
) -> None:
    """Search for the best settings of each method.

    Every method has the same budget on the same training plants.
    """
    from servobench.harness.batch.blocks import open_workers
    from servobench.harness.batch.lock import locked
    from servobench.harness.studies.tuning.campaign import (
        TuningPlan,
        check_study_folder,
        open_methods,
        write_results,
    )
    from servobench.harness.studies.tuning.objective import TuningSet
    from servobench.harness.studies.tuning.spaces import SPACES, find_tunable

    names = selection.split_names("controllers", controllers, tuple(SPACES), find_tunable)
    with configuration_errors():
        runs = TuningSet(selection.split("plants", plants), robots, offset)
        second = runs.second()
        plan = TuningPlan(names, trials, runs, studies, search, study_seed)
    check_study_folder(out)
    opening = open_workers(
        place.workers, place.scheduler, place.bounds(), plants=plan.runs.plants, controllers=names
    )
    with opening as opened, locked(out):
        if check:
            _check(out, names, second, opened)
            return
        say(
            f"at most {_counted(plan)}; --controllers, --studies, --trials, --search and --robots make it less"
        )
        methods = open_methods(out, plan)
        interrupted = not _advance(methods, plan, opened)
    if results := write_results(out, methods):
        _print_tuned(results)
    lost = [name for name, tuned in results.items() if tuned.lost]
    if len(results) > len(lost):
        say(f"studies and tuned values in {out}; copy its .toml files to controllers/tuned")
    if interrupted:
        _end_interrupted(out)
    if lost:
        found = f"no run of {', '.join(lost)} came near its target with any settings, so no values are written"
        raise ConfigurationError(f"{found}; servobench run with the same plant may say why")


def _counted(plan: TuningPlan) -> str:
    """Return how many points and runs a campaign has, without those of its second set of robots."""
    methods = len(plan.controllers)
    budget = plan.trials + plan.search
    runs = len(plan.runs.runs())
    points = methods * plan.studies * budget
    compared = "1 method" if methods == 1 else f"{methods} methods"
    factors = f"{compared} × {plan.studies} studies × {budget} points × {runs} runs"
    return f"{factors} = {points * runs} runs"


def _end_interrupted(out: Path) -> NoReturn:
    end_interrupted(f"finished points are kept in {out}", "the same call continues")


def _check(folder: Path, names: Sequence[str], runs: TuningSet, workers: Workers) -> None:
    """Score every change of one value of the settings in use and say which of them improve a score by too much."""
    from servobench.harness.cli.progress import Bars
    from servobench.harness.studies.tuning.campaign import TOLERANCE, Check, improvements

    checked = Check(folder, names, runs)
    total, begun = len(checked), checked.known()
    try:
        with Bars(console) as bars:
            bar = bars.begin("points", total, begun)
            for done, _ in enumerate(checked.carry_out(workers), begun + 1):
                bars.reach(bar, done, f"{done} of {total} points")
    except KeyboardInterrupt:
        _end_interrupted(folder)
    found = improvements(checked.changes())
    if not found:
        say(f"no change improves a score by more than {TOLERANCE:.0%}")
        return
    rows = []
    for change in found:
        values = (
            f"{value:.4g}" if isinstance(value, float) else str(value)
            for value in (change.before, change.after)
        )
        scores = f"{change.score_before:.4f}", f"{change.score_after:.4f}", f"{change.gain:.1%}"
        rows.append((change.controller, change.key, *values, *scores))
    print_rows(("controller", "key", "in use", "better", "score", "with the change", "gain"), rows)
    sys.exit(FAILED)


def _advance(methods: Sequence[Method], plan: TuningPlan, workers: Workers) -> bool:
    """Advance the studies to their end and show how far they are; return whether they got there."""
    from rich.progress import TextColumn

    from servobench.harness.cli.progress import Bars
    from servobench.harness.studies.tuning.campaign import advance

    total = plan.studies * (plan.trials + plan.search)
    try:
        with Bars(console, TextColumn("points, best {task.fields[best]}")) as bars:
            shown = {
                method.name: bars.begin(method.name, total, method.done, best="–")
                for method in methods
            }
            for method in advance(methods, plan, workers):
                score = method.ledger.best()
                best = "–" if score is None else f"{score:.4f}"
                done = sum(each.done for each in methods)
                text = f"{method.done} of {total} points, best {best}; in all {done} of {total * len(methods)}"
                bars.reach(shown[method.name], method.done, f"{method.name}: {text}", best=best)
    except KeyboardInterrupt:
        return False
    return True


def _print_tuned(results: Mapping[str, TunedValues]) -> None:
    rows = []
    for name, tuned in results.items():
        numbers = (
            tuned.score_of_defaults,
            tuned.score,
            tuned.second_score_of_defaults,
            tuned.second_score,
        )
        spread = " ".join(f"{study.second_score:.4f}" for study in tuned.studies)
        rows.append((name, *(f"{number:.4f}" for number in numbers), spread))
    print_rows(
        (
            "controller",
            "score of defaults",
            "score tuned",
            "second set, defaults",
            "tuned",
            "its studies",
        ),
        rows,
    )
    for name, tuned in results.items():
        for edge in tuned.edges:
            say(f"{name}: {edge}; with these values in use the next study searches a wider box")


TABLE = "analyse.csv"


def analyse(
    controllers: Annotated[
        list[str], typer.Argument(metavar="CONTROLLER", help="Names of controllers.")
    ],
    *,
    mismatch: options.MismatchOption = "none",
    seed: Annotated[int, option("INTEGER", "Seed of the warm-up move and of the robot.")] = 0,
    robot: options.RobotOption = "ur5",
    jacobian: Annotated[
        Literal["true", "nominal", "estimated"],
        option("NAME", "Jacobian that estimators are fixed at: true, nominal or estimated."),
    ] = "true",
    identify: Annotated[
        bool,
        switch(
            "--identify",
            "Identify all loops from logged small motions, while estimators go on learning.",
        ),
    ] = False,
    simulate: Annotated[
        bool, switch("--simulate", "Also find the limits of gain and latency by simulation.")
    ] = False,
    overrides: options.Overrides,
    out: Annotated[Path, option("FOLDER", "Folder for table, pictures and page.")] = Path("results")
    / "analyse",
) -> None:
    """Analyse the loop at rest: margins, Bode, Nyquist, step.

    Also sensitivity, and stability over gain and latency.
    """
    from servobench.harness.analysis.loops.loop_analysis import (
        LEGEND,
        analyse_loop,
        loop_table,
        printed,
    )
    from servobench.harness.pictures.loops import write_pictures
    from servobench.plant.contract.files import accessing, write_csv, writing_together

    runs = _resolved(controllers, mismatch, seed, robot, overrides.settings())
    loops = []
    for run in runs:
        with console.status(f"analysing {run.request.controller}"):
            try:
                loops.append(analyse_loop(run, jacobian, identify=identify))
            except RunFault as fault:
                say(f"{run.request.controller}: {fault}")
    if not loops:
        raise ConfigurationError("no loop is left to analyse")
    table = loop_table(loops)
    if simulate:
        chosen = {run.request.controller: run for run in runs}
        with console.status("simulating"):
            table = table.join(_simulated([chosen[loop.name] for loop in loops]))
    text = printed(table)
    with accessing(out), writing_together(out) as partial:
        write_csv(table, partial / TABLE)
        page = out / write_pictures(partial, loops, text, LEGEND)[0].name
    identified = ", ".join(loop.name for loop in loops if loop.model == "identified")
    title = f"Loops at rest, estimators frozen at the {jacobian} Jacobian"
    if identified:
        title += f"; identified in small motions: {identified}"
    if identify:
        title = "Loops identified in small motions"
    print_tables([(title, text)], LEGEND)
    say(f"table in {out / TABLE}, pictures in {page}")


def _resolved(
    controllers: list[str], mismatch: str, seed: int, robot: str, settings: Settings
) -> list[ResolvedRun]:
    """Return a run for each controller on the kinematic plant."""
    from servobench.harness.analysis.loops.equilibrium import PLANT, TASK
    from servobench.harness.run.request import RunRequest, read_mismatch
    from servobench.harness.run.resolution import check_settings, resolve

    names = selection.split("controllers", ",".join(controllers), robot=robot)
    check_settings(settings, [PLANT, TASK, *names])
    drawn = read_mismatch(mismatch)
    return [
        resolve(RunRequest(PLANT, name, TASK, drawn, seed, robot=robot), settings) for name in names
    ]


def _simulated(runs: list[ResolvedRun]) -> pd.DataFrame:
    """Return the simulated limits, a row for each run; NaN for a controller that is not composed."""
    import pandas as pd

    from servobench.controllers.servo import ServoController
    from servobench.harness.analysis.loops.equilibrium import SmallLoop, warm_up

    rows = []
    for warm in map(warm_up, runs):
        loop = SmallLoop(warm) if isinstance(warm.controller, ServoController) else None
        rows.append(
            (float("nan"), float("nan"))
            if loop is None
            else (loop.gain_limit(), loop.latency_limit())
        )
    return pd.DataFrame(rows, columns=["simulated_gain_margin", "simulated_latency_limit_s"])
