"""The pair stage: which joint motion belongs to a motion of the feature, and how a model relates to what is seen.

    x_d = Σ J_b Δq  over the joint motion that ended d periods ago         J_b the base: a model's Jacobian (m, n)
    Δy ≈ M x_d                                                             M a map (m, m), of a turned camera

For each candidate delay d a filter holds a map (`map_bank`); the delay is that of the filter that predicts best:

    P ← P + w² ‖x_d‖ I, no larger than P₀;   M, P ← map_update(x_d, Δy)    for each delay d
    d = argmin ℓ_d, once it is better than the present one by a margin
    M̄, R = near_rotation(M_d, P_d)

P returns to P₀ for all delays when the camera seems to have been moved: a feature step that no motion of the arm
explains, from which nothing is learned, or a CUSUM of innovations, C ← max(0, C + min(‖ν‖²/(s m), 10) − 3) beyond a
gate. M stays, as the best guess. The first sample of the noise σ is a guess (`noise_level`).
"""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np
import numpy.typing as npt

from servobench.controllers.aids import AidsConfig
from servobench.controllers.estimators.estimator import MOTION_TIME
from servobench.controllers.stages.map_bank import fresh_bank, map_update, near_rotation
from servobench.controllers.stages.noise_level import NoiseLevel
from servobench.plant.checks import FloatArray
from servobench.plant.lanes import branch, norm, pick
from servobench.plant.signals import BoolArray, Observation, PlantSpec

MAX_GAP = 16  # motions of the least length that one over lost frames may span; from a longer one nothing is learned
MAX_CANDIDATES = 25  # delays that are compared; at fast rates they lie more than one period apart
MIN_JUMP_RATIO = 2.0  # [1] to the longest predicted step; a longer step of the feature is no motion of the arm
MIN_JUMP_DEVIATIONS = 10.0  # [σ] above which it is no noise either
NIS_CAP = 50.0  # [1] of ‖ν‖²/s, the normalised innovation squared (NIS), of one motion in the score of a delay
CUSUM_DRIFT = 3.0  # [1] NIS per feature that is subtracted at each motion; 1 is its expectation
CUSUM_CAP = 10.0  # [1] NIS per feature of one motion, so that one outlier cannot reach the gate
NOW_AND_BEFORE = np.array([0, 1])


def whole_periods(time: float, period: float) -> int:
    """Return the number of control periods that is nearest to a time [s]."""
    return round(time / period)


class PairState(NamedTuple):
    """The state of the stage.

    Attributes:
        past: [q, Σ x] of the last periods, (..., H, n + m), the newest first.
        base: J_b, (..., m, n), of the last period.
        bank: each candidate's map M and noise e of the last frame above their covariance P, (..., D, 2m+1, m+1).
        scores: ℓ_d, (..., D).
        noise: σ².
        candidate: index of the delay, (...).
        map: M̄, (..., m, m).
        rotation: R, (..., m, m).
        moves: how often the camera seems to have been moved, (...).
        nis: of the last motion per feature, (...).
        cusum: C, (...).
    """

    past: FloatArray
    base: FloatArray
    bank: FloatArray
    scores: FloatArray
    noise: NoiseLevel
    candidate: npt.NDArray[np.int_]
    map: FloatArray
    rotation: FloatArray
    moves: npt.NDArray[np.int_]
    nis: FloatArray
    cusum: FloatArray


class Paired(NamedTuple):
    """A motion of the feature and the joint motion that belongs to it.

    Attributes:
        joint_position: (..., n), rad, where the joint motion began.
        joint_step: Δq, (..., n), rad.
        predicted: x, (..., m), the step that the base predicts.
    """

    joint_position: FloatArray
    joint_step: FloatArray
    predicted: FloatArray


