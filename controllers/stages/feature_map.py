"""A map between features, one matrix M (m, m), and a delay, both estimated online by a filter bank.

For each of D candidate delays d a filter of its own holds a map M, (m, m), and the noise e, (m,), of the last
frame, with a covariance P, (m+1, m+1), that the rows of [M e] share. x_d is the feature step that the model predicts
for the joint motion d periods ago. A step Δy holds the noise of both its frames, of the new one e₊ ~ N(0, σ² I):

    Δy = M x_d + e₊ − e + v,   v ~ N(0, c² ‖x_d‖² I)                   v the error of the model
    h = [x_d; −1],   ν = Δy − [M e] h,   s = σ² + c² ‖x_d‖² + hᵀ P h
    M ← M + ν (P h)_Mᵀ / s,   P_M ← P_M − (P h)_M (P h)_Mᵀ / s          if ‖x_d‖ ≥ σ
    e ← ν σ²/s,   P_ee ← σ² (1 − σ²/s),   P_Me ← −(P h)_M σ²/s          e₊ takes the place of e

Without e the filter would be biased: a closed loop turns the noise of a frame into joint motion, which at a shorter
delay than the true one seems to explain that this noise is gone from the next frame.

This is a Kalman filter, exact for a given noise; without walk of M it is generalised least squares of Δy on x. Steps
shorter than the noise do not change M and P_M, but P_M counts in s (a Schmidt–Kalman filter). An arm at rest makes many
such steps: the posture stage moves the joints, x is the motion of the feature that a wrong model predicts for
this, and the law removes the measured motion. Learned from, they would teach M that x moves nothing.

The candidates are judged by −2 log of the likelihood of the measured motions:

    ℓ_d = Σ ‖ν‖² / s + m ln s

All functions are pure; the axis of the candidates follows the leading axes of runs side by side.
"""

from __future__ import annotations

from typing import final

import numpy as np

from servobench.controllers.aids import AidsConfig
from servobench.controllers.algebra import nearest_rotation
from servobench.controllers.stages.camera_map import CameraMap, Innovation, Step
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import FilterDiverged
from servobench.plant.contract.lanes import norm, outer, plus_diagonal


def fresh_bank(M: FloatArray, P_M: FloatArray, frame: FloatArray | float) -> FloatArray:
    """Return a bank, [M e] above P, without information about the last frame.

    Args:
        M: (..., m, m).
        P_M: covariance of a row of M, (m, m).
        frame: σ², (...), m².

    Returns:
        (..., 2m+1, m+1).
    """
    m = M.shape[-1]
    bank = np.zeros((*M.shape[:-2], 2 * m + 1, m + 1))
    bank[..., :m, :m], bank[..., m:-1, :m], bank[..., -1, -1] = M, P_M, frame
    return bank


