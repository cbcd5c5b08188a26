"""The commands `servobench fmu export | ssp | validate | info`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.harness.cli import completion
from servobench.harness.cli.options import ConfigOption, RobotOption, SensingOption, SetOption
from servobench.harness.cli.selection import known_robot
from servobench.harness.cli.terminal import console

if TYPE_CHECKING:
    from servobench.fmus.product import Product
    from servobench.harness.config.settings import Settings
    from servobench.harness.run.request import RunRequest

fmu_app = typer.Typer(help="Export an arm or a controller as an FMU; check and show FMUs.", no_args_is_help=True)

PlatformsOption = Annotated[
    str | None,
    typer.Option(help="Comma-separated, such as x86_64-linux,aarch64-darwin, or 'all'; default: this machine."),
]
SeedOption = Annotated[int, typer.Option(help="Seed of the run whose robot this is.")]
FileArgument = Annotated[Path, typer.Argument(dir_okay=False, help="The .fmu file.")]


@fmu_app.command()
def export(
    output: Annotated[Path, typer.Option("--output", "-o", dir_okay=False, help="The .fmu file to write.")],
    fmi: Annotated[
        int,
        typer.Option(
            help="Version of FMI, 2 or 3. An arm has co-simulation and model exchange, a controller co-simulation."
        ),
    ] = 2,
    controller: Annotated[
        str | None,
        typer.Option(
            help="Name or file of a controller to export instead of the arm.", autocompletion=completion.controllers
        ),
    ] = None,
    mismatch: Annotated[
        str, typer.Option(help="Mismatch in the start values: none, factory, moderate, severe, or axes.")
    ] = "none",
    robot: RobotOption = "ur5",
    sensing: SensingOption = "position",
    seed: SeedOption = 0,
    platforms: PlatformsOption = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
) -> None:
    """Export an arm with a mismatch as start values, or a controller."""
    from servobench.fmus.compile import CompilationFailed, CompilerMissing, parse_platforms
    from servobench.harness.config.settings import ConfigurationError, read_settings

    settings = read_settings(config, assignments or ())
    if controller is None and settings.sections:
        raise ConfigurationError("--config and --set are for --controller; an arm has --mismatch")
    drawn = known_robot(robot), sensing, mismatch, seed
    try:
        chosen = parse_platforms(platforms)
        product = _arm(fmi, *drawn) if controller is None else _controller(fmi, controller, *drawn, settings)
        product.write(output, chosen)
    except (ValueError, OSError, CompilerMissing, CompilationFailed) as error:
        raise ConfigurationError(str(error)) from error
    names = ", ".join(platform.name for platform in chosen)
    console.print(f"{output}: FMI {fmi}, {output.stat().st_size / 1024:.0f} kB, for {names}", soft_wrap=True)


@fmu_app.command()
def ssp(
    output: Annotated[Path, typer.Option("--output", "-o", dir_okay=False, help="The .ssp file to write.")],
    controller: Annotated[
        str, typer.Option(help="Name or file of the controller.", autocompletion=completion.controllers)
    ],
    mismatch: Annotated[
        str, typer.Option(help="Mismatch of the arm: none, factory, moderate, severe, or axes.")
    ] = "none",
    robot: RobotOption = "ur5",
    sensing: SensingOption = "position",
    seed: SeedOption = 0,
    platforms: PlatformsOption = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
) -> None:
    """Export arm, controller and connections as one system (SSP).

    The reference is the target of the task `target`.
    """
    from servobench.fmus.compile import CompilationFailed, CompilerMissing, parse_platforms
    from servobench.fmus.ssp import write_loop
    from servobench.harness.config.settings import ConfigurationError, read_settings
    from servobench.harness.run.loop_ssp import loop_products

    settings = read_settings(config, assignments or ())
    request = _request(controller, known_robot(robot), sensing, mismatch, seed, settings)
    try:
        chosen = parse_platforms(platforms)
        plant, regulator, stop = loop_products(request, settings)
        write_loop(output, plant, regulator, chosen, stop)
    except (ValueError, OSError, CompilerMissing, CompilationFailed) as error:
        raise ConfigurationError(str(error)) from error
    console.print(f"{output}: SSP 1.0, {output.stat().st_size / 1024:.0f} kB, plant and controller", soft_wrap=True)


def _arm(fmi: int, robot: str, sensing: str, mismatch: str, seed: int) -> Product:
    from servobench.fmus.export import ExportOptions, default_actuation, product
    from servobench.harness.config.robots import find_robot, find_sensing
    from servobench.plant.contract.seeds import named_seed
    from servobench.plant.robot.mismatch import Mismatch, sample_mismatch

    described, differs, drawn = find_robot(robot), Mismatch.parse(mismatch), named_seed(seed, "mismatch")
    arm, sample = sample_mismatch(differs, described, drawn)
    model, _ = find_sensing(sensing).true(described, arm, sample, differs, drawn)
    words = "none" if mismatch == "none" else f"{mismatch}, seed {seed}"
    return product(ExportOptions(fmi, model, default_actuation(described), mismatch=words, robot=described))


def _controller(fmi: int, name: str, robot: str, sensing: str, mismatch: str, seed: int, settings: Settings) -> Product:
    from servobench.fmus.product import check_version
    from servobench.harness.run.controller_fmu import controller_model

    check_version(fmi)
    return controller_model(_request(name, robot, sensing, mismatch, seed, settings), settings).product(fmi)


def _request(controller: str, robot: str, sensing: str, mismatch: str, seed: int, settings: Settings) -> RunRequest:
    """Return the run of a controller that an FMU is made for, and refuse settings that it does not read."""
    from servobench.harness.config.registry import choose_controller
    from servobench.harness.run.request import RunRequest, read_mismatch

    names = "kinematic", choose_controller(controller), "target"
    settings.check_sections([*names, "run"])
    return RunRequest(*names, read_mismatch(mismatch), seed, robot=robot, sensing=sensing)


@fmu_app.command()
def validate(file: FileArgument) -> None:
    """Check archive and description, and repeat its reference run.

    The run happens in a process of its own.
    """
    from servobench.harness.batch.validation import validate_apart

    found = validate_apart(file)
    for problem in found.problems:
        console.print(f"problem: {problem}", soft_wrap=True, markup=False)
    if found.deviation is None:
        console.print("no reference run inside")
    else:
        console.print(f"reference run: largest difference {found.deviation:.2g}")
    if found.problems:
        raise typer.Exit(1)
    console.print("no problem found")


@fmu_app.command()
def info(file: FileArgument) -> None:
    """Show version, platforms, capabilities and variables."""
    from rich.table import Table

    from servobench.fmus.information import read_information
    from servobench.harness.config.settings import ConfigurationError

    try:
        information = read_information(file)
    except ValueError as error:
        raise ConfigurationError(str(error)) from error
    console.print(f"{information.model_name}: FMI {information.fmi_version}, {', '.join(information.interfaces)}")
    console.print(f"made by {information.tool}; token {information.token}")
    sources = "; with sources" if information.has_sources else ""
    console.print(f"platforms: {', '.join(information.platforms) or 'none'}{sources}")
    for name, capabilities in information.interfaces.items():
        console.print(f"capabilities in {name}: {', '.join(capabilities) or 'none'}", soft_wrap=True)
    table = Table("name", "causality", "size", "unit", "start")
    for variable in information.variables:
        size = " × ".join(map(str, variable.shape)) or "1"
        table.add_row(variable.name, variable.causality, size, variable.unit, _shortened(variable.start))
    console.print(table)


def _shortened(text: str, width: int = 24) -> str:
    return text if len(text) <= width else f"{text[: width - 1]}…"
