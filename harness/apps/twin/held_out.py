"""The end of a log, held out: errors of the robot that is identified from the frames before."""

from typing import NamedTuple

import numpy as np

from servobench.harness.apps.twin.identification import (
    MAX_FRAMES,
    Identified,
    errors_along,
    identify,
    robust_covariance,
)
from servobench.harness.apps.twin.log import MAX_LATENCY, MIN_FRAMES, Clocks, Log, frames_of
from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.hand_eye import RobotModel

SHARE = 0.2  # [1] share of the last frames
FITS = 2  # as the search begins at the robot of the whole log


class HeldOut(NamedTuple):
    """Errors in the window that was held out."""

    begin: float  # [s]
    end: float  # [s]
    deviations: FloatArray  # errors of each feature without outliers, (m,) [unit of the feature]
    ratio: float  # [1] their size over that of the residuals of the frames before


def held_out(log: Log, model: RobotModel, robot: Identified) -> HeldOut | None:
    """Return the errors in the last fifth of a log by the robot of the rest; None if that has too few frames.

    Both parts take frames at the times that the whole log gives them.

    Args:
        log: rows of a robot with one fixed camera.
        model: nominal robot under the sensing of the log.
        robot: as identified from the whole log, where the search begins.
    """
    clocks = log.clocks or Clocks(0.0, MAX_LATENCY, None)
    log = log._replace(captured=log.frame_time, clocks=clocks)
    rows = frames_of(log)
    before = rows[: len(rows) - round(SHARE * len(rows))]
    if len(before) < MIN_FRAMES or len(before) == len(rows):
        return None
    is_before = np.isin(np.arange(len(log.time)), before)
    rest = log._replace(valid=is_before)
    fitted = identify(rest, model, MAX_FRAMES, FITS, robot.values_by_name())
    shown, errors = errors_along(log, model, fitted)
    is_late = shown > before[-1]
    noise, _ = robust_covariance(errors[is_late])
    return HeldOut(
        begin=float(log.time[before[-1] + 1]),
        end=float(log.time[-1]),
        deviations=np.sqrt(np.diag(noise)),
        ratio=float(np.sqrt(np.trace(noise) / np.trace(fitted.noise))),
    )
