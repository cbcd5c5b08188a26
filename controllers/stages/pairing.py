"""The pair stage: delay of the camera, noise, and the model of the motion, identified by filters side by side.

It pairs each motion of the feature with the joint motion that caused it. For each candidate delay d, in periods and not
always a whole number of them, a filter (`regression`) holds a map M of the nominal Jacobian J_n and a constant error E;
the filter that predicts best has the delay:

    x_d = Σ J_n Δq  over the joint motion Δq_d that ended d periods ago
    Δy ≈ M x_d + E Δq_d                          P ← P + diag(w² ‖x_d‖, u² ‖Δq_d‖)
    d = argmin ℓ_d, once it is better than the present one by a margin; motions that tell no delays apart are left out

A false frame shows once a later one is seen, by ν of the motion since the last frame that was believed, the anchor:

    ν_d = Δy + e − M x_d − E Δq_d                the frame is doubtful if ‖ν_d‖² > g σ² for every delay d of its end,
    ‖ν‖² < ½ min_d ‖ν_d‖² of the one before      and false then: learned is from the anchor as if it had been lost

σ keeps the innovations of false frames, as it would stay too small without all large ones.
E belongs to it: where the model is wrong by more than a map, filters without E take the error for noise, and find the
delay at which it happens to be smallest. The first sample of the noise σ is a guess (`noise_level`). A regression over
the motions that the delay pairs then gives the Jacobian.
"""

import math
import operator
from collections.abc import Iterable
from functools import reduce
from typing import Final, NamedTuple, Self, TypeAlias, cast, final

import numpy as np
import numpy.typing as npt

from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.estimator import MOTION_TIME
from servobench.controllers.periods import in_periods, whole_periods
from servobench.controllers.stages.noise_level import NoiseLevel
from servobench.controllers.stages.regression import (
    Innovation,
    IntArray,
    Regression,
    RegressionState,
    fresh_bank,
    interrupted,
    learn,
    of_filter,
)
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, norm, pick
from servobench.plant.contract.signals import BoolArray, Observation

MAX_GAP = (
    16  # longest motion over lost frames from which is learned, in motions of the least length
)
MIN_CHANGE_RATIO = (
    0.8  # [1] of a motion's change between candidates to noise, above which delays differ
)
MAX_BIAS_RATIO = 0.25  # [1] of the model's error to noise, above which a steady motion would favour a wrong delay
RESOLUTION = 0.0125  # [s] approximate distance between candidate delays
DOUBT: Final = 100.0  # [1] g
RETURN: Final = 0.5  # [1] of ‖ν‖² at a later frame to that of a doubtful one
DOUBTFUL = 4  # longest motion with doubtful frames, in motions of the least length
MAP_WALK: Final = 0.1  # [1/√m] w, of an entry of M
REST_DEVIATION: Final = 0.2  # [m/rad] of an entry of E at first
REST_WALK: Final = 0.1  # [m/rad/√rad] u, of an entry of E
MODEL_ERROR: Final = 0.05  # [1] share of ‖x‖ that M and E do not explain
MAP_DEVIATION: Final = (
    0.55  # [1] of an entry of M at first; larger ones favour late delays while an arm speeds up
)
FeatureMotion: TypeAlias = tuple[FloatArray, FloatArray, BoolArray]  # the first three of `Paired`


