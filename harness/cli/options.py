"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from rich.markup import escape

from servobench.harness.cli import completion

if TYPE_CHECKING:
    from servobench.harness.batch.campaign import Execution, Observer
    from servobench.harness.batch.workers import Bounds
    from servobench.harness.config.settings import Settings

DEFAULT_PLANT = "the first of bullet, mujoco and kinematic that is installed"
FAILED = 1  # exit code where a run failed, or a check was not passed
INTERRUPTED = 130  # exit code after Ctrl-C
EXECUTION = "Execution"  # title of the options that say how runs are carried out

ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", help="TOML file with settings; a [section] for each plant, controller or task."),
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="One setting, such as kinematic.lag=0.1; may be repeated.")
]
WorkersOption = Annotated[
    int | None,
    typer.Option(min=1, help="Worker processes; default: one for each processor.", rich_help_panel=EXECUTION),
]
SchedulerOption = Annotated[
    str | None, typer.Option(help="Address of a Dask scheduler to which runs are sent.", rich_help_panel=EXECUTION)
]
TimeoutOption = Annotated[
    float | None,
    typer.Option(
        min=0.001,
        help="Time limit of a run [s], or inf; default: 600 for code that is not servobench's.",
        rich_help_panel=EXECUTION,
    ),
]
MemoryOption = Annotated[
    str | None,
    typer.Option(
        help="Memory limit of a run, such as 2GB, or inf; default: a share of the machine's for code that is not "
        "servobench's.",
        rich_help_panel=EXECUTION,
    ),
]
IsolateOption = Annotated[
    bool,
    typer.Option(
        "--isolate/--no-isolate",
        help="Keep plug-ins and foreign FMUs in processes of their own, with limits.",
        rich_help_panel=EXECUTION,
    ),
]


def _listed(what: str, complete: Callable[[str], list[str]], kinds: str = "names or files") -> Any:  # noqa: ANN401
    """Return the option for several of what a command lists."""
    return typer.Option(
        help=f"Comma-separated {kinds}, or 'all'; servobench {what} lists them.",
        autocompletion=completion.listed(complete),
    )


PlantsOption = Annotated[str, _listed("plants", completion.plants)]
ControllersOption = Annotated[str, _listed("controllers", completion.controllers)]
TasksOption = Annotated[str, _listed("tasks", completion.tasks, "names")]
TaskOption = Annotated[
    str, typer.Option(help="Name of the task; servobench tasks lists them.", autocompletion=completion.tasks)
]
MismatchOption = Annotated[
    str,
    typer.Option(
        help="How far the true robot is from the nominal one: none, factory, moderate, severe, or axes, such as "
        "links=10%+tool=20mm.",
        autocompletion=completion.mismatches,
    ),
]
MismatchesOption = Annotated[
    str,
    typer.Option(
        metavar="NAMES",
        help="Comma-separated: none, factory, moderate, severe, or axes, such as links=10%+tool=20mm.",
        autocompletion=completion.listed(completion.mismatches),
    ),
]
RobotOption = Annotated[
    str,
    typer.Option(
        help="ur3, ur5, ur10, ur3e, ur5e, ur10e, panda, or a file: a UR calibration (.yaml), DH table (.toml), .urdf.",
        autocompletion=completion.robots,
    ),
]
SensingOption = Annotated[
    str,
    typer.Option(
        help="position, pixel, stereo, plate or a file; pixel:hand for a camera on the hand.",
        autocompletion=completion.sensings,
    ),
]
SensingsOption = Annotated[
    str,
    typer.Option(
        metavar="NAMES",
        help="Comma-separated: position, pixel, stereo, plate or files, or 'all'; pixel:hand for a camera on the hand.",
        autocompletion=completion.listed(completion.sensings),
    ),
]
SeedsOption = Annotated[str, typer.Option(help="A count (5), a list (3,1,4) or a range (100:120).")]
FolderOption = Annotated[Path, typer.Option(help="Folder for the results; with --resume the one to continue.")]
DebugOption = Annotated[
    bool,
    typer.Option(
        "--debug", help="Run in this process, and stop at the first crash with its trace.", rich_help_panel=EXECUTION
    ),
]
StrictOption = Annotated[
    bool, typer.Option("--strict", help="End with exit code 1 if a run failed.", rich_help_panel=EXECUTION)
]
ResumeOption = Annotated[
    bool, typer.Option("--resume", help="Continue in a folder whose runs were interrupted.", rich_help_panel=EXECUTION)
]


@dataclass(frozen=True)
class Limited:
    """What a command lets a run take."""

    run_timeout: TimeoutOption = None
    run_memory: MemoryOption = None
    isolate: IsolateOption = True

    def bounds(self) -> Bounds:
        """Return it as the driver takes it.

        Raises:
            ConfigurationError: a memory limit that is no size.
        """
        from servobench.harness.batch.guard import read_size
        from servobench.harness.batch.workers import Bounds
        from servobench.harness.config.settings import ConfigurationError

        try:
            memory = None if self.run_memory is None else read_size(self.run_memory)
        except ValueError as error:
            raise ConfigurationError(f"--run-memory: {error}") from error
        return Bounds(self.run_timeout, memory, self.isolate)


