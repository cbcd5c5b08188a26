"""The commands `servobench robustness | suite`: studies that compare methods."""

from __future__ import annotations

from typing import Annotated

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import PLANT, Value, option, switch
from servobench.harness.cli.results import judge, print_lacking
from servobench.harness.cli.selection import Names, accepted
from servobench.harness.cli.terminal import console, print_tables, say
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import split_words, write_csv

DEFAULT_CONTROLLERS = (
    "regression_mfac, rbfnn_mfac, ukf_mfac, ukf_mpc, rbf_pid"  # spaces let the help break lines
)


def _challenges() -> Names:
    from servobench.harness.apps.studies.challenge import challenge_names, find_challenge

    return Names(challenge_names, accepted(find_challenge))


CHALLENGE = Value("NAME", selection.completing(_challenges))


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
    from servobench.harness.apps.studies.robustness import BASE, TASK, find_lines, make_map
    from servobench.harness.batch.plan import Batch, parse_seeds
    from servobench.harness.batch.results import ResultsFolder
    from servobench.harness.cli.progress import watching
    from servobench.plant.robot.catalogue import find_robot

    settings = overrides.settings()
    lines = find_lines(split_words(axes))
    names = selection.split("controllers", controllers, robot=robot)
    where = selection.split("plants", plant, option="plant", robot=robot)[0]
    base = "none" if find_robot(robot).twin else BASE
    batch = Batch((where,), names, (TASK,), (base,), parse_seeds(seeds), robot, (sensing,))
    with watching(console, out, running.execution()) as how:
        files = make_map(out, batch, settings, how, lines)
    say(f"the map is in {files[0]}; its runs are in {out}")
    judge(ResultsFolder(out), strict=False)


def suite(
    *,
    out: options.FolderOption,
    challenges: Annotated[
        str,
        option(
            CHALLENGE.several(),
            "Comma-separated names, or .toml files of your own; default: all with a grade.",
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
    until_decided: options.UntilDecidedOption = False,
    against: options.AgainstOption = None,
    audit: Annotated[
        bool,
        switch(
            "--audit",
            "Also say what the suite is worth: shortcuts, significance, overfitting, sources.",
        ),
    ] = False,
    metric: options.MetricsOption = None,
    running: options.Running,
    overrides: options.Overrides,
) -> None:
    """Score methods over challenges, worlds that tell them apart.

    A score is the error or time of a method that knows the true robot over that of the method; a lost run has 0.
    """
    from servobench.harness.analysis.folder import describe_tuning, mark_tuned
    from servobench.harness.apps.studies import audit as diagnostics
    from servobench.harness.apps.studies.challenge import GRADES, choose_challenges
    from servobench.harness.apps.studies.suite import carry_out_suite, suite_tables
    from servobench.harness.batch.plan import parse_seeds
    from servobench.harness.batch.results import ResultsFolder
    from servobench.harness.cli.deciding import ask
    from servobench.harness.cli.progress import watching

    grades = split_words(grade)
    if challenges == selection.ALL and not grades:
        grades = GRADES  # the rankings of pages and stored tables have graded ones alone
    words = selection.split(_challenges, challenges, option="challenges")
    worlds = choose_challenges(words, grades)
    if audit and until_decided:
        raise ConfigurationError(
            "--audit needs all robots, and --until-decided leaves some out; give one of them"
        )
    methods = selection.split("controllers", controllers)
    names = diagnostics.with_probes(methods) if audit else methods
    where = selection.split("plants", plants) if plants else ()
    robots = parse_seeds(seeds)
    metrics = selection.choose_metrics(metric)
    settings = overrides.settings()
    runs = {world.name: world.cells(where, names, robots, reference_seeds) for world in worlds}
    count = sum(len(where or world.plants) for world in worlds)
    question = ask(until_decided, against, names, count, robots)
    with watching(console, out, running.execution()) as how:
        judged = carry_out_suite(out, worlds, runs, settings, how, metrics, question)
        if audit:
            robots = diagnostics.robots_of_tuning(judged)
            runs = {
                world.name: world.cells(where, methods, robots, len(robots)) for world in worlds
            }
            tuned = carry_out_suite(
                out / diagnostics.ROBOTS, worlds, runs, settings, how, on_tuning_seeds=True
            )
            found = diagnostics.audit(judged, tuned, worlds)
            write_csv(found, out / diagnostics.AUDIT)
    for world in worlds:
        print_lacking(ResultsFolder(out / world.name))
    manifest = ResultsFolder(out / worlds[0].name).manifest
    shown = mark_tuned(judged, manifest)
    print_tables(suite_tables(shown), "score: reference over method, at most 1; 0 for a lost run")
    say("\n".join(describe_tuning(manifest, command=not audit)))
    if audit:
        print_tables([("audit", found)], diagnostics.LEGEND)
    say(f"tables and pictures in {out}; the runs of each challenge in a folder of its name")