@final
class Candidates:
    """Candidate delays and rows of the past at them; between rows the motion is interpolated.

    At a share c of a period before row w, with the second difference of the motion at its earlier end, because the
    joints lag behind their commands and never change their speed at once:

        x = (1 − c) x_w + c x_{w+1} − ½ c (1 − c) (x_w − 2 x_{w+1} + x_{w+2})

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
        c = delays - self._whole
        bend = -0.5 * c * (1.0 - c)
        weights = (
            np.stack([1.0 - c + bend, c - 2.0 * bend, bend])
            if c.any()
            else np.ones((1, len(delays)))
        )
        self._weights = weights[..., None]

    @classmethod
    def up_to(cls, longest: float, period: float) -> Self:
        """Return delays from 0 to the longest one [s], with control periods of `period` [s].

        They lie about `RESOLUTION` apart: a whole number of periods, or a period divided by a whole number.
        """
        spacing = max(1, whole_periods(RESOLUTION, period)) / max(
            1, whole_periods(period, RESOLUTION)
        )
        count = 1 + math.floor(whole_periods(longest, period) / spacing)
        return cls(np.asarray(spacing * np.arange(count), dtype=np.float64))

    def ends(self, past: FloatArray) -> FloatArray:
        """Return the past (..., H, columns) at each delay, (..., D, columns)."""
        return weighted(
            self._weights, [past[..., self._whole + i, :] for i in range(len(self._weights))]
        )

    def begins(self, past: FloatArray, periods: FloatArray) -> FloatArray:
        """Return the past (..., H, columns) at each delay and about `periods` (...) before, (..., D, columns)."""
        first = self._whole + np.rint(periods).astype(np.int_)[..., None]
        return weighted(
            self._weights, [pick(past, first + i, axes=1) for i in range(len(self._weights))]
        )

    def exposed(self, past: FloatArray, candidate: IntArray) -> FloatArray:
        """Return the past (..., H, columns) at a candidate delay (...) and a period before, (..., 2, columns)."""
        count = len(self._weights)
        rows = pick(past, np.take(self._whole, candidate)[..., None] + np.arange(count + 1), axes=1)
        weights = [np.take(each, candidate, axis=0)[..., None] for each in self._weights]
        return weighted(weights, [rows[..., i : i + 2, :] for i in range(count)])


def weighted(weights: Iterable[FloatArray], rows: Iterable[FloatArray]) -> FloatArray:
    """Return Σ_i w_i x_i."""
    return reduce(operator.add, map(operator.mul, weights, rows))


class Known(NamedTuple):
    """What returns with an anchor; as in `PairState`."""

    bank: FloatArray
    scores: FloatArray
    candidate: IntArray
    regression: RegressionState


class Anchor(NamedTuple):
    """The last frame that was believed, and the motion since then if the frames of it are doubtful."""

    known: Known  # at the anchor
    step: FloatArray  # Δy, (..., m)
    duration: FloatArray  # (...), s
    valid: BoolArray  # (..., m), features that were measured at both ends
    miss: FloatArray  # min_d ‖ν_d‖², (...), of the last frame; 0 where it is the anchor


class PairState(NamedTuple):
    """The state of the stage."""

    past: FloatArray  # [q, Σ x] of the last periods, (..., H, n + m), the newest first
    base: FloatArray  # J_n, (..., m, n), of the last period
    bank: FloatArray  # of a filter for each delay, (..., D, 2m+n+1, m+n+1)
    scores: FloatArray  # ℓ_d, (..., D)
    noise: NoiseLevel  # σ²
    candidate: IntArray  # index of the delay, (...)
    nis: FloatArray  # ‖ν‖²/s of the last motion per feature, (...)
    regression: RegressionState  # over the paired motions
    anchor: Anchor  # from which false frames are found

    def anchored(self) -> Self:
        """Return the state with its last frame as the anchor."""
        known = Known(*(getattr(self, name) for name in Known._fields))
        none = np.zeros((*np.shape(self.candidate), self.base.shape[-2]))
        return self._replace(anchor=Anchor(known, none, none[..., 0], none == 0.0, none[..., 0]))


class Paired(NamedTuple):
    """A motion of the feature and the joint motion that belongs to it; it begins at the anchor after a false frame."""

    feature_step: FloatArray  # Δy, (..., m)
    duration: FloatArray  # (...), s
    valid: BoolArray  # (..., m), features that were measured at both ends
    joint_position: FloatArray  # (..., n), rad, where the joint motion began
    joint_step: FloatArray  # Δq, (..., n), rad
    predicted: FloatArray  # x = J_n Δq, (..., m)
    h: FloatArray  # its regressors in the regression
    before: RegressionState  # the regression before it
    back: BoolArray  # (...), whether a false frame was taken back


class Past(NamedTuple):
    """The past motion that the predict stage needs."""

    exposed: FloatArray  # q(k−d), (..., n), rad.
    before: FloatArray  # q(k−d) − q(k−d−1), (..., n), rad.
    # J_n Δq, (..., m), along each of them: from q(k−d−1) to q(k−d), and from there to q(k).
    predicted: tuple[FloatArray, FloatArray]
    window: (
        FloatArray  # q(k) − q(k−w), (..., n), rad, over the w periods of a window of the response.
    )
    noise: FloatArray  # e, (..., m), of the last frame from which was learned.


@final
class Pairing:
    """Identifies delay, noise and the model of the motion, and pairs motions by the delay.

    Attributes:
        delays: the candidates, (D,), periods.
        gap: the longest motion, from one valid feature to the next, of which the past is remembered, periods.
        regression: the model of the motion.
    """

    def __init__(self, aids: AidsConfig, knowledge: RobotKnowledge, latency: float) -> None:
        """Take settings, sizes and period, and the latency [s] of a given delay."""
        spec = knowledge.spec
        self._aids, self._n, self._m, self._period = aids, spec.n, spec.m, spec.period
        motion = max(1, whole_periods(MOTION_TIME, spec.period))
        if aids.delay == "identified":
            self._candidates = Candidates.up_to(aids.longest_delay, spec.period)
        else:
            given = in_periods(latency, spec.period) if aids.delay == "given" else 0.0
            self._candidates = Candidates(np.array([given]))
        self.delays = self._candidates.delays
        self.gap = MAX_GAP * motion
        self._doubtful = (DOUBTFUL * motion + 0.5) * spec.period
        self._rows = self._candidates.longest + self.gap + DOUBTFUL * motion + 4
        self.regression = Regression(knowledge)
        self._variances = np.repeat([MAP_DEVIATION**2, REST_DEVIATION**2], [self._m, self._n])

    def start(self, observation: Observation, base: FloatArray) -> PairState:
        """Return the state of an arm that has rested, with J_n (..., m, n) there."""
        q, lead, m = observation.joint_position, observation.feature.shape[:-1], self._m
        none, frame = np.zeros(lead, dtype=np.int_)[()], self._aids.feature_noise**2
        row = np.concatenate([q, np.zeros((*lead, m))], axis=-1)
        bank = fresh_bank(np.eye(m, m + self._n), self._variances, frame)
        known = Known(
            bank=np.broadcast_to(bank, (*lead, len(self.delays), *bank.shape)),
            scores=np.zeros((*lead, len(self.delays))),
            candidate=none,
            regression=self.regression.start(lead, frame),
        )
        past, unset = np.repeat(row[..., None, :], self._rows, axis=-2), cast("Anchor", None)
        noise = NoiseLevel.start(self._aids.feature_noise, lead)
        return PairState(
            past, base, noise=noise, nis=np.zeros(lead)[()], anchor=unset, **known._asdict()
        ).anchored()

    def advance(self, state: PairState, joint_position: FloatArray, base: FloatArray) -> PairState:
        """Return the state one period later, with the arm at `joint_position` (..., n), rad, and J_n there."""
        past, n = state.past, self._n
        new = np.empty_like(past)
        new[..., 1:, :] = past[..., :-1, :]
        new[..., 0, :n] = joint_position
        mean = 0.5 * (state.base + base)  # of both ends: the error is of third order in the motion
        new[..., 0, n:] = past[..., 0, n:] + np.matvec(mean, joint_position - past[..., 0, :n])
        return state._replace(past=new, base=base)

    def delay(self, state: PairState) -> FloatArray:
        """Return d, (...), periods."""
        return np.asarray(np.take(self.delays, state.candidate))[()]

    def past(self, state: PairState, joint_position: FloatArray, window: int) -> Past:
        """Return the past of an arm that is at `joint_position` (..., n), rad; `window` in periods."""
        n, rows = self._n, self._candidates.exposed(state.past, state.candidate)
        exposed, before = rows[..., 0, :], rows[..., 0, :] - rows[..., 1, :]
        since = state.past[..., 0, :] - exposed
        moved, noise = joint_position - state.past[..., window, :n], state.regression.mean[..., -1]
        return Past(
            exposed[..., :n], before[..., :n], (before[..., n:], since[..., n:]), moved, noise
        )

    def noise(self, state: PairState) -> FloatArray | None:
        """Return σ, (...), m; None where it is not identified."""
        return state.noise.deviation if self._aids.noise == "identified" else None

    def learn(
        self, state: PairState, feature_step: FloatArray, duration: FloatArray, valid: BoolArray
    ) -> tuple[PairState, Paired]:
        """Return the state after a motion of the feature, and the joint motion that belongs to it.

        Args:
            state: with the arm's present position.
            feature_step: Δy, (..., m).
            duration: that it took, (...), s, at most `gap` periods.
            valid: features that were measured at both ends, (..., m); others are taken to move as foreseen, the noise
                of their last frame included.
        """
        anchor, end = state.anchor, self._candidates.ends(state.past)
        step, total = anchor.step + feature_step, anchor.duration + duration
        since = anchor._replace(step=step, duration=total, valid=anchor.valid & valid)
        first = self._candidates.begins(state.past, total / self._period)
        miss = self._miss(None, since, first, pick(end, anchor.known.candidate)[..., None, :])
        back = (miss < RETURN * anchor.miss) & np.logical_and.reduce(
            since.valid == anchor.valid, axis=-1
        )
        state = branch(
            back, lambda now, known: now._replace(**known._asdict()), state, anchor.known
        )
        motion = branch(
            back,
            lambda _, whole: whole,
            (feature_step, duration, valid),
            (step, total, since.valid),
        )
        periods, shorter = duration / self._period, (anchor.miss > 0.0) & ~back
        begin = branch(
            shorter, lambda _, *last: self._candidates.begins(*last), first, state.past, periods
        )
        state, paired = self._learned(state, motion, begin, end, back)
        least, state = DOUBT * state.noise.variance, state.anchored()
        doubtful = ~back & (total < self._doubtful) & (miss > least)
        since = since._replace(miss=branch(doubtful, self._miss, miss, since, first, end))
        anchor = branch(
            doubtful & (since.miss > least), lambda _, older: older, state.anchor, since
        )
        return state._replace(anchor=anchor), paired

    def _learned(
        self,
        state: PairState,
        motion: FeatureMotion,
        begin: FloatArray,
        end: FloatArray,
        back: BoolArray,
    ) -> tuple[PairState, Paired]:
        """Return `learn` from a motion that is believed, with the past at both of its ends, (..., D, n + m)."""
        n, (feature_step, duration, valid) = self._n, motion
        passed = end - begin
        h = np.concatenate([passed[..., n:], passed[..., :n]], axis=-1)
        now = pick(state.bank, state.candidate)[..., : self._m, :]
        foreseen = np.matvec(now[..., :-1], pick(h, state.candidate)) - now[..., -1]
        state = self._find_delay(state, h, np.where(valid, feature_step, foreseen), valid)
        begin, passed = pick(begin, state.candidate), pick(passed, state.candidate)
        q, step, x = begin[..., :n], passed[..., :n], passed[..., n:]
        h = self.regression.regressors(q + 0.5 * step, step, x)
        paired = Paired(*motion, q, step, x, h, state.regression, back)
        foreseen = (
            self.regression.explained(state.regression, paired.h) - state.regression.mean[..., -1]
        )
        dy = np.where(valid, feature_step, foreseen)
        regression = self.regression.update(
            state.regression, paired.h, dy, duration, state.noise.variance
        )
        moved = regression.moves > state.regression.moves
        state = branch(moved, self._forget, state._replace(regression=regression))
        return state, paired

    def _miss(
        self, _: FloatArray | None, since: Anchor, begin: FloatArray, end: FloatArray
    ) -> FloatArray:
        """Return the least ‖ν‖², (...), of the motion from `begin` by the delay to each `end`, (..., *, n + m)."""
        n, m, known = self._n, self._m, since.known
        passed = end - pick(begin, known.candidate)[..., None, :]
        W = pick(known.bank, known.candidate)[..., None, :m, :]
        foreseen = (
            np.matvec(W[..., :m], passed[..., n:])
            + np.matvec(W[..., m:-1], passed[..., :n])
            - W[..., -1]
        )
        nu = np.where(since.valid[..., None, :], since.step[..., None, :] - foreseen, 0.0)
        return np.asarray(np.minimum.reduce(np.vecdot(nu, nu), axis=-1))

    def interrupt(self, state: PairState) -> PairState:
        """Return the state after a frame at which no motion ended, without information about its noise."""
        frame = state.noise.variance
        regression = self.regression.interrupt(state.regression, frame)
        return state._replace(bank=interrupted(state.bank, frame), regression=regression).anchored()

    def diagnostics(self, state: PairState) -> dict[str, npt.ArrayLike]:
        """Return delay [s], noise, NIS, moves of the camera, rotation [rad] of the map, and the deviation of E."""
        regression, R = state.regression, state.regression.rotation
        turned = (R - np.eye(self._m)).reshape(*R.shape[:-2], -1)
        return {
            "delay": self.delay(state) * self._period,
            "noise_level": state.noise.deviation,
            "model_surprise": state.nis,
            "camera_moves": regression.moves,
            "map_rotation": np.arccos(np.maximum(1.0 - 0.25 * np.vecdot(turned, turned), -1.0)),
            "model_deviation": self.regression.deviation(regression),
        }

    def _forget(self, state: PairState) -> PairState:
        """Return the state in which any map is possible."""
        bank = fresh_bank(
            state.bank[..., : self._m, :-1], self._variances, state.noise.variance[..., None]
        )
        return state._replace(bank=bank)

    def _find_delay(
        self, state: PairState, h: FloatArray, feature_step: FloatArray, valid: BoolArray
    ) -> PairState:
        """Update filter and score of every delay, choose among them, and learn the noise."""
        aids, m, candidate, frame = self._aids, self._m, state.candidate, state.noise.variance
        lengths, turns = norm(h[..., :m]), norm(h[..., m:])
        steps = np.repeat(
            np.stack([MAP_WALK**2 * lengths, REST_WALK**2 * turns], axis=-1), (m, self._n), axis=-1
        )
        model = MODEL_ERROR**2 * (lengths * lengths)
        learns = lengths * lengths >= frame[..., None]
        bank, innovations = learn(state.bank, h, feature_step, frame, model, steps, learns)
        now: Innovation = of_filter(innovations, candidate)
        noise, count = state.noise, np.add.reduce(valid, axis=-1)
        if aids.noise == "identified":
            noise = noise.learn(now.square, count, now.frames, now.variance - now.frames * frame)
        counts = self._is_informative(h, lengths, noise)[..., None]
        evidence = innovations.square / innovations.capped + m * np.log(innovations.capped)
        scores = aids.score_memory * state.scores + evidence * counts
        best = scores.argmin(axis=-1)
        better = pick(scores, best) < pick(scores, candidate) - aids.delay_margin
        candidate = np.where(better, best, candidate)[()]
        nis = now.square / (now.variance * np.maximum(count, 1))
        return state._replace(bank=bank, scores=scores, noise=noise, candidate=candidate, nis=nis)

    def _is_informative(self, h: FloatArray, lengths: FloatArray, noise: NoiseLevel) -> BoolArray:
        """Return whether a motion counts in the scores, (...).

        A steady motion hardly differs from one delay to another. The difference is then the noise of single frames,
        which the loop turned into motion, and an error of the model is easily taken for that noise.
        """
        x = h[..., : self._m]
        changes = norm(x - x[..., self._candidates.beside, :])
        change, length = (np.maximum.reduce(each, axis=-1) for each in (changes, lengths))
        error = MODEL_ERROR * length
        return np.asarray(
            (change >= MIN_CHANGE_RATIO * noise.deviation)
            | (error < MAX_BIAS_RATIO * noise.deviation)
        )
