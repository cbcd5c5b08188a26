"""The pair stage: delay of the camera, noise, and the model of the motion, identified by filters side by side.

It pairs each motion of the feature with the joint motion that caused it. For each candidate delay d, in periods and not
always a whole number of them, a filter (`regression`) holds a map M of the nominal Jacobian J_n and a constant error E;
the filter that predicts best has the delay:

    x_d = Σ J_n Δq  over the joint motion Δq_d that ended d periods ago
    Δy ≈ M x_d + E Δq_d                          P ← P + diag(w² ‖x_d‖, u² ‖Δq_d‖)
    d = argmin ℓ_d, once it is better than the present one by a margin; motions that tell no delays apart are left out

A false frame shows once a later one is seen, by ν of the motion since the last frame that was believed, the anchor:

    ν_d = Δy + e − M x_d − E Δq_d                the frame is doubtful if ‖ν_d‖² > g σ² for every delay d of its end,
    ‖ν‖² < ½ min_d ‖ν_d‖² of the one before      and then that one was false: what is learned now is the whole motion
                                                 since the anchor, as if the false frame had been lost

σ keeps the innovations of false frames, as it would stay too small without all large ones.

Stamps tell how old each frame is but for the offset of the camera's clock. A frame that is older than the first one by
Δa belongs to the joint positions d + Δa ago, so that the constant d is found as before and no jitter is left.

The error E is necessary: where the model is wrong by more than a map, filters without E take the error for noise, and
find the delay at which it happens to be smallest. The first sample of the noise σ is a guess (`noise_level`). A
regression over the motions that the delay pairs then gives the Jacobian.
"""

import math
import operator
from collections.abc import Iterable
from functools import reduce
from typing import NamedTuple, Self, final

import numpy as np
import numpy.typing as npt

from servobench.controllers.aids import AidsConfig
from servobench.controllers.choice import choose
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.estimator import MOTION_TIME
from servobench.controllers.periods import in_periods, whole_periods
from servobench.controllers.stages.noise_level import NoiseLevel
from servobench.controllers.stages.regression import (
    Innovation,
    Regression,
    RegressionState,
    fresh_bank,
    interrupted,
    learn,
    of_filter,
)
from servobench.plant.contract.checks import FloatArray, IntArray
from servobench.plant.contract.lanes import branch, entries, norm, pick
from servobench.plant.contract.signals import BoolArray, Observation

