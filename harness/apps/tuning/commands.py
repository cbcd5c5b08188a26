"""The command `servobench tune`: a search for the best settings of each method."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import CONTROLLER, option
from servobench.harness.cli.terminal import console, end_interrupted, print_rows, say
from servobench.plant.contract.faults import ConfigurationError, configuration_errors

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servobench.harness.apps.tuning.campaign import Method, TunedValues, TuningPlan
    from servobench.harness.batch.isolation import Workers


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
    robots: Annotated[int, option("COUNT", "Robots under each condition of a trial.")] = 12,
    plants: options.PlantsOption = "kinematic",
    place: options.Place,
    offset: Annotated[
        int,
        option("INTEGER", "First seed, counted from the beginning of the range kept for tuning."),
    ] = 0,
    study_seed: Annotated[int, option("INTEGER", "Seed of the first study's sampler.")] = 0,
    out: Annotated[
        Path, option("FOLDER", "Folder of the studies; interrupted ones are continued.")
    ] = (Path("results") / "tuning"),
) -> None:
    """Search for the best settings of each method.

    Every method has the same budget on the same training plants.
    """
    from servobench.harness.apps.tuning.campaign import (
        TuningPlan,
        check_study_folder,
        open_methods,
        write_results,
    )
    from servobench.harness.apps.tuning.objective import TuningSet
    from servobench.harness.apps.tuning.spaces import SPACES, choose_tunable
    from servobench.harness.batch.blocks import open_workers
    from servobench.harness.batch.lock import locked

    names = selection.split_names("controllers", controllers, tuple(SPACES), choose_tunable)
    with configuration_errors():
        runs = TuningSet(selection.split("plants", plants), robots, offset)
        runs.second()  # there must be room for these robots, too
        plan = TuningPlan(names, trials, runs, studies, study_seed)
    check_study_folder(out)
    opening = open_workers(
        place.workers, place.scheduler, place.bounds(), plants=plan.runs.plants, controllers=names
    )
    with opening as opened, locked(out):
        say(
            f"at most {_counted(plan)}; --controllers, --studies, --trials and --robots make it less"
        )
        methods = open_methods(out, plan)
        interrupt = _advance(methods, plan, opened)
    if results := write_results(out, methods):
        _print_tuned(results)
    lost = [name for name, tuned in results.items() if tuned.lost]
    if len(results) > len(lost):
        say(
            f"studies in {out}; tuned values of your controllers lie beside their code and are taken from now on, "
            "those of servobench in its .toml files, for controllers/tuned"
        )
    if interrupt is not None:
        end_interrupted(f"finished points are kept in {out}", "the same call continues")
    if lost:
        raise ConfigurationError(
            f"no run of {', '.join(lost)} came near its target with any settings, so no values are written; "
            "servobench run with the same plant may say why"
        )


def _counted(plan: TuningPlan) -> str:
    """Return how many points and runs a campaign has, without those of its second set of robots."""
    methods = len(plan.controllers)
    runs = len(plan.runs.runs())
    points = methods * plan.studies * plan.trials
    compared = "1 method" if methods == 1 else f"{methods} methods"
    return f"{compared} × {plan.studies} studies × {plan.trials} trials × {runs} runs = {points * runs} runs"


def _advance(
    methods: Sequence[Method], plan: TuningPlan, workers: Workers
) -> KeyboardInterrupt | None:
    """Advance the studies to their end and show how far they are; return what stopped them before, if anything did."""
    from rich.progress import TextColumn

    from servobench.harness.apps.tuning.campaign import advance
    from servobench.harness.cli.progress import Bars

    total = plan.studies * plan.trials
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
                bars.reach(
                    shown[method.name],
                    method.done,
                    f"{method.name}: {method.done} of {total} points, best {best}; in all {done} of "
                    f"{total * len(methods)}",
                    best=best,
                )
    except KeyboardInterrupt as interrupt:
        return interrupt
    return None


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
            say(f"{name}: {edge}; a wider one may hold better values")
