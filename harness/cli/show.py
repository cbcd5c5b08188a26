"""The commands that show what there is, `plants | controllers | tasks`, and results, `statistics | report | record`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servobench.harness.cli.options import split_names
from servobench.harness.cli.terminal import console, print_markdown, print_tables

if TYPE_CHECKING:
    from servobench.harness.config.settings import Settings
    from servobench.harness.pictures.replay import LoggedRun

RECORDED = {
    "plant": "bullet",
    "controller": "rbfnn_mfac",
    "task": "circle",
    "mismatch": "moderate",
    "robot": "ur5",
    "seed": 0,
}
RECORDINGS = "recordings"
SLOW_REPORT = 20.0  # [s], beyond which the time that a report took is printed


NameArgument = Annotated[str | None, typer.Argument(help="Show the settings of this one.")]


def plants(name: NameArgument = None) -> None:
    """List the plants, or show the settings of one."""
    from servobench.harness.config.registry import find_plant, installed_plant, plant_names

    _show("plants", name, plant_names(), find_plant if name else installed_plant, lambda entry: entry.config())


def controllers(name: NameArgument = None) -> None:
    """List the controllers, or show the settings of one."""
    from servobench.controllers.parts import ESTIMATORS, LAWS
    from servobench.harness.config.defaults import default_config
    from servobench.harness.config.registry import choose_controller, controller_names, find_controller

    name = choose_controller(name) if name else None
    _show("controllers", name, controller_names(), find_controller, default_config)
    if not name:
        console.print(f"or any law with any estimator, such as mfac+rls: laws {', '.join(LAWS)};", soft_wrap=True)
        console.print(f"estimators {', '.join(ESTIMATORS)}", soft_wrap=True)


def tasks(name: NameArgument = None) -> None:
    """List the tasks, or show the settings of one."""
    from servobench.harness.run.tasks import TASKS, find_task

    _show("tasks", name, list(TASKS), find_task, lambda entry: entry.default)


def _show(
    kind: str, name: str | None, names: Sequence[str], find: Callable[[str], Any], default: Callable[[Any], Any]
) -> None:
    """Print names with their summaries, or the settings of one with their defaults."""
    from rich.markup import escape
    from rich.table import Table

    from servobench.harness.config.settings import ConfigurationError, flatten

    table = Table("setting", "default") if name else Table(kind, "")
    if name:
        for key, value in flatten(default(find(name))).items():
            table.add_row(f"{name}.{key}", str(value))
    for known in () if name else names:
        try:
            table.add_row(known, find(known).summary)
        except ConfigurationError as error:  # an extra is missing, or a plug-in is broken; the others are usable
            table.add_row(known, escape(str(error)))
    console.print(table)


def statistics(
    folder: Annotated[Path, typer.Argument(help="Results folder of a run, comparison or sweep.")],
    metric: Annotated[
        str | None, typer.Option(help="Column that pairs are compared by; default: settling time, on curves RMS error.")
    ] = None,
    never: Annotated[
        float | None, typer.Option(help="Stands for the value of a run without one; default: twice the largest.")
    ] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print the tables as Markdown.")] = False,
) -> None:
    """Judge the controllers of a folder, with 95 % intervals.

    Rates, medians, tails, failures and paired differences.
    """
    from servobench.harness.analysis.tables import statistics_tables
    from servobench.harness.batch import results

    tables = statistics_tables(results.load_runs(folder), metric, never)
    print_markdown(tables) if markdown else print_tables(tables)


def report(
    folder: Annotated[Path, typer.Argument(help="Results folder of run, compare, sweep or claims.")],
    out: Annotated[Path | None, typer.Option(help="The page; default report.html in the folder.")] = None,
) -> None:
    """Write one page about a results folder.

    With figures, sortable tables and paths to turn; it needs no network.
    """
    make_report(folder, out)


def make_report(folder: Path, out: Path | None = None) -> None:
    """Write the report and print its path and, if it took long, the time."""
    from servobench.harness.pictures.report import write_report

    began = time.monotonic()
    with console.status("making the report"):
        path = write_report(folder, out)
    seconds = time.monotonic() - began
    took = f", made in {seconds:.0f} s" if seconds > SLOW_REPORT else ""
    console.print(f"report: {path} ({path.stat().st_size / 1e6:.1f} MB{took})", soft_wrap=True, markup=False)


def _new(what: str) -> str:
    return f"New run: {what}, default {RECORDED[what]}."


def record(
    folder: Annotated[
        Path | None, typer.Argument(help="Results folder whose run to show; without one a run is carried out.")
    ] = None,
    run: Annotated[str | None, typer.Option(help="The run_id, where the folder has more than one run.")] = None,
    plant: Annotated[str | None, typer.Option(help=_new("plant"))] = None,
    controller: Annotated[str | None, typer.Option(help=_new("controller"))] = None,
    task: Annotated[str | None, typer.Option(help=_new("task"))] = None,
    mismatch: Annotated[str | None, typer.Option(help=_new("mismatch"))] = None,
    robot: Annotated[str | None, typer.Option(help=_new("robot"))] = None,
    seed: Annotated[int | None, typer.Option(help=_new("seed"))] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="SECTION.KEY=VALUE", help="New run: one setting.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="New run: TOML file with settings.")] = None,
    kinds: Annotated[str, typer.Option(help="Comma-separated kinds: mp4, gif, snapshots; or 'all'.")] = "all",
    out: Annotated[
        Path | None, typer.Option(help="Folder for the films; default recordings below the results folder.")
    ] = None,
) -> None:
    """Show a run as film (MP4, GIF) and snapshots.

    They have the rendered arm, its camera's view and the error. Without a folder a new run is carried out.
    """
    from servobench.harness.config.extras import check_installed
    from servobench.harness.config.settings import ConfigurationError, read_settings
    from servobench.harness.pictures.film import KINDS, find_kind, write_recording

    wanted = split_names("kinds", kinds, KINDS, find_kind)
    check_installed(("pybullet",), "a film of the rendered arm")
    new = {"plant": plant, "controller": controller, "task": task, "mismatch": mismatch, "robot": robot, "seed": seed}
    given = [f"--{name}" for name, value in (new | {"set": set_, "config": config}).items() if value not in (None, [])]
    with console.status("reading") as status:
        if folder is not None:
            if given:
                raise ConfigurationError(f"{given[0]} belongs to a new run; a run of {folder} is named by --run")
            shown = _run_of(folder, run)
        else:
            if run is not None:
                raise ConfigurationError("--run names a run of a results folder, and no folder is given")
            status.update("running")
            chosen = {name: value for name, value in new.items() if value is not None}
            shown = _new_run(RECORDED | chosen, read_settings(config, set_ or []))
        paths = write_recording(
            shown,
            (out or (folder or Path("results")) / RECORDINGS) / str(shown.track.row["run_id"]),
            wanted,
            lambda share, what: status.update(f"drawing: {100 * share:3.0f} %, {what}"),
        )
    for path in paths:
        console.print(f"{path}: {path.stat().st_size / 1e6:.1f} MB", soft_wrap=True, markup=False, highlight=False)


def _run_of(folder: Path, run_id: str | None) -> LoggedRun:
    """Return a run of a results folder; without a name the only one."""
    from servobench.harness.batch import results
    from servobench.harness.config.settings import ConfigurationError
    from servobench.harness.pictures.replay import logged_run
    from servobench.plant.settings import suggest

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


def _new_run(asked: dict[str, Any], settings: Settings) -> LoggedRun:
    """Carry out a run to be shown."""
    from servobench.harness.config.registry import choose_controller
    from servobench.harness.config.settings import ConfigurationError, flatten
    from servobench.harness.pictures.replay import logged_run
    from servobench.harness.run.episode import run_experiment
    from servobench.harness.run.request import RunRequest, read_mismatch
    from servobench.harness.run.resolved import known_sections
    from servobench.plant.bullet.bullet_plant import BulletConfig

    chosen = {"mismatch": read_mismatch(asked["mismatch"]), "controller": choose_controller(asked["controller"])}
    request = RunRequest(**asked | chosen)
    if request.seed < 0:
        raise ConfigurationError(f"seed must not be negative, got {request.seed}")
    settings.check_sections([*known_sections(), request.plant, request.controller])
    result = run_experiment(request, settings)
    return logged_run(result.row, result.steps, flatten(settings.resolve("bullet", BulletConfig())))
