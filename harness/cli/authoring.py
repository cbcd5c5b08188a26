"""The commands for a controller, plant, log or robot of your own: `new | check | shadow | identify | serve`."""

from __future__ import annotations

import ipaddress
import keyword
import math
import os
import re
import sys
from dataclasses import replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Final

import typer

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import CONTROLLER, PLANT, option, switch
from servobench.harness.cli.terminal import FAILED, console, print_tables, say
from servobench.plant.contract.faults import ConfigurationError, RunFault, configuration_errors
from servobench.plant.contract.files import accessing, user_path, write_atomically, write_csv

if TYPE_CHECKING:
    from pandas import DataFrame

    from servobench.harness.run.resolution import ResolvedRun

TEMPLATES: Final = "servobench.harness.cli"
IDENTIFYING: Final = "constant"  # a controller, which identification does not run
PERIOD_TOLERANCE: Final = 1e-4  # [1] within which a logged period is one that is easier to write
PREFIX: Final = "test_"
NEXT: Final = {  # kind of a new file -> the next commands
    "controller": ("check {}", "run --controller {} --plant kinematic"),
    "plant": ("check plant {}", "run --plant {}"),
}
COLOURS: Final = {"ok": "green", "failed": "bold red", "note": "yellow"}
LOG = typer.Argument(
    help="Results folder, or a table (.csv, .parquet) with the columns of its steps."
)
LEGEND: Final = (
    "error / motion: 1 is as good as to predict no motion; noise of the feature is left by the best Jacobian, too\n"
    "The log does not answer to the controller, so that this does not say how well it would have done."
)


def new(
    kind: Annotated[str, typer.Argument(help="What to write: controller or plant.")],
    name: Annotated[
        str, typer.Argument(help="Name of the file and, as MyLaw for my_law, of the class in it.")
    ] = "",
    folder: Annotated[Path, option("FOLDER", "Folder for the files.")] = Path(),
    aids: Annotated[
        bool, switch("--aids", "A controller with the aids of the bench's methods.")
    ] = False,
) -> None:
    """Write a commented controller or plant, and its test."""
    from importlib.metadata import packages_distributions

    if kind not in NEXT:
        commands = " or ".join(f"servobench new {word} NAME" for word in NEXT)
        raise ConfigurationError(f"{kind!r} is nothing to begin with; the command is {commands}")
    if aids and kind != "controller":
        raise ConfigurationError(
            f"--aids are those of a controller; leave the option out for a {kind}"
        )
    module = name.removesuffix(".py")
    if (
        not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", module)
        or keyword.iskeyword(module)
        or module.startswith(PREFIX)
    ):
        raise ConfigurationError(
            f"the name must be one of a Python module, such as my_law, got {name!r}"
        )
    class_name = "".join(part[:1].upper() + part[1:] for part in module.split("_"))
    templates = "aided_controller" if aids else kind, f"{PREFIX}{kind}"
    wanted = dict(
        zip((folder / f"{module}.py", folder / f"{PREFIX}{module}.py"), templates, strict=True)
    )
    for path in wanted:
        if path.exists():
            raise ConfigurationError(
                f"{path} exists already and is left as it is; take another name or --folder"
            )
    if module in sys.stdlib_module_names or module in packages_distributions():
        hidden = f"a Python package is called {module}, which a file of this name would hide"
        raise ConfigurationError(f"{hidden}; take another")
    with accessing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for path, template in wanted.items():
            text = (files(TEMPLATES) / "templates" / f"{template}.py.txt").read_text(
                encoding="utf-8"
            )
            text = text.replace("{{module}}", module).replace("{{Class}}", class_name)
            write_atomically(path, partial(Path.write_text, data=text, encoding="utf-8"))
    file, test = wanted
    place = file if file.is_absolute() else f"./{file}"
    lines = [
        f"wrote {file} and {test}; next:",
        *(f"    servobench {command.format(place)}" for command in NEXT[kind]),
    ]
    say("\n".join(lines))


