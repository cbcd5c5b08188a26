"""The commands `servobench shadow | identify`: what a log says about a controller, and about an arm."""

from __future__ import annotations

import math
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.harness.cli import options, selection
from servobench.harness.cli.options import CONTROLLER, option
from servobench.harness.cli.terminal import FAILED, console, print_tables, say
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import accessing, user_path, write_csv, write_text

if TYPE_CHECKING:
    from pandas import DataFrame

    from servobench.harness.apps.twin.log import Clocks
    from servobench.harness.apps.twin.summary import Answer
    from servobench.harness.run.request import RunRequest
    from servobench.harness.run.resolution import ResolvedRun

IDENTIFYING = "constant"  # a controller, which identification does not run
PERIOD_TOLERANCE = 1e-4  # [1] within which a logged period is one that is easier to write
LOG = typer.Argument(
    help="Results folder, or a table (.csv, .parquet) with the columns of its steps; none with --joints."
)
LEGEND = (
    "error / motion: 1 is as good as to predict no motion; noise of the feature is left by the best Jacobian, too\n"
    "The log does not answer to the controller, so that this does not say how well it would have done."
)


@dataclass(frozen=True)
class StreamOptions:
    """A log of two streams with stamps of their own."""

    joints: Annotated[
        Path | None,
        option(
            "FILE",
            "Joints at their own stamps in place of a log: table (.csv, .parquet) or bag (.mcap, rosbag2, .db3, .bag).",
        ),
    ] = None
    features: Annotated[
        Path | None, option("FILE", "Features at theirs, likewise; default: the file of joints.")
    ] = None
    columns: Annotated[
        Path | None, option("FILE", "TOML file with topics, fields, columns, joints and units.")
    ] = None


USUAL_STREAMS = StreamOptions()


def shadow(
    log: Annotated[Path | None, LOG] = None,
    controller: Annotated[
        str | None, option(CONTROLLER, "Name or file of the controller; default: that of the run.")
    ] = None,
    run: options.RunIdOption = None,
    robot: options.RobotOption = "ur5",
    sensing: options.SensingOption = "position",
    streams: StreamOptions = USUAL_STREAMS,
    out: Annotated[
        Path | None, option("FILE", "CSV file for the commands of the controller at each instant.")
    ] = None,
) -> None:
    """Compare commands and predictions of a controller with a log.

    Nothing is simulated: its commands do not change the log. Its Jacobian predicts each feature from the frame before.
    """
    from servobench.harness.apps.twin.predictions import predictions
    from servobench.harness.apps.twin.shadow import differences
    from servobench.harness.apps.twin.shadow import shadow as see
    from servobench.harness.config.registry import find_controller

    chosen = None if controller is None else selection.choose("controllers", controller)
    is_folder = log is not None and log.is_dir()
    if chosen is not None and find_controller(chosen).needs_truth and not is_folder:
        raise ConfigurationError(
            f"controller {chosen} is given the true robot, which {log or 'a bag'} does not have"
        )
    log_name, resolved, table, _ = _logged(log, run, chosen, (robot, sensing), out, streams)
    with console.status(f"showing {len(table)} rows to {resolved.request.controller}"):
        seen = see(resolved, table)
    name, apart, ahead = resolved.request.controller, differences(seen), predictions(seen)
    if out is not None:
        with accessing(out):
            write_csv(seen, out)
        say(f"table in {out}")
    elif apart.empty and ahead.empty:
        raise ConfigurationError(
            f"{log_name} has no commands to compare with; --out FILE.csv keeps those of the controller"
        )
    if ahead.empty:
        say(f"{name} gives no Jacobian that could predict a feature")
    titled = {
        f"{name} beside the log": apart,
        f"Features one frame ahead, by the Jacobian of {name}": ahead,
    }
    words = [
        (title, rows.map(lambda each: each if isinstance(each, str) else f"{each:.3g}"))
        for title, rows in titled.items()
        if not rows.empty
    ]
    print_tables(words, LEGEND)


