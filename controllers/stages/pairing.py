"""The pair stage: delay of the camera, map from model to camera, and noise, identified by a filter bank.

It pairs each motion of the feature with the joint motion that caused it, and relates a model to the measured features:

    x_d = Σ J_b Δq  over the joint motion that ended d periods ago         J_b the base: a model's Jacobian (m, n)
    Δy ≈ M x_d                                                             M a map (m, m), of a turned camera

With a camera model, x_d has the motions of the points, and a map turns those of each camera (`point_map`); else a
map is a matrix between features (`feature_map`). For each candidate delay d, in periods and not always a whole number
of them, a filter holds a map (a filter bank, or multiple-model estimator); the filter that predicts best has the delay:

    P ← P + w² ‖x_d‖ I, no larger than P₀;   M, P ← update(x_d, Δy)        for each delay d
    d = argmin ℓ_d, once it is better than the present one by a margin; motions that tell no delays apart are left out
    M̄, R = completed(M_d, P_d)

P returns to P₀ for all delays when the camera seems to have been moved: a feature step that no motion of the arm
explains, from which nothing is learned, or a CUSUM of innovations, C ← max(0, C + min(‖ν‖²/(s m), 10) − 3) beyond a
gate. M stays, as the best guess. The first sample of the noise σ is a guess (`noise_level`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias, final

import numpy as np
import numpy.typing as npt

from servobench.controllers.aids import AidsConfig
from servobench.controllers.camera_model import CameraModel
from servobench.controllers.estimators.estimator import MOTION_TIME
from servobench.controllers.periods import in_periods, whole_periods
from servobench.controllers.stages.camera_map import CameraMap, Step, of_delay
from servobench.controllers.stages.feature_map import FeatureMap
from servobench.controllers.stages.noise_level import NoiseLevel
from servobench.controllers.stages.point_map import PointMap
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, norm, pick
from servobench.plant.contract.signals import BoolArray, Observation, PlantSpec

MAX_GAP = 16  # longest motion over lost frames from which is learned, in motions of the least length
MIN_JUMP_RATIO = 2.0  # [1] to the longest predicted step; a longer step of the feature is no motion of the arm
MIN_JUMP_DEVIATIONS = 10.0  # [σ] a longer step is no noise either
MIN_CHANGE_RATIO = 0.8  # [1] of a motion's change between candidates to noise, above which delays differ
MAX_BIAS_RATIO = 0.25  # [1] of the model's error to noise, above which a steady motion would favour a wrong delay
NIS_CAP = 50.0  # [1] of ‖ν‖²/s, the normalised innovation squared (NIS), of one motion in the score of a delay
CUSUM_DRIFT = 3.0  # [1] NIS per feature that is subtracted at each motion; 1 is its expectation
CUSUM_CAP = 10.0  # [1] NIS per feature of one motion, so that one outlier cannot reach the gate
RESOLUTION = 0.0125  # [s] approximate distance between candidate delays
LAST_THREE = np.array([0, 1, 2])
NO_DEPTH = np.zeros(0)
IntArray: TypeAlias = npt.NDArray[np.int_]
Bank: TypeAlias = Any  # the state of either form of map


@final
class Candidates:
    """Candidate delays and rows of the past at them; between two rows the motion is interpolated linearly.

    Attributes:
        delays: (D,), periods.
        beside: (D,), a neighbour of each.
        longest: whole periods of the last one.
    """

    def __init__(self, delays: FloatArray) -> None:
        """Take the delays, (D,), periods, in order."""
        self.delays = delays
        self.beside = np.abs(np.arange(len(delays)) - 1) % len(delays)
        self._whole = delays.astype(np.int_)
        self.longest = int(self._whole[-1])
        self._share = delays - self._whole
        self._around = (self._whole, self._whole + 1) if self._share.any() else (self._whole,)

    @classmethod
    def up_to(cls, longest: float, period: float) -> Candidates:
        """Return delays from 0 to the longest one [s], with control periods of `period` [s].

        They lie about `RESOLUTION` apart: a whole number of periods, or a period divided by a whole number.
        """
        spacing = max(1, whole_periods(RESOLUTION, period)) / max(1, whole_periods(period, RESOLUTION))
        count = 1 + math.floor(whole_periods(longest, period) / spacing)
        return cls(np.asarray(spacing * np.arange(count), dtype=np.float64))

    def ends(self, past: FloatArray) -> FloatArray:
        """Return the past (..., H, columns) at each delay, (..., D, columns)."""
        return self._between(*(past[..., rows, :] for rows in self._around))

    def begins(self, past: FloatArray, periods: IntArray) -> FloatArray:
        """Return the past (..., H, columns) at each delay and `periods` (...) before, (..., D, columns)."""
        return self._between(*(pick(past, rows + periods[..., None], axes=1) for rows in self._around))

    def exposed(self, past: FloatArray, candidate: IntArray) -> FloatArray:
        """Return the past (..., H, columns) at a candidate delay (...) and a period before, (..., 2, columns)."""
        whole, share = (np.take(each, candidate)[..., None] for each in (self._whole, self._share))
        rows = pick(past, whole + LAST_THREE, axes=1)
        return np.asarray(rows[..., :2, :] + share[..., None] * (rows[..., 1:, :] - rows[..., :2, :]))

    def _between(self, row: FloatArray, before: FloatArray | None = None) -> FloatArray:
        return row if before is None else np.asarray(row + self._share[:, None] * (before - row))


class PairState(NamedTuple):
    """The state of the stage.

    Attributes:
        past: [q, Σ x, z] of the last periods, (..., H, n + columns + depths), the newest first.
        base: J_b, (..., columns, n), of the last period.
        bank: of the map; see `CameraMap`.
        scores: ℓ_d, (..., D).
        noise: σ².
        candidate: index of the delay, (...).
        map: M̄, (..., m, m) or (..., c, 3, 3).
        rotation: R, likewise.
        moves: how often the camera seems to have been moved, (...).
        nis: of the last motion per feature, (...).
        cusum: C, (...).
    """

    past: FloatArray
    base: FloatArray
    bank: Bank
    scores: FloatArray
    noise: NoiseLevel
    candidate: IntArray
    map: FloatArray
    rotation: FloatArray
    moves: IntArray
    nis: FloatArray
    cusum: FloatArray


class Paired(NamedTuple):
    """A motion of the feature and the joint motion that belongs to it.

    Attributes:
        joint_position: (..., n), rad, where the joint motion began.
        joint_step: Δq, (..., n), rad.
        predicted: x, (..., columns), the step that the base predicts.
        rates: L, (..., c, p, k, 3), during it; empty without a camera model.
    """

    joint_position: FloatArray
    joint_step: FloatArray
    predicted: FloatArray
    rates: FloatArray


class Past(NamedTuple):
    """The past motion that the predict stage needs.

    Attributes:
        delay: d, (...), periods.
        exposed: q(k−d), (..., n), rad.
        before: q(k−d) − q(k−d−1), (..., n), rad.
        window: q(k) − q(k−w), (..., n), rad, over the w periods of a window of the response.
    """

    delay: FloatArray
    exposed: FloatArray
    before: FloatArray
    window: FloatArray


@final
class Pairing:
    """Identifies delay, map and noise, each if its aid is on, and pairs motions by the delay.

    Attributes:
        delays: the candidates, (D,), periods.
        learns: whether delay, map or noise are identified, for which the base Jacobian predicts motions.
        gap: the longest motion, from one valid feature to the next, of which the past is remembered, periods.
        maps: the form of the map.
    """

    def __init__(self, aids: AidsConfig, spec: PlantSpec, latency: float, cameras: CameraModel | None = None) -> None:
        """Take settings, sizes and period.

        Args:
            aids: the settings.
            spec: of the plant.
            latency: s, of a given delay.
            cameras: model of the cameras, where a map is to turn the motions of points; None for a map of features.
        """
        self._aids, self._n, self._m, self._period = aids, spec.n, spec.m, spec.period
        motion = max(1, whole_periods(MOTION_TIME, spec.period))
        if aids.delay == "identified":
            self._candidates = Candidates.up_to(aids.longest_delay, spec.period)
        else:
            given = in_periods(latency, spec.period) if aids.delay == "given" else 0.0
            self._candidates = Candidates(np.array([given]))
        self.delays = self._candidates.delays
        self.gap = MAX_GAP * motion
        self._rows = self._candidates.longest + self.gap + 3
        self._aligns = aids.model == "map"
        self.learns = self._aligns or aids.delay == "identified" or aids.noise == "identified"
        self._cameras = cameras
        self.maps: CameraMap[Any] = FeatureMap(aids, spec.m) if cameras is None else PointMap(aids, cameras, spec.m)
        self._end = spec.n + self.maps.columns

    def start(self, observation: Observation, base: FloatArray, depth: FloatArray = NO_DEPTH) -> PairState:
        """Return the state of an arm that has rested, with J_b (..., columns, n) and the depths (..., c p) there."""
        q, lead = observation.joint_position, observation.feature.shape[:-1]
        none = np.zeros(lead, dtype=np.int_)
        row = np.concatenate(
            [q, np.zeros((*lead, self.maps.columns)), np.broadcast_to(depth, (*lead, depth.shape[-1]))], axis=-1
        )
        bank, first = self.maps.start(lead, len(self.delays), self._aids.feature_noise**2)
        return PairState(
            past=np.repeat(row[..., None, :], self._rows, axis=-2),
            base=base,
            bank=bank,
            scores=np.zeros((*lead, len(self.delays))),
            noise=NoiseLevel.guess(self._aids.feature_noise, lead),
            candidate=none,
            map=first,
            rotation=first,
            moves=none,
            nis=np.zeros(lead),
            cusum=np.zeros(lead),
        )

    def advance(self, state: PairState, joint_position: FloatArray, depth: FloatArray = NO_DEPTH) -> PairState:
        """Return the state one period later, with the arm at `joint_position` (..., n), rad, and depths (..., c p)."""
        past, n, end = state.past, self._n, self._end
        new = np.empty_like(past)
        new[..., 1:, :] = past[..., :-1, :]
        new[..., 0, :n] = joint_position
        new[..., 0, n:end] = past[..., 0, n:end] + np.matvec(state.base, joint_position - past[..., 0, :n])
        new[..., 0, end:] = depth
        return state._replace(past=new)

    def delay(self, state: PairState) -> FloatArray:
        """Return d, (...), periods."""
        return np.asarray(np.take(self.delays, state.candidate))[()]

    def past(self, state: PairState, joint_position: FloatArray, window: int) -> Past:
        """Return the past of an arm that is at `joint_position` (..., n), rad; `window` in periods."""
        positions = state.past[..., : self._n]
        rows = self._candidates.exposed(positions, state.candidate)
        before = rows[..., 0, :] - rows[..., 1, :]
        return Past(self.delay(state), rows[..., 0, :], before, joint_position - positions[..., window, :])

    def noise(self, state: PairState) -> FloatArray | None:
        """Return σ, (...), m; None where it is not identified."""
        return state.noise.deviation if self._aids.noise == "identified" else None

    def learn(
        self,
        state: PairState,
        feature_step: FloatArray,
        duration: FloatArray,
        feature: FloatArray,
        valid: BoolArray,
    ) -> tuple[PairState, Paired]:
        """Return the state after a motion of the feature, and the joint motion that belongs to it.

        Args:
            state: with the arm's present position.
            feature_step: Δy, (..., m).
            duration: that it took, (...), s, at most `gap` periods.
            feature: in the middle of it, (..., m).
            valid: features that were measured at both ends, (..., m).
        """
        n, periods = self._n, np.rint(duration / self._period).astype(np.int_)
        begin, end = self._candidates.begins(state.past, periods), self._candidates.ends(state.past)
        passed = end - begin
        x, depth = passed[..., n : self._end], 0.5 * (begin + end)[..., self._end :]
        rates = np.zeros((*feature.shape[:-1], 0))
        if self._cameras is not None:
            rates = self._cameras.rates(feature[..., None, :], depth)
        if self.learns:
            now = state.candidate
            explained = self.maps.explained(state.map, pick(x, now), self._now(rates, now))
            step = Step(x, np.where(valid, feature_step, explained), valid, rates)
            state = self._identify(state, step)
        now, passed = state.candidate, pick(passed, state.candidate)
        begin, rates = pick(begin, now)[..., :n], self._now(rates, now)
        return state, Paired(begin, passed[..., :n], passed[..., n : self._end], rates)

    def _now(self, rates: FloatArray, candidate: IntArray) -> FloatArray:
        return rates if self._cameras is None else pick(rates, candidate)

    def interrupt(self, state: PairState) -> PairState:
        """Return the state after a frame at which no motion ended, without information about its noise."""
        return state._replace(bank=self.maps.interrupted(state.bank, state.noise.variance))

    def is_known(self, state: PairState) -> bool | BoolArray:
        """Return whether the map, where there is one, is known well enough to learn with it, (...)."""
        return not self._aligns or self.deviation(state) < self._aids.confidence

    def deviation(self, state: PairState) -> FloatArray:
        """Return the uncertainty of the map, (...); see `CameraMap.deviation`."""
        return self.maps.deviation(of_delay(state.bank, state.candidate), state.rotation)

    def diagnostics(self, state: PairState) -> dict[str, npt.ArrayLike]:
        """Return delay (s), rotation (rad), deviation and NIS of the map, moves of the camera, noise level (m)."""
        found: dict[str, npt.ArrayLike] = {"delay": self.delay(state) * self._period}
        if self.learns:
            found |= {"map_surprise": state.nis, "camera_moves": state.moves, "noise_level": state.noise.deviation}
        if self._aligns:
            R = state.rotation
            turned = (R - np.eye(R.shape[-1])).reshape(*R.shape[:-2], -1)
            angle = np.arccos(np.maximum(1.0 - 0.25 * np.vecdot(turned, turned), -1.0))
            found["map_rotation"] = angle if self._cameras is None else np.maximum.reduce(angle, axis=-1)
            found["map_deviation"] = self.deviation(state)
        return found

    def _identify(self, state: PairState, step: Step) -> PairState:
        lengths = self.maps.lengths(step)
        if not self._aids.detect_moves:
            return self._learn_map(state, step, lengths)
        reach = MIN_JUMP_RATIO * np.maximum.reduce(lengths, axis=-1) + MIN_JUMP_DEVIATIONS * state.noise.deviation
        jumped = norm(step.feature_step) > reach
        state = branch(jumped, self._jump, state, step.feature_step)
        return branch(np.logical_not(jumped), self._learn_map, state, step, lengths)

    def _jump(self, state: PairState, feature_step: FloatArray) -> PairState:
        noise, zero = state.noise, np.zeros_like(state.cusum)
        if self._aids.noise == "identified":
            noise = noise.learn(np.vecdot(feature_step, feature_step) / self._m, 2.0, zero)
        bank = self.maps.unknown(state.bank, noise.variance)
        return state._replace(bank=bank, cusum=zero, moves=state.moves + 1, noise=noise)

    def _learn_map(self, state: PairState, step: Step, lengths: FloatArray) -> PairState:
        """Update map, covariance and score of every delay, and choose among them."""
        aids, noise, candidate, frame = self._aids, state.noise, state.candidate, state.noise.variance
        before = self.maps.walked(state.bank, step, lengths)
        bank, innovations = self.maps.update(before, step, lengths, frame)
        now = of_delay(innovations, candidate)
        surprise = now.nis / np.maximum(np.add.reduce(step.valid, axis=-1), 1)
        if aids.noise == "identified":
            noise = noise.learn(surprise * now.variance, now.frames, now.variance - now.frames * noise.variance)
        cusum, moves = np.maximum(0.0, state.cusum + np.minimum(surprise, CUSUM_CAP) - CUSUM_DRIFT), state.moves
        if aids.detect_moves:
            moved = cusum > aids.move_gate
            bank = branch(moved, self._learn_any_map, bank, before, step, lengths, frame)
            cusum, moves = cusum * ~moved, moves + moved
        counts = self._is_informative(step, lengths, noise)[..., None]
        scores = aids.score_memory * state.scores + (np.minimum(innovations.nis, NIS_CAP) + innovations.spread) * counts
        best = scores.argmin(axis=-1)
        better = pick(scores, best) < pick(scores, candidate) - aids.delay_margin
        candidate = np.where(better, best, candidate)[()]
        state = state._replace(
            bank=bank, scores=scores, noise=noise, candidate=candidate, moves=moves, nis=surprise, cusum=cusum
        )
        if not self._aligns:
            return state
        nearest, rotation = self.maps.completed(of_delay(bank, candidate), state.rotation)
        return state._replace(map=nearest, rotation=rotation)

    def _is_informative(self, step: Step, lengths: FloatArray, noise: NoiseLevel) -> BoolArray:
        """Return whether a motion counts in the scores, (...).

        A steady motion hardly differs from one delay to another. The difference is then the noise of single frames,
        which the loop turned into motion, and an error of the model is easily taken for that noise.
        """
        changes = self.maps.lengths(step._replace(x=step.x - step.x[..., self._candidates.beside, :]))
        change, length = (np.maximum.reduce(each, axis=-1) for each in (changes, lengths))
        error = self._aids.map_error * length
        return np.asarray((change >= MIN_CHANGE_RATIO * noise.deviation) | (error < MAX_BIAS_RATIO * noise.deviation))

    def _learn_any_map(self, bank: Bank, before: Bank, step: Step, lengths: FloatArray, frame: FloatArray) -> Bank:
        return self.maps.update(self.maps.unknown(before, frame), step, lengths, frame)[0]
