"""The feature from the camera's frames and from the motion of the joints between them.

    z ← z + Ĵ Δq(k−d),   p ← p + c² ‖Ĵ‖² ‖Δq(k−d)‖²/n + r²        as far as the arm moved until the exposure
    L = p / (p + σ²),   z ← z + L (y − z),   p ← (1 − L) p               with a valid feature y

A Kalman filter with one variance p for all axes. In motion the Jacobian's error c makes it follow the camera, whether
or not Ĵ predicts a motion of the feature; at rest it averages: L tends to r/σ. A frame outside the innovation gate (a
camera that was moved) restarts it.
"""

from __future__ import annotations

from typing import final

import numpy as np

from servobench.controllers.noise_level import NoiseLevel
from servobench.plant.checks import FloatArray

REST_DRIFT = 1e-4  # [m] r, process noise of z per period at rest
RESTART_RATIO = 25.0  # [1] squared innovation over its variance; above it the filter restarts at y


@final
class FeatureFilter:
    """z and its variance p."""

    def __init__(self, noise: NoiseLevel, model_error: float, feature: FloatArray, *, find_noise: bool) -> None:
        """Start at a feature.

        Args:
            noise: σ, m, standard deviation of the feature an axis.
            model_error: c, error of the Jacobian as a share of ‖Ĵ‖.
            feature: y, (m,), m.
            find_noise: learn σ from y − z.
        """
        self._noise, self._model_error, self._find_noise = noise, model_error, find_noise
        self._restart(feature)

    def _restart(self, feature: FloatArray) -> None:
        self.feature = feature
        self.variance = self._noise.variance

    def advance(self, jacobian: FloatArray, joint_step: FloatArray, feature: FloatArray | None) -> None:
        """Advance by one period.

        Args:
            jacobian: Ĵ, (m, n), m/rad.
            joint_step: Δq, (n,), rad.
            feature: y, (m,), m; None where the frame is lost.
        """
        sigma2 = self._noise.variance
        z = self.feature + jacobian @ joint_step
        uncertainty = float(np.vdot(jacobian, jacobian)) * float(joint_step @ joint_step) / len(joint_step)
        p = self.variance + self._model_error**2 * uncertainty + REST_DRIFT**2
        if feature is None:
            self.feature, self.variance = z, p
            return
        error = feature - z
        square = float(error @ error) / len(z)
        if self._find_noise:
            self._noise.learn(square, 1.0, p)
        if square > RESTART_RATIO * (p + sigma2):
            self._restart(feature)
            return
        share = p / (p + sigma2)
        self.feature, self.variance = np.asarray(z + share * error), (1.0 - share) * p
