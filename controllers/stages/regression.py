"""A linear regression of the feature's motion on the joints' motion, from which the Jacobian follows everywhere.

The nominal Jacobian J_n is wrong by a matrix M (a camera that is turned or at another distance) and by an error of the
arm, which is expanded to second order about the centre q_c of the working region:

    Δy = M J_n Δq + E Δq + H[r, Δq] + e₊ − e + v              r = q̄ − q_c, q̄ the middle of the motion
    Ĵ(q) = M J_n(q) + E + H[q − q_c, ·]                       H (m, n, n) symmetric in the joints: y is quadratic in q

e, (m,), is the noise of the frame at which the motion began, e₊ ~ N(0, σ² I) that of the new one, and v ~ N(0, c² ‖Δq‖²
I) the rest. All unknowns are linear in the regressors h, so that a Kalman filter with one covariance P
(K, K) for all rows of W = [E H M e] is exact for a given noise (Bayesian linear regression with a walk of W):

    ν = Δy − W h,   s = σ² + (r² T) + c² ‖Δq‖² + hᵀ P h
    s' = max(s, ‖ν‖²/g),   σ'² = σ² + s' − s                  the excess over the gate g counts as noise of this frame
    W ← W + ν (P h)ᵀ/s',   P ← P − (P h)(P h)ᵀ/s'             but for e:
    e ← ν σ'²/s',   P_ee ← σ'² (1 − σ'²/s'),   P_We ← −(P h)_W σ'²/s'

Without e the estimate would be biased: a closed loop turns the noise of a frame into joint motion, and the next frame
undoes it. An outlier goes into its own e, and so back with the next frame. A motion that is too short to tell anything
changes e only; the rest of P counts in s (a Schmidt-Kalman filter).

How far the arm differs from its model is not known beforehand: filters with several prior deviations of E and H run
side by side and are weighed by the evidence for each (Bayesian model averaging), from small ones, for which M is near
a rotation, to large ones, for which the nominal model is hardly more than one regressor of many. With the smallest
there is a second filter whose M walks seven times as fast: of a camera that turns while the arm moves, or of frames
whose delay swings, which look alike. Evidence has to choose it, as the walk costs accuracy where the camera stands.

    ℓ_b ← ℓ_b + ‖ν‖²/s' + m ln s',   μ_b ∝ exp(−ℓ_b/2),   W̄ = Σ μ_b W_b

Three successive frames that do not fit the estimate, but agree with each other, show a moved camera: P returns to the
prior.
All functions are pure; the axis of the filters follows the leading axes of runs side by side.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, final

import numpy as np

from servobench.controllers.algebra import nearest_rotation
from servobench.controllers.controller import RobotKnowledge
from servobench.plant.contract.checks import FloatArray, IntArray, Shape
from servobench.plant.contract.faults import FilterDiverged
from servobench.plant.contract.lanes import Tree, branch, entries, map_arrays, outer, pick
from servobench.plant.contract.signals import BoolArray

GATE = 10.0  # [1] g, the largest ‖ν‖²/s; the excess is taken for noise of the frame
# [1] Largest lead of one filter in −2 ln likelihood, so that another can come back after a change.
LEAD_CAP = 100.0
# The filters of this number of runs side by side are updated at once, and all of these if a single one learns.
PIECE = 32
REST_DRIFT = 4.472136e-4  # [m/√s] walk of the feature at rest, r
MIN_MOTION = 0.002  # [rad] shortest ‖Δq‖ from which W is learned
# After this number of successive frames that do not fit but agree with each other, the camera was moved.
MOVED_FRAMES = 3
# A frame agrees with the one before if ‖ν − e‖² is below this share of ‖ν‖².
AGREEMENT = 0.25  # [1]
# [m/rad] prior deviation of an entry of E; [m/rad/rad] that of H
DEVIATIONS = np.array([0.01, 0.01, 0.1, 0.4])
PRIOR = np.array([0.0, 6.0, 6.0, 12.0])  # [1] −2 ln of the prior probability of each
MODEL_ERROR = 0.02  # [m/rad] c, deviation of the unexplained motion
# [1/√rad] random walk of an entry of E or H, as a share of its prior deviation
WALK = np.array([0.0, 0.0, 0.1, 0.1])
# Random walk of an entry of M over the motion of the joints, in each filter.
MAP_TURN_WALKS = np.array([0.02, 0.15, 0.0, 0.0])  # [1/√rad]
# [1] ς, deviation of an entry of M from the nearest rotation; filters beyond these have any M
ROTATION_DEVIATIONS = np.array([0.1, 0.1, 0.3])


class Innovation(NamedTuple):
    """The innovation of one motion in each of N filters, (..., N) but for ν."""

    nu: FloatArray  # ν, (..., N, m)
    square: FloatArray  # ‖ν‖²
    variance: FloatArray  # s
    capped: FloatArray  # s'
    frames: FloatArray  # the multiple of σ² in s


def fresh_bank(W: FloatArray, variances: FloatArray, frame: FloatArray | float) -> FloatArray:
    """Return filters, [W e] above P, without information about the last frame.

    Args:
        W: (..., N, m, K−1).
        variances: of an entry of each column of W, (N, K−1) or (K−1,).
        frame: σ², (..., 1) or a number.

    Returns:
        (..., N, m+K, K).
    """
    m, k = W.shape[-2:]
    bank = np.zeros((*W.shape[:-2], m + k + 1, k + 1))
    bank[..., :m, :k] = W
    bank[..., m:-1, :k] = variances[..., None] * np.eye(k)
    bank[..., -1, -1] = frame
    return bank


def interrupted(bank: FloatArray, frame: FloatArray) -> FloatArray:
    """Return filters without information about the noise of the last frame, σ² (...)."""
    bank = bank.copy()
    bank[..., -1] = 0.0
    bank[..., -1, :] = 0.0
    bank[..., -1, -1] = frame[..., None]
    return bank


def learn(
    bank: FloatArray,
    h: FloatArray,
    feature_step: FloatArray,
    frame: FloatArray,
    model: FloatArray,
    walk: FloatArray,
    learns: BoolArray,
) -> tuple[FloatArray, Innovation]:
    """Learn from one motion in every filter, as above.

    Args:
        bank: each [W e] above its P, (..., N, m+K, K), so that one product with h serves both.
        h: regressors without the −1 of e, (..., N or 1, K−1).
        feature_step: Δy, (..., m), m.
        frame: σ², (...), m².
        model: variance of the motion that the model leaves, (..., N), m².
        walk: variance that the columns of W gain during the motion, (..., N, K−1).
        learns: (..., N or 1), whether W is learned; otherwise it is considered only.
    """
    m = feature_step.shape[-1]
    K = h.shape[-1] + 1
    walked = walk * h
    of_noise = np.full((*h.shape[:-1], 1), -1.0)
    h = np.concatenate([h, of_noise], axis=-1)

    # One product with h gives W h above P h; less Δy, it is −ν above P h. The change of the bank is minus its products
    # with the gain.
    known = np.matvec(bank, h)
    known[..., m:-1] += walked
    Ph = known[..., m:]
    s = frame[..., None] + model + np.vecdot(h, Ph)
    known[..., :m] -= feature_step[..., None, :]
    square = np.vecdot(known[..., :m], known[..., :m])

    capped = np.maximum(s, square / GATE)
    noise = frame[..., None] + (capped - s)
    share = noise / capped
    # An infinite variance leaves W as it is. The last column, for e, is not used: the column of the new e replaces it.
    variance = np.where(learns, capped, np.inf)
    gain = Ph / variance[..., None]
    last_noise = bank[..., -1, -1]
    frames = 1.0 + np.minimum(last_noise / frame[..., None], 1.0)
    noisy = -share[..., None] * known
    noisy[..., -1] = noise * (1.0 - share)

    learned = np.empty(bank.shape)
    for part in _parts(bank):
        new = learned[part]
        some = np.logical_or.reduce(learns[part].reshape(-1), axis=-1)
        new[...] = branch(some, _corrected, bank[part], known[part], gain[part])
        # P begins after m rows of K entries, so that its diagonal is every (K+1)-th entry from there.
        flat = entries(new)
        diagonal = flat[..., m * K :: K + 1]
        diagonal[..., :-1] += walk[part]
        new[..., -1] = noisy[part]
        new[..., -1, :-1] = noisy[part][..., m:-1]
    return learned, Innovation(-known[..., :m], square, s, capped, frames)


def _parts(bank: FloatArray) -> Sequence[Any]:
    """Return indices of `PIECE` runs side by side each."""
    if bank.ndim <= 3:
        return [...]
    return [slice(k, k + PIECE) for k in range(0, len(bank), PIECE)]


def _corrected(bank: FloatArray, known: FloatArray, gain: FloatArray) -> FloatArray:
    """Return the bank less the products of [W h − Δy, P h], (..., N, m+K), with the gain, (..., N, K)."""
    change = outer(known, gain)
    return np.subtract(bank, change, out=change)


def of_filter(tree: Tree, index: IntArray) -> Tree:
    """Return the part of one filter of a tree of arrays (..., N, *); `index` is (...)."""
    return map_arrays(lambda array: pick(array, index), tree)


class RegressionState(NamedTuple):
    """The state of the regression."""

    bank: FloatArray  # the filters, (..., B, m+K, K)
    scores: FloatArray  # ℓ_b, (..., B)
    mean: FloatArray  # W̄ with e, (..., m, K)
    share: FloatArray  # Σ μ_b σ'²/s' of the last frame, (...): of its innovation that is noise
    # R of the filter with the largest weight of those that have one, (..., m, m)
    rotation: FloatArray
    rotations: FloatArray  # R of each filter that has one, (..., R, m, m)
    excess: FloatArray  # (M − R) (P_MM + ς² I)⁻¹ for each of them; like R it changes with W and P_WW only
    streak: IntArray  # number of successive frames that do not fit but agree with each other, (...)
    moves: IntArray  # how often the camera seems to have been moved, (...)


@final
class Regression:
    """Estimates Ĵ(q) and the noise e of the last frame, as above."""

    def __init__(self, knowledge: RobotKnowledge) -> None:
        """Take the sizes, and the working region, whose centre is q_c."""
        spec = knowledge.spec
        m = spec.m
        n = spec.n
        self._m = m
        self._n = n
        self._pairs = np.triu_indices(n)
        lower, upper = knowledge.region or (spec.joint_lower, spec.joint_upper)
        self._centre: FloatArray = (lower + upper) / 2.0

        # Columns of W: E and H, which are of the arm, and then M.
        arm = n + len(self._pairs[0])
        self._map = slice(arm, arm + m)
        arm_variances = np.repeat(DEVIATIONS[:, None] ** 2, arm, axis=1)
        map_variances = np.ones((len(DEVIATIONS), m))
        arm_walks = WALK[:, None] ** 2 * arm_variances
        map_walks = np.repeat(MAP_TURN_WALKS[:, None] ** 2, m, axis=1)
        self._P0 = np.concatenate([arm_variances, map_variances], axis=1)
        self._walk = np.concatenate([arm_walks, map_walks], axis=1)

    def start(self, lead: Shape, frame: float) -> RegressionState:
        """Return the state of the nominal model, for the variance σ² of a frame, m²."""
        m = self._m
        W = np.zeros((m, self._map.stop))
        W[:, self._map] = np.eye(m)
        filters = np.broadcast_to(W, (len(PRIOR), *W.shape))
        bank = fresh_bank(filters, self._P0, frame)
        mean = np.concatenate([W, np.zeros((m, 1))], axis=1)
        identity = np.eye(m)
        near = (*lead, len(ROTATION_DEVIATIONS), m, m)
        rotation = np.broadcast_to(identity, (*lead, m, m))
        rotations = np.broadcast_to(identity, near)
        scores = np.broadcast_to(PRIOR, (*lead, len(PRIOR)))
        none = np.zeros(lead, dtype=np.int_)[()]
        return RegressionState(
            bank=np.broadcast_to(bank, (*lead, *bank.shape)),
            scores=scores,
            mean=np.broadcast_to(mean, (*lead, *mean.shape)),
            share=np.zeros(lead)[()],
            rotation=rotation,
            rotations=rotations,
            excess=np.zeros(near),
            streak=none,
            moves=none,
        )

    def interrupt(self, state: RegressionState, frame: FloatArray) -> RegressionState:
        """Return the state after a frame at which no motion ended."""
        mean = state.mean.copy()
        mean[..., -1] = 0.0
        return state._replace(
            bank=interrupted(state.bank, frame), mean=mean, share=np.zeros_like(state.share)
        )

    def update(
        self,
        state: RegressionState,
        h: FloatArray,
        feature_step: FloatArray,
        duration: FloatArray,
        frame: FloatArray,
    ) -> RegressionState:
        """Return the state after a motion.

        Args:
            state: before.
            h: its regressors, (..., K−1).
            feature_step: Δy, (..., m), m.
            duration: T, (...), s.
            frame: σ², (...), m².
        """
        joint_step = h[..., : self._n]
        square = np.vecdot(joint_step, joint_step)
        moved = square >= MIN_MOTION**2
        turn = np.sqrt(square) * moved
        walk = turn[..., None, None] * self._walk
        drift = REST_DRIFT**2 * duration[..., None]
        model = drift + MODEL_ERROR**2 * square[..., None]
        h_each = h[..., None, :]
        learns = moved[..., None]
        bank, found = learn(state.bank, h_each, feature_step, frame, model, walk, learns)

        evidence = found.square / found.capped + self._m * np.log(found.capped)
        scores = state.scores + evidence * learns
        least = np.minimum.reduce(scores, axis=-1)
        scores = np.minimum(scores - least[..., None], LEAD_CAP)
        best = scores.argmin(axis=-1)
        last_noise = pick(state.bank[..., : self._m, -1], best)
        streak = self._streak(state, of_filter(found, best), last_noise)
        state = state._replace(bank=bank, scores=scores, streak=streak)
        jumped = streak >= MOVED_FRAMES
        state = branch(jumped, self._forget, state, frame)

        before = (state.rotations, state.excess)
        columns = state.bank[..., : len(ROTATION_DEVIATIONS), :, self._map]
        rotations, excess = branch(moved | jumped, self._nearest, before, columns)
        state = state._replace(rotations=rotations, excess=excess)
        rest = found.variance - frame[..., None]
        noise = 1.0 - rest / found.capped
        return self._combined(state, best, noise)

    def jacobian(
        self, state: RegressionState, joint_position: FloatArray, nominal: FloatArray
    ) -> FloatArray:
        """Return Ĵ, (..., m, n), at `joint_position` (..., n), rad, for J_n (..., m, n) there."""
        W = state.mean
        M = W[..., self._map]
        E = W[..., : self._n]
        H = W[..., self._n : self._map.start]
        return M @ nominal + E + H @ self._quadratic(joint_position)

    def regressors(
        self, middle: FloatArray, joint_step: FloatArray, predicted: FloatArray
    ) -> FloatArray:
        """Return h, (..., K−1), of a motion but for the −1 of e.

        Args:
            middle: q̄, (..., n), rad.
            joint_step: Δq, (..., n), rad.
            predicted: J_n Δq, (..., m), m.
        """
        quadratic = np.matvec(self._quadratic(middle), joint_step)
        return np.concatenate([joint_step, quadratic, predicted], axis=-1)

    def explained(self, state: RegressionState, h: FloatArray) -> FloatArray:
        """Return the motion Ĵ Δq, (..., m), of a joint motion with the regressors h."""
        return np.matvec(state.mean[..., :-1], h)

    def deviation(self, state: RegressionState) -> FloatArray:
        """Return Σ μ_b A_b, (...), m/rad: how far the arm seems to differ from its model."""
        return np.vecdot(self.weights(state), DEVIATIONS)

    def weights(self, state: RegressionState) -> FloatArray:
        """Return μ, (..., B)."""
        likelihood = np.exp(-0.5 * state.scores)
        return likelihood / np.add.reduce(likelihood, axis=-1)[..., None]

    def _quadratic(self, joint_position: FloatArray) -> FloatArray:
        """Return the derivatives of the products r_j r_k (j < k) and r_j²/2, (..., n (n+1)/2, n), at r = q − q_c."""
        first, second = self._pairs
        r = joint_position - self._centre
        rows = np.arange(len(first))
        derivative = np.zeros((*r.shape[:-1], len(first), self._n))
        derivative[..., rows, first] = r[..., second]
        derivative[..., rows, second] = r[..., first]
        return derivative

    def _streak(self, state: RegressionState, found: Innovation, last: FloatArray) -> IntArray:
        """Return `streak` after a motion `found` by the filter with the largest weight; `last` is its e before."""
        fits = found.square <= GATE * found.variance
        # Where a frame agrees with the one before, the noise of the last frame, e, explains its innovation.
        alone = found.nu - last
        agrees = np.vecdot(alone, alone) < AGREEMENT * found.square
        goes_on = agrees | (state.streak == 0)
        length = np.where(goes_on, state.streak + 1, 1)
        return np.asarray(np.where(fits, 0, length))

    def _forget(self, state: RegressionState, frame: FloatArray) -> RegressionState:
        """Return the state in which W has its prior variances again."""
        W = state.bank[..., : self._m, :-1]
        bank = fresh_bank(W, self._P0, frame[..., None])
        streak = np.zeros_like(state.streak)
        return state._replace(bank=bank, streak=streak, moves=state.moves + 1)

    def _combined(
        self, state: RegressionState, best: IntArray, noise: FloatArray
    ) -> RegressionState:
        """Return the state with W̄, after each M was completed towards the rotation nearest to it.

        With the prior belief that an entry of M is N(R, ς²), and M ~ N(R, P_MM + ς² I) by rows,

            R = argmin ‖(M − R) (P_MM + ς² I)^(−½)‖_F, the rotation nearest to M (P_MM + ς² I)⁻¹
            W ← W − (M − R) (P_MM + ς² I)⁻¹ P_M

        so that directions count by their certainty: two known directions of three give the third.
        """
        m = self._m
        near = len(ROTATION_DEVIATIONS)
        W = state.bank[..., :m, :]
        P_M = state.bank[..., :near, m:, :][..., self._map, :]
        completed = W[..., :near, :, :] - state.excess @ P_M
        W = np.concatenate([completed, W[..., near:, :, :]], axis=-3)
        weights = self.weights(state)
        weighted = weights[..., None, None] * W
        mean = np.add.reduce(weighted, axis=-3)
        share = np.add.reduce(weights * noise, axis=-1)
        nearest = np.minimum(best, near - 1)
        rotation = pick(state.rotations, nearest)
        return state._replace(mean=mean, share=share, rotation=rotation)

    def _nearest(self, _: Any, columns: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: ANN401 - those before
        """Return `rotations` and `excess` of the state for the columns of M of filters, (..., R, m+K, m)."""
        m = self._m
        M = columns[..., :m, :]
        P = columns[..., m:, :][..., self._map, :]
        deviations = ROTATION_DEVIATIONS**2
        believed = P + deviations[:, None, None] * np.eye(m)
        try:
            information = np.linalg.inv(believed)
        except np.linalg.LinAlgError as error:
            raise FilterDiverged(f"covariance of the map is singular: {P.tolist()}") from error
        R = nearest_rotation(M @ information)
        return R, (M - R) @ information
