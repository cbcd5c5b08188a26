"""Options of the command line, each declared once, and commands made of them.

The type of a parameter declares its option: `seed: Annotated[int, option("INTEGER", "Seed of the run.")]`.
Help pages, completion by shells, checks and the table in docs/commands.md are made from this one row. A parameter whose
type is a dataclass stands for its fields, each of which is an option.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial, wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_type_hints

import typer

from servobench.harness.cli import selection
from servobench.plant.contract.faults import ConfigurationError, configuration_errors

if TYPE_CHECKING:
    from servobench.harness.batch.campaign import Execution
    from servobench.harness.batch.plan import Batch
    from servobench.harness.batch.processes import Bounds
    from servobench.harness.config.settings import Settings

ABSENT: dict[
    tuple[Any, Any], str
] = {}  # command and option -> why it does not have this option of others


class Value(NamedTuple):
    """A kind of value that options take: its word in help pages, values that a shell offers, and its check."""

    word: str
    complete: selection.Complete | None = None
    check: selection.Choose | None = None  # returns the value of a text, or refuses it

    def several(self) -> Value:
        """Return the value of an option that takes a comma-separated list of these."""
        return Value(
            f"{self.word}S", selection.completing_lists(self.complete) if self.complete else None
        )


PLANT, CONTROLLER, ESTIMATOR, TASK, MISMATCH = (
    Value("NAME", selection.completing(kind))
    for kind in ("plants", "controllers", "estimators", "tasks", "mismatch")
)
ROBOT, SENSING = (
    Value("NAME", selection.completing(kind), partial(selection.choose, kind))
    for kind in ("robot", "sensing")
)


def named_option(
    name: str,
    value: Value | str,
    words: str,
    absent: Mapping[str, str] | None = None,
    **further: Any,  # noqa: ANN401 - any argument of typer.Option
) -> Any:  # noqa: ANN401 - typer's own word for it
    """Declare an option whose name is not that of its parameter.

    Args:
        name: with its dashes; `--on/--off` for a switch with two names, `--output -o` for a short one; empty for the
            name of the parameter.
        value: kind of its value, or only the word for it; empty for a switch.
        words: meaning, for help pages; unit in brackets.
        absent: command without this option -> the reason.
        further: arguments of `typer.Option`, such as `min` and `rich_help_panel`.
    """
    kind = value if isinstance(value, Value) else Value(value)
    ABSENT.update(((command, name), reason) for command, reason in (absent or {}).items())

    def check(context: typer.Context, text: Any) -> Any:  # noqa: ANN401 - typer's own word for it
        if kind.check is None or text is None or context.resilient_parsing:
            return text
        return kind.check(text)

    return typer.Option(
        *name.split(), metavar=kind.word, help=words, autocompletion=kind.complete,
        callback=check if kind.check else None, **further,
    )  # fmt: skip


def switch(name: str, words: str, **further: Any) -> Any:  # noqa: ANN401 - as above
    """Declare a switch; see `named_option`."""
    return named_option(name, "", words, **further)


EXECUTION = "Execution"  # panel of workers, limits and resuming
option = partial(named_option, "")  # called as its parameter
execution_option = partial(option, rich_help_panel=EXECUTION)
execution_switch = partial(switch, rich_help_panel=EXECUTION)


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Return a function as a command that typer can read, with its dataclasses taken apart into options."""
    hints = get_type_hints(function, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    rows = []
    camera = (
        [("camera", None, CameraOption)] if (function.__name__, "--camera") not in ABSENT else []
    )
    for name, parameter in signature(function).parameters.items():
        rows += camera if name == "robot" else []
        if name not in groups:
            rows.append((name, parameter.default, hints[name]))
            continue
        types = get_type_hints(groups[name], include_extras=True)
        given = {} if parameter.default is Parameter.empty else vars(parameter.default)
        rows += [
            (each.name, given.get(each.name, each.default), types[each.name])
            for each in fields(groups[name])
        ]
        rows += camera if "robot" in types else []

    @wraps(function)
    def call(**values: Any) -> None:  # noqa: ANN401 - those of the options
        from servobench.harness.config.registry import offering

        if (camera := values.pop("camera", None)) is not None:
            from servobench.plant.robot.catalogue import DEFAULT_ROBOT, with_camera

            values["robot"] = with_camera(values["robot"] or DEFAULT_ROBOT, camera)
        if values.get("mismatch") == DEFAULT_MISMATCH and values.get("robot"):
            from servobench.plant.robot.catalogue import find_robot

            values["mismatch"] = "none" if find_robot(values["robot"]).twin else DEFAULT_MISMATCH
        for name, group in groups.items():
            values[name] = group(**{each.name: values.pop(each.name) for each in fields(group)})
        with (
            offering()
        ):  # a user's own controllers have their names for as long as the command takes
            function(**values)

    keyword = partial(Parameter, kind=Parameter.KEYWORD_ONLY)
    parameters = [keyword(name, default=default, annotation=hint) for name, default, hint in rows]
    vars(call)["__signature__"] = Signature(parameters)
    call.__annotations__ = {each.name: each.annotation for each in parameters}
    return call


DEFAULT_MISMATCH = "moderate"
AXES = "none, factory, lab, moderate, severe, or axes, such as links=10%+tool=20mm"
LISTED = "Comma-separated names or files, or 'all'; servobench {} lists them."
ROBOT_WORDS = (
    "ur3, ur5, ur10, ur3e, ur5e, ur10e, panda, or a file: "
    "UR calibration (.yaml), DH table or twin (.toml), .urdf."
)
CAMERA_WORDS = (
    "Your camera: a .toml, a camera_info.yaml of ROS or a file of OpenCV, in place of the bench's."
)
SENSING_WORDS = "position, pixel, stereo, plate or a file; pixel:hand for a camera on the hand."
NO_WORLD = {  # command -> why it has neither --robot nor --camera nor --sensing
    "suite": "challenges are graded on the UR5 and the ball in 3-D, with the camera of their files; compare and sweep "
    "take others",
    "tune": "methods are tuned on the UR5 alone, by the ball in 3-D before the bench's camera, and others take these "
    "settings in natural units; compare shows how they do",
}
NO_CAMERA = {
    "analyse": "its loops are those of the ball in 3-D before the bench's camera; compare shows how a method does"
}
NO_SENSING = {
    "play": "its page shows the ball in space; figures of run --sensing show pixels",
    "controllers": "settings of a controller are the same under all sensing",
}
RobotOption = Annotated[str, named_option("--robot", ROBOT, ROBOT_WORDS, NO_WORLD)]
# Every command that has --robot has --camera, too.
CameraOption = Annotated[
    Path | None, named_option("--camera", "FILE", CAMERA_WORDS, NO_WORLD | NO_CAMERA)
]
SensingOption = Annotated[
    str, named_option("--sensing", SENSING, SENSING_WORDS, NO_WORLD | NO_CAMERA | NO_SENSING)
]
PlantsOption = Annotated[str, option(PLANT.several(), LISTED.format("plants"))]
ControllersOption = Annotated[str, option(CONTROLLER.several(), LISTED.format("controllers"))]
TasksOption = Annotated[
    str, option(TASK.several(), "Comma-separated names, or 'all'; servobench tasks lists them.")
]
TaskOption = Annotated[str, option(TASK, "Name of the task; servobench tasks lists them.")]
MismatchOption = Annotated[
    str, option(MISMATCH, f"Difference of the true robot from the nominal one: {AXES}.")
]
SeedsOption = Annotated[str, option("SEEDS", "A count (5), a list (3,1,4) or a range (100:120).")]
FolderOption = Annotated[
    Path,
    named_option("--out", "FOLDER", "Folder for the results; with --resume the one to continue."),
]
RunIdOption = Annotated[
    str | None,
    named_option("--run", "RUN_ID", "The run_id, where the folder has more than one run."),
]
ShownOption = Annotated[
    str,
    named_option(
        "--controllers",
        "NAMES",
        "Comma-separated names, in this order; default: all of the folder.",
    ),
]
NamesOption = Annotated[
    str,
    named_option(
        "--names",
        "NAMES",
        "Their names here: CONTROLLER=NAME,..., or all in the order of --controllers.",
    ),
]
MetricsOption = Annotated[
    list[str] | None,
    named_option(
        "--metric", "PLACE", "A metric of yours, such as ./mine.py:itae; may be repeated."
    ),
]
UntilDecidedOption = Annotated[
    bool,
    switch(
        "--until-decided",
        "Look after every 16 seeds; end when each pair is better, worse or equivalent, or --seeds are spent.",
    ),
]
AgainstOption = Annotated[
    str | None, option("NAME", "Only pairs with this controller, which is A in them.")
]
JsonOption = Annotated[bool, switch("--json", "Print JSON, for other programs.")]
DebugOption = Annotated[
    bool,
    execution_switch("--debug", "Run in this process, and stop at the first crash with its trace."),
]


@dataclass(frozen=True)
class Combinations:
    """The runs of a comparison or a sweep: all combinations of these names and seeds."""

    plants: PlantsOption = "kinematic"
    controllers: ControllersOption = "all"
    tasks: TasksOption = "exp1,exp2,exp3,exp4,circle"
    mismatch: Annotated[str, option(MISMATCH.several(), f"Comma-separated: {AXES}.")] = (
        DEFAULT_MISMATCH
    )
    robot: RobotOption = "ur5"
    sensing: Annotated[
        str,
        option(
            SENSING.several(),
            "Comma-separated: position, pixel, stereo, plate or files, or 'all'; pixel:hand for a camera on the hand.",
        ),
    ] = "position"
    seeds: SeedsOption = "1"

    def batch(self) -> Batch:
        """Return them as the planner takes them, each name looked up.

        Raises:
            ConfigurationError: a name that is unknown or given twice, or seeds that cannot be read.
        """
        from servobench.harness.batch.plan import Batch, parse_seeds

        return Batch(
            selection.split("plants", self.plants, robot=self.robot),
            selection.split("controllers", self.controllers, robot=self.robot),
            selection.split("tasks", self.tasks),
            selection.split("mismatch", self.mismatch),
            parse_seeds(self.seeds),
            self.robot,
            selection.split("sensing", self.sensing),
        )


@dataclass(frozen=True)
class Limited:
    """Limits of a single run."""

    run_timeout: Annotated[
        float | None,
        execution_option(
            "SECONDS",
            "Time limit of a run [s], or inf; default: 600 for code that is not servobench's.",
            min=0.001,
        ),
    ] = None
    run_memory: Annotated[
        str | None,
        execution_option(
            "SIZE",
            "Memory limit of a run, such as 2GB, or inf; default: a share of the machine's for code that is not "
            "servobench's.",
        ),
    ] = None
    isolate: Annotated[
        bool,
        execution_switch(
            "--isolate/--no-isolate",
            "Keep plug-ins and foreign FMUs in processes of their own, with limits.",
        ),
    ] = True

    def bounds(self) -> Bounds:
        """Return them as the driver takes them.

        Raises:
            ConfigurationError: a memory limit that is no size.
        """
        from servobench.harness.batch.processes import Bounds, read_size

        with configuration_errors("--run-memory: "):
            memory = None if self.run_memory is None else read_size(self.run_memory)
        return Bounds(self.run_timeout, memory, self.isolate)


@dataclass(frozen=True)
class Place(Limited):
    """Processors or cluster that carry runs out."""

    workers: Annotated[
        int | None,
        execution_option("COUNT", "Worker processes; default: one for each processor.", min=1),
    ] = None
    scheduler: Annotated[
        str | None,
        execution_option("ADDRESS", "Address of a Dask scheduler to which runs are sent."),
    ] = None


@dataclass(frozen=True)
class Running(Place):
    """Execution of runs that can be resumed."""

    resume: Annotated[
        bool, execution_switch("--resume", "Continue in a folder whose runs were interrupted.")
    ] = False

    def execution(self) -> Execution:
        """Return it as the driver takes it."""
        from servobench.harness.batch.campaign import Execution

        return Execution(self.workers, self.scheduler, self.bounds(), self.resume)


@dataclass(frozen=True)
class Batched(Running):
    """Execution of a batch or of a part of it, and treatment of runs that fail."""

    part: Annotated[
        str,
        execution_option(
            "K/N", "Carry out part K of N of the runs only; servobench merge puts parts together."
        ),
    ] = "1/1"
    debug: DebugOption = False
    strict: Annotated[
        bool, execution_switch("--strict", "End with exit code 1 if a run failed.")
    ] = False

    def execution(self) -> Execution:
        """Return it as the driver takes it; runs that are debugged go one by one in this process.

        Raises:
            ConfigurationError: --part does not name one of N parts, or processes or a limit for runs that are debugged.
        """
        words = self.part.split("/")
        if (
            len(words) != 2
            or not all(map(str.isdecimal, words))
            or not 1 <= int(words[0]) <= int(words[1])
        ):
            raise ConfigurationError(
                f"--part names a part of how many, 1/40 to 40/40 for instance, got {self.part!r}"
            )
        how = replace(super().execution(), part=(int(words[0]), int(words[1])))
        if not self.debug:
            return how
        given = {
            "--workers": self.workers not in (None, 1),
            "--scheduler": self.scheduler,
            "--run-timeout": self.run_timeout,
            "--run-memory": self.run_memory,
        }
        for option, value in given.items():
            if value:
                raise ConfigurationError(
                    f"--debug carries runs out one by one in this process; leave {option} away"
                )
        return replace(how, workers=1, debug=True)


@dataclass(frozen=True)
class Overrides:
    """Settings that a user gives."""

    set_: Annotated[
        list[str] | None,
        named_option(
            "--set", "KEY=VALUE", "One setting, such as kinematic.lag=0.1; may be repeated."
        ),
    ] = None
    config: Annotated[
        Path | None,
        option("FILE", "TOML file with settings; a [section] for each plant, controller or task."),
    ] = None

    def settings(self, *further: str) -> Settings:
        """Return them, with `further` assignments on top."""
        from servobench.harness.config.settings import read_settings

        return read_settings(self.config, [*(self.set_ or []), *further])


@dataclass(frozen=True)
class RunOverrides(Overrides):
    """Settings of runs that a user gives."""

    compiled: Annotated[
        bool, execution_switch("--compiled", "Step composed controllers in C: run.compiled=true.")
    ] = False

    def settings(self, *further: str) -> Settings:
        """Return them, with `further` assignments on top."""
        return super().settings(*["run.compiled=true"] * self.compiled, *further)
