"""Options that several commands share, and lists of names."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servobench.harness.cli import completion

if TYPE_CHECKING:
    from servobench.controllers.controller import ControllerEntry
    from servobench.harness.batch.campaign import Execution, Observer
    from servobench.harness.batch.trial import Tried
    from servobench.harness.batch.workers import Bounds
    from servobench.harness.config.settings import Settings
    from servobench.plant.plant import PlantEntry

DEFAULT_PLANT = "the first of bullet, mujoco and kinematic that is installed"
FAILED = 1  # exit code where a run failed, or a check was not passed
INTERRUPTED = 130  # exit code after Ctrl-C

ConfigOption = Annotated[Path | None, typer.Option("--config", help="TOML file with settings, a [section] a name.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="SECTION.KEY=VALUE", help="One setting, such as kinematic.lag=0.1.")
]
WorkersOption = Annotated[int | None, typer.Option(min=1, help="Worker processes; default: the processors.")]
SchedulerOption = Annotated[str | None, typer.Option(help="Address of a Dask scheduler that the runs are sent to.")]
TimeoutOption = Annotated[
    float | None,
    typer.Option(min=0.001, help="Time limit of a run [s], or inf; default: 600 for code that is not servobench's."),
]
MemoryOption = Annotated[
    str | None,
    typer.Option(
        metavar="SIZE",
        help="Memory limit of a run, such as 2GB, or inf; default: a share of the machine's for code that is not "
        "servobench's.",
    ),
]
IsolateOption = Annotated[
    bool,
    typer.Option(
        "--isolate/--no-isolate", help="Keep plug-ins and foreign FMUs in processes of their own, with limits."
    ),
]
NAMES = "Comma-separated names, or 'all'."
PLACES = "Comma-separated names or files, or 'all'."
PlantsOption = Annotated[str, typer.Option(help=PLACES, autocompletion=completion.listed(completion.plants))]
ControllersOption = Annotated[str, typer.Option(help=PLACES, autocompletion=completion.listed(completion.controllers))]
TasksOption = Annotated[str, typer.Option(help=NAMES, autocompletion=completion.listed(completion.tasks))]
TaskOption = Annotated[str, typer.Option(help="Name of the task.", autocompletion=completion.tasks)]
MismatchOption = Annotated[
    str,
    typer.Option(
        help="none, factory, moderate, severe, or axes: links=10%+tool=20mm.", autocompletion=completion.mismatches
    ),
]
MismatchesOption = Annotated[
    str, typer.Option(help="Comma-separated mismatches.", autocompletion=completion.listed(completion.mismatches))
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
        help="Comma-separated sensing set-ups, or 'all'.", autocompletion=completion.listed(completion.sensings)
    ),
]
SeedsOption = Annotated[str, typer.Option(help="A count (5), a list (3,1,4) or a range (100:120).")]
FolderOption = Annotated[Path, typer.Option(help="Folder for the results; with --resume the one to continue.")]
DebugOption = Annotated[bool, typer.Option("--debug", help="Stop at the first crash, in this process, with its trace.")]
StrictOption = Annotated[bool, typer.Option("--strict", help="End with exit code 1 if a run failed.")]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Continue in a folder whose runs were interrupted.")]


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


def known_robot(name: str) -> str:
    """Return the name of a robot that can be found, and print what was assumed about it."""
    from servobench.harness.cli.terminal import say
    from servobench.harness.config.robots import find_robot

    note = find_robot(name).note
    if note:
        say(note)
    return name


def split_words(text: str) -> tuple[str, ...]:
    """Split a comma-separated list."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def split_names(kind: str, text: str, known: Sequence[str], find: Callable[[str], Any]) -> tuple[str, ...]:
    """Split a comma-separated list of names, each of which `find` accepts; `all` stands for those in `known`."""
    from servobench.harness.config.settings import ConfigurationError

    if text.strip() == "all":
        return tuple(known)
    names = split_words(text)
    if not names:
        raise ConfigurationError(f"--{kind} is empty; valid: {', '.join(known)}")
    for name in names:
        find(name)
    refuse_repetition(kind, names)
    return names