@final
class Pairing:
    """Identifies delay, map and noise, as far as the aids ask for it, and pairs motions by the delay.

    Attributes:
        delays: the candidates, (D,), periods.
        learns: whether delay, map or noise are identified, for which the base Jacobian predicts motions.
        gap: the longest motion, from one valid feature to the next, of which the past is remembered, periods.
    """

    def __init__(self, aids: AidsConfig, spec: PlantSpec, latency: float) -> None:
        """Take settings, sizes and period.

        Args:
            aids: the settings.
            spec: of the plant.
            latency: s, of a given delay.
        """
        self._aids, self._n, self._m, self._period = aids, spec.n, spec.m, spec.period
        motion = max(1, whole_periods(MOTION_TIME, spec.period))
        longest = whole_periods(aids.longest_delay, spec.period)
        spacing = max(1, math.ceil(longest / (MAX_CANDIDATES - 1)))
        given = whole_periods(latency, spec.period) if aids.delay == "given" else 0
        candidates = np.arange(0, longest + 1, spacing) if aids.delay == "identified" else np.array([given])
        self.delays: npt.NDArray[np.int_] = candidates
        self.gap = MAX_GAP * motion
        self._rows = int(candidates[-1]) + self.gap + 2
        self._aligns = aids.model == "map"
        self.learns = self._aligns or aids.delay == "identified" or aids.noise == "identified"
        self._eye = np.eye(spec.m)
        self._P0 = aids.map_deviation**2 * self._eye

    def start(self, observation: Observation, base: FloatArray) -> PairState:
        """Return the state of an arm that has rested, with J_b (..., m, n) there."""
        q, lead = observation.joint_position, observation.feature.shape[:-1]
        none = np.zeros(lead, dtype=np.int_)
        row = np.concatenate([q, np.zeros((*lead, self._m))], axis=-1)
        bank, eye = (
            self._any_map(self._eye, self._aids.feature_noise**2),
            np.broadcast_to(self._eye, (*lead, self._m, self._m)),
        )
        return PairState(
            past=np.repeat(row[..., None, :], self._rows, axis=-2),
            base=base,
            bank=np.broadcast_to(bank, (*lead, len(self.delays), *bank.shape)),
            scores=np.zeros((*lead, len(self.delays))),
            noise=NoiseLevel.guess(self._aids.feature_noise, lead),
            candidate=none,
            map=eye,
            rotation=eye,
            moves=none,
            nis=np.zeros(lead),
            cusum=np.zeros(lead),
        )

    def advance(self, state: PairState, joint_position: FloatArray) -> PairState:
        """Return the state one period later, with the arm at `joint_position` (..., n), rad."""
        past, n = state.past, self._n
        new = np.empty_like(past)
        new[..., 1:, :] = past[..., :-1, :]
        new[..., 0, :n] = joint_position
        new[..., 0, n:] = past[..., 0, n:] + np.matvec(state.base, joint_position - past[..., 0, :n])
        return state._replace(past=new)

    def delay(self, state: PairState) -> npt.NDArray[np.int_]:
        """Return d, (...), periods."""
        delay: npt.NDArray[np.int_] = self.delays[state.candidate]
        return delay

    def exposed(self, state: PairState) -> tuple[FloatArray, FloatArray]:
        """Return q(k−d) and q(k−d) − q(k−d−1), (..., n), rad."""
        rows = pick(state.past, self.delay(state)[..., None] + NOW_AND_BEFORE, axes=1)[..., : self._n]
        return rows[..., 0, :], rows[..., 0, :] - rows[..., 1, :]

    def noise(self, state: PairState) -> FloatArray | None:
        """Return σ, (...), m; None where it is not identified."""
        return state.noise.deviation if self._aids.noise == "identified" else None

    def learn(self, state: PairState, feature_step: FloatArray, duration: FloatArray) -> tuple[PairState, Paired]:
        """Return the state after a motion of the feature, and the joint motion that belongs to it.

        Args:
            state: with the arm's present position.
            feature_step: Δy, (..., m).
            duration: that it took, (...), s, at most `gap` periods.
        """
        n, periods = self._n, np.rint(duration / self._period).astype(np.int_)
        end = self.delays
        begin = pick(state.past, end + periods[..., None], axes=1)
        passed = state.past[..., end, :] - begin
        if self.learns:
            state = self._identify(state, passed[..., n:], feature_step)
        passed = pick(passed, state.candidate)
        return state, Paired(pick(begin, state.candidate)[..., :n], passed[..., :n], passed[..., n:])

    def interrupt(self, state: PairState) -> PairState:
        """Return the state after a frame in which no motion ended: nothing is known of its noise."""
        bank = state.bank.copy()
        bank[..., -1], bank[..., -1, :] = 0.0, 0.0
        bank[..., -1, -1] = state.noise.variance[..., None]
        return state._replace(bank=bank)

    def is_known(self, state: PairState) -> bool | BoolArray:
        """Return whether the map, where there is one, is known well enough to learn with it, (...)."""
        return not self._aligns or self.deviation(state) < self._aids.confidence

    def deviation(self, state: PairState) -> FloatArray:
        """Return the deviation of an entry of the map, (...)."""
        P = pick(state.bank, state.candidate)[..., self._m : -1, :-1]
        deviation: FloatArray = np.sqrt(P.trace(axis1=-2, axis2=-1) / self._m)
        return deviation

    def diagnostics(self, state: PairState) -> dict[str, npt.ArrayLike]:
        """Return delay (s), rotation (rad), deviation and NIS of the map, moves of the camera, noise level (m)."""
        found: dict[str, npt.ArrayLike] = {"delay": self.delay(state) * self._period}
        if self.learns:
            found |= {"map_surprise": state.nis, "camera_moves": state.moves, "noise_level": state.noise.deviation}
        if self._aligns:
            turned = (state.rotation - self._eye).reshape(*np.shape(state.candidate), -1)
            found["map_rotation"] = np.arccos(np.maximum(1.0 - 0.25 * np.vecdot(turned, turned), -1.0))
            found["map_deviation"] = self.deviation(state)
        return found

    def _identify(self, state: PairState, x: FloatArray, feature_step: FloatArray) -> PairState:
        lengths = norm(x)
        if not self._aids.detect_moves:
            return self._learn_map(state, x, lengths, feature_step)
        reach = MIN_JUMP_RATIO * np.maximum.reduce(lengths, axis=-1) + MIN_JUMP_DEVIATIONS * state.noise.deviation
        jumped = norm(feature_step) > reach
        state = branch(jumped, self._jump, state, feature_step)
        return branch(np.logical_not(jumped), self._learn_map, state, x, lengths, feature_step)

    def _jump(self, state: PairState, feature_step: FloatArray) -> PairState:
        noise, zero = state.noise, np.zeros_like(state.cusum)
        if self._aids.noise == "identified":
            noise = noise.learn(np.vecdot(feature_step, feature_step) / self._m, 2.0, zero)
        bank = self._any_map(self._maps(state.bank), noise.variance[..., None])
        return state._replace(bank=bank, cusum=zero, moves=state.moves + 1, noise=noise)

    def _maps(self, bank: FloatArray) -> FloatArray:
        return bank[..., : self._m, :-1]

    def _any_map(self, maps: FloatArray, frame: FloatArray | float) -> FloatArray:
        """Return a bank with M (..., m, m), P₀ for its covariance, and σ² (...) for that of the last frame."""
        return fresh_bank(maps, self._P0, frame)

    def _learn_map(self, state: PairState, x: FloatArray, lengths: FloatArray, feature_step: FloatArray) -> PairState:
        """Update map, covariance and score of every delay, and choose among them."""
        aids, m, noise, candidate = self._aids, self._m, state.noise, state.candidate
        frame, model = noise.variance[..., None], aids.map_error**2 * (lengths * lengths)
        before = self._walked(state.bank, lengths)
        bank, nis, s = map_update(before, x, feature_step, frame, model)
        surprise, expected = pick(nis, candidate) / m, pick(s, candidate)
        if aids.noise == "identified":
            frames = 1.0 + np.minimum(pick(before, candidate)[..., -1, -1] / noise.variance, 1.0)  # σ² in s
            noise = noise.learn(surprise * expected, frames, expected - frames * noise.variance)
        cusum, moves = np.maximum(0.0, state.cusum + np.minimum(surprise, CUSUM_CAP) - CUSUM_DRIFT), state.moves
        if aids.detect_moves:
            moved = cusum > aids.move_gate
            bank = branch(moved, self._learn_any_map, bank, before, x, feature_step, frame, model)
            cusum, moves = cusum * ~moved, moves + moved
        scores = aids.score_memory * state.scores + np.minimum(nis, NIS_CAP) + m * np.log(s)
        best = scores.argmin(axis=-1)
        better = pick(scores, best) < pick(scores, candidate) - aids.delay_margin
        candidate = np.where(better, best, candidate)[()]
        state = state._replace(
            bank=bank, scores=scores, noise=noise, candidate=candidate, moves=moves, nis=surprise, cusum=cusum
        )
        if not self._aligns:
            return state
        now = pick(bank, candidate)
        nearest, rotation = near_rotation(self._maps(now), now[..., m:-1, :-1], aids.rotation_deviation)
        return state._replace(map=nearest, rotation=rotation)

    def _walked(self, bank: FloatArray, lengths: FloatArray) -> FloatArray:
        """Return the bank with P_M ← P_M + w² ‖x_d‖ I, no larger than P₀."""
        aids, m, walked = self._aids, self._m, bank.copy()
        P = walked[..., m:, :]
        P[..., :-1, :-1] += (aids.map_walk**2 * lengths)[..., None, None] * self._eye
        larger = np.maximum(P[..., :-1, :-1].trace(axis1=-2, axis2=-1) / (m * aids.map_deviation**2), 1.0)
        shrink = 1.0 / np.sqrt(larger)[..., None, None]  # of M in P = E[M; e][M; e]ᵀ
        P[..., :-1, :] *= shrink
        P[..., :-1] *= shrink
        return walked

    def _learn_any_map(
        self,
        bank: FloatArray,
        before: FloatArray,
        x: FloatArray,
        feature_step: FloatArray,
        frame: FloatArray,
        model: FloatArray,
    ) -> FloatArray:
        return map_update(self._any_map(self._maps(before), frame), x, feature_step, frame, model)[0]