@dataclass(frozen=True)
class Place(Limited):
    """Where a command carries runs out."""

    workers: WorkersOption = None
    scheduler: SchedulerOption = None


@dataclass(frozen=True)
class Running(Place):
    """How a command carries runs out that can be resumed."""

    resume: ResumeOption = False

    def execution(self, observer: Observer | None = None) -> Execution:
        """Return it as the driver takes it."""
        from servobench.harness.batch.campaign import Execution, Observer

        return Execution(self.workers, self.scheduler, self.bounds(), self.resume, observer or Observer())


@dataclass(frozen=True)
class Judging:
    """What a command does about runs that fail."""

    debug: DebugOption = False
    strict: StrictOption = False

    def execution(self, running: Running) -> Execution:
        """Return how runs are carried out: as asked for, but one by one in this process where they are debugged.

        Raises:
            ConfigurationError: processes or a time limit for runs that are debugged.
        """
        from servobench.harness.config.settings import ConfigurationError

        how = running.execution()
        if not self.debug:
            return how
        given = {
            "--workers": how.workers not in (None, 1),
            "--scheduler": how.scheduler,
            "--run-timeout": how.bounds.run_timeout,
            "--run-memory": how.bounds.run_memory,
        }
        for option, value in given.items():
            if value:
                raise ConfigurationError(f"--debug carries runs out one by one in this process; leave {option} away")
        return replace(how, workers=1, debug=True)


@dataclass(frozen=True)
class Overrides:
    """Settings that a user gives."""

    set_: SetOption = None
    config: ConfigOption = None

    def settings(self, *further: str) -> Settings:
        """Return them, with `further` assignments on top."""
        from servobench.harness.config.settings import read_settings

        return read_settings(self.config, [*(self.set_ or []), *further])


LIMITED, PLACE, RUNNING, JUDGING, OVERRIDES = Limited(), Place(), Running(), Judging(), Overrides()  # as defaults


VALUES = {  # what a value is -> the long names of the options that take it
    "NAME": "controller division estimator format jacobian mismatch plant robot sensing task",
    "NAMES": "axes controllers kinds plants platforms tasks",
    "SEEDS": "seeds",
    "INTEGER": "fmi offset seed study-seed",
    "COUNT": "robots search studies trials workers",
    "NUMBER": "never",
    "NUMBERS": "noise",
    "SECONDS": "begin latency length limit period run-timeout",
    "SIZE": "run-memory",
    "KEY=VALUE": "set",
    "AXIS=VALUES": "vary",
    "FILE": "config output",
    "FOLDER": "folder out",
    "RUN_ID": "run",
    "COLUMN": "metric",
    "ADDRESS": "scheduler",
}
WORDS = {option: word for word, options in VALUES.items() for option in options.split()}
HELP_NAMES = ["-h", "--help"]
COMPLETION_HELP = {  # by the option that typer adds
    "install_completion": "Let this shell complete names.",
    "show_completion": "Print the completion script instead of installing it.",
}


def word(root: Any) -> None:  # noqa: ANN401 - typer's own classes have no public name
    """Name the values in the help of a command and its subcommands, instead of their types in Python.

    Help texts are taken as they stand: `[s]` is a unit and no markup.
    """
    waiting = [root]
    while waiting:
        each = waiting.pop()
        waiting += getattr(each, "commands", {}).values()
        for option in (*each.params, each.get_help_option(typer.Context(each, help_option_names=HELP_NAMES))):
            option.help = COMPLETION_HELP.get(option.name) or escape(option.help or "")
            if option.param_type_name == "argument":
                option.metavar = option.metavar or option.name.upper()
                option.display_type_rich = _untyped
            elif option.is_flag:
                option.metavar = ""
            else:
                option.metavar = option.metavar or WORDS[option.opts[0].removeprefix("--")]


def _untyped(ctx: object) -> None:
    """Return no type: the help of an argument says what it is."""


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that has, for each parameter that is a dataclass, the fields of this class as options."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    parameters = []
    for name, parameter in signature(command).parameters.items():
        if name in groups:
            own = get_type_hints(groups[name], include_extras=True)
            options: list[tuple[str, Any, Any]] = [
                (each.name, each.default, own[each.name]) for each in fields(groups[name])
            ]
        else:
            options = [(name, parameter.default, hints[name])]
        parameters += [Parameter(key, Parameter.KEYWORD_ONLY, default=default, annotation=hint)
                       for key, default, hint in options]  # fmt: skip

    @wraps(command)
    def call(**values: Any) -> None:  # noqa: ANN401 - those of the options
        from servobench.harness.config.registry import offering

        for name, group in groups.items():
            values[name] = group(**{each.name: values.pop(each.name) for each in fields(group)})
        with offering():  # a user's own controllers have their names for as long as the command takes
            command(**values)

    vars(call).update(
        __signature__=Signature(parameters), __annotations__={each.name: each.annotation for each in parameters}
    )
    return call
