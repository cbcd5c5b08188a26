"""Where the feature is: what the camera tells, and what the joints' motion says between its frames.

    z ← z + Ĵ Δq(k−d),   p ← p + c² ‖Ĵ‖² ‖Δq(k−d)‖²/n + r²        as far as the arm moved until the exposure
    L = p / (p + σ²),   z ← z + L (y − z),   p ← (1 − L) p               with a valid feature y

A Kalman filter with one variance p for all axes. In motion the Jacobian's error c makes it believe the camera, whether
or not Ĵ says that the feature moves; at rest it averages: L tends to r/σ. A frame further away than its variance allows
(a camera that was moved) starts it anew.
"""

from __future__ import annotations

from typing import final

import numpy as np

from servobench.controllers.noise_level import NoiseLevel
from servobench.plant.checks import FloatArray

REST_DRIFT = 1e-4  # r, m: how far z may drift a period at rest
OUTLIER = 25.0  # ‖y − z‖² over its expectation from which on the camera is right and z wrong


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
        """Go on by a period.

        Args:
            jacobian: Ĵ, (m, n), m/rad.
            joint_step: Δq, (n,), rad.
            feature: y, (m,), m; None where no valid one came.
        """
        sigma2 = self._noise.variance
        z = self.feature + jacobian @ joint_step
        unsure = float(np.vdot(jacobian, jacobian)) * float(joint_step @ joint_step) / len(joint_step)
        p = self.variance + self._model_error**2 * unsure + REST_DRIFT**2
        if feature is None:
            self.feature, self.variance = z, p
            return
        error = feature - z
        square = float(error @ error) / len(z)
        if self._find_noise:
            self._noise.learn(square, 1.0, p)
        if square > OUTLIER * (p + sigma2):
            self._restart(feature)
            return
        share = p / (p + sigma2)
        self.feature, self.variance = np.asarray(z + share * error), (1.0 - share) * p