# A motion over lost frames teaches nothing if it is longer than this many motions of the least length.
MAX_GAP = 16
# Candidate delays differ only by noise if the motion changes between neighbours by less than this share of the noise.
MIN_CHANGE_RATIO = 0.8  # [1]
# A model error below this share of the noise cannot favour a wrong delay, so that a steady motion counts as well.
MAX_BIAS_RATIO = 0.25  # [1]
RESOLUTION = 0.0125  # [s] approximate distance between candidate delays
MAX_LATENESS = 1.0  # [s] a larger change of the age of frames is one of the camera's clock
# [s] by which the age that counts as not late follows that of a frame: 200 ppm of the least duration of a motion
DRIFT_STEP = 1e-5
DOUBT_GATE = 100.0  # [1] g
# A doubtful frame was false if ‖ν‖² of the motion past it is below this share of the ‖ν‖² of the motion to it.
TAKE_BACK_RATIO = 0.5  # [1]
# A motion since the anchor is doubtful no longer if it is longer than this many motions of the least length.
MAX_DOUBTFUL_GAP = 4
# w, random walk of an entry of M over the motion of the feature.
MAP_LENGTH_WALK = 0.1  # [1/√m]
REST_DEVIATION = 0.2  # [m/rad] prior deviation of an entry of E
REST_WALK = 0.1  # [m/rad/√rad] u, random walk of an entry of E
UNEXPLAINED_SHARE = 0.05  # [1] share of ‖x‖ that M and E do not explain
# The prior deviation of an entry of M. Larger ones favour late delays while an arm speeds up.
MAP_DEVIATION = 0.55  # [1]


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
        count = len(delays)
        self.delays = delays
        self.beside = np.abs(np.arange(count) - 1) % count
        self._whole = delays.astype(np.int_)
        self.longest = int(self._whole[-1])
        self._weights = interpolation_weights(delays - self._whole)[..., None]

    @classmethod
    def up_to(cls, longest: float, period: float) -> Self:
        """Return delays from 0 to the longest one [s], with control periods of `period` [s].

        They lie about `RESOLUTION` apart: a whole number of periods, or a period divided by a whole number.
        """
        periods_each = max(1, whole_periods(RESOLUTION, period))
        delays_a_period = max(1, whole_periods(period, RESOLUTION))
        spacing = periods_each / delays_a_period
        count = 1 + math.floor(whole_periods(longest, period) / spacing)
        return cls(np.asarray(spacing * np.arange(count), dtype=np.float64))

    def ends(self, past: FloatArray, late: FloatArray | None = None) -> FloatArray:
        """Return the past (..., H, columns) at each delay, (..., D, columns), and `late` (...) periods before."""
        if late is not None:
            return rows_ago(past, self.delays + late[..., None])
        rows = [past[..., self._whole + i, :] for i in range(len(self._weights))]
        return weighted(self._weights, rows)

    def begins(
        self, past: FloatArray, periods: FloatArray, late: FloatArray | None = None
    ) -> FloatArray:
        """Return the past (..., H, columns) at each delay and about `periods` (...) before, (..., D, columns).

        With `late` (...) [periods] it is so much before, exactly.
        """
        if late is not None:
            return rows_ago(past, self.delays + (periods + late)[..., None])
        first = self._whole + np.rint(periods).astype(np.int_)[..., None]
        rows = [pick(past, first + i, axes=1) for i in range(len(self._weights))]
        return weighted(self._weights, rows)

    def exposed(self, past: FloatArray, candidate: IntArray) -> FloatArray:
        """Return the past (..., H, columns) at a candidate delay (...) and a period before, (..., 2, columns)."""
        count = len(self._weights)
        first = np.take(self._whole, candidate)[..., None]
        rows = pick(past, first + np.arange(count + 1), axes=1)
        weights = [np.take(each, candidate, axis=0)[..., None] for each in self._weights]
        return weighted(weights, [rows[..., i : i + 2, :] for i in range(count)])


def interpolation_weights(c: FloatArray) -> FloatArray:
    """Return the weights of x_w, x_{w+1} and x_{w+2}, (3, D), at shares c (D,) of a period; (1, D) if all c are 0."""
    if not c.any():
        return np.ones((1, len(c)))
    return parabola(c)


def parabola(c: FloatArray) -> FloatArray:
    """Return the weights of x_w, x_{w+1} and x_{w+2}, (3, ...), at shares c (...) of a period."""
    bend = -0.5 * c * (1.0 - c)
    return np.stack([1.0 - c + bend, c - 2.0 * bend, bend])


def rows_ago(past: FloatArray, ago: FloatArray) -> FloatArray:
    """Return the past (..., H, columns) at any times `ago` (..., K) [periods], (..., K, columns)."""
    oldest = past.shape[-2] - 3
    periods = np.clip(ago, 0.0, oldest)
    whole = periods.astype(np.int_)
    weights = parabola(periods - whole)[..., None]
    return weighted(weights, [pick(past, whole + i, axes=1) for i in range(len(weights))])


def weighted(weights: Iterable[FloatArray], rows: Iterable[FloatArray]) -> FloatArray:
    """Return Σ_i w_i x_i."""
    return reduce(operator.add, map(operator.mul, weights, rows))


class Lateness(NamedTuple):
    """How late frames are, by their stamps."""

    age: FloatArray  # (...) [s] that counts as not late, by the stamps; NaN before there is one
    last: FloatArray  # (...) [s] lateness of the last frame; 0 where it is not known

    def next(self, age: FloatArray) -> Self:
        """Return the state after a frame whose age by its stamp is `age` (...) [s], NaN without one."""
        late = age - self.age
        known = np.abs(late) < MAX_LATENESS
        followed = self.age + np.clip(late, -DRIFT_STEP, DRIFT_STEP)
        anew = np.where(np.isnan(age), self.age, age)
        return type(self)(
            age=np.where(known, followed, anew)[()], last=np.where(known, late, 0.0)[()]
        )


class Identified(NamedTuple):
    """The part of a `PairState` that returns when a false frame is taken back; the fields are the same."""

    bank: FloatArray
    scores: FloatArray
    candidate: IntArray
    regression: RegressionState


