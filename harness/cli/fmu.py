"""The commands `servobench fmu export | validate | info`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servobench.harness.cli.named import known_robot
from servobench.harness.cli.options import RobotOption, SensingOption
from servobench.harness.cli.terminal import console

fmu_app = typer.Typer(help="Export an arm as an FMU; check and show FMUs.", no_args_is_help=True)

FileArgument = Annotated[Path, typer.Argument(help="The .fmu file.")]


@fmu_app.command()
def export(
    output: Annotated[Path, typer.Option("--output", "-o", help="The .fmu file to write.")],
    fmi: Annotated[int, typer.Option(help="2 or 3; both offer co-simulation and model exchange.")] = 2,
    mismatch: Annotated[str, typer.Option(help="Start values: none, factory, moderate, severe, or axes.")] = "none",
    robot: RobotOption = "ur5",
    sensing: SensingOption = "position",
    seed: Annotated[int, typer.Option(help="Seed of the run whose robot this is.")] = 0,
    platforms: Annotated[
        str | None,
        typer.Option(help="Comma-separated, such as x86_64-linux,aarch64-darwin, or 'all'; default: this machine."),
    ] = None,
) -> None:
    """Export an arm with a mismatch as start values."""
    from servobench.fmus.compile import CompilationFailed, CompilerMissing, parse_platforms
    from servobench.fmus.export import ExportOptions, default_actuation, export_fmu
    from servobench.harness.config.robots import find_robot
    from servobench.harness.config.sensing import find_sensing
    from servobench.harness.config.settings import ConfigurationError
    from servobench.plant.robot.mismatch import Mismatch, sample_mismatch
    from servobench.plant.seeds import named_seed

    described = find_robot(known_robot(robot))
    try:
        drawn, differs = named_seed(seed, "mismatch"), Mismatch.parse(mismatch)
        arm, sample = sample_mismatch(differs, described, drawn)
        model, _ = find_sensing(sensing).true(described, arm, sample, differs, drawn)
        words = "none" if mismatch == "none" else f"{mismatch}, seed {seed}"
        options = ExportOptions(fmi, model, default_actuation(described), parse_platforms(platforms), words, described)
        export_fmu(output, options)
    except (ValueError, OSError, CompilerMissing, CompilationFailed) as error:
        raise ConfigurationError(str(error)) from error
    names = ", ".join(platform.name for platform in options.platforms)
    console.print(f"{output}: FMI {fmi}, {output.stat().st_size / 1024:.0f} kB, for {names}", soft_wrap=True)


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
