"""The command `servobench robustness`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from servobench.harness.batch import results
from servobench.harness.batch.compare import parse_seeds
from servobench.harness.cli.options import ConfigOption, SetOption, split_names
from servobench.harness.cli.sweep import carry_out_sweep
from servobench.harness.config.registry import (
    controller_names,
    find_controller,
    find_plant,
    plant_names,
)
from servobench.harness.config.settings import Settings, read_settings

FIVE = "rbfnn_mfac_plus,rbfnn_mfac,ukf_mfac,ukf_mpc,rbf_pid"
FIGURES = "figures"

console = Console()


def robustness(
    out: Annotated[Path, typer.Option(help="Folder for the results; with --resume the one to go on with.")],
    plant: Annotated[str, typer.Option(help="Name of the plant.")] = "fmu",
    controllers: Annotated[str, typer.Option(help="Names by comma, or all.")] = FIVE,
    seeds: Annotated[str, typer.Option(help="A count (5), a list (3,1,4) or a range (100:120).")] = "40",
    workers: Annotated[int | None, typer.Option(min=1, help="Worker processes; default: the processors.")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler to send the runs to.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a map that was killed.")] = False,
    set_: SetOption = None,
    config: ConfigOption = None,
) -> None:
    """Draw the robustness map: success and settling time along seven axes, one made worse at a time."""
    settings = read_settings(config, set_ or [])
    names = split_names("controllers", controllers, controller_names(), find_controller)
    where = split_names("plant", plant, plant_names(), find_plant)[0]
    files = make_map(out, where, names, parse_seeds(seeds), settings, workers, scheduler, resume=resume)
    console.print(f"the map is in {files[0]}; its runs are in {out}", soft_wrap=True)


def make_map(
    out: Path,
    plant: str,
    controllers: Sequence[str],
    seeds: Sequence[int],
    settings: Settings,
    workers: int | None = None,
    scheduler: str | None = None,
    *,
    resume: bool = False,
) -> list[Path]:
    """Carry out the runs of a map, put its tables together and draw it; the options are those of the command.

    Returns:
        The files of the pictures.
    """
    from servobench.harness.studies.robustness import (  # noqa: PLC0415 - draws with matplotlib
        MOVED,
        USUAL,
        draw_map,
        map_cells,
        map_tables,
        moved_settings,
    )

    usual, moved = map_cells(plant, controllers, seeds)
    for folder, cells, chosen in ((USUAL, usual, settings), (MOVED, moved, moved_settings(settings))):
        going_on = resume and (out / folder).exists()
        carry_out_sweep(cells, chosen, out / folder, workers, scheduler, resume=going_on)
    results.write_summary(out, map_tables(out), results.read_manifest(out / USUAL))
    return draw_map(results.load_runs(out), out / FIGURES)
