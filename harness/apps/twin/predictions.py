"""Predictions of a controller's Jacobian along a logged run, one frame ahead.

The Jacobian Ĵ_k that the controller holds at a valid frame k, learned up to this frame, predicts the next one, l:

    ŷ_l = y_k + Ĵ_k (q(t_l − d_k) − q(t_k − d_k))

with the logged joint positions q and the delay d_k of the camera that the controller has identified, 0 without one.
"""

import numpy as np
import pandas as pd

from servobench.harness.run.log import Steps
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.settings import remark

PREDICTED = "predicted_"  # before the name of a column of features
DELAY = "delay"  # diagnostic of controllers that identify the camera's delay [s]
MAX_DELAY = 0.25  # [s] longest delay that is tried in place of the controller's
# Another delay is remarked on if it leaves less than this share of the prediction error.
MIN_GAIN = 0.8  # [1]
MAX_LATE = 12  # control periods by which a frame may follow another, or be late


def predicted(steps: Steps, delay: float | None = None) -> FloatArray:
    """Return the feature that the Jacobian of the valid frame before predicts for each valid frame, as above.

    Args:
        steps: rows of one run.
        delay: d [s] at all frames; by default that of the controller.

    Returns:
        (k, m) [unit of the feature]; NaN where no valid frame is at most `MAX_LATE` periods before, where the
        controller had no Jacobian, and where the joint motion began before the log.
    """
    t = steps.time
    d = steps.diagnostics.get(DELAY, np.zeros_like(t))
    if delay is not None:
        d = np.full_like(t, delay)
    frames = np.flatnonzero(steps.feature_valid)
    begins = frames[:-1]
    ends = frames[1:]
    known = (ends - begins <= MAX_LATE) & (t[begins] - d[begins] >= t[0])
    k = begins[known]
    next_k = ends[known]
    before = t[k] - d[k]
    after = t[next_k] - d[k]
    moved = [np.interp(after, t, q) - np.interp(before, t, q) for q in steps.joint_position.T]
    y = np.full_like(steps.feature, np.nan)
    y[next_k] = steps.feature[k] + np.matvec(steps.estimated_jacobian[k], np.transpose(moved))
    return y


def check_delay(steps: Steps, ahead: FloatArray) -> None:
    """Remark on a camera that is later than the controller takes it to be, given its predictions (k, m)."""
    delays = steps.spec.period * np.arange(1 + int(MAX_DELAY / steps.spec.period))
    tried = np.array([ahead, *(predicted(steps, delay) for delay in delays)])
    common = np.isfinite(tried).all(axis=(0, 2))
    if not common.any():
        return
    errors = (steps.feature - tried)[:, common]
    own, *others = map(rms, errors)
    best = int(np.argmin(others))
    if others[best] < MIN_GAIN * own:
        remark(
            f"features of the log come {delays[best]:g} s after the joint motion: with this delay the Jacobian "
            f"would predict them with {others[best] / own:.0%} of the error; look for the controller's setting of "
            "the delay"
        )


def rms(values: FloatArray) -> float:
    """Return the root of the mean squared length of vectors (k, m)."""
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))


def predictions(steps: pd.DataFrame) -> pd.DataFrame:
    """Return how well the controller's Jacobian predicts the features of a table of `shadow.shadow`, one frame ahead.

    Returns:
        A row a feature, and one for their sum of squares: RMS of the motion from frame to frame, which is the error of
        predicting no motion; RMS of the error of the prediction; and their ratio. The first two are in the unit that
        the name ends with. A perfect Jacobian leaves the noise of two frames, √2 σ. Empty where nothing is predicted.
    """
    names = [name for name in map(str, steps) if name.startswith(PREDICTED)]
    if not names:
        return pd.DataFrame()
    features = [name.removeprefix(PREDICTED) for name in names]
    y = steps[features]
    ahead = steps[names].set_axis(features, axis=1)
    known = ahead.notna().all(axis=1)
    before = y.where(steps["feature_valid"]).ffill().shift()
    motion = _rms_of_columns((y - before)[known])
    error = _rms_of_columns((y - ahead)[known])
    ratio = np.divide(error, motion, out=np.full_like(error, np.nan), where=motion > 0.0)
    return pd.DataFrame(
        {
            "feature": [*(name.removeprefix("feature_") for name in features), "all"],
            "motion, RMS": motion,
            "prediction error, RMS": error,
            "error / motion": ratio,
        }
    )


def _rms_of_columns(values: pd.DataFrame) -> FloatArray:
    """Return the RMS of each column, and the root of the sum of their mean squares."""
    squares = (values**2).mean()
    return np.sqrt([*squares, squares.sum()])
