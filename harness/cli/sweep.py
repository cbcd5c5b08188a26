"""The command `servobench sweep`."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from servobench.controllers.networks.fit import Progress
from servobench.harness.analysis.tables import SWEEP_LEGEND, sweep_tables
from servobench.harness.batch import results
from servobench.harness.batch.cluster import Backend, open_backend
from servobench.harness.batch.compare import Batch, check_batch, parse_seeds
from servobench.harness.batch.manifest import describe_batch
from servobench.harness.batch.sweep import (
    CHUNK,
    Cell,
    SweepPlan,
    check_cells,
    parse_variation,
    run_sweep,
)
from servobench.harness.batch.workers import default_workers
from servobench.harness.cli.options import (
    ConfigOption,
    SetOption,
    split_names,
    split_words,
)
from servobench.harness.cli.progress import sweep_progress
from servobench.harness.cli.terminal import print_tables
from servobench.harness.config.registry import (
    controller_names,
    find_controller,
    find_plant,
    plant_names,
)
from servobench.harness.config.settings import ConfigurationError, Settings, read_settings
from servobench.harness.run.request import RunRequest
from servobench.harness.run.tasks import find_task, task_names

console = Console()


def sweep(
    out: Annotated[Path, typer.Option(help="Folder for the results; with --resume the one to go on with.")],
    plants: Annotated[str, typer.Option(help="Names by comma, or all.")] = "kinematic",
    controllers: Annotated[str, typer.Option(help="Names by comma, or all.")] = "rbfnn_mfac,ukf_mfac,ukf_mpc,rbf_pid",
    tasks: Annotated[str, typer.Option(help="Names by comma.")] = "random",
    mismatch: Annotated[str, typer.Option(help="Mismatches by comma.")] = "moderate",
    vary: Annotated[
        list[str] | None,
        typer.Option(help="Axis and magnitudes put on top of the mismatch, such as camera_rotation=0:180:30deg."),
    ] = None,
    noise: Annotated[str, typer.Option(help="Factors on the plants' sensor noise, by comma.")] = "1",
    latency: Annotated[str, typer.Option(help="Camera latencies in periods by comma; default: the plant's.")] = "",
    seeds: Annotated[str, typer.Option(help="A count (5), a list (3,1,4) or a range (100:120).")] = "10",
    workers: Annotated[int | None, typer.Option(min=1, help="Worker processes; default: the processors.")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler to send the runs to.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a sweep that was killed.")] = False,
    set_: SetOption = None,
    config: ConfigOption = None,
) -> None:
    """Run a Monte Carlo sweep: many runs, a row each, no steps; can be continued."""
    plan = SweepPlan(
        Batch(
            split_names("plants", plants, plant_names(), find_plant),
            split_names("controllers", controllers, controller_names(), find_controller),
            split_names("tasks", tasks, task_names(), find_task),
            split_words(mismatch),
            parse_seeds(seeds),
        ),
        tuple(parse_variation(text) for text in vary or []),
        tuple(_numbers("noise", noise, float)),
        tuple(_numbers("latency", latency, int)) if latency.strip() else (None,),
    )
    carry_out_sweep(plan.cells(), read_settings(config, set_ or []), out, workers, scheduler, resume=resume)
    print_tables(sweep_tables(results.load_runs(out)), SWEEP_LEGEND)
    console.print(f"table in {out / results.RUNS}", soft_wrap=True)


def carry_out_sweep(
    cells: Sequence[Cell],
    settings: Settings,
    folder: Path,
    workers: int | None = None,
    scheduler: str | None = None,
    *,
    resume: bool = False,
) -> None:
    """Check and carry out the runs of a sweep and put its table together.

    Args:
        cells: the runs.
        settings: overrides of the defaults.
        folder: where results go; with `resume` it holds those of the same sweep.
        workers: number of local processes; None for the processors.
        scheduler: address of a Dask scheduler; None for local processes.
        resume: go on with a sweep that was killed.

    Raises:
        ConfigurationError: a sweep that cannot be run, or a folder that cannot be used.
    """
    check_cells(cells)
    with console.status("checking the configuration") as status:
        check_sweep(
            cells, settings, lambda share, what: status.update(f"training networks once: {100 * share:3.0f} %, {what}")
        )
    manifest = describe_sweep(cells, settings)
    with open_backend(scheduler, workers or default_workers()) as backend:
        if resume:
            check_same_sweep(folder, manifest)
        else:
            results.create_folder(folder, manifest)
        if (folder / results.PARTS).is_dir():
            done = sum(min(CHUNK, len(cells) - index) for index in results.finished_parts(folder))
            with sweep_progress(console, len(cells), done) as advance:
                _run(cells, settings, folder, backend, advance)
    results.collect(folder)


def _run(
    cells: Sequence[Cell], settings: Settings, folder: Path, backend: Backend, advance: Callable[[int], None]
) -> None:
    try:
        for rows in run_sweep(cells, settings, folder, backend):
            advance(len(rows))
    except KeyboardInterrupt:
        sys.stderr.write(f"servobench: finished runs are kept in {folder}; the same call with --resume goes on\n")
        raise


def check_sweep(cells: Sequence[Cell], settings: Settings, progress: Progress | None = None) -> None:
    """Build everything once in each condition of sensing; see `check_batch`."""
    by_condition: dict[tuple[float, int | None], list[RunRequest]] = {}
    for cell in cells:
        condition = cell.request.noise_factor, cell.request.latency_periods
        by_condition.setdefault(condition, []).append(cell.request)
    for (noise, latency), requests in by_condition.items():
        check_batch(Batch.around(requests), settings, progress, noise, latency)


def describe_sweep(cells: Sequence[Cell], settings: Settings) -> dict[str, Any]:
    """Return the manifest of a sweep: that of a batch, the number of runs, and a digest by which it is known again."""
    manifest = describe_batch([cell.request for cell in cells], settings)
    identity = {"runs": [cell.request.run_id for cell in cells], "configuration": manifest["configuration"]}
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode()).hexdigest()
    return {**manifest, "run_count": len(cells), "sweep": digest}


def check_same_sweep(folder: Path, manifest: dict[str, Any]) -> None:
    """Refuse to go on with what is not the same sweep.

    Raises:
        ConfigurationError: not a results folder, or one of other runs or settings.
    """
    there = results.read_manifest(folder)
    if there.get("sweep") != manifest["sweep"]:
        raise ConfigurationError(f"{folder} holds the results of another sweep; name another folder with --out")
    for key, what in (("git_commit", "commit"), ("packages", "packages")):
        if there.get(key) != manifest[key]:
            console.print(f"note: {folder} was begun with other {what}; later runs may differ", soft_wrap=True)


def _numbers(option: str, text: str, kind: Any) -> list[Any]:  # noqa: ANN401 - int or float
    try:
        numbers = [kind(part) for part in text.split(",") if part.strip()]
    except ValueError as error:
        raise ConfigurationError(f"--{option} must be numbers by comma, got {text!r}") from error
    if not numbers or min(numbers) < 0:
        raise ConfigurationError(f"--{option} must be numbers from 0 on, got {text!r}")
    return list(dict.fromkeys(numbers))
