"""The rotation of each camera, for features of points: a map M (3, 3) before the interaction matrix.

    Δy = L(y, z) M x + e₊ − e + v            x = Σ G Δq the motions of the points by the nominal model

L (K, 3) of a camera has the measured features of its points, and their depths z by the nominal model. That a
camera is turned is all in M: a rotation, constant, times the ratio of the nominal to the true depth. The filter of a
camera and a candidate delay holds θ = [vec M, e], (9 + K,), by rows of M, and its covariance P:

    H = [L ⊗ xᵀ, −I],   ν = Δy − H θ,   S = σ² I + c² diag(ℓ²) + H P Hᵀ       ℓ² = ‖L‖²_F ‖x‖² / k of a point
    θ ← θ + P Hᵀ S⁻¹ ν,   P ← P − P Hᵀ S⁻¹ H P,   then e₊ takes the place of e:
    e ← σ² S⁻¹ ν,   P_ee ← σ² I − σ⁴ S⁻¹,   P_Me ← −σ² (P Hᵀ)_M S⁻¹

M and P_M stay where ℓ² of no feature reaches σ² (see `feature_map`), and features that were not measured are left out
of ν, H and S. All functions are pure; axes: (..., D candidates, c cameras).
"""

from __future__ import annotations

from typing import Final, NamedTuple, TypeVar, final

import numpy as np
import numpy.typing as npt

from servobench.controllers.aids import AidsConfig
from servobench.controllers.algebra import nearest_rotation
from servobench.controllers.camera_model import CameraModel, feature_jacobian
from servobench.controllers.stages.camera_map import CameraMap, Innovation, Step
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import FilterDiverged
from servobench.plant.contract.lanes import norm, plus_diagonal, transposed, where
from servobench.plant.contract.signals import BoolArray