def map_update(
    bank: FloatArray, x: FloatArray, feature_step: FloatArray, frame: FloatArray, model: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Learn from one motion under every candidate delay.

    Args:
        bank: each [M e] above its P, (..., D, 2m+1, m+1), so that one product with h serves both.
        x: feature steps that the model predicts, (..., D, m), m.
        feature_step: Δy, (..., m), m.
        frame: σ², (..., 1), m², positive.
        model: c² ‖x_d‖², (..., D), m².

    Returns:
        The new bank; ‖ν‖²/s, (..., D), the normalised innovation squared; and s, (..., D), m².
    """
    m = feature_step.shape[-1]
    h = np.concatenate([x, np.full((*x.shape[:-1], 1), -1.0)], axis=-1)
    known = np.matvec(bank, h)
    Ph = known[..., m:]
    s = frame + model + np.vecdot(h, Ph)
    known[..., :m] -= feature_step[..., None, :]  # −ν above P h: minus their products with the gain is the change
    nu, share = known[..., :m], frame / s
    gain = Ph / s[..., None]
    gain[..., :-1] *= (np.vecdot(x, x) >= frame)[..., None]
    learned = bank - outer(known, gain)
    learned[..., -1] = -share[..., None] * known
    learned[..., -1, :-1] = learned[..., m:-1, -1]
    learned[..., -1, -1] = frame * (1.0 - share)
    return learned, np.vecdot(nu, nu) / s, s


def near_rotation(M: FloatArray, P: FloatArray, deviation: float) -> tuple[FloatArray, FloatArray]:
    """Regularise a map towards the nearest rotation, the more the larger P is.

    With the prior belief that an entry of the map is N(R, ς²), the estimate is M ~ N(R, P + ς² I) by rows, so that

        R = argmin ‖(M − R) (P + ς² I)^(−½)‖_F, the rotation nearest to M (P + ς² I)⁻¹
        M̄ = R + (M − R) ς² (P + ς² I)⁻¹

    Directions count by their certainty: two known directions of three give the third.

    Args:
        M: (..., m, m).
        P: (..., m, m), positive definite.
        deviation: ς, of an entry of the map from the rotation; 0 for the rotation itself.

    Returns:
        M̄ and R.

    Raises:
        FilterDiverged: a P is not positive definite.
    """
    believed = plus_diagonal(P, deviation**2)
    try:
        np.linalg.cholesky(believed)
        information = np.linalg.inv(believed)
    except np.linalg.LinAlgError as error:
        raise FilterDiverged(f"covariance of the map is not positive definite: {P.tolist()}") from error
    R = nearest_rotation(M @ information)
    if deviation == 0.0:
        return R, R
    return R + (M - R) @ (deviation**2 * information), R


@final
class FeatureMap(CameraMap[FloatArray]):
    """The map M with a filter for each candidate delay; a bank is (..., D, 2m+1, m+1)."""

    def __init__(self, aids: AidsConfig, features: int) -> None:
        """Take the settings and m."""
        super().__init__(aids)
        self.columns = self._m = features
        self._eye = np.eye(features)
        self._P0 = aids.map_deviation**2 * self._eye

    def start(self, lead: tuple[int, ...], candidates: int, frame: float) -> tuple[FloatArray, FloatArray]:
        """See `CameraMap.start`."""
        bank = fresh_bank(self._eye, self._P0, frame)
        first = np.broadcast_to(self._eye, (*lead, self._m, self._m))
        return np.broadcast_to(bank, (*lead, candidates, *bank.shape)), first

    def unknown(self, bank: FloatArray, frame: FloatArray) -> FloatArray:
        """See `CameraMap.unknown`."""
        return fresh_bank(self._maps(bank), self._P0, frame[..., None])

    def interrupted(self, bank: FloatArray, frame: FloatArray) -> FloatArray:
        """See `CameraMap.interrupted`."""
        bank = bank.copy()
        bank[..., -1], bank[..., -1, :] = 0.0, 0.0
        bank[..., -1, -1] = frame[..., None]
        return bank

    def lengths(self, step: Step) -> FloatArray:
        """Return ‖x‖."""
        return norm(step.x)

    def walked(self, bank: FloatArray, step: Step, lengths: FloatArray) -> FloatArray:
        """Return the bank with P_M ← P_M + w² ‖x_d‖ I, no larger than P₀."""
        aids, m, walked = self._aids, self._m, bank.copy()
        P = walked[..., m:, :]
        P[..., :-1, :-1] += (aids.map_walk**2 * lengths)[..., None, None] * self._eye
        larger = np.maximum(P[..., :-1, :-1].trace(axis1=-2, axis2=-1) / (m * aids.map_deviation**2), 1.0)
        shrink = 1.0 / np.sqrt(larger)[..., None, None]  # acts on rows and columns of P
        P[..., :-1, :] *= shrink
        P[..., :-1] *= shrink
        return walked

    def update(
        self, bank: FloatArray, step: Step, lengths: FloatArray, frame: FloatArray
    ) -> tuple[FloatArray, Innovation]:
        """See `CameraMap.update`."""
        model = self._aids.map_error**2 * (lengths * lengths)
        new, nis, s = map_update(bank, step.x, step.feature_step, frame[..., None], model)
        frames = 1.0 + np.minimum(bank[..., -1, -1] / frame[..., None], 1.0)
        return new, Innovation(nis, self._m * np.log(s), s, frames)

    def completed(self, bank: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `near_rotation`."""
        return near_rotation(self._maps(bank), bank[..., self._m : -1, :-1], self._aids.rotation_deviation)

    def deviation(self, bank: FloatArray, rotation: FloatArray) -> FloatArray:
        """Return the deviation of an entry of the map, (...)."""
        P = bank[..., self._m : -1, :-1]
        deviation: FloatArray = np.sqrt(P.trace(axis1=-2, axis2=-1) / self._m)
        return deviation

    def explained(self, map_: FloatArray, x: FloatArray, rates: FloatArray) -> FloatArray:
        """Return M x."""
        return np.asarray(np.matvec(map_, x))

    def jacobian(self, map_: FloatArray, base: FloatArray, rates: FloatArray) -> FloatArray:
        """Return M J_b."""
        jacobian: FloatArray = map_ @ base
        return jacobian

    def _maps(self, bank: FloatArray) -> FloatArray:
        return bank[..., : self._m, :-1]
