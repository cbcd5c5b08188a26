"""The command `servobench record`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from servobench.harness.batch import results
from servobench.harness.cli.options import split_names
from servobench.harness.config.settings import (
    ConfigurationError,
    Settings,
    flatten,
    read_settings,
    suggest,
)
from servobench.harness.pictures.replay import LoggedRun, logged_run
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.experiment import known_sections
from servobench.harness.run.request import RunRequest
from servobench.plant.bullet.bullet_plant import BulletConfig
from servobench.plant.robot.mismatch import Mismatch

DEFAULTS = RunRequest("bullet", "rbfnn_mfac", "circle", Mismatch("moderate"), 0)
FOLDER = "recordings"

console = Console()


def record(
    folder: Annotated[
        Path | None, typer.Argument(help="Results folder whose run to show; without one a run is carried out.")
    ] = None,
    run: Annotated[str | None, typer.Option(help="The run_id, where the folder has more than one run.")] = None,
    plant: Annotated[str | None, typer.Option(help=f"New run: plant, default {DEFAULTS.plant}.")] = None,
    controller: Annotated[str | None, typer.Option(help=f"New run: controller, default {DEFAULTS.controller}.")] = None,
    task: Annotated[str | None, typer.Option(help=f"New run: task, default {DEFAULTS.task}.")] = None,
    mismatch: Annotated[str | None, typer.Option(help=f"New run: mismatch, default {DEFAULTS.mismatch}.")] = None,
    seed: Annotated[int | None, typer.Option(help=f"New run: seed, default {DEFAULTS.seed}.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="SECTION.KEY=VALUE", help="New run: one setting.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="New run: TOML file with settings.")] = None,
    kinds: Annotated[str, typer.Option(help="What to write, by comma: mp4, gif, snapshots; or all.")] = "all",
    out: Annotated[
        Path | None, typer.Option(help="Folder for the films; default recordings below the results folder.")
    ] = None,
) -> None:
    """Show a run: film (MP4, GIF) and snapshots of the rendered arm, its camera's view and the error."""
    from servobench.harness.pictures.film import KINDS, find_kind, write_recording  # noqa: PLC0415 - matplotlib, see compare

    wanted = split_names("kinds", kinds, KINDS, find_kind)
    new = {"plant": plant, "controller": controller, "task": task, "mismatch": mismatch, "seed": seed}
    given = [f"--{name}" for name, value in (new | {"set": set_, "config": config}).items() if value not in (None, [])]
    with console.status("reading") as status:
        if folder is not None:
            if given:
                raise ConfigurationError(f"{given[0]} belongs to a new run; a run of {folder} is named by --run")
            shown = _from_folder(folder, run)
        else:
            if run is not None:
                raise ConfigurationError("--run names a run of a results folder, and no folder is given")
            status.update("running")
            request = {name: value for name, value in new.items() if value is not None}
            shown = _new_run(request, read_settings(config, set_ or []))
        target = out or (folder or Path("results")) / FOLDER
        paths = write_recording(
            shown,
            target / str(shown.row["run_id"]),
            wanted,
            lambda share, what: status.update(f"drawing: {100 * share:3.0f} %, {what}"),
        )
    for path in paths:
        console.print(f"{path}: {path.stat().st_size / 1e6:.1f} MB", soft_wrap=True, markup=False, highlight=False)


def _from_folder(folder: Path, run_id: str | None) -> LoggedRun:
    runs = results.load_runs(folder)
    names = runs["run_id"].tolist()
    if run_id is None and len(names) > 1:
        raise ConfigurationError(f"{folder} holds {len(names)} runs; name one with --run, such as {names[0]}")
    chosen = run_id or names[0]
    if chosen not in names:
        raise ConfigurationError(f"{folder} has no run {chosen!r}: {suggest(chosen, names[:20])}")
    row = {str(name): value for name, value in runs[runs["run_id"] == chosen].iloc[0].items()}
    configuration = results.read_manifest(folder).get("configuration", {})
    return logged_run(row, results.load_steps(folder, [chosen]), configuration.get("bullet", {}))


def _new_run(request: dict[str, Any], settings: Settings) -> LoggedRun:
    asked = RunRequest(**{**vars(DEFAULTS), **request})
    if asked.seed < 0:
        raise ConfigurationError(f"seed must not be negative, got {asked.seed}")
    settings.check_sections([*known_sections(), asked.plant, asked.controller])
    result = run_experiment(asked, settings)
    if result.steps is None:
        raise ConfigurationError(f"run {result.row['run_id']} has no steps to show")
    return logged_run(result.row, result.steps, flatten(settings.resolve("bullet", BulletConfig())))