Scalar = TypeVar("Scalar", bound=np.generic)
ENTRIES: Final = 9  # number of entries of M
REFINEMENTS: Final = 3  # number of Gauss-Newton steps to the nearest rotation
TURNS: Final = np.array([[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
                         [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], dtype=np.float64)  # fmt: skip
"""[e_i]× of the three axes."""


class PointBank(NamedTuple):
    """The state of the filters.

    Attributes:
        theta: (..., D, c, 9+K).
        P: (..., D, c, 9+K, 9+K).
    """

    theta: FloatArray
    P: FloatArray


def point_update(
    bank: PointBank,
    H: FloatArray,
    feature_step: FloatArray,
    valid: BoolArray,
    frame: FloatArray,
    model: FloatArray,
    learns: BoolArray | bool = True,
) -> tuple[PointBank, Innovation]:
    """Learn from one motion.

    Args:
        bank: of filters side by side.
        H: (..., K, 9), how features move with the entries of M.
        feature_step: Δy, (..., K).
        valid: which of them were measured, (..., K).
        frame: σ², (..., 1).
        model: c² ℓ², (..., K).
        learns: (...), whether M is learned; otherwise it is considered only.
    """
    theta, P = bank
    K = H.shape[-2]
    whole = np.concatenate([H, np.broadcast_to(-np.eye(K), (*H.shape[:-1], K))], axis=-1)
    whole = np.where(valid[..., None], whole, 0.0)
    nu = np.where(valid, feature_step - np.matvec(whole, theta), 0.0)
    PH = P @ transposed(whole)
    S = plus_diagonal(whole @ PH, np.where(valid, frame + model, 1.0))
    try:
        root = np.linalg.cholesky(S)
        weight = np.linalg.inv(S)
    except np.linalg.LinAlgError as error:
        raise FilterDiverged(f"covariance of the map is not positive definite: {P.tolist()}") from error
    weight = np.where(valid[..., None] & valid[..., None, :], weight, 0.0)
    gain = PH @ weight
    used = np.where(np.asarray(learns)[..., None, None], gain, 0.0)
    theta = theta + np.matvec(used, nu)
    P = P - used @ transposed(PH)
    P = 0.5 * (P + transposed(P))
    weighted = np.matvec(weight, nu)
    theta[..., ENTRIES:] = frame * weighted
    P[..., :ENTRIES, ENTRIES:] = -frame[..., None] * gain[..., :ENTRIES, :]
    P[..., ENTRIES:, :ENTRIES] = transposed(P[..., :ENTRIES, ENTRIES:])
    P[..., ENTRIES:, ENTRIES:] = frame[..., None] * (np.eye(K) - frame[..., None] * weight)
    diagonal = np.where(valid, np.diagonal(S, axis1=-2, axis2=-1), 0.0)
    before = np.where(valid, np.diagonal(bank.P, axis1=-2, axis2=-1)[..., ENTRIES:], 0.0)
    spread = 2.0 * np.add.reduce(np.log(np.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
    sums = np.add.reduce(diagonal, axis=-1), np.add.reduce(before, axis=-1)
    return PointBank(theta, P), Innovation(np.vecdot(nu, weighted), spread, *sums)


def near_turn(M: FloatArray, P: FloatArray, deviation: float, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Regularise a map towards the nearest rotation; see `feature_map.near_rotation`.

    The covariance of the entries is not that of rows, so that the nearest rotation has no closed form: it is the better
    one of two that Gauss-Newton steps reach, from the closed form of the weighted map and from the one before.

    Args:
        M: (..., 3, 3).
        P: of its entries by rows, (..., 9, 9).
        deviation: ς.
        rotation: the one before, (..., 3, 3).

    Returns:
        M̄ and R.
    """
    information, entries = _information(P, deviation), M.reshape(*M.shape[:-2], ENTRIES)
    first = nearest_rotation(np.matvec(information, entries).reshape(M.shape))
    R = np.stack([first, rotation])
    best, least = R, _cost(R, entries, information)
    for _ in range(REFINEMENTS):
        along = _derivative(R)
        wrong = np.matvec(information, entries - R.reshape(*R.shape[:-2], ENTRIES))
        turn = np.linalg.solve(transposed(along) @ information @ along, np.vecmat(wrong, along)[..., None])
        R = nearest_rotation(R + R @ (TURNS * turn[..., None]).sum(axis=-3))
        cost = _cost(R, entries, information)
        best, least = where(cost < least, R, best), np.minimum(cost, least)
    R = where(least[0] <= least[1], best[0], best[1])
    wrong = entries - R.reshape(*R.shape[:-2], ENTRIES)
    return R + deviation**2 * np.matvec(information, wrong).reshape(M.shape), R


def turn_deviation(P: FloatArray, deviation: float, rotation: FloatArray) -> FloatArray:
    """Return the deviation of the angles of R, (...), rad, for P (..., 9, 9) and R (..., 3, 3)."""
    along = _derivative(rotation)
    information = transposed(along) @ _information(P, deviation) @ along
    return np.asarray(np.sqrt(np.linalg.inv(information).trace(axis1=-2, axis2=-1) / 3.0))


def _information(P: FloatArray, deviation: float) -> FloatArray:
    try:
        return np.asarray(np.linalg.inv(plus_diagonal(P, deviation**2)))
    except np.linalg.LinAlgError as error:
        raise FilterDiverged(f"covariance of the map is singular: {P.tolist()}") from error


def _derivative(R: FloatArray) -> FloatArray:
    """Return how the entries of R exp([δ]×) change with δ at 0, (..., 9, 3)."""
    along = R[..., None, :, :] @ TURNS
    return transposed(along.reshape(*along.shape[:-2], ENTRIES))


def _cost(R: FloatArray, entries: FloatArray, information: FloatArray) -> FloatArray:
    wrong = entries - R.reshape(*R.shape[:-2], ENTRIES)
    return np.asarray(np.vecdot(wrong, np.matvec(information, wrong)))


@final
class PointMap(CameraMap[PointBank]):
    """M of each camera; a map is (..., c, 3, 3)."""

    def __init__(self, aids: AidsConfig, model: CameraModel, features: int) -> None:
        """Take the settings, the model of the cameras, and m."""
        super().__init__(aids)
        self.columns, self._c, self._p = model.rows, model.cameras, model.points
        self._K = features // model.cameras
        self._P0 = aids.map_deviation**2 * np.eye(ENTRIES)

    def start(self, lead: tuple[int, ...], candidates: int, frame: float) -> tuple[PointBank, FloatArray]:
        """See `CameraMap.start`."""
        lanes, size = (*lead, candidates, self._c), ENTRIES + self._K
        eye, theta, P = np.eye(3), np.zeros((*lanes, size)), np.zeros((*lanes, size, size))
        theta[..., :ENTRIES] = eye.ravel()
        P[..., :ENTRIES, :ENTRIES], P[..., ENTRIES:, ENTRIES:] = self._P0, frame * np.eye(self._K)
        return PointBank(theta, P), np.broadcast_to(eye, (*lead, self._c, 3, 3))

    def unknown(self, bank: PointBank, frame: FloatArray) -> PointBank:
        """See `CameraMap.unknown`."""
        bank = self.interrupted(bank, frame)
        bank.P[..., :ENTRIES, :ENTRIES] = self._P0
        return bank

    def interrupted(self, bank: PointBank, frame: FloatArray) -> PointBank:
        """See `CameraMap.interrupted`."""
        theta, P = bank.theta.copy(), bank.P.copy()
        theta[..., ENTRIES:], P[..., ENTRIES:], P[..., ENTRIES:, :] = 0.0, 0.0, 0.0
        P[..., ENTRIES:, ENTRIES:] = frame[..., None, None, None, None] * np.eye(self._K)
        return PointBank(theta, P)

    def lengths(self, step: Step) -> FloatArray:
        """Return √Σ ‖L‖²_F ‖x‖² over all points."""
        squares = self._squares(step)
        return np.asarray(np.sqrt(np.add.reduce(squares.reshape(*squares.shape[:-2], -1), axis=-1)))

    def walked(self, bank: PointBank, step: Step, lengths: FloatArray) -> PointBank:
        """Return the bank with P_M ← P_M + w² ‖x‖ I, x the mean motion of the points, no larger than P₀."""
        aids, P = self._aids, bank.P.copy()
        moved = norm(self._points(step.x)).mean(axis=-1)
        P[..., :ENTRIES, :ENTRIES] += (aids.map_walk**2 * moved)[..., None, None] * np.eye(ENTRIES)
        trace = P[..., :ENTRIES, :ENTRIES].trace(axis1=-2, axis2=-1)
        shrink = 1.0 / np.sqrt(np.maximum(trace / (ENTRIES * aids.map_deviation**2), 1.0))[..., None, None]
        P[..., :ENTRIES, :] *= shrink
        P[..., :ENTRIES] *= shrink
        return bank._replace(P=P)

    def update(
        self, bank: PointBank, step: Step, lengths: FloatArray, frame: FloatArray
    ) -> tuple[PointBank, Innovation]:
        """See `CameraMap.update`."""
        rates, points = step.rates, self._points(step.x)
        k, shape = rates.shape[-2], (*step.x.shape[:-1], self._c, self._K)
        H = (rates[..., None] * points[..., None, None, :]).reshape(*shape, ENTRIES)
        squares = np.repeat(self._squares(step) / k, k, axis=-1).reshape(shape)
        model = self._aids.map_error**2 * squares
        moved, valid = self._by_camera(step.feature_step), self._by_camera(step.valid)
        variance = frame[..., None, None, None]
        learns = np.logical_or.reduce(valid & (squares >= variance), axis=-1)
        new, said = point_update(bank, H, moved, valid, variance, model, learns)
        count = np.maximum(np.add.reduce(step.valid, axis=-1), 1)[..., None]
        nis, spread, total, before = (np.add.reduce(each, axis=-1) for each in said)
        frames = 1.0 + np.minimum(before / (count * frame[..., None]), 1.0)
        return new, Innovation(nis, spread, total / count, frames)

    def completed(self, bank: PointBank, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `near_turn`."""
        M = bank.theta[..., :ENTRIES].reshape(*bank.theta.shape[:-1], 3, 3)
        return near_turn(M, bank.P[..., :ENTRIES, :ENTRIES], self._aids.rotation_deviation, rotation)

    def deviation(self, bank: PointBank, rotation: FloatArray) -> FloatArray:
        """Return the deviation of the angles of the camera that is known least, (...), rad."""
        own = turn_deviation(bank.P[..., :ENTRIES, :ENTRIES], self._aids.rotation_deviation, rotation)
        return np.asarray(np.maximum.reduce(own, axis=-1))

    def explained(self, map_: FloatArray, x: FloatArray, rates: FloatArray) -> FloatArray:
        """Return L M x."""
        return self.jacobian(map_, x[..., None], rates)[..., 0]

    def jacobian(self, map_: FloatArray, base: FloatArray, rates: FloatArray) -> FloatArray:
        """Return L M G."""
        return feature_jacobian(rates, map_, base)

    def _points(self, x: FloatArray) -> FloatArray:
        return x.reshape(*x.shape[:-1], self._c, self._p, 3)

    def _by_camera(self, features: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
        """Return (..., m) as (..., 1, c, K)."""
        return features.reshape(*features.shape[:-1], 1, self._c, self._K)

    def _squares(self, step: Step) -> FloatArray:
        """Return ‖L‖²_F ‖x‖² of each point, (..., D, c, p)."""
        points, flat = self._points(step.x), step.rates.reshape(*step.rates.shape[:-2], -1)
        return np.asarray(np.vecdot(flat, flat) * np.vecdot(points, points))
