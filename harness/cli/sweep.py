"""The command `servobench sweep`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, TypeVar

import typer

from servobench.harness.cli import options
from servobench.harness.cli.terminal import console, print_tables

Value = TypeVar("Value", int, float)


def sweep(
    out: options.FolderOption,
    plants: options.NamesOption = "kinematic",
    controllers: options.NamesOption = "rbfnn_mfac,ukf_mfac,ukf_mpc,rbf_pid",
    tasks: options.NamesOption = "random",
    mismatch: Annotated[str, typer.Option(help="Comma-separated mismatches.")] = "moderate",
    vary: Annotated[
        list[str] | None,
        typer.Option(help="Axis and magnitudes put on top of the mismatch, such as camera_rotation=0:180:30deg."),
    ] = None,
    noise: Annotated[str, typer.Option(help="Comma-separated factors on the plants' sensor noise.")] = "1",
    latency: Annotated[
        str, typer.Option(help="Comma-separated camera latencies [periods]; default: the plant's.")
    ] = "",
    seeds: options.SeedsOption = "10",
    running: options.Running = options.RUNNING,
    overrides: options.Overrides = options.OVERRIDES,
) -> None:
    """Run a Monte Carlo sweep: many runs, a row each, no steps; can be continued."""
    from servobench.harness.analysis.summary import SWEEP_COLUMNS, sweep_legend, sweep_tables
    from servobench.harness.batch import results
    from servobench.harness.batch.campaign import Campaign, carry_out
    from servobench.harness.batch.compare import Batch, parse_seeds
    from servobench.harness.batch.sweep import SweepPlan, parse_variation
    from servobench.harness.cli.progress import watching

    plan = SweepPlan(
        Batch(
            options.split_plants(plants),
            options.split_controllers(controllers),
            options.split_tasks(tasks),
            options.split_words(mismatch),
            parse_seeds(seeds),
        ),
        tuple(parse_variation(text) for text in vary or []),
        tuple(_numbers("noise", noise, float)),
        tuple(_numbers("latency", latency, int)) if latency.strip() else (None,),
    )
    campaign = Campaign(plan.cells(), overrides.settings())
    with watching(console, out) as observer:
        carry_out(campaign, out, running.execution(observer))
    legend = sweep_legend(results.iterate_runs(out, SWEEP_COLUMNS))
    print_tables(sweep_tables(results.iterate_runs(out, SWEEP_COLUMNS)), legend)
    console.print(f"table in {out / results.RUNS}", soft_wrap=True)


def _numbers(option: str, text: str, kind: Callable[[str], Value]) -> list[Value]:
    from servobench.harness.config.settings import ConfigurationError

    try:
        numbers = [kind(part) for part in text.split(",") if part.strip()]
    except ValueError as error:
        raise ConfigurationError(f"--{option} must be comma-separated numbers, got {text!r}") from error
    if not numbers or min(numbers) < 0:
        raise ConfigurationError(f"--{option} must be numbers from 0 on, got {text!r}")
    return list(dict.fromkeys(numbers))
