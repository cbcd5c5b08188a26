"""Robots by name or by file: `--robot ur10e`, `panda`, `random_arm:7`, `my_ur10e.yaml`, `arm.toml`, `arm.urdf`.

A robot with the file of a user's camera is `ur10e with my_camera.toml`.

A random arm is drawn from its number: the number of joints, lengths and offsets of the links, twists and the signs of
the gears. It is as long as a UR5, and drawn again until it can work at the bench. The tool on its flange and the turn
of the camera are those of the run's mismatch. Controllers know the joint limits and the number of features, no model.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path, PurePath
from typing import NamedTuple

import numpy as np

from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import (
    divisions,
    is_file,
    kept_while_unchanged,
    read_toml,
    user_path,
)
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.settings import Section, suggest
from servobench.plant.robot.arm import SerialArm, arm_from_dh, narrow_limits, numbered_joints
from servobench.plant.robot.camera_file import read_camera
from servobench.plant.robot.makers import UNIVERSAL_ROBOTS, panda, universal_robot
from servobench.plant.robot.robot import Robot, estimate_links
from servobench.plant.robot.twin import read_twin
from servobench.plant.robot.ur5 import UR5
from servobench.plant.robot.workspace import search_workspace, with_ball

ROBOTS = {title.lower(): partial(universal_robot, title) for title in UNIVERSAL_ROBOTS} | {
    "panda": panda
}
"""The arms by their makers' tables; each is made once."""
DEFAULT_ROBOT = UR5
WITH = " with "  # between a robot and the file of its camera
# The suffixes of files of robots, and one that is refused
SUFFIXES = (".yaml", ".yml", ".toml", ".urdf", ".xacro")


@configuration_errors()
def find_robot(text: str) -> Robot:
    """Return the robot that a name or the path of a file stands for; the same object for the same unchanged file.

    Args:
        text: a key of `ROBOTS`, `random_arm:` and a number, or the path of a file that ends in .yaml (a factory
            calibration of Universal Robots), .toml (a DH table) or .urdf, and after that #LINK, the link that carries
            the ball; each also with the file of a camera.

    Raises:
        ConfigurationError: an unknown name, or a file that cannot be used.
    """
    word = read_word(text)
    if word.camera:
        return _equipped(find_robot(text.removesuffix(WITH + word.camera)), word.camera)
    if text in ROBOTS:
        return ROBOTS[text]()
    kind, _, number = text.partition(":")
    if kind == RANDOM_ARM:
        is_number = number.isascii() and number.isdigit()
        if not is_number or len(number) > len(str(MAX_NUMBER)):
            raise ValueError(
                f"robot {text!r}: {RANDOM_ARM} needs a colon and a number, such as {RANDOM_ARM}:7"
            )
        return random_robot(int(number))
    before_link = text.partition("#")[0]
    if PurePath(before_link).suffix.lower() == ".xacro":
        from servobench.plant.robot.urdf_elements import RUN_XACRO  # noqa: PLC0415 - as in `_read`

        raise ValueError(f"robot {text!r} is a xacro file: {RUN_XACRO}")
    if not _is_robot_file(word.robot):
        known = suggest(text, ROBOTS)
        raise ValueError(
            f"unknown robot {text!r}: {known}; or a file: a factory calibration (.yaml), a DH table (.toml) or a "
            f".urdf; or an arm that is drawn, {RANDOM_ARM}:7"
        )
    return _read(text)


class RobotWord(NamedTuple):
    """The parts of a text that stands for a robot."""

    robot: str  # a name, or the path of a file
    link: str = ""  # the link that carries the ball
    camera: str = ""  # the path of a file

    def is_likely(self) -> bool:
        """Return whether the parts look like a robot with a link and a camera, without a look at files."""
        if self.camera.lower().endswith(".urdf"):
            return False
        if _is_robot_file(self.robot):
            return True
        return not (self.link or "/" in self.robot or "#" in self.robot)


def read_word(text: str, is_there: Callable[[str], bool] = is_file) -> RobotWord:
    """Return the parts of a text that stands for a robot, `ROBOT#LINK with CAMERA`.

    The path of a file that exists is taken as it stands, also where it holds these marks itself.

    Args:
        text: as a user wrote it.
        is_there: says whether a path is that of a file.
    """
    if WITH not in text and "#" not in text:
        return RobotWord(text)
    without_camera = [
        RobotWord(robot, link) for robot, link in divisions(text, "#") if WITH not in link
    ]
    with_camera = []
    for before, camera in divisions(text, WITH):
        if camera:
            with_camera += [
                RobotWord(robot, link, camera) for robot, link in divisions(before, "#")
            ]
    for word in (*without_camera, *with_camera):
        if _is_robot_file(word.robot) and is_there(word.robot):
            return word
    for word in (*with_camera, *without_camera[1:]):
        if word.is_likely():
            return word
    return without_camera[0]


def _is_robot_file(name: str) -> bool:
    """Return whether a name has the suffix of a robot's file."""
    return PurePath(name).suffix.lower() in SUFFIXES


def with_files(
    text: str, change: Callable[[str], str], is_there: Callable[[str], bool] = is_file
) -> str:
    """Return the text of a robot with the paths of robot and camera, or its name, changed; see `read_word`."""
    robot, link, camera = read_word(text, is_there)
    changed = change(robot)
    if link:
        changed += f"#{link}"
    if camera:
        changed += f"{WITH}{change(camera)}"
    return changed