class Anchor(NamedTuple):
    """The last frame that was believed, and the motion since then if the frames of it are doubtful."""

    known: Identified  # at the anchor
    step: FloatArray  # Δy, (..., m)
    duration: FloatArray  # (...), s
    valid: BoolArray  # (..., m), features that were measured at both ends
    miss: FloatArray  # min_d ‖ν_d‖², (...), of the last frame; 0 where it is the anchor
    late: FloatArray | None  # (...) [s]; None without stamps

    @classmethod
    def at_last_frame(cls, known: Identified, features: int, late: FloatArray | None) -> Self:
        """Return the anchor at a frame that is believed, since which no motion ended; `features` is m."""
        none = np.zeros((*np.shape(known.candidate), features))
        return cls(
            known, step=none, duration=none[..., 0], valid=none == 0.0, miss=none[..., 0], late=late
        )


class PairState(NamedTuple):
    """The state of the stage."""

    past: FloatArray  # [q, Σ x] in the last periods, (..., H, n + m), the newest first
    base: FloatArray  # J_n, (..., m, n), of the last period
    bank: FloatArray  # a filter for each delay, (..., D, 2m+n+1, m+n+1)
    scores: FloatArray  # ℓ_d, (..., D)
    noise: NoiseLevel  # σ²
    candidate: IntArray  # index of the delay, (...)
    nis: FloatArray  # ‖ν‖²/s of the last motion per feature, (...)
    regression: RegressionState  # over the paired motions
    anchor: Anchor  # from which false frames are found
    lateness: Lateness | None  # None without stamps

    @property
    def late(self) -> FloatArray | None:
        """Lateness of the last frame, (...) [s]; None without stamps."""
        if self.lateness is None:
            return None
        return self.lateness.last

    def after(self, observation: Observation) -> Self:
        """Return the state with the lateness of the frame of an observation."""
        if self.lateness is None:
            return self
        age = observation.time - np.asarray(observation.capture_time)
        return self._replace(lateness=self.lateness.next(age))

    def anchored(self) -> Self:
        """Return the state with its last frame as the anchor."""
        known = Identified(self.bank, self.scores, self.candidate, self.regression)
        anchor = Anchor.at_last_frame(known, self.base.shape[-2], self.late)
        return self._replace(anchor=anchor)


class FeatureMotion(NamedTuple):
    """A motion of the feature between two frames; as in `Paired`."""

    feature_step: FloatArray
    duration: FloatArray
    valid: BoolArray


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


class LateFrame(NamedTuple):
    """The motion from the exposure of a late frame to that of one that is not."""

    begin: FloatArray  # (..., n) [rad]
    joint_step: FloatArray  # (..., n) [rad]
    predicted: FloatArray  # J_n Δq, (..., m), along it


