"""The file of a twin: an identified robot as TOML, which `--robot` of all commands takes."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from servobench.harness.apps.twin.drive import Response
from servobench.harness.apps.twin.held_out import HeldOut
from servobench.harness.apps.twin.identification import EXTRAS, Identified
from servobench.harness.apps.twin.log import Log
from servobench.harness.apps.twin.sensor import frame_period, sensor
from servobench.harness.config.description import toml
from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.twin import TIMES


def twin_text(
    robot: Identified,
    log: Log,
    response: Response | None,
    named: tuple[str, str],
    held: HeldOut | None = None,
) -> str:
    """Return the file of a twin.

    Args:
        robot: as identified.
        log: the log that it was identified from.
        response: to commands, if the log tells it.
        named: robot and sensing.
        held: errors in a window that was held out.
    """
    own = [k for k, name in enumerate(robot.names) if name not in EXTRAS]
    names = [robot.names[k] for k in own]
    factor = robot.factor[:, own]
    mean = {}
    for k, name in zip(own, names, strict=True):
        if name != "latency" and not name.startswith("camera"):
            mean[name] = float(robot.values[k])
    if response is not None:
        mean["command_delay"] = response.delay
        mean["lag"] = response.lag
        factor = _with_times(factor, response.covariance)
        names += TIMES[1:]
    measured = sensor(log, robot)
    top = {
        "robot": named[0],
        "sensing": named[1],
        "covariance": measured.noise,
        "lost_frames": measured.lost,
    }
    if measured.outliers.any():
        false = robot.residuals[measured.outliers]
        top["outliers"] = float(measured.outliers.mean())
        top["outlier_size"] = float(np.sqrt(np.mean(false**2)))
    if held is not None:
        top["held_out"] = held.deviations
    top["parameters"] = names
    top["factor"] = factor
    camera = {"latency": measured.latency, "rate": 1.0 / frame_period(log)}
    place = toml(robot.pose[:3, 3])
    rotation = toml(robot.pose[:3, :3])
    lines = [
        *_assignments(top),
        "[camera]",
        *_assignments(camera),
        f'pose = {{ frame = "base", position = {place}, rotation = {rotation} }}',
        "[mean]",
        *_assignments(mean),
    ]
    for name, settings in measured.settings.items():
        lines += [f"[plant.{name}]", *_assignments(settings)]
    return "\n".join(lines) + "\n"


def _assignments(values: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {toml(value)}" for key, value in values.items()]


def _with_times(factor: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return a factor (d, p) with rows and columns for delay and lag, of covariance (2, 2): (d + 2, p + 2)."""
    values, vectors = np.linalg.eigh(covariance)
    times = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    directions, parameters = factor.shape
    return np.block([[factor, np.zeros((directions, 2))], [np.zeros((2, parameters)), times]])
