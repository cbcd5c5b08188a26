"""A search for the arm of a log, however far it is from the nominal one, by the ensemble of the calibrating stage."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from servobench.controllers.stages.arm_fit import (
    ASSUMED_PLAY,
    DRAWS,
    FLOOR,
    FRAMES,
    LATENCY,
    MEDIAN_SQUARE,
    Fit,
    Frames,
    Members,
    squared,
)
from servobench.harness.apps.twin.identification import fit_cameras, played, sees_pixels
from servobench.harness.apps.twin.log import Log, frames_of
from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.parametric import ParametricModel
from servobench.plant.robot.twin import deviated

SCREENED_AT_ONCE = 256  # arms that are compared before any iteration
KEPT = 16  # the best of them, which are fitted
COARSE = 1e-2  # [m] deviation of residuals in this comparison, in natural units
ITERATIONS = 40  # which each fit makes
RETURNED = 4  # arms, as several may leave nearly equal residuals


def searched(log: Log, model: RobotModel) -> list[dict[str, float]]:
    """Return the parameters by name, those of the camera left out, of the arms that explain a log best.

    Args:
        log: rows of a robot with one fixed camera.
        model: nominal robot under the sensing of the log.
    """
    fit = Fit(ParametricModel(model), log.spec.feature.scale, log.spec.period)
    frames = _frames(fit, log)
    never_late = np.zeros(())
    members = fit.begun(_members(fit, model, frames), frames, np.array([FLOOR**2]))
    middle = members.variance
    for made in range(ITERATIONS):
        # What the best member leaves is taken for noise.
        floor = np.maximum(middle.min() / MEDIAN_SQUARE, FLOOR**2)
        members = fit.annealed(members, np.array(made), frames, never_late, floor[None])
        middle = np.median(squared(fit.residual(members, frames)), axis=-1)
    best = np.argsort(middle)[:RETURNED]
    return [_values(fit, theta) for theta in members.theta[best]]


def _values(fit: Fit, theta: FloatArray) -> dict[str, float]:
    """Return the parameters of an arm by name, those of the camera left out."""
    values = dict(zip(fit.names, theta.tolist(), strict=True))
    values["backlash"] = values.pop("play")
    return {name: value for name, value in values.items() if not name.startswith("camera")}


def _members(fit: Fit, model: RobotModel, frames: Frames) -> Members:
    """Return the nominal arm, and the best of many drawn ones before any iteration."""
    latency = np.array(LATENCY[0])
    coarse = np.full(SCREENED_AT_ONCE, COARSE**2)
    parts = [_placed(fit, model, fit.start((), 1, latency), frames)]
    for first in range(0, DRAWS, SCREENED_AT_ONCE):
        drawn = fit.spawned((), np.array(first), SCREENED_AT_ONCE, latency)
        placed = _placed(fit, model, drawn, frames)
        parts.append(fit.screened(placed, frames, coarse, KEPT))
    return Members(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _placed(fit: Fit, model: RobotModel, members: Members, frames: Frames) -> Members:
    """Return members whose cameras see the pixels of the frames from where they fit best; the fit places others."""
    if not sees_pixels(model):
        return members
    gears = fit.exposed(members, frames.path)
    pixels = fit.scale * frames.feature
    cameras = members.cameras.copy()
    for member, (theta, joints) in enumerate(zip(members.theta, gears.joints, strict=True)):
        arm = deviated(model, _values(fit, theta))
        cameras[member], _ = fit_cameras(arm, joints[None], pixels)
    return members._replace(cameras=cameras)


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
        path=np.concatenate([joints, places], axis=-1).swapaxes(0, 1),
        number=np.array(len(rows)),
    )