def check(
    subject: Annotated[
        list[str],
        typer.Argument(
            metavar="CONTROLLER | plant PLANT", help="As ./mine.py:Mine, or plant kinematic."
        ),
    ],
    limit: Annotated[float, option("SECONDS", "Time limit of one check [s].", min=1.0)] = 60.0,
) -> None:
    """Check a controller or a plant against its contract.

    Each failure names its remedy.
    """
    from rich.text import Text

    from servobench.harness.batch.trials import Checks, run_checks
    from servobench.harness.check.controllers import check_controller
    from servobench.harness.check.plants import check_plant
    from servobench.harness.check.report import Finding

    if subject == ["plant"]:
        raise ConfigurationError(
            "check plant needs a plant, such as servobench check plant ./cell.py"
        )
    is_plant, name = subject[0] == "plant", subject[-1]
    if len(subject) != 1 + is_plant:
        raise ConfigurationError(
            f"check needs a controller, or the word plant and a plant, got {' '.join(subject)!r}"
        )
    checks: Checks = check_plant if is_plant else check_controller
    findings: list[Finding] = []

    def hear(finding: Finding) -> None:
        findings.append(finding)
        verdict = f"{finding.verdict:7s}", COLOURS[finding.verdict]
        console.print(Text.assemble(verdict, f"{finding.check:15s}", finding.text), soft_wrap=True)

    run_checks(checks, name, limit, hear)
    failed = sum(finding.verdict == "failed" for finding in findings)
    say(
        f"{name}: "
        + (f"{failed} of {len(findings)} checks failed" if failed else "keeps its contract")
    )
    if failed:
        sys.exit(FAILED)


def shadow(
    log: Annotated[Path, LOG],
    controller: Annotated[
        str | None, option(CONTROLLER, "Name or file of the controller; default: that of the run.")
    ] = None,
    run: options.RunIdOption = None,
    robot: options.RobotOption = "ur5",
    sensing: options.SensingOption = "position",
    out: Annotated[
        Path | None, option("FILE", "CSV file for the commands of the controller at each instant.")
    ] = None,
) -> None:
    """Compare commands and predictions of a controller with a log.

    Nothing is simulated: its commands do not change the log. Its Jacobian predicts each feature from the frame before.
    """
    from servobench.harness.config.registry import find_controller
    from servobench.harness.run.shadow import differences, predictions
    from servobench.harness.run.shadow import shadow as see

    chosen = None if controller is None else selection.choose("controllers", controller)
    if chosen is not None and find_controller(chosen).needs_truth and not log.is_dir():
        raise ConfigurationError(
            f"controller {chosen} is given the true robot, which {log} does not have"
        )
    resolved, table = _logged(log, run, chosen, (robot, sensing), out)
    with console.status(f"showing {len(table)} rows to {resolved.request.controller}"):
        seen = see(resolved, table)
    name, apart, ahead = resolved.request.controller, differences(seen), predictions(seen)
    if out is not None:
        with accessing(out):
            write_csv(seen, out)
        say(f"table in {out}")
    elif apart.empty and ahead.empty:
        raise ConfigurationError(
            f"{log} has no commands to compare with; --out FILE.csv keeps those of the controller"
        )
    if ahead.empty:
        say(f"{name} gives no Jacobian that could predict a feature")
    titles = f"{name} beside the log", f"Features one frame ahead, by the Jacobian of {name}"
    tables = [
        (title, rows) for title, rows in zip(titles, (apart, ahead), strict=True) if not rows.empty
    ]
    words = [
        (title, rows.map(lambda each: each if isinstance(each, str) else f"{each:.3g}"))
        for title, rows in tables
    ]
    print_tables(words, LEGEND)


def identify(
    log: Annotated[Path, LOG],
    run: options.RunIdOption = None,
    robot: options.RobotOption = "ur5",
    sensing: options.SensingOption = "position",
    out: Annotated[
        Path | None, option("FILE", "TOML file of the twin, for --robot of all commands.")
    ] = None,
) -> None:
    """Identify arm, camera and drive from a log, as a twin.

    A mistake of the log, such as exchanged joints, is named instead, with exit code 1.
    """
    from servobench.harness.batch.logs import UnevenRows
    from servobench.harness.run.drive import command_response
    from servobench.harness.run.experiment import build
    from servobench.harness.run.identification import read_log
    from servobench.harness.run.preflight import mistakes
    from servobench.harness.run.request import RunSettings, find_sensing
    from servobench.harness.run.twin_file import estimates, remarks, twin_text
    from servobench.plant.robot.catalogue import ROBOTS, find_robot, with_files

    try:
        resolved, table = _logged(log, run, IDENTIFYING, (robot, sensing), out)
    except UnevenRows as error:
        say(str(error))
        sys.exit(FAILED)
    request = resolved.request
    setup, own = find_sensing(request.sensing), find_robot(request.robot)
    if own.twin:
        wanted = f"identify a table, such as steps.parquet, with --robot {own.twin.keys.robot}"
        raise ConfigurationError(
            f"{request.robot} is itself a twin, which no twin can deviate from: {wanted}"
        )
    if (
        not log.is_dir()
    ):  # a table does not say at which speed commands are clipped: at that of the robot
        resolved = replace(
            resolved, plant=replace(resolved.plant, max_joint_speed=float(own.limits.speed.max()))
        )
    experiment = build(resolved)
    rows = read_log(experiment.plant.spec, table)
    experiment.plant.close()
    apart = [name for name in ROBOTS if name != request.robot]  # made only for a log with a mistake
    with console.status(f"identifying {request.robot} in {len(table)} rows"):
        mistake, found = mistakes(
            rows, setup.nominal(own), lambda: {k: setup.nominal(find_robot(k)) for k in apart}
        )
        response = command_response(rows)
    if found is None:
        say(f"{log}: {mistake}")
        sys.exit(FAILED)
    print_tables(
        [(f"{log} against the nominal {own.title}, where they differ", estimates(found, response))]
    )
    say("\n".join(remarks(rows, found, response)))
    if out is not None:
        with accessing(out):
            folder = out.resolve().parent  # where the twin looks for files first
            named = with_files(
                request.robot,
                lambda file: (
                    os.path.relpath(user_path(file), folder) if user_path(file).is_file() else file
                ),
            )
            text = twin_text(found, rows, response, (named, request.sensing))
            write_atomically(out, lambda path: path.write_text(text, encoding="utf-8"))
        next_one = f"servobench compare --robot {quote(str(out))} --plants kinematic"
        if abs(resolved.run.period - RunSettings.period) > PERIOD_TOLERANCE * RunSettings.period:
            next_one += f" --set run.period={_as_clock(resolved.run.period)}"
        say(f"twin in {out}; the next command: {next_one}")


