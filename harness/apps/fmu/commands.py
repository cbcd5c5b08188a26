"""The commands `servobench fmu export | ssp | validate | info`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import CONTROLLER, command, named_option, option
from servobench.harness.cli.terminal import FAILED, print_rows, say
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import accessing

if TYPE_CHECKING:
    from servobench.fmus.compiler import Platforms
    from servobench.harness.config.settings import Settings
    from servobench.harness.run.request import RunRequest

fmu = typer.Typer(
    help="Export an arm or a controller as an FMU; check and show FMUs.", no_args_is_help=True
)

FileArgument = Annotated[Path, typer.Argument(dir_okay=False, help="The .fmu file.")]


@dataclass(frozen=True)
class Export:
    """The run whose arm and controller are exported, and the platforms for which they are compiled."""

    mismatch: options.MismatchOption = "none"
    robot: options.RobotOption = "ur5"
    sensing: options.SensingOption = "position"
    seed: Annotated[int, option("INTEGER", "Seed of the run whose robot this is.")] = 0
    platforms: Annotated[
        str | None,
        option(
            "NAMES",
            "Comma-separated, such as x86_64-linux,aarch64-darwin, or 'all'; default: this machine.",
        ),
    ] = None

    @contextlib.contextmanager
    def compiling(self) -> Iterator[Platforms]:
        """Yield the platforms; an error of the export or of a compiler becomes one line for the user."""
        from servobench.fmus.compiler import parse_platforms

        with configuration_errors(), accessing(None):
            yield parse_platforms(self.platforms)

    def request(self, controller: str, settings: Settings) -> RunRequest:
        """Return the run of a controller, and refuse settings that it does not read."""
        from servobench.harness.run.request import RunRequest
        from servobench.harness.run.resolution import check_settings
        from servobench.plant.robot.mismatch import Mismatch

        names = "kinematic", selection.choose("controllers", controller), "target"
        check_settings(settings, names)
        return RunRequest(
            *names, Mismatch.parse(self.mismatch), self.seed, robot=self.robot, sensing=self.sensing
        )


def check_output(output: Path, ending: str) -> None:
    """Raise ConfigurationError if the file to write has no folder, or does not end as importing tools expect it to."""
    if output.suffix.lower() != ending:
        raise ConfigurationError(f"--output must end in {ending}, got {output}")
    if not output.parent.is_dir():
        raise ConfigurationError(f"the folder {output.parent} for {output.name} does not exist")


@fmu.command()
@command
def export(
    *,
    output: Annotated[
        Path, named_option("--output -o", "FILE", "The .fmu file to write.", dir_okay=False)
    ],
    fmi: Annotated[
        int,
        option(
            "INTEGER",
            "Version of FMI, 2 or 3. An arm has co-simulation and model exchange, a controller co-simulation.",
        ),
    ] = 2,
    controller: Annotated[
        str | None, option(CONTROLLER, "Name or file of a controller to export instead of the arm.")
    ] = None,
    exported: Export,
    overrides: options.Overrides,
) -> None:
    """Export an arm with a mismatch as start values, or a controller."""
    from servobench.fmus.dialect import export_dialect
    from servobench.harness.apps.fmu.products import arm_product, controller_model

    settings = overrides.settings()
    if controller is None and settings.sections:
        raise ConfigurationError("--config and --set are for --controller; an arm has --mismatch")
    if controller is not None and (exported.mismatch != "none" or exported.seed):
        raise ConfigurationError(
            "--mismatch and --seed are for an arm; a controller does not know them"
        )
    check_output(output, ".fmu")
    with exported.compiling() as platforms:
        request = exported.request(controller or "constant", settings)
        if controller is None:
            words = (
                "none"
                if exported.mismatch == "none"
                else f"{exported.mismatch}, seed {exported.seed}"
            )
            product = arm_product(request, words, fmi)
        else:
            export_dialect(fmi)
            product = controller_model(request, settings).product(fmi)
        product.write(output, platforms)
    names = ", ".join(platform.name for platform in platforms)
    say(f"{output}: FMI {fmi}, {output.stat().st_size / 1024:.0f} kB, for {names}")


@fmu.command()
@command
def ssp(
    *,
    output: Annotated[
        Path, named_option("--output -o", "FILE", "The .ssp file to write.", dir_okay=False)
    ],
    controller: Annotated[str, option(CONTROLLER, "Name or file of the controller.")],
    exported: Export,
    overrides: options.Overrides,
) -> None:
    """Export arm, controller and connections as one system (SSP).

    The reference is the target of the task `target`.
    """
    from servobench.fmus.controllers.ssp import write_loop
    from servobench.harness.apps.fmu.products import loop_products

    check_output(output, ".ssp")
    settings = overrides.settings()
    request = exported.request(controller, settings)
    with exported.compiling() as platforms:
        plant, regulator, stop = loop_products(request, settings)
        write_loop(output, plant, regulator, platforms, stop)
    say(f"{output}: SSP 1.0, {output.stat().st_size / 1024:.0f} kB, plant and controller")


@fmu.command()
def validate(file: FileArgument) -> None:
    """Check archive and description, and repeat its reference run.

    The run happens in a process of its own.
    """
    from servobench.harness.apps.fmu.validation import validate as run_reference

    found = run_reference(file)
    for problem in found.problems:
        say(f"problem: {problem}")
    ran = ", runs nevertheless"
    if found.problems:
        ran = ""
    for departure in found.departures:
        say(f"breaks the standard here{ran}: {departure}")
    if found.deviation is None:
        say(
            "no reference run inside"
            + ("" if found.problems else "; it was loaded and made ready for a run")
        )
    else:
        say(f"reference run: largest difference {found.deviation:.2g}")
    if found.problems:
        raise typer.Exit(FAILED)
    if not found.departures:
        say("no problem found")


@fmu.command()
def info(file: FileArgument) -> None:
    """Show version, license, platforms, capabilities and variables."""
    from servobench.harness.apps.fmu.inspection import read_information

    with configuration_errors():
        information = read_information(file)
    described = information.description
    say(f"{described.modelName}: FMI {described.fmiVersion}, {', '.join(information.interfaces)}")
    token = described.guid or described.instantiationToken
    say(f"made by {described.generationTool or 'unknown'}; token {token}")
    if described.license:
        say(f"license: {described.license}")
    sources = "; with sources" if information.has_sources else ""
    say(f"platforms: {', '.join(information.platforms) or 'none'}{sources}")
    for name, capabilities in information.interfaces.items():
        say(f"capabilities in {name}: {', '.join(capabilities) or 'none'}")
    rows = []
    for each in described.modelVariables:
        size = " × ".join(map(str, each.shape)) or "1"
        start = str(each.start or "")
        start = start if len(start) <= 24 else f"{start[:23]}…"
        rows.append((each.name, each.causality or "local", size, each.unit or "", start))
    print_rows(("name", "causality", "size", "unit", "start"), rows)