def with_camera(robot: str, camera: Path) -> str:
    """Return the word for a robot with the camera of a file in place of the bench's.

    Raises:
        ConfigurationError: a robot or a file that cannot be used.
    """
    for path in (camera, camera.absolute()):  # a file may be called "ur5 with my_camera.toml"
        word = f"{robot}{WITH}{path}"
        if read_word(word).camera == str(path):
            find_robot(word)
            return word
    raise ConfigurationError(
        f"{word!r} is also the name of a file; give robot or camera another name"
    )


def short_name(robot: str) -> str:
    """Return the word for a robot, and for its camera, without the folders of files."""
    return with_files(robot, lambda file: PurePath(file).name)


@kept_while_unchanged
def _equipped(robot: Robot, camera: str) -> Robot:
    """Return a robot with the camera of a file."""
    return robot.equipped(read_camera(user_path(camera)))


@kept_while_unchanged
def _read(text: str) -> Robot:
    """Return the robot of a file."""
    from servobench.plant.robot import files, urdf_file  # noqa: PLC0415 - only files need their readers

    name, tip, _ = read_word(text)
    path = user_path(name)
    kind = path.suffix.lower()
    if kind == ".urdf":
        return urdf_file.read_urdf_robot(path, tip)
    if tip:
        raise ValueError(f"robot {text!r}: only a .urdf has links to be named after '#'")
    if kind != ".toml":
        return files.read_calibrated_robot(path)
    values = read_toml("robot file", path)
    if "robot" in values:
        return _read_twin_robot(path, values)
    return files.read_dh_robot(path, values)


def _read_twin_robot(path: Path, values: Section) -> Robot:
    """Return the robot of a twin's file with its content; files that it names are beside it or where they say."""

    def locate(file: str) -> str:
        beside = path.parent / file
        if beside.is_file():
            return str(beside)
        return file

    named = with_files(str(values["robot"]), locate, lambda file: is_file(locate(file)))
    base = user_path(read_word(named).robot)
    if base.suffix.lower() == ".toml" and "robot" in read_toml("robot file", base):
        raise ValueError(
            f"twin {path}: its robot must be the one that controllers know, got the twin {named}"
        )
    robot = find_robot(named)
    twin = read_twin(path, values, robot.arm)
    return replace(robot, name=path.stem, title=f"{robot.title} twin", source=path.name, twin=twin)


RANDOM_ARM = "random_arm"  # followed by a colon and the number
MAX_NUMBER = 1_000_000
MIN_JOINTS = 3
MAX_JOINTS = 7
TOTAL_LENGTH = 1.2  # [m] length of all links together, about that of a UR5
MAX_SKEW = math.radians(10.0)  # largest deviation of a twist from quarter turns
LENGTH_PROBABILITY = 0.6  # probability that a length or an offset is not zero
MIN_LENGTH = 0.2  # [1] least length that is not zero, over the largest one, before scaling
JOINT_RANGE = 0.9 * math.pi  # [rad] range of a joint to either side
JOINT_SPEED = math.pi  # [rad/s]
MAX_DRAWS = 200


@cache
def random_robot(number: int) -> Robot:
    """Return the random arm with a number; a number always gives the same arm.

    Raises:
        ValueError: a number out of its bounds.
    """
    if not 0 <= number <= MAX_NUMBER:
        raise ValueError(
            f"the number of a {RANDOM_ARM} must be from 0 to {MAX_NUMBER:,}, got {number}"
        )
    generator = named_generator(number, RANDOM_ARM)
    n = int(generator.integers(MIN_JOINTS, MAX_JOINTS + 1))
    name = f"{RANDOM_ARM}_{number}"
    limits = narrow_limits(None, n, JOINT_SPEED, JOINT_RANGE)
    for _ in range(MAX_DRAWS):
        arm = _draw_arm(n, generator)
        links = estimate_links(arm)
        workspace = search_workspace(arm, limits, links)
        if workspace is not None:
            source = f"drawn from the number {number}"
            note = f"{name} has {n} joints"
            return Robot(name, name, source, arm, limits, links, workspace, note=note, known=False)
    raise ValueError(
        f"none of {MAX_DRAWS} arms drawn for {name} can work at the bench; take another number"
    )


def _draw_arm(n: int, generator: np.random.Generator) -> SerialArm:
    """Draw an arm with `n` joints; a DH length is zero or within a factor of five of the others."""
    sizes = generator.uniform(MIN_LENGTH, 1.0, (2, n))
    is_there = generator.random((2, n)) < LENGTH_PROBABILITY
    lengths = sizes * is_there
    lengths[0, 0] = max(lengths[0, 0], MIN_LENGTH)  # one link at least
    a, d = TOTAL_LENGTH / lengths.sum() * lengths
    quarters = generator.choice([-1.0, 0.0, 1.0], n)
    skews = generator.uniform(-MAX_SKEW, MAX_SKEW, n)
    twists = 0.5 * math.pi * quarters + skews
    arm = with_ball(arm_from_dh(a, d, twists, numbered_joints(n)))
    return replace(arm, gear_ratio=generator.choice([-1.0, 1.0], n))