def _as_clock(period: float) -> str:
    """Return a control period [s] as users write it: in whole milliseconds, as a rate in whole Hz, or as it is."""
    if math.isclose(round(period, 3), period, rel_tol=PERIOD_TOLERANCE):
        return f"{round(period, 3):g}"
    if math.isclose(round(1.0 / period), 1.0 / period, rel_tol=PERIOD_TOLERANCE):
        return f"{round(1.0 / period)}Hz"
    return f"{period:.6g}"


def _logged(
    log: Path, run: str | None, controller: str | None, named: tuple[str, str], out: Path | None
) -> tuple[ResolvedRun, DataFrame]:
    """Return a run of a controller, None for that of the log, with robot and sensing as named, and the log's rows."""
    from servobench.harness.batch.logs import logged_in_file, logged_in_folder

    if not log.exists():
        raise ConfigurationError(f"{log} does not exist; wanted a results folder or a table")
    if out is not None and out.exists() and out.samefile(log):
        raise ConfigurationError(f"--out {out} is the log itself; name another file")
    if log.is_dir():
        resolved, table = logged_in_folder(log, run, controller, named[1])
        for word, given, usual in (("robot", named[0], "ur5"), ("sensing", named[1], "position")):
            if given not in (usual, own := getattr(resolved.request, word)):
                raise ConfigurationError(
                    f"--{word} {given} is not that of the run, {own}; leave it out for a folder"
                )
        return resolved, table
    if run is not None:
        raise ConfigurationError(f"--run names a run of a results folder, and {log} is a table")
    if controller is None:
        raise ConfigurationError(
            f"{log} does not say which controller to show it to; name one with --controller"
        )
    return logged_in_file(log, controller, *named)


def serve(
    *,
    plant: Annotated[str, option(PLANT, "The plant that is served.")] = "kinematic",
    robot: options.RobotOption = "ur5e",
    task: options.TaskOption = "exp2",
    mismatch: options.MismatchOption = options.DEFAULT_MISMATCH,
    sensing: options.SensingOption = "position",
    seed: Annotated[int, option("INTEGER", "Seed of the plant.")] = 0,
    overrides: options.Overrides,
    address: Annotated[
        str, option("ADDRESS", "Of the network interface to listen on.")
    ] = "127.0.0.1",
    lockstep: Annotated[
        bool, switch("--lockstep", "Let the clock wait for the command of each period.")
    ] = False,
) -> None:
    """Serve a plant on the ports of a UR.

    For the client ur-rtde 1.6.5. Conformance with it is checked; nothing here makes a robot safe. Ctrl-C ends it.
    """
    import asyncio

    from servobench.harness.run.loop import careful
    from servobench.harness.run.request import RunRequest, read_mismatch
    from servobench.harness.run.tasks import choose_task
    from servobench.harness.serve import server

    with configuration_errors("--address: "):
        ipaddress.ip_address(address)
    names = selection.choose("plants", plant), "constant", choose_task(task)
    request = RunRequest(*names, read_mismatch(mismatch), seed, robot=robot, sensing=sensing)

    with careful():
        try:
            served = server.Server(request, overrides.settings(), say, lockstep=lockstep)
        except RunFault as fault:
            raise ConfigurationError(f"plant {plant}: {fault}") from fault
        try:
            asyncio.run(served.serve(address))
        finally:
            served.rollout.plant.close()
