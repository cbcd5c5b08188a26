"""The feature from the camera's frames and from the motion of the joints between them.

    z ← z + Ĵ Δq(k−d),   p ← p + c² ‖Ĵ‖² ‖Δq(k−d)‖²/n + r²        as far as the arm moved until the exposure
    L = p / (p + σ²),   z ← z + L (y − z),   p ← (1 − L) p               with a valid feature y

A Kalman filter with one variance p for all axes. In motion the Jacobian's error c makes it follow the camera, whether
or not Ĵ predicts a motion of the feature; at rest it averages: L tends to r/σ. A frame outside the innovation gate (a
camera that was moved) restarts it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servobench.controllers.estimators.estimator import MOTION_TIME
from servobench.controllers.stages.noise_level import NoiseLevel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch
from servobench.plant.contract.signals import BoolArray

REST_DRIFT = 4.472136e-4  # [m/√s] process noise of z at rest; r in the formula is that of a period
RESTART_RATIO = 25.0  # [1] squared innovation over its variance; above it the filter restarts at y


class FeatureFilter(NamedTuple):
    """The state of the filter.

    Attributes:
        feature: z, (..., m), m.
        variance: p, (...), m².
        noise: σ, standard deviation of the feature per axis.
    """

    feature: FloatArray
    variance: FloatArray
    noise: NoiseLevel

    def restart(self, feature: FloatArray) -> FeatureFilter:
        """Return the filter at a feature y, (..., m), m."""
        return self._replace(feature=feature, variance=self.noise.variance)

    def advance(self, jacobian: FloatArray, joint_step: FloatArray, model_error: float, period: float) -> FeatureFilter:
        """Return the filter one period later, before the frame of that period.

        Args:
            jacobian: Ĵ, (..., m, n), m/rad.
            joint_step: Δq, (..., n), rad.
            model_error: c, error of the Jacobian as a share of ‖Ĵ‖, which lasts for `MOTION_TIME`.
            period: s.
        """
        flat = jacobian.reshape(*jacobian.shape[:-2], -1)
        uncertainty = np.vecdot(flat, flat) * np.vecdot(joint_step, joint_step) / joint_step.shape[-1]
        error = model_error**2 * (MOTION_TIME / period)
        return self._replace(
            feature=self.feature + np.matvec(jacobian, joint_step),
            variance=self.variance + error * uncertainty + REST_DRIFT**2 * period,
        )

    def correct(self, feature: FloatArray, valid: BoolArray, find_noise: bool) -> FeatureFilter:
        """Return the filter after a frame in which at least one feature was seen; the others stay as predicted.

        Args:
            feature: y, (..., m), m.
            valid: which of them were seen, (..., m).
            find_noise: learn σ from y − z.
        """
        z, p, noise = self
        feature = np.where(valid, feature, z)
        error, innovation_variance = feature - z, p + noise.variance
        square = np.vecdot(error, error) / np.add.reduce(valid, axis=-1)
        share = p / innovation_variance
        if find_noise:
            noise = noise.learn(square, 1.0, p)
        corrected = FeatureFilter(z + share[..., None] * error, (1.0 - share) * p, noise)
        return branch(square > RESTART_RATIO * innovation_variance, FeatureFilter.restart, corrected, feature)
