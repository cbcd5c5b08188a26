"""A search for the arm of a log, however far it is from the nominal one, by the ensemble of the calibrating stage."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from servobench.controllers.stages.arm_fit import (
    ASSUMED_PLAY,
    FLOOR,
    FRAMES,
    LATENCY,
    Fit,
    Frames,
    Members,
    squared,
)
from servobench.harness.apps.twin.identification import Log, frames_of, played
from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.parametric import ParametricModel

DRAWN: Final = 1024  # arms that are drawn
SCREENED_AT_ONCE: Final = 256
KEPT: Final = 8  # the best of those, of which each is fitted
COARSE: Final = 1e-2  # [m] deviation of residuals in that comparison, in natural units
ITERATIONS: Final = 40
MEDIAN: Final = 2.366  # median of the squared length of three normal variables


def searched(log: Log, model: RobotModel) -> dict[str, float]:
    """Return the parameters by name, those of the camera left out, of the arm that explains a log best.

    Args:
        log: rows of a robot with one fixed camera.
        model: nominal robot under the sensing of the log.
    """
    fit = Fit(ParametricModel(model), log.spec.feature.scale, log.spec.period)
    frames = _frames(fit, log)
    never_late = np.zeros(())
    trial = fit.begun(_members(fit, frames), frames, np.array([FLOOR**2]))
    middle = trial.variance
    for _ in range(ITERATIONS):
        # What the best member leaves is taken for noise.
        floor = np.maximum(middle.min() / MEDIAN, FLOOR**2)
        trial = fit.annealed(trial, frames, never_late, floor[None])
        middle = np.median(squared(fit.residual(trial.members, frames)), axis=-1)
    theta = trial.members.theta[middle.argmin()]
    values = dict(zip(fit.names, theta.tolist(), strict=True))
    values["backlash"] = values.pop("play")
    return {name: value for name, value in values.items() if not name.startswith("camera")}


def _members(fit: Fit, frames: Frames) -> Members:
    """Return the nominal arm, and the best of many drawn ones before any iteration."""
    latency = np.array(LATENCY[0])
    coarse = np.full(SCREENED_AT_ONCE, COARSE**2)
    parts = [fit.start((), 1, latency)]
    for first in range(0, DRAWN, SCREENED_AT_ONCE):
        drawn = fit.spawned((), np.array(first), SCREENED_AT_ONCE, latency)
        parts.append(fit.screened(drawn, frames, coarse, KEPT))
    return Members(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _frames(fit: Fit, log: Log) -> Frames:
    """Return frames of a log, equally spaced, with the joints' paths to them."""
    rows = frames_of(log, FRAMES)
    time = log.frame_time[rows]
    ago = fit.grid * np.arange(fit.rows)[::-1]
    instants = np.maximum(time[:, None] - ago, log.time[0])
    joints: FloatArray = CubicSpline(log.time, log.joints)(instants)
    shares = played(log.joints, ASSUMED_PLAY) / ASSUMED_PLAY
    places = np.clip(CubicSpline(log.time, shares)(instants), -1.0, 1.0)
    features = log.features[rows] / fit.scale
    return Frames(
        time=time - log.time[0],
        feature=features,
        weight=np.ones_like(features),
        path=np.concatenate([joints, places], axis=-1),
        number=np.array(len(rows)),
    )
