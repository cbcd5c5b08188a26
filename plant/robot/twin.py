"""Twins: robots as they were identified from a log of theirs, read from a TOML file.

A twin deviates from the robot that it names, which controllers know, by parameters with a normal posterior. A run with
seed s has θ = mean + factorᵀ z, with z ~ N(0, 1) drawn from s and z = 0 for seed 0. Parameters by name:

    latency, command_delay, lag    [s] of the camera, of commands and of the joints
    camera_turn_x ...              [rad] rotation vector of the camera in its own frame, from the pose of the file on
    camera_x ...                   [m] of the camera in the base frame, likewise
    tool_x ...                     [m] added to the marker's place in the flange frame
    focal, centre_u, centre_v, distortion   [1, px, px, 1] of an image: factor 1 + focal; the others are added
    gear_JOINT, zero_JOINT         [1, rad] factor 1 + gear on the reported position, and offset of the true angle
    link_I_x ...                   [1] factor 1 + link on a length of the I-th fixed translation, from 0 on
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.features import parameters_of_joints
from servobench.plant.contract.files import Record
from servobench.plant.contract.seeds import named_generator
from servobench.plant.contract.settings import (
    NonNegative,
    Number,
    Rows,
    Section,
    ShareBelowOne,
    did_you_mean,
    nested,
    override,
    remark,
    settings,
)
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.camera_file import ROUNDED, CameraFile, frame_time
from servobench.plant.robot.hand_eye import RobotModel, rotation_matrix

TIMES = ("latency", "command_delay", "lag")
POSE = ("turn_x", "turn_y", "turn_z", "x", "y", "z")
CAMERA = tuple(f"camera_{each}" for each in POSE)
TOOL = ("tool_x", "tool_y", "tool_z")
LENS = ("focal", "centre_u", "centre_v", "distortion")
MAX_DEVIATION = 0.5  # [s, m, rad or 1] usual largest deviation of a parameter
MIN_LENGTH = 1e-6  # [m] a shorter part of a translation is no length
Parameters = Mapping[str, float]  # values by the names of `parameter_names`


def parameter_names(arm: SerialArm) -> tuple[str, ...]:
    """Return the names of all parameters of an arm and its camera."""
    joints = parameters_of_joints(arm.joint_names)
    links = [name for name, _, _ in links_of(arm)]
    return (*TIMES, *CAMERA, *TOOL, *LENS, *joints, *links)


def links_of(arm: SerialArm) -> Iterator[tuple[str, int, int]]:
    """Yield the name of each length of an arm with its row and axis among the translations."""
    for row, axis in np.argwhere(np.abs(arm.translation) > MIN_LENGTH).tolist():
        yield f"link_{row}_{'xyz'[axis]}", row, axis


def deviated(model: RobotModel, values: Parameters) -> RobotModel:
    """Return a model with the deviations of its parameters by name; one that is left out is 0."""

    def given(*names: str) -> FloatArray:
        return np.array([values.get(name, 0.0) for name in names])

    planned = model.arm
    translation = planned.translation.copy()
    for name, row, axis in links_of(planned):
        translation[row, axis] *= 1.0 + values.get(name, 0.0)
    zeros = given(*(f"zero_{name}" for name in planned.joint_names))
    gears = given(*(f"gear_{name}" for name in planned.joint_names))
    arm = replace(
        planned,
        translation=translation,
        joint_offset=planned.joint_offset + zeros,
        gear_ratio=planned.gear_ratio * (1.0 + gears),
        tool=planned.tool + given(*TOOL),
    )
    pose = np.array(model.camera)
    pose[:3, :3] = pose[:3, :3] @ rotation_matrix(given(*CAMERA[:3]))
    pose[:3, 3] += given(*CAMERA[3:])
    return model.with_arm(arm).with_camera(pose).with_lens(given(*LENS))


@settings
class TwinFile:
    """The keys of a file."""

    robot: str = ""
    """Of which it is the twin, as after --robot."""
    sensing: str = "position"
    """With which it was logged."""
    camera: CameraFile = nested(CameraFile)
    """Pose, latency and rate of the camera; keys as in the file of a camera."""
    covariance: Rows = ()
    """[m² or px²] of the feature's noise."""
    lost_frames: ShareBelowOne = 0.0
    """[1] share of the frames."""
    outliers: ShareBelowOne = 0.0
    """[1] share of the frames."""
    outlier_size: NonNegative = 0.0
    """[m or px] their usual distance."""
    held_out: tuple[Number, ...] = ()
    """[m or px] Errors of each feature in a part of the log, of a fit to the rest; for readers."""
    plant: dict[str, dict[str, Number | bool]] = field(default_factory=dict)
    """Further settings of sensing and mechanics, such as backlash."""
    mean: dict[str, Number] = field(default_factory=dict)
    """Parameters by name, but for those of the camera; one that is left out is 0."""
    parameters: tuple[str, ...] = ()
    """Names of the columns of the factor."""
    factor: Rows = ()
    """A row for each independent direction; factorᵀ factor is the covariance of the parameters."""


