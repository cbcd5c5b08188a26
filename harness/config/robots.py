"""Robots and sensing set-ups by the words that users give: names of this package, or files of the user."""

import re
from functools import lru_cache
from pathlib import Path
from typing import Final

from servobench.harness.config.source import PLACE, SourceFile
from servobench.plant.cameras.registry import FIXED, HAND, SETUPS, Sensing
from servobench.plant.cameras.setups import SensingSetup
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.robot import catalogue, ur5
from servobench.plant.robot.robot import Robot

DEFAULT_ROBOT: Final = ur5.UR5
OWN_ROBOT: Final = "own"  # in the column `robot`: the plant brings it


@configuration_errors()
def find_robot(name: str) -> Robot:
    """Return the robot that a name or the path of a file stands for.

    Raises:
        ConfigurationError: an unknown name, or a file that cannot be used.
    """
    return catalogue.find_robot(name)


def with_camera(robot: str, camera: Path) -> str:
    """Return the word for a robot with the camera of a file in place of the bench's.

    Raises:
        ConfigurationError: a robot or a file that cannot be used.
    """
    word = f"{robot}{catalogue.WITH}{camera}"
    find_robot(word)
    return word


def short_name(robot: str) -> str:
    """Return the word for a robot, and for its camera, without the folders of files."""
    return catalogue.WITH.join(Path(part).name for part in robot.split(catalogue.WITH))


def sensing_names() -> list[str]:
    """Return the words of all sensing set-ups of this package, each with fixed cameras and with cameras on the hand."""
    return [str(Sensing(setup, mount)) for setup in SETUPS.values() for mount in (FIXED, HAND)]


def find_sensing(word: str) -> Sensing:
    """Return the sensing that a word stands for, such as `pixel`, `stereo:hand` or `./polar.py:hand`.

    Raises:
        ConfigurationError: an unknown word, or a file that cannot be used.
    """
    return _find(word, sensing_file(word))


@lru_cache(maxsize=64)
def _find(word: str, file: SourceFile | None) -> Sensing:
    place, found = _place(word)
    own = {} if file is None or found is None else {place: _pick(file, found["file"], found["name"])}
    with configuration_errors():
        return Sensing.parse(word, {**SETUPS, **own})


def sensing_file(word: str) -> SourceFile | None:
    """Return the file of a user's own set-up; None for one of this package."""
    _, found = _place(word)
    return SourceFile.read(found["file"]) if found is not None and found["file"] else None


def sensing_place(word: str) -> str:
    """Return a word without its mount."""
    place, _, mount = word.rpartition(":")
    return place if mount in (FIXED, HAND) else word


def _place(word: str) -> tuple[str, re.Match[str] | None]:
    """Return a word without its mount, and the file and the name in it where it is those of a user."""
    place = sensing_place(word)
    return place, PLACE.fullmatch(place)


def _pick(source: SourceFile, file: str, name: str | None) -> SensingSetup:
    """Return the set-up called `name` that a file defines, or without a name its only one."""
    module, known = source.load(), SETUPS.values()
    found = {
        key: value for key, value in vars(module).items() if isinstance(value, SensingSetup) and value not in known
    }
    if name is None and len(found) == 1:
        return next(iter(found.values()))
    if name in found:
        return found[name]
    if not found:
        raise ConfigurationError(
            f"{file} defines no sensing set-up: no object of servobench.plant.cameras.setups.SensingSetup"
        )
    first, *_ = found
    wrong = f"has no sensing set-up {name!r}" if name else "has several sensing set-ups"
    raise ConfigurationError(f"{file} {wrong}: it defines {', '.join(found)}; name one, such as {file}:{first}")
