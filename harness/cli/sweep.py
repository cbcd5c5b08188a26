"""The command `servobench sweep`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

from servobench.harness.cli import named, options
from servobench.harness.cli.terminal import console, print_tables
from servobench.harness.cli.verdict import judge


def sweep(
    out: options.FolderOption,
    plants: options.PlantsOption = "kinematic",
    controllers: options.ControllersOption = "rbfnn_mfac,ukf_mfac,ukf_mpc,rbf_pid",
    tasks: options.TasksOption = "random",
    mismatch: options.MismatchesOption = "moderate",
    robot: options.RobotOption = "ur5",
    sensing: options.SensingsOption = "position",
    vary: Annotated[
        list[str] | None,
        typer.Option(help="Axis and magnitudes put on top of the mismatch, such as camera_rotation=0:180:30deg."),
    ] = None,
    noise: Annotated[str, typer.Option(help="Comma-separated factors on the plants' sensor noise.")] = "1",
    latency: Annotated[str, typer.Option(help="Comma-separated camera latencies [s]; default: the plant's.")] = "",
    period: Annotated[str, typer.Option(help="Comma-separated control periods [s]; default: run.period.")] = "",
    seeds: options.SeedsOption = "10",
    running: options.Running = options.RUNNING,
    overrides: options.Overrides = options.OVERRIDES,
    judging: options.Judging = options.JUDGING,
) -> None:
    """Run a Monte Carlo sweep: many runs, a row each.

    No steps are kept. A sweep that was interrupted is continued with --resume.
    """
    from servobench.harness.analysis.tables import SWEEP_COLUMNS, sweep_legend, sweep_tables
    from servobench.harness.batch import results
    from servobench.harness.batch.campaign import Campaign, carry_out
    from servobench.harness.batch.compare import Batch, parse_seeds
    from servobench.harness.batch.sweep import SweepPlan, parse_variation
    from servobench.harness.cli.progress import watching

    plan = SweepPlan(
        Batch(
            named.split_plants(plants, robot=robot),
            named.split_controllers(controllers, robot),
            named.split_tasks(tasks),
            named.split_mismatches(mismatch),
            parse_seeds(seeds),
            named.known_robot(robot),
            named.split_sensings(sensing),
        ),
        tuple(parse_variation(text) for text in vary or []),
        tuple(_numbers("noise", noise)),
        _times("latency", latency),
        _times("period", period),
    )
    campaign = Campaign(plan.cells(), overrides.settings())
    how = judging.execution(running)
    with watching(console, out, bar=not how.debug) as observer:
        carry_out(campaign, out, replace(how, observer=observer))
    legend = sweep_legend(results.iterate_runs(out, SWEEP_COLUMNS))
    print_tables(sweep_tables(results.iterate_runs(out, SWEEP_COLUMNS)), legend)
    console.print(f"table in {out / results.RUNS}", soft_wrap=True)
    judge(out, strict=judging.strict)


def _times(option: str, text: str) -> tuple[float | None, ...]:
    """Return times, s; numbers from 1 on are refused because they were control periods in version 0.1."""
    from servobench.harness.config.settings import ConfigurationError

    times = _numbers(option, text) if text.strip() else [None]
    if max(time or 0.0 for time in times) >= 1.0:
        raise ConfigurationError(f"--{option} is in seconds, below 1, such as 0.05 for a period of 20 Hz; got {text!r}")
    return tuple(times)


def _numbers(option: str, text: str) -> list[float]:
    from servobench.harness.config.settings import ConfigurationError

    try:
        numbers = [float(part) for part in text.split(",") if part.strip()]
    except ValueError as error:
        raise ConfigurationError(f"--{option} must be comma-separated numbers, got {text!r}") from error
    if not numbers or min(numbers) < 0:
        raise ConfigurationError(f"--{option} must be numbers from 0 on, got {text!r}")
    named.refuse_repetition(option, [f"{number:g}" for number in numbers])
    return numbers
