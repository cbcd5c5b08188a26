"""Challenges: named worlds that tell methods apart, a TOML file each.

    title, why         the world in some words, and a sentence of physics
    task, mismatch     as of a run; period [s], latency [s] and noise (a factor) where they differ from the usual ones
    measure            settling: the settling time of a move; later: of the third and later moves of a sequence; path:
                       the RMS error of the judged part, as of the last lap
    reference          methods that know the true robot; on each robot the better one bounds the others. They run on
                       the first `reference_seeds` robots, or on all
    [settings]         further settings, SECTION.KEY = VALUE, of the sections run, plant and task
    plants             those on which it is carried out unless a user names others
    camera             a file with the camera of a user, in place of the bench's
    [grade]            name, date and the mean scores of the methods that gave it, written once

Grade I: all equipped methods pass. II: the best and the worst of them differ by a factor of three or by 30 points of
lost runs, or another one is the first beyond its interval. III: the best is below half of the reference's score. The
files of the folder `challenges` are known by their names; a user adds a challenge by the path of a file. The files of
its camera, of the code of its task and of the setting task.file are found from its folder.
"""

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Literal, NamedTuple

from servobench.harness.batch.plan import Batch, Cell
from servobench.harness.config.registry import find_controller, find_plant
from servobench.harness.config.settings import Settings, flatten
from servobench.harness.config.source import find_place
from servobench.harness.run.references import TaskKind
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.harness.run.sampling import draw
from servobench.harness.run.tasks import choose_task
from servobench.harness.run.variations import SHORT_NAMES
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import Record, read_toml, user_path
from servobench.plant.contract.settings import (
    Count,
    Names,
    NonNegative,
    Number,
    Positive,
    nested,
    override,
    settings,
    suggest,
)
from servobench.plant.robot.catalogue import DEFAULT_ROBOT, with_camera

GRADES = ("I", "II", "III")
SUFFIX = ".toml"
OWN_SECTIONS = ("run.", "plant.", "task.")  # whose settings a challenge may change
FOLDER = files("servobench.harness.apps.studies") / "challenges"


class Measure(NamedTuple):
    """The measure of a challenge."""

    column: str  # column of the table of runs; less is better
    floor: float  # value below which a difference does not count [unit of the column]
    factor: float  # from the column to the unit in which it is shown
    unit: str  # unit in which it is shown
    achieved: str  # the word for a run that is not lost
    kind: TaskKind | None = None  # kind of the tasks for which it is; None for all
    tasks: str = ""  # word for these tasks
    whole: bool = True  # whether a run whose outcome is bad is lost, or only one without a value


MEASURES: Mapping[str, Measure] = {
    "settling": Measure("settling_time_s", 0.05, 1.0, "s", "settled", "point_to_point", "moves"),
    "later": Measure(
        "settling_time_later_s", 0.05, 1.0, "s", "settled", "sequence", "sequences", whole=False
    ),
    "path": Measure("rms_error_evaluated", 0.0015, 1000.0, "mm", "followed"),
}


@settings
class Grade:
    """How hard a challenge was on the day on which it was graded; see the module."""

    name: Literal["", "I", "II", "III"] = ""
    date: datetime.date | None = None
    scores: dict[str, Number] = field(default_factory=dict)


