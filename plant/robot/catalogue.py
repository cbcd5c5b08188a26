"""Robots by name or by file: `--robot ur10e`, `panda`, `random_arm:7`, `my_ur10e.yaml`, `arm.toml`, `arm.urdf`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Final

from servobench.plant.contract.files import user_path
from servobench.plant.contract.settings import suggest
from servobench.plant.robot.makers import UNIVERSAL_ROBOTS, panda, universal_robot
from servobench.plant.robot.random_arm import MAX_NUMBER, RANDOM_ARM, random_robot
from servobench.plant.robot.robot import Robot

UR5: Final = "ur5"
ROBOTS: Final[Mapping[str, Callable[[], Robot]]] = {
    title.lower(): partial(universal_robot, title) for title in UNIVERSAL_ROBOTS
} | {"panda": panda}


def find_robot(text: str) -> Robot:
    """Return the robot that a name or the path of a file stands for; the same object for the same unchanged file.

    Args:
        text: a key of `ROBOTS`, `random_arm:` and a number, or the path of a file that ends in .yaml (a factory
            calibration of Universal Robots), .toml (a DH table) or .urdf.

    Raises:
        ValueError: an unknown name, or a file that cannot be used.
    """
    if text in ROBOTS:
        return _known(text)
    kind, _, number = text.partition(":")
    if kind == RANDOM_ARM:
        if not (number.isascii() and number.isdigit() and len(number) <= len(str(MAX_NUMBER))):
            raise ValueError(f"robot {text!r}: {RANDOM_ARM} needs a colon and a number, such as {RANDOM_ARM}:7")
        return _drawn(int(number))
    path = user_path(text.partition("#")[0])
    if path.suffix.lower() not in {".yaml", ".yml", ".toml", ".urdf"}:
        raise ValueError(
            f"unknown robot {text!r}: {suggest(text, ROBOTS)}; or a file: a factory calibration (.yaml), a DH table "
            f"(.toml) or a .urdf; or an arm that is drawn, {RANDOM_ARM}:7"
        )
    try:
        changed = path.stat().st_mtime_ns
    except OSError as error:
        raise ValueError(f"robot file {path} cannot be read: {error.strerror}") from error
    return _read(text, changed)


def nominal_ur5() -> Robot:
    """Return the robot of every run that names none."""
    return _known(UR5)


@cache
def _known(name: str) -> Robot:
    return ROBOTS[name]()


@cache
def _drawn(number: int) -> Robot:
    return random_robot(number)


@cache
def _read(text: str, changed: int) -> Robot:
    from servobench.plant.robot.files import read_robot  # noqa: PLC0415 - only files need their readers

    return read_robot(text)