@dataclass(frozen=True, eq=False)
class Twin:
    """A robot as it was identified from a log."""

    path: Path  # the file
    keys: TwinFile  # its content

    def values(self, seed: int) -> dict[str, float]:
        """Return the parameters of a run with a seed by name."""
        keys = self.keys
        values = {**keys.mean, "latency": keys.camera.latency or 0.0}
        deviation = np.zeros(len(keys.parameters))
        if keys.factor:
            z = named_generator(seed, "twin").standard_normal(len(keys.factor)) * (seed > 0)
            deviation = z @ np.array(keys.factor)
        for name, own in zip(keys.parameters, deviation.tolist(), strict=True):
            values[name] = values.get(name, 0.0) + own
        return values

    def model(self, nominal: RobotModel, sensing: str, seed: int, *, exact: bool) -> RobotModel:
        """Return the true robot of a run with a seed.

        Args:
            nominal: the robot that controllers know.
            sensing: the sensing of the run.
            seed: the seed of the run.
            exact: whether no mismatch moves the robot.

        Raises:
            ValueError: another sensing than that of the log, or a mismatch.
        """
        if sensing != self.keys.sensing:
            raise ValueError(
                f"twin {self.path} was logged with the sensing {self.keys.sensing}, got {sensing}"
            )
        if not exact:
            raise ValueError(
                f"twin {self.path} draws its robot from a posterior: leave the mismatch out, and axes, but for "
                "camera_move and those of sensor, gears and tool"
            )
        planned = nominal.with_camera(self.keys.camera.pose.matrix)
        return deviated(planned, self.values(seed))

    def times(self, seed: int) -> dict[str, float]:
        """Return the known ones of latency, delay and lag of a run by key of a plant [s], rounded to milliseconds."""
        drawn = self.values(seed)
        times = {}
        for name in TIMES:
            if name in drawn:
                key = "sensing.latency" if name == "latency" else name
                times[key] = max(0, round(1e3 * drawn[name])) / 1e3
        return times

    def plant_settings(self, config: Any, period: float) -> Record:  # noqa: ANN401 - of any plant
        """Return the settings of the mean, nested, of a plant with a configuration and a control `period` [s]."""
        keys = self.keys
        times = self.times(0)
        sensing = {"latency": times.pop("sensing.latency")}
        sensing |= self._sensing_settings(period)
        sensing |= keys.plant.get("sensing", {})
        given = {**times, **keys.plant, "sensing": sensing}
        known = {each.name for each in fields(config)}
        for name in keys.plant.keys() - known:
            remark(f"twin {self.path} goes without its {name}, which the plant does not have")
        return {name: value for name, value in given.items() if name in known}

    def _sensing_settings(self, period: float) -> Record:
        """Return losses, noise and rate of the camera as settings of a sensor, for a control `period` [s]."""
        keys = self.keys

        def with_unit(size: float) -> float | str:
            """A setting without a unit is in metres."""
            if keys.sensing == "position":
                return size
            return f"{size}px"

        sensing: Record = {
            "drop_probability": keys.lost_frames,
            "outliers": keys.outliers,
        }
        if keys.covariance:
            scale = float(np.sqrt(np.trace(keys.covariance) / len(keys.covariance)))
            shape = np.linalg.cholesky(np.array(keys.covariance)) / scale
            sensing["feature_noise"] = with_unit(scale)
            sensing["noise_shape"] = shape.tolist()
        if keys.outliers > 0.0:
            sensing["outlier_size"] = with_unit(keys.outlier_size)
        rate = keys.camera.rate
        if rate is not None and abs(rate * period - 1.0) > ROUNDED:
            sensing["frame_period"] = frame_time(f"twin {self.path}", rate, period)
        return sensing


def read_twin(path: Path, values: Section, arm: SerialArm) -> Twin:
    """Return the twin with the content of a file, given the nominal arm of its robot.

    Raises:
        ValueError: an unknown key or parameter, or a value that cannot be used.
    """
    what = f"twin {path}"
    keys = override(what, TwinFile(), values)
    known = parameter_names(arm)
    for name in (*keys.mean, *keys.parameters):
        # The means of latency and camera are among the keys of the camera.
        is_elsewhere = name in keys.mean and name in ("latency", *CAMERA)
        if name not in known or is_elsewhere:
            raise ValueError(
                f"{what}: {keys.robot} has no parameter {name!r} there{did_you_mean(name, known)}"
            )
    for name in keys.parameters:
        if keys.parameters.count(name) > 1:
            raise ValueError(f"{what}: parameters names {name!r} twice")
    for name in TIMES:
        if keys.mean.get(name, 0.0) < 0.0:
            raise ValueError(f"{what}: mean.{name} must be at least 0 s, got {keys.mean[name]:g}")
    if keys.camera.pose.frame != "base":
        raise ValueError(f'{what}: camera.pose must have frame = "base", position and rotation')
    if any(len(row) != len(keys.parameters) for row in keys.factor):
        raise ValueError(
            f"{what}: each row of factor needs {len(keys.parameters)} numbers, one for each parameter"
        )
    spreads = [float(np.linalg.norm(column)) for column in zip(*keys.factor, strict=True)]
    deviations = (*keys.mean.items(), *zip(keys.parameters, spreads, strict=False))
    for name, value in deviations:
        if abs(value) > MAX_DEVIATION and not name.startswith("centre_"):
            remark(
                f"{what}: {name} deviates by {value:g}, and usually by {MAX_DEVIATION:g} at most, in s, m, rad or 1"
            )
    if keys.covariance and not _is_covariance(keys.covariance):
        raise ValueError(f"{what}: covariance must be a symmetric, positive definite matrix")
    return Twin(path, keys)


def _is_covariance(rows: Rows) -> bool:
    """Return whether rows are those of a symmetric, positive definite matrix."""
    if any(len(row) != len(rows) for row in rows):
        return False
    matrix = np.array(rows)
    if not np.allclose(matrix, matrix.T):
        return False
    return bool(np.linalg.eigvalsh(matrix)[0] > 0.0)
