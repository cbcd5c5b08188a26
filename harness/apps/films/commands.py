"""The command `servobench record`: films and snapshots of a run."""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import (
    CONTROLLER,
    MISMATCH,
    PLANT,
    ROBOT,
    TASK,
    Value,
    named_option,
    option,
)
from servobench.harness.cli.terminal import console, say
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import writing_together

if TYPE_CHECKING:
    from servobench.harness.apps.films.replay import LoggedRun

RECORDED = {
    "controller": "rbfnn_mfac",
    "task": "circle",
    "mismatch": "moderate",
    "robot": "ur5",
    "seed": 0,
}
RECORDINGS = "recordings"


def _new(name: str, value: Value | str) -> Any:  # noqa: ANN401 - typer's own word for it
    return option(value, f"New run: {name}, default {RECORDED[name]}.")


@dataclass(frozen=True)
class NewRun:
    """The run that is carried out where no folder is given."""

    plant: Annotated[
        str | None, option(PLANT, "New run: plant, default bullet, or mujoco without PyBullet.")
    ] = None
    controller: Annotated[str | None, _new("controller", CONTROLLER)] = None
    task: Annotated[str | None, _new("task", TASK)] = None
    mismatch: Annotated[str | None, _new("mismatch", MISMATCH)] = None
    robot: Annotated[str | None, _new("robot", ROBOT)] = None
    seed: Annotated[int | None, _new("seed", "INTEGER")] = None
    set_: Annotated[
        list[str] | None,
        named_option("--set", "KEY=VALUE", "New run: one setting, such as bullet.latency=0.05."),
    ] = None
    config: Annotated[Path | None, option("FILE", "New run: TOML file with settings.")] = None


def record(
    folder: Annotated[
        Path | None,
        typer.Argument(help="Results folder whose run to show; without one a run is carried out."),
    ] = None,
    *,
    run: options.RunIdOption = None,
    new: NewRun,
    kinds: Annotated[
        str, option("NAMES", "Comma-separated kinds: mp4, gif, snapshots; or 'all'.")
    ] = "all",
    begin: Annotated[
        float, option("SECONDS", "Time in the run at which the film begins [s].", min=0.0)
    ] = 0.0,
    length: Annotated[
        float | None,
        option("SECONDS", "Length of the film [s]; default: to the end of the run.", min=0.001),
    ] = None,
    out: Annotated[
        Path | None,
        option(
            "PATH",
            "Folder for the films, or the file of one film (.mp4, .gif); default: recordings in the folder.",
        ),
    ] = None,
) -> None:
    """Make a film (MP4, GIF) and snapshots of a run.

    They show the rendered arm, its camera's view and the error. Without a folder a new run is carried out.
    """
    from servobench.harness.apps.films.film import GIF, KINDS, MP4, write_recording
    from servobench.harness.apps.films.replay import stretch
    from servobench.harness.cli.progress import telling
    from servobench.harness.config.registry import engine_of, rendered_plant

    into = out or (folder or Path("results")) / RECORDINGS
    ending = into.suffix.removeprefix(".")
    film = out if ending in (MP4, GIF) else None
    if film is not None:
        if kinds not in (selection.ALL, ending):
            raise ConfigurationError(
                f"--out {film} names one film; leave --kinds {kinds} away, or name a folder"
            )
        kinds = ending
        into = film.parent
    elif out is not None and ending.isalpha() and not out.is_dir():
        raise ConfigurationError(
            f"--out {out} must be a folder, or one film that ends in .{MP4} or .{GIF}"
        )
    wanted = selection.split_names("kinds", kinds, KINDS)
    _check_writable(into)
    with telling(console, "reading" if folder else "running") as tell:
        shown = _shown(folder, run, new)
        say(f"rendered by {engine_of(rendered_plant(shown.track.row['plant']))}")
        name = str(shown.track.row["run_id"])
        if film is not None:
            name = film.stem
        with writing_together(into) as partial:
            made = write_recording(stretch(shown, begin, length), partial / name, wanted, tell)
    for path in [into / each.name for each in made]:
        say(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


def _check_writable(folder: Path) -> None:
    """Refuse a folder that takes no film before a run is carried out and drawn."""
    standing = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    if not standing.is_dir():
        raise ConfigurationError(f"{folder} cannot be written: {standing} is a file")
    if not os.access(standing, os.W_OK | os.X_OK):
        raise ConfigurationError(f"{folder} cannot be written: {os.strerror(errno.EACCES)}")


def _shown(folder: Path | None, run_id: str | None, new: NewRun) -> LoggedRun:
    """Return the run of a folder that is named, or its only one, or carry out a new one."""
    from servobench.harness.apps.films.replay import logged_run
    from servobench.harness.batch.logs import find_run
    from servobench.harness.batch.results import ResultsFolder
    from servobench.harness.config.registry import rendered_plant
    from servobench.harness.config.settings import read_settings
    from servobench.harness.run.episode import run_experiment
    from servobench.harness.run.request import RunRequest
    from servobench.harness.run.resolution import check_settings
    from servobench.plant.robot.mismatch import Mismatch

    given = {name: value for name, value in vars(new).items() if value not in (None, [])}
    if folder is not None:
        if given:
            name = next(iter(given)).rstrip("_")
            raise ConfigurationError(
                f"--{name} belongs to a new run; a run of {folder} is named by --run"
            )
        opened = ResultsFolder(folder)
        row = find_run(opened, run_id)
        return logged_run(row, opened.steps([row["run_id"]]))
    if run_id is not None:
        raise ConfigurationError("--run names a run of a results folder, and no folder is given")
    names = {
        name: given.get(name, usual)
        for name, usual in {"plant": rendered_plant(new.plant), **RECORDED}.items()
    }
    settings = read_settings(new.config, new.set_ or [])
    chosen = {each: selection.choose(f"{each}s", names[each]) for each in ("plant", "controller")}
    request = RunRequest(**names | chosen | {"mismatch": Mismatch.parse(names["mismatch"])})
    check_settings(settings, [request.plant, request.controller, request.task])
    result = run_experiment(request, settings)
    return logged_run(result.row, result.steps)