class Past(NamedTuple):
    """The past motion that the predict stage needs."""

    exposed: FloatArray  # q(k−d), (..., n), rad.
    before: FloatArray  # q(k−d) − q(k−d−1), (..., n), rad.
    # J_n Δq, (..., m), along each of them: from q(k−d−1) to q(k−d), and from there to q(k).
    predicted: tuple[FloatArray, FloatArray]
    # q(k) − q(k−w), (..., n), rad, over the w periods of a window of the response.
    window: FloatArray
    noise: FloatArray  # e, (..., m), of the last frame from which was learned.
    late: LateFrame | None  # the present frame; None without stamps


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
        self._aids = aids
        self._n = spec.n
        self._m = spec.m
        self._period = spec.period
        if aids.delay == "identified":
            self._candidates = Candidates.up_to(aids.longest_delay, spec.period)
        elif aids.delay == "given":
            self._candidates = Candidates(np.array([in_periods(latency, spec.period)]))
        else:
            self._candidates = Candidates(np.zeros(1))
        self.delays = self._candidates.delays
        motion = max(1, whole_periods(MOTION_TIME, spec.period))
        doubtful = MAX_DOUBTFUL_GAP * motion
        self.gap = MAX_GAP * motion
        self._longest_doubtful = (doubtful + 0.5) * spec.period
        # The rows reach back to the beginning of the longest motion since an anchor at the longest delay. Four more are
        # for this period, for the two rows beyond that interpolation needs, and for rounding.
        self._rows = self._candidates.longest + self.gap + doubtful + 4
        self.regression = Regression(knowledge)
        self._variances = np.repeat([MAP_DEVIATION**2, REST_DEVIATION**2], [self._m, self._n])

    def start(self, observation: Observation, base: FloatArray) -> PairState:
        """Return the state of an arm that has rested, with J_n (..., m, n) there."""
        q = observation.joint_position
        lead = observation.lead
        m = self._m
        frame = self._aids.feature_noise**2
        no_motion = np.zeros((*lead, m))
        row = np.concatenate([q, no_motion], axis=-1)
        lateness = None
        late: FloatArray | None = None
        count = self._rows
        if np.isfinite(observation.capture_time).any():
            never = np.full(lead, np.nan)[()]
            late = np.zeros(lead)[()]
            lateness = Lateness(never, late)
            count += whole_periods(MAX_LATENESS, self._period)
        past = np.repeat(row[..., None, :], count, axis=-2)
        nominal_map = np.eye(m, m + self._n)
        bank = fresh_bank(nominal_map, self._variances, frame)
        count = len(self.delays)
        known = Identified(
            bank=np.broadcast_to(bank, (*lead, count, *bank.shape)),
            scores=np.zeros((*lead, count)),
            candidate=np.zeros(lead, dtype=np.int_)[()],
            regression=self.regression.start(lead, frame),
        )
        noise = NoiseLevel.start(self._aids.feature_noise, lead)
        anchor = Anchor.at_last_frame(known, m, late)
        nis = np.zeros(lead)[()]
        start = PairState(
            past, base, noise=noise, nis=nis, anchor=anchor, lateness=lateness, **known._asdict()
        )
        return start.after(observation)

    def advance(self, state: PairState, joint_position: FloatArray, base: FloatArray) -> PairState:
        """Return the state one period later, with the arm at `joint_position` (..., n), rad, and J_n there."""
        n = self._n
        past = state.past
        dq = joint_position - past[..., 0, :n]
        # With the mean of J_n at both ends the error of J_n Δq is of third order in the motion.
        mean = 0.5 * (state.base + base)
        new = np.empty_like(past)
        new[..., 1:, :] = past[..., :-1, :]
        new[..., 0, :n] = joint_position
        new[..., 0, n:] = past[..., 0, n:] + np.matvec(mean, dq)
        return state._replace(past=new, base=base)

    def delay(self, state: PairState) -> FloatArray:
        """Return d, (...), periods."""
        return np.asarray(np.take(self.delays, state.candidate))[()]

    def past(self, state: PairState, observation: Observation, window: int) -> Past:
        """Return the past of an arm as it is observed; `window` in periods."""
        n = self._n
        rows = self._candidates.exposed(state.past, state.candidate)
        exposed = rows[..., 0, :]
        before = exposed - rows[..., 1, :]
        since = state.past[..., 0, :] - exposed
        predicted = (before[..., n:], since[..., n:])
        step = observation.joint_position - state.past[..., window, :n]
        noise = state.regression.mean[..., -1]
        late = self._late_frame(state, observation, exposed)
        return Past(exposed[..., :n], before[..., :n], predicted, step, noise, late)

    def _late_frame(
        self, state: PairState, observation: Observation, exposed: FloatArray
    ) -> LateFrame | None:
        """Return the motion to the row of the past (..., n + m) that a frame shows that is not late."""
        # Between frames the last one becomes older.
        late = self._in_periods(state.after(observation).late)
        if late is None:
            return None
        n = self._n
        ago = self.delay(state) + late
        begin = rows_ago(state.past, ago[..., None])[..., 0, :]
        passed = exposed - begin
        return LateFrame(begin[..., :n], passed[..., :n], passed[..., n:])

    def _in_periods(self, late: FloatArray | None) -> FloatArray | None:
        if late is None:
            return None
        return late / self._period

    def noise(self, state: PairState) -> FloatArray | None:
        """Return σ, (...), m; None where it is not identified."""
        if self._aids.noise == "given":
            return None
        return state.noise.deviation

    def learn(
        self,
        state: PairState,
        feature_step: FloatArray,
        duration: FloatArray,
        valid: BoolArray,
        observation: Observation,
    ) -> tuple[PairState, Paired]:
        """Return the state after a motion of the feature, and the joint motion that belongs to it.

        Args:
            state: with the arm's present position.
            feature_step: Δy, (..., m).
            duration: that it took, (...), s, at most `gap` periods.
            valid: features that were measured at both ends, (..., m); others are taken to move as foreseen, the noise
                of their last frame included.
            observation: at which the motion ended.
        """
        late_before = self._in_periods(state.late)
        state = state.after(observation)
        motion = FeatureMotion(feature_step, duration, valid)
        anchor = state.anchor
        since = anchor._replace(
            step=anchor.step + feature_step,
            duration=anchor.duration + duration,
            valid=anchor.valid & valid,
        )
        end = self._candidates.ends(state.past, self._in_periods(state.late))
        periods_since = since.duration / self._period
        late_since = self._in_periods(anchor.late)
        begin_since = self._candidates.begins(state.past, periods_since, late_since)

        # A frame is taken back if the motion past it, from the anchor, fits much better than the motion to it. Its miss
        # is that of the delay that was known at the anchor.
        end_known = pick(end, anchor.known.candidate)[..., None, :]
        miss = self._least_miss(since, begin_since, end_known)
        fits_better = miss < TAKE_BACK_RATIO * anchor.miss
        same_features = np.logical_and.reduce(since.valid == anchor.valid, axis=-1)
        back = fits_better & same_features
        state = branch(back, _taken_back, state, anchor.known)
        whole = FeatureMotion(since.step, since.duration, since.valid)
        motion = choose(back, whole, motion)

        # Where the anchor is the last frame, the motion since the anchor is the last motion, and its begin is known.
        shorter = (anchor.miss > 0.0) & ~back
        periods = duration / self._period
        begin = branch(shorter, self._begins_instead, begin_since, state.past, periods, late_before)
        state, paired = self._learned(state, motion, begin, end, back)
        state = state.anchored()

        # A frame is doubtful if no delay explains the motion from the anchor to it. The least miss over all delays is
        # only found where the miss of the known delay is large already.
        least = DOUBT_GATE * state.noise.variance
        recent = since.duration < self._longest_doubtful
        suspect = ~back & recent & (miss > least)
        miss = branch(suspect, self._least_miss_instead, miss, since, begin_since, end)
        doubtful = suspect & (miss > least)
        anchor = choose(doubtful, since._replace(miss=miss), state.anchor)
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
        n = self._n
        passed = end - begin
        h = np.concatenate([passed[..., n:], passed[..., :n]], axis=-1)
        now = pick(state.bank, state.candidate)[..., : self._m, :]
        motion_now = np.matvec(now[..., :-1], pick(h, state.candidate))
        foreseen = motion_now - now[..., -1]
        dy = np.where(motion.valid, motion.feature_step, foreseen)
        state = self._find_delay(state, h, dy, motion.valid)

        begin = pick(begin, state.candidate)
        passed = pick(passed, state.candidate)
        q = begin[..., :n]
        dq = passed[..., :n]
        x = passed[..., n:]
        before = state.regression
        h = self.regression.regressors(q + 0.5 * dq, dq, x)
        paired = Paired(*motion, q, dq, x, h, before, back)

        foreseen = self.regression.explained(before, h) - before.mean[..., -1]
        dy = np.where(motion.valid, motion.feature_step, foreseen)
        frame = state.noise.variance
        regression = self.regression.update(before, h, dy, motion.duration, frame)
        moved = regression.moves > before.moves
        state = branch(moved, self._forget, state._replace(regression=regression))
        return state, paired

    def _begins_instead(
        self, _: FloatArray, past: FloatArray, periods: FloatArray, late: FloatArray | None
    ) -> FloatArray:
        return self._candidates.begins(past, periods, late)

    def _least_miss_instead(
        self, _: FloatArray, since: Anchor, begin: FloatArray, end: FloatArray
    ) -> FloatArray:
        return self._least_miss(since, begin, end)

    def _least_miss(self, since: Anchor, begin: FloatArray, end: FloatArray) -> FloatArray:
        """Return the least ‖ν‖², (...), of the motion from `begin` by the delay to each `end`, (..., *, n + m)."""
        n = self._n
        m = self._m
        known = since.known
        passed = end - pick(begin, known.candidate)[..., None, :]
        dq = passed[..., :n]
        x = passed[..., n:]
        W = pick(known.bank, known.candidate)[..., None, :m, :]
        M = W[..., :m]
        E = W[..., m:-1]
        e = W[..., -1]
        foreseen = np.matvec(M, x) + np.matvec(E, dq) - e
        missed = since.step[..., None, :] - foreseen
        nu = np.where(since.valid[..., None, :], missed, 0.0)
        square = np.vecdot(nu, nu)
        return np.asarray(np.minimum.reduce(square, axis=-1))

    def interrupt(self, state: PairState, observation: Observation) -> PairState:
        """Return the state after a frame at which no motion ended, without information about its noise."""
        state = state.after(observation)
        frame = state.noise.variance
        regression = self.regression.interrupt(state.regression, frame)
        return state._replace(bank=interrupted(state.bank, frame), regression=regression).anchored()

    def diagnostics(self, state: PairState) -> dict[str, npt.ArrayLike]:
        """Return delay [s], noise, NIS, moves of the camera, rotation [rad] of the map, and the deviation of E."""
        regression = state.regression
        R = regression.rotation
        # ‖R − I‖² = 4 (1 − cos φ) for a rotation by φ about one axis.
        difference = R - np.eye(self._m)
        turned = entries(difference)
        cosine = 1.0 - 0.25 * np.vecdot(turned, turned)
        angle = np.arccos(np.maximum(cosine, -1.0))
        deviation = self.regression.deviation(regression)
        return {
            "delay": self.delay(state) * self._period,
            "noise_level": state.noise.deviation,
            "model_surprise": state.nis,
            "camera_moves": regression.moves,
            "map_rotation": angle,
            "model_deviation": deviation,
        }

    def _forget(self, state: PairState) -> PairState:
        """Return the state in which any map is possible."""
        W = state.bank[..., : self._m, :-1]
        bank = fresh_bank(W, self._variances, state.noise.variance[..., None])
        return state._replace(bank=bank)

    def _find_delay(
        self, state: PairState, h: FloatArray, feature_step: FloatArray, valid: BoolArray
    ) -> PairState:
        """Update filter and score of every delay, choose among them, and learn the noise."""
        m = self._m
        frame = state.noise.variance
        lengths = norm(h[..., :m])
        turns = norm(h[..., m:])
        map_walk = MAP_LENGTH_WALK**2 * lengths
        rest_walk = REST_WALK**2 * turns
        walks = np.stack([map_walk, rest_walk], axis=-1)
        walk = np.repeat(walks, (m, self._n), axis=-1)
        unexplained = UNEXPLAINED_SHARE**2 * (lengths * lengths)
        learns = lengths * lengths >= frame[..., None]
        bank, innovations = learn(state.bank, h, feature_step, frame, unexplained, walk, learns)

        now: Innovation = of_filter(innovations, state.candidate)
        count = np.add.reduce(valid, axis=-1)
        noise = state.noise
        if self._aids.noise == "identified":
            rest = now.variance - now.frames * frame
            noise = noise.learn(now.square, count, now.frames, rest)

        counts = self._is_informative(h, lengths, noise)[..., None]
        capped = innovations.capped
        evidence = innovations.square / capped + m * np.log(capped)
        scores = self._aids.score_memory * state.scores + evidence * counts
        best = scores.argmin(axis=-1)
        present = pick(scores, state.candidate)
        better = pick(scores, best) < present - self._aids.delay_margin
        candidate = np.where(better, best, state.candidate)[()]
        nis = now.square / (now.variance * np.maximum(count, 1))
        return state._replace(bank=bank, scores=scores, noise=noise, candidate=candidate, nis=nis)

    def _is_informative(self, h: FloatArray, lengths: FloatArray, noise: NoiseLevel) -> BoolArray:
        """Return whether a motion counts in the scores, (...).

        A steady motion hardly differs from one delay to another. The difference is then the noise of single frames,
        which the loop turned into motion, and an error of the model is easily taken for that noise.
        """
        x = h[..., : self._m]
        changes = norm(x - x[..., self._candidates.beside, :])
        change = np.maximum.reduce(changes, axis=-1)
        error = UNEXPLAINED_SHARE * np.maximum.reduce(lengths, axis=-1)
        differs = change >= MIN_CHANGE_RATIO * noise.deviation
        unbiased = error < MAX_BIAS_RATIO * noise.deviation
        return np.asarray(differs | unbiased)


def _taken_back(state: PairState, known: Identified) -> PairState:
    """Return the state with what was identified at the anchor."""
    return state._replace(**known._asdict())
