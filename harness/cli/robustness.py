"""The command `servobench robustness`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servobench.harness.batch.compare import parse_seeds
from servobench.harness.cli.options import (
    ConfigOption,
    ResumeOption,
    SchedulerOption,
    SetOption,
    TimeoutOption,
    WorkersOption,
    split_names,
)
from servobench.harness.cli.progress import watching
from servobench.harness.cli.terminal import console
from servobench.harness.config.registry import (
    controller_names,
    find_controller,
    find_plant,
    plant_names,
)
from servobench.harness.config.settings import read_settings

DEFAULT_CONTROLLERS = "rbfnn_mfac_plus,rbfnn_mfac,ukf_mfac,ukf_mpc,rbf_pid"


def robustness(
    out: Annotated[Path, typer.Option(help="Folder for the results; with --resume the one to continue.")],
    plant: Annotated[str, typer.Option(help="Name of the plant.")] = "fmu",
    controllers: Annotated[str, typer.Option(help="Comma-separated names, or all.")] = DEFAULT_CONTROLLERS,
    seeds: Annotated[str, typer.Option(help="A count (5), a list (3,1,4) or a range (100:120).")] = "40",
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    run_timeout: TimeoutOption = None,
    resume: ResumeOption = False,
    set_: SetOption = None,
    config: ConfigOption = None,
) -> None:
    """Draw the robustness map: success and settling time along seven axes, each varied by itself."""
    from servobench.harness.studies.robustness import make_map  # noqa: PLC0415 - draws with matplotlib

    settings = read_settings(config, set_ or [])
    names = split_names("controllers", controllers, controller_names(), find_controller)
    where = split_names("plant", plant, plant_names(), find_plant)[0]
    with watching(console, out) as observer:
        files = make_map(
            out, where, names, parse_seeds(seeds), settings, workers=workers, scheduler=scheduler,
            run_timeout=run_timeout, resume=resume, observer=observer,
        )  # fmt: skip
    console.print(f"the map is in {files[0]}; its runs are in {out}", soft_wrap=True)
