"""The command `servobench record`: films and snapshots of a run."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Annotated

import typer

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import option
from servobench.harness.cli.terminal import console, say
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import writing_together


def record(
    folder: Annotated[Path, typer.Argument(help="Results folder whose run to show.")],
    *,
    run: options.RunIdOption = None,
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

    They show the rendered arm, its camera's view and the error.
    """
    from servobench.harness.apps.films.film import GIF, KINDS, MP4, write_recording
    from servobench.harness.apps.films.replay import logged_run, stretch
    from servobench.harness.batch.logs import find_run
    from servobench.harness.batch.results import ResultsFolder
    from servobench.harness.cli.progress import telling
    from servobench.harness.config.registry import engine_of, rendered_plant

    into = out or folder / "recordings"
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
    with telling(console, "reading") as tell:
        opened = ResultsFolder(folder)
        row = find_run(opened, run)
        shown = logged_run(row, opened.steps([row["run_id"]]))
        say(f"rendered by {engine_of(rendered_plant(shown.track.row['plant']))}")
        name = str(shown.track.row["run_id"])
        if film is not None:
            name = film.stem
        with writing_together(into) as partial:
            made = write_recording(stretch(shown, begin, length), partial / name, wanted, tell)
    for path in [into / each.name for each in made]:
        say(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


def _check_writable(folder: Path) -> None:
    """Refuse a folder that takes no film before a run is drawn."""
    standing = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    if not standing.is_dir():
        raise ConfigurationError(f"{folder} cannot be written: {standing} is a file")
    if not os.access(standing, os.W_OK | os.X_OK):
        raise ConfigurationError(f"{folder} cannot be written: {os.strerror(errno.EACCES)}")