def identify(
    log: Annotated[Path | None, LOG] = None,
    run: options.RunIdOption = None,
    robot: options.RobotOption = "ur5",
    sensing: options.SensingOption = "position",
    streams: StreamOptions = USUAL_STREAMS,
    out: Annotated[
        Path | None, option("FILE", "TOML file of the twin, for --robot of all commands.")
    ] = None,
    page: Annotated[
        Path | None,
        option("FILE.html", "Page about the twin: intervals, residuals, where it is sure."),
    ] = None,
) -> None:
    """Identify arm, camera and drive from a log, as a twin.

    A mistake of the log, such as exchanged joints, is named instead, with exit code 1.
    """
    from servobench.harness.apps.twin.drive import command_response
    from servobench.harness.apps.twin.held_out import held_out
    from servobench.harness.apps.twin.log import read_log
    from servobench.harness.apps.twin.preflight import mistakes
    from servobench.harness.apps.twin.summary import (
        Answer,
        estimates,
        held_out_line,
        remarks,
    )
    from servobench.harness.batch.logs import UnevenRows
    from servobench.harness.config.installation import check_installed
    from servobench.harness.config.sensing import find_sensing
    from servobench.harness.run.experiment import build
    from servobench.plant.robot.catalogue import ROBOTS, find_robot

    if page is not None:
        check_installed(("jinja2",), "--page")
    try:
        name, resolved, table, clocks = _logged(
            log, run, IDENTIFYING, (robot, sensing), out, streams
        )
    except UnevenRows as error:
        say(str(error))
        sys.exit(FAILED)
    request = resolved.request
    setup, own = find_sensing(request.sensing), find_robot(request.robot)
    if own.twin:
        raise ConfigurationError(
            f"{request.robot} is itself a twin, which no twin can deviate from: identify a table, such as "
            f"steps.parquet, with --robot {own.twin.keys.robot}"
        )
    if (
        log is None or not log.is_dir()
    ):  # a table does not say at which speed commands are clipped: at that of the robot
        resolved = replace(
            resolved, plant=replace(resolved.plant, max_joint_speed=float(own.limits.speed.max()))
        )
    experiment = build(resolved)
    rows = read_log(experiment.plant.spec, table, clocks=clocks)
    experiment.plant.close()
    apart = [name for name in ROBOTS if name != request.robot]  # made only for a log with a mistake
    with console.status(f"identifying {request.robot} in {len(table)} rows"):
        nominal = setup.nominal(own)
        mistake, found = mistakes(
            rows, nominal, lambda: {k: setup.nominal(find_robot(k)) for k in apart}
        )
        response = command_response(rows)
    if found is None:
        say(f"{name}: {mistake}")
        sys.exit(FAILED)
    held = held_out(rows, nominal, found)
    print_tables(
        [(f"{name} against the nominal {own.title}, where they differ", estimates(found, response))]
    )
    say("\n".join(remarks(rows, found, response)))
    say(held_out_line(rows, held))
    answer = Answer(own.title, name, rows, nominal, found, response, held)
    if page is not None:
        from servobench.harness.apps.twin.page import write_page

        with accessing(page):
            write_page(answer, page)
        say(f"page in {page}")
    if out is not None:
        _write_twin(answer, request, out)
        _say_next(out, resolved.run.period)


def _write_twin(answer: Answer, request: RunRequest, out: Path) -> None:
    """Write the file of a twin of the robot and the sensing of a request."""
    from servobench.harness.apps.twin.twin_file import twin_text
    from servobench.plant.robot.catalogue import with_files

    folder = out.resolve().parent  # where the twin looks for files first

    def beside(file: str) -> str:
        path = user_path(file)
        if path.is_file():
            return os.path.relpath(path, folder)
        return file

    with accessing(out):
        named = (with_files(request.robot, beside), request.sensing)
        text = twin_text(answer.robot, answer.log, answer.response, named, answer.held)
        write_text(out, text)


def _say_next(twin: Path, period: float) -> None:
    """Say where a twin is, and the next command, given the control period of its log [s]."""
    from servobench.harness.run.request import RunSettings

    next_one = f"servobench compare --robot {quote(str(twin))} --plants kinematic"
    if abs(period - RunSettings.period) > PERIOD_TOLERANCE * RunSettings.period:
        next_one += f" --set run.period={_as_clock(period)}"
    say(f"twin in {twin}; the next command: {next_one}")


def _as_clock(period: float) -> str:
    """Return a control period [s] as users write it: in whole milliseconds, as a rate in whole Hz, or as it is."""
    if math.isclose(round(period, 3), period, rel_tol=PERIOD_TOLERANCE):
        return f"{round(period, 3):g}"
    if math.isclose(round(1.0 / period), 1.0 / period, rel_tol=PERIOD_TOLERANCE):
        return f"{round(1.0 / period)}Hz"
    return f"{period:.6g}"


def _logged(
    log: Path | None,
    run: str | None,
    controller: str | None,
    named: tuple[str, str],
    out: Path | None,
    streams: StreamOptions,
) -> tuple[str, ResolvedRun, DataFrame, Clocks | None]:
    """Return the name of a log, the run that it is taken for, its rows, and the clocks of its streams, if any.

    The run is that of a controller, None for that of the log, with robot and sensing as named.
    """
    from servobench.harness.apps.twin.joining import joined
    from servobench.harness.batch.logs import logged_in_file, logged_in_folder
    from servobench.harness.batch.results import ResultsFolder

    read = (log, streams.joints, streams.features, streams.columns)
    if out and out.exists() and any(out.samefile(file) for file in read if file and file.exists()):
        raise ConfigurationError(f"--out {out} is the log itself; name another file")
    if streams.joints is not None:
        features = streams.features or streams.joints
        if log or run or not controller:
            raise ConfigurationError(
                "--joints is in place of a log and --run, and wants a --controller"
            )
        files = (streams.joints, features, streams.columns)
        return str(features), *joined(files, named, controller)
    if not log or streams != USUAL_STREAMS:
        raise ConfigurationError("missing argument 'LOG', or --joints with a file of joints")
    if not log.exists():
        raise ConfigurationError(f"{log} does not exist; wanted a results folder or a table")
    if log.is_dir():
        resolved, table = logged_in_folder(ResultsFolder(log), run, controller, named[1])
        for word, given, usual in (("robot", named[0], "ur5"), ("sensing", named[1], "position")):
            own = getattr(resolved.request, word)
            if given != usual and Path(given) != Path(own):
                raise ConfigurationError(
                    f"--{word} {given} is not that of the run, {own}; leave it out for a folder"
                )
        return str(log), resolved, table, None
    if run is not None:
        raise ConfigurationError(f"--run names a run of a results folder, and {log} is a table")
    if controller is None:
        raise ConfigurationError(
            f"{log} does not say which controller to show it to; name one with --controller"
        )
    return str(log), *logged_in_file(log, controller, *named), None
