"""A map between features: one matrix M (m, m), with Δy ≈ M x and x what the model's Jacobian predicts."""

from __future__ import annotations

from typing import final

import numpy as np

from servobench.controllers.aids import AidsConfig
from servobench.controllers.stages.camera_map import CameraMap, Innovation, Step
from servobench.controllers.stages.map_bank import fresh_bank, map_update, near_rotation
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm


@final
class FeatureMap(CameraMap[FloatArray]):
    """M with the filters of `map_bank`; a bank is (..., D, 2m+1, m+1)."""

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
        shrink = 1.0 / np.sqrt(larger)[..., None, None]  # of M in P = E[M; e][M; e]ᵀ
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