@settings
class Challenge:
    """A named world: the stem of its file, and the keys in it; see the module."""

    name: str
    title: str = ""
    why: str = ""
    task: str = ""
    mismatch: str = "moderate"
    measure: Literal["settling", "later", "path"] = "settling"
    reference: Names = ()
    plants: Names = ("kinematic",)
    camera: str = ""
    period: Positive | None = None
    latency: NonNegative | None = None
    noise: NonNegative | None = None
    settings: Record = field(default_factory=dict)
    reference_seeds: Count | None = None
    grade: Grade = nested(Grade)

    def cells(
        self,
        plants: Sequence[str],
        controllers: Sequence[str],
        seeds: Sequence[int],
        bounded: int | None = None,
    ) -> list[Cell]:
        """Return the runs of methods and references.

        Args:
            plants: names; none for those of the file.
            controllers: names of methods.
            seeds: of the robots.
            bounded: number of robots on which the references run; None for that of the file.
        """
        given = {name: getattr(self, name) for name in SHORT_NAMES}
        short = {name: value for name, value in given.items() if value is not None}
        varied = tuple((short | flatten(self.settings)).items())
        robot = with_camera(DEFAULT_ROBOT, Path(self.camera)) if self.camera else DEFAULT_ROBOT
        world = partial(
            Batch,
            tuple(plants) or self.plants,
            tasks=(self.task,),
            mismatches=(self.mismatch,),
            robot=robot,
        )
        methods = tuple(name for name in controllers if name not in self.reference)
        seeds_by_names = {methods: seeds, self.reference: seeds[: bounded or self.reference_seeds]}
        requests: list[RunRequest] = []
        for names, own in seeds_by_names.items():
            requests += world(names, seeds=own).requests()
        return [Cell(replace(request, varied=varied)) for request in requests]

    def check(self) -> None:
        """Refuse a challenge that cannot be carried out or judged.

        Raises:
            ValueError: names it.
        """
        for key in ("title", "why", "reference"):
            if not getattr(self, key):
                raise ValueError(f"{key} is missing")
        for name in self.reference:
            if not find_controller(name).needs_truth:
                raise ValueError(
                    f"reference {name} does not know the true robot; wanted calibrated, nmpc_calibrated"
                )
        for key in flatten(self.settings):
            if not key.startswith(OWN_SECTIONS):
                raise ValueError(
                    f"settings: {key} must begin with one of {', '.join(OWN_SECTIONS)}"
                )
        first = self.cells((), (), [0])[0]
        run = resolve(first.request, Settings())
        own_robot = find_plant(run.request.plant).own_robot
        # A plant with a robot of its own draws no scenario here.
        measure = MEASURES[self.measure]
        if measure.kind is None or own_robot:
            return
        kind = draw(run).scenario.kind
        if kind != measure.kind:
            fit = next(name for name, each in MEASURES.items() if each.kind in (kind, None))
            raise ValueError(
                f"measure {self.measure} is for {measure.tasks}, and {self.task} is a {kind}; wanted {fit}"
            )


def challenge_names() -> list[str]:
    """Return the names of the challenges of this package."""
    names = [file.name for file in FOLDER.iterdir()]
    return sorted(name.removesuffix(SUFFIX) for name in names if name.endswith(SUFFIX))


def choose_challenges(words: Sequence[str], grades: Sequence[str]) -> list[Challenge]:
    """Return the challenges of names or files; of these grades only, if any are named.

    Raises:
        ConfigurationError: an unknown grade, two files of one name, or no challenge of these grades.
    """
    for grade in grades:
        if grade not in GRADES:
            raise ConfigurationError(f"unknown grade {grade!r}: wanted {', '.join(GRADES)}")
    found = [find_challenge(word) for word in words]
    names = [each.name for each in found]
    if again := [name for name in names if names.count(name) > 1]:
        raise ConfigurationError(
            f"two challenges are called {again[0]}; give one of the files another name"
        )
    found.sort(key=lambda each: each.grade.name or "ungraded")
    chosen = [each for each in found if not grades or each.grade.name in grades]
    if not chosen:
        raise ConfigurationError(
            f"none of these challenges is of grade {' or '.join(grades)}: {', '.join(names)}"
        )
    return chosen


def find_challenge(word: str) -> Challenge:
    """Return the challenge of a name or of a file that ends in `.toml`.

    Raises:
        ConfigurationError: there is none, or one line with the fault of its file.
    """
    is_own = word.lower().endswith(SUFFIX)
    if not is_own and word not in challenge_names():
        raise ConfigurationError(
            f"unknown challenge {word!r}: {suggest(word, challenge_names())}, or a {SUFFIX} file"
        )
    path = user_path(word) if is_own else Path(str(FOLDER / f"{word}{SUFFIX}"))
    values = read_toml("challenge", path)
    with configuration_errors(f"{path}: "):
        challenge = override("challenge", Challenge(path.stem), values)
        task = challenge.task
        if (place := find_place(task)) and place["file"]:
            before = place.string[: place.start("file")]
            behind = place.string[place.end("file") :]
            task = f"{before}{_seen(path, place['file'])}{behind}"
        given = flatten(challenge.settings)
        if "task.file" in given:
            given["task.file"] = _seen(path, given["task.file"])
        camera = _seen(path, challenge.camera) if challenge.camera else ""
        challenge = replace(challenge, task=choose_task(task), camera=camera, settings=given)
        challenge.check()
    return challenge


def _seen(challenge: Path, file: str) -> str:
    """Return the path of a file that a challenge names relative to its own folder."""
    return str(challenge.parent / user_path(str(file)))