def refuse_repetition(option: str, values: Sequence[object]) -> None:
    """Refuse a list that names something twice."""
    from servobench.harness.config.settings import ConfigurationError

    for value in values:
        if values.count(value) > 1:
            raise ConfigurationError(f"--{option} names {value} twice")


def split_mismatches(text: str) -> tuple[str, ...]:
    """Return the mismatches that a user named; each is read, so that a mistyped one is refused at once."""
    from servobench.harness.run.request import read_mismatch
    from servobench.plant.robot.mismatch import PROFILES

    return split_names("mismatch", text, tuple(PROFILES), read_mismatch) if text.strip() != "all" else (text,)


def one_sensing(word: str) -> str:
    """Return the sensing set-up that a user named; it is looked up, so that a mistyped one is refused at once."""
    from servobench.harness.config.sensing import find_sensing

    find_sensing(word)
    return word


def split_sensings(text: str) -> tuple[str, ...]:
    """Return the sensing set-ups that a user named; each is looked up, so that a mistyped one is refused at once."""
    from servobench.harness.config.sensing import find_sensing, sensing_names

    return split_names("sensing", text, sensing_names(), find_sensing)


def default_plant() -> str:
    """Return the plant of a run for which none is named; a line says if it is not the first choice, and why."""
    from servobench.harness.cli.terminal import say
    from servobench.harness.config.engines import default_plant

    name, why = default_plant()
    if why:
        say(f"no plant is named, so this run is on {name}: {why}")
    return name


def tell_unused(entry: type[ControllerEntry | PlantEntry], named: Sequence[str]) -> None:
    """Print a line for each entry point that is not used though a user named it, or all."""
    from servobench.harness.config.registry import ALL, unused_points

    for name, line in unused_points(entry):
        if name in named or ALL in named:
            sys.stderr.write(f"servobench: note: {line}\n")


def _usable(all_of_them: Sequence[Tried]) -> list[str]:
    """Return the names of those that can be used, with a line for each other."""
    for each in all_of_them:
        if each.fault:
            sys.stderr.write(f"servobench: left out: {each.fault}\n")
    return [each.name for each in all_of_them if not each.fault]


def split_plants(text: str, option: str = "plants", robot: str = "ur5") -> tuple[str, ...]:
    """Return the names of the plants that a user named, or whose place was given, such as ./cell.py:Cell."""
    from servobench.harness.batch.trial import try_plants
    from servobench.harness.config.registry import ALL, choose_plant, find_plant, plant_names
    from servobench.plant.plant import PlantEntry

    known, names = plant_names(), list[str]()
    for word in split_words(text):
        names += _usable(try_plants(robot)) if word == ALL else [choose_plant(word)]
    tell_unused(PlantEntry, split_words(text))
    return split_names(option, ",".join(names), known, find_plant)


def split_controllers(text: str, robot: str = "ur5") -> tuple[str, ...]:
    """Return the names of the controllers that a user named, or whose place was given, such as ./mine.py:Mine."""
    from servobench.controllers.controller import ControllerEntry
    from servobench.harness.batch.trial import try_controllers
    from servobench.harness.config.registry import ALL, choose_controller, controller_names, find_controller

    known, names = controller_names(), list[str]()
    for word in split_words(text):
        names += _usable(try_controllers(robot)) if word == ALL else [choose_controller(word)]
    tell_unused(ControllerEntry, split_words(text))
    return split_names("controllers", ",".join(names), known, find_controller)


def split_tasks(text: str) -> tuple[str, ...]:
    """Return the tasks that a user named."""
    from servobench.harness.run.tasks import TASKS, find_task

    return split_names("tasks", text, list(TASKS), find_task)
