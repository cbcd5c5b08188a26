"""The calibrating stage: an arm that is fitted while it servoes (`arm_fit`), and whether to believe it.

The arm and the regression predict each frame from what was known `HORIZON` frames before. The fitted arm is used while
the mean square of its errors is below a multiple (`GATE`) of that of the regression, a larger one once it explains all
frames to their noise.

Few frames fit many arms, and of those that are far away an iteration finds the right one slowly. While no member
explains the frames, all of them make several iterations from frame to frame, and the worst ones are replaced by the
best of many new arms. With more frames there are fewer members, so that the work of an iteration stays the same.

The work of a frame is spread over the periods to the next one, so that none of them takes long: the frame is taken in
during the first one, members are fitted to it in the next one, and other arms are searched for in those that remain. At
20 Hz all of that falls into one period.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias, TypeVar, final

import numpy as np

from servobench.controllers.choice import choose
from servobench.controllers.controller import Diagnostics, RobotKnowledge
from servobench.controllers.estimators.estimator import MOTION_TIME
from servobench.controllers.periods import whole_periods
from servobench.controllers.stages.arm_fit import (
    ANNEALED,
    FIRST_DAMPING,
    FLOOR,
    FRAMES,
    GEARS,
    KEPT,
    MEDIAN_SQUARE,
    Fit,
    Fitted,
    Frames,
    Members,
    added,
    at_latency,
    first,
    last,
    squared,
    whitened,
    without_rates,
)
from servobench.controllers.stages.pairing import MAX_LATENESS, rows_ago
from servobench.controllers.stages.regression import MOVED_FRAMES
from servobench.plant.contract.checks import FloatArray, IntArray
from servobench.plant.contract.features import FeatureModel
from servobench.plant.contract.lanes import branch, norm, pick
from servobench.plant.contract.signals import BoolArray, Observation

FIRST_MEMBERS = 32  # members at first
SEARCHED = 16  # least number of members until `SEARCH_TIME`
MEMBERS = 3  # members at last
WORK = 240  # product of members and frames that is not exceeded by more
SEARCH_TIME = (
    1.5  # [s] until which members that do not explain the frames are searched for an arm that does
)
SEARCH_ITERATIONS = 8  # their iterations from frame to frame
ITERATION_INTERVAL = 2  # frames from one iteration to the next, once all are explained
RIPPLE_ITERATIONS = 4  # for which another order is tried; shares no factor with their number
MIN_MOTION = 5.0  # [1] motion of a feature, in σ, before anything is fitted
NOISE = (0.5e-3, 2e-2)  # [m] least and largest σ, in natural units
BIAS_TIME = 0.4  # [s] over which the residuals' mean is taken
HORIZON = 2  # frames
# [1] shares of the errors that are kept from frame to frame: with few frames, which change much, and with many
MEMORIES = (0.6, 0.9)
MAX_ERROR = 12.0  # [1] largest error that counts, in σ
GATE = 0.9  # [1] below 1: errors of both are limited, so that two bad predictions are equal
HYSTERESIS = (0.8, 1.25)  # [1] factors of the gate before and while the arm is used
MANY_FRAMES = 40
KNOWN_GATE = 2.0  # [1] factor of the gate where all frames are explained
MIN_TRAVEL = 2.0  # [rad] motion of all joints before it is
EXPLAINED = 1.3  # [1] residuals in σ up to which frames are explained
LEAST_LATENESS = 0.012  # [s] below which there is none
FAST = 0.03  # [1/s] least speed of a feature whose residuals tell lateness
MOVE_ERROR = 3.0  # [1] error of a frame in σ from which on it tells a moved camera
MIN_EXPONENT = -100.0  # exponent of a weight: its square does not underflow
MIN_TOTAL = 1e-12  # [1] sum of weights by which they are divided
CANDIDATES = 8  # new members from frame to frame
SCREENED = 256  # arms at most of which these are the best, before any iteration
SCREENING_WORK = 4096  # product of them and frames that is not exceeded
SCREENING = 25.0  # [1] factor of the variance by which they are compared, as no arm is near yet
LONG_SPREAD = 4  # periods of a frame up to which each has time for new arms and for an iteration


class Regressed(NamedTuple):
    """What the regression says at a frame, in natural units."""

    feature: FloatArray  # without its noise, (..., m)
    jacobian: FloatArray  # (..., m, n)
    delay: FloatArray  # latency of frames, (...) [s]
    deviation: FloatArray  # σ of their noise, (...)
    moves: IntArray  # how often the camera seems to have been moved, (...)


class Known(NamedTuple):
    """What was known at a frame, with which later ones are predicted."""

    members: Members
    share: FloatArray  # weight of each member, (..., E)
    bias: FloatArray  # (..., E, m)
    feature: FloatArray  # the regression's, without its noise, (..., m)
    jacobian: FloatArray  # the regression's, (..., m, n)
    exposed: FloatArray  # joint position at the exposure, by the regression's delay, (..., n)
    fitted: BoolArray  # (...), whether the members had been fitted
    moves: IntArray  # the regression's, (...)


Past: TypeAlias = tuple[Known, ...]
"""The last `HORIZON` frames, the oldest first."""


class CalibrationState(NamedTuple):
    """The state of the stage."""

    begin: float  # [s] time of the first observation
    elapsed: float  # [s] from it to the last one
    # Joint positions q [rad] of the last periods and their places x within the play, the newest first, (..., h, 2n)
    history: FloatArray
    frames: Frames
    members: Members
    share: FloatArray  # weight of each member, (..., E)
    bias: FloatArray  # mean residual of each member, (..., E, m)
    begun: IntArray  # iterations with which members begin, (...): -1 before, `ANNEALED` once they are fitted
    phase: IntArray  # periods since the last frame, (...)
    lateness: FloatArray  # s, (...) [s]
    across: FloatArray  # deviation of residuals across the motion, (...); 0 where it is unknown
    rms: FloatArray  # deviation of the residuals of the best member, (...)
    noise: FloatArray  # σ of the last frame, (...)
    travel: FloatArray  # (...) [rad] sum of the joints' motion
    errors: FloatArray  # mean squares of the prediction errors of regression and arm, (..., 2); NaN before
    used: BoolArray  # (...), whether the arm is believed
    moves: IntArray  # those of the regression at the last frame, (...)
    passed: IntArray  # frames since the last iteration, (...)
    spawned: IntArray  # members begun so far, and iterations of other ripples, (...)
    past: Past

    @property
    def fitted(self) -> BoolArray:
        """Whether members are fitted, (...)."""
        return np.equal(self.begun, ANNEALED)


Holder = TypeVar("Holder", CalibrationState, Known)


class Ahead(NamedTuple):
    """Prediction by the fitted arm."""

    feature: FloatArray  # (..., m)
    jacobian: FloatArray  # (..., m, n)
    drift: FloatArray  # motion of the feature in a period by the camera's turning, (..., m)


@final
class Calibration:
    """The stage; see above."""

    def __init__(self, knowledge: RobotKnowledge, model: FeatureModel) -> None:
        """Take knowledge in natural units, and the model in the unit of the plant."""
        self._period = knowledge.spec.period
        self._m = knowledge.spec.m
        self._n = knowledge.spec.n
        self.fit = Fit(model, knowledge.unit, self._period)
        self._periods = 1 + (self.fit.rows - 1) * self.fit.stride
        # At least so many periods lie between frames that are learned from.
        self._spread = max(1, whole_periods(MOTION_TIME, self._period))
        self._frame_time = self._spread * self._period
        # Periods after a frame in which members are fitted and arms are searched for
        self._fitting = min(1, self._spread - 1)
        self._searching = min(2, self._spread - 1)
        # Short periods are for new arms and for an iteration in turn, long ones for both.
        self._cycle = 1 + int(self._spread > LONG_SPREAD)

    def start(self, observation: Observation) -> CalibrationState:
        """Return the state before any frame."""
        lead = observation.lead
        q = observation.joint_position
        fit = self.fit
        m = self._m
        none = np.zeros(lead)[()]
        no = np.zeros(lead, dtype=np.bool_)[()]
        zero = np.zeros(lead, dtype=np.int_)[()]
        rows = (*lead, FRAMES)
        features = np.zeros((*rows, m))
        row = np.concatenate([q, np.zeros_like(q)], axis=-1)
        paths = np.zeros((*lead, fit.rows, FRAMES, row.shape[-1]))
        frames = Frames(np.zeros(rows), features, features, paths, number=zero)
        members = fit.start(lead, FIRST_MEMBERS, none)
        size = (*lead, FIRST_MEMBERS)
        periods = self._periods
        if np.isfinite(observation.capture_time).any():
            periods += whole_periods(MAX_LATENESS, self._period)
        history = np.repeat(row[..., None, :], periods, axis=-2)
        return CalibrationState(
            begin=float(observation.time),
            elapsed=0.0,
            history=history,
            frames=frames,
            members=members,
            share=np.full(size, 1.0 / FIRST_MEMBERS),
            bias=np.zeros((*size, m)),
            begun=zero - 1,
            phase=zero + self._spread,
            lateness=none,
            across=none,
            rms=none,
            noise=none,
            travel=none,
            errors=np.full((*lead, 2), np.nan),
            used=no,
            moves=zero,
            passed=zero,
            spawned=zero + FIRST_MEMBERS,
            past=(),
        )

    def update(
        self,
        state: CalibrationState,
        observation: Observation,
        due: BoolArray,
        regression: Regressed,
        late: FloatArray | None = None,
    ) -> CalibrationState:
        """Return the state at an observation.

        Args:
            state: one period ago.
            observation: of this period.
            due: whether its frame is learned from, (...).
            regression: at this observation.
            late: by which the frame is known to be later than others, (...) [s]; None where nothing is known.
        """
        before = state.history[..., 0, :]
        q = observation.joint_position
        row = self.fit.next_row(state.members, state.share, before, q)
        step = q - self._joints(before)
        earlier = state.history[..., :-1, :]
        history = np.concatenate([row[..., None, :], earlier], axis=-2)
        elapsed = float(observation.time) - state.begin
        travel = state.travel + norm(step)
        past = state.past
        phase = state.phase + 1
        state = state._replace(
            history=history, travel=travel, elapsed=elapsed, phase=phase, past=()
        )
        least = MEMBERS
        if elapsed <= SEARCH_TIME:
            least = SEARCHED
        size = max(least, WORK // self._most_frames(elapsed))
        if state.share.shape[-1] > size:
            state = self._reduced(state, size)
        state = branch(due, self._taken_in, state, observation, regression, past, late)
        state = self._worked(state, regression.delay)
        return state._replace(past=self._remembered(past, state, due, regression))

    def _most_frames(self, elapsed: float) -> int:
        """Return the largest number of frames that there can be, which does not depend on other lanes."""
        return 1 + round(elapsed / self._frame_time)

    def _taken_in(
        self,
        state: CalibrationState,
        observation: Observation,
        regression: Regressed,
        past: Past,
        late: FloatArray | None,
    ) -> CalibrationState:
        """Return the state with a frame more, by which earlier predictions are judged."""
        delay = regression.delay
        path = self._path(state.history, late)
        instant = np.full(state.travel.shape, state.elapsed)[()]
        if late is not None:
            # Time and path are those at which it would have come if it were not late.
            instant = instant - late
        y = observation.feature
        most = np.where(state.lateness > 0.0, FRAMES, KEPT)
        frames = added(state.frames, most, instant, y, observation.valid, path)
        noise = np.clip(regression.deviation, *NOISE)
        known = (state.lateness > 0.0) & (state.across > 0.0)
        across = np.minimum(np.maximum(state.across, NOISE[0]), noise)
        noise = np.where(known, across, noise)
        state = state._replace(frames=frames, noise=noise, phase=np.zeros_like(state.phase))
        if past:
            state, missed = self._judged(state, y, path, instant, delay, past)
            camera_moved = missed & (regression.moves > state.moves)
            state = branch(camera_moved, self._after_move, state._replace(moves=regression.moves))
            frames = state.frames
        moved = norm(y - frames.feature[..., 0, :]) > MIN_MOTION * noise
        begins = (state.begun < 0) & moved & (frames.number > 2)
        state = state._replace(passed=state.passed + 1)
        return _by_size(begins, self._begun, state, delay)

    def _worked(self, state: CalibrationState, delay: FloatArray) -> CalibrationState:
        """Return the state after the work of a period: a part of what the last frame asks for."""
        phase = state.phase
        noise = state.noise
        many = state.frames.number >= MANY_FRAMES
        least = np.minimum(noise, EXPLAINED * state.rms + 0.2e-3)
        level = np.where(many & state.fitted, least, noise)

        for _ in range(math.ceil(ANNEALED / self._spread)):
            # Placing the cameras is work enough for a period of several.
            waits = (state.begun == 0) & (phase < self._fitting)
            begins = (state.begun >= 0) & ~state.fitted & ~waits
            state = _by_size(begins, self._annealed, state, level)
        unexplained = state.fitted & (state.rms > EXPLAINED * noise)
        searches = unexplained & (state.elapsed <= SEARCH_TIME) & (phase >= self._searching)
        turn = (phase - self._searching) % self._cycle
        refreshes = searches & (phase < self._spread) & (turn == 0)
        state = branch(refreshes, self._refreshed, state, delay, level)
        searches = searches & (turn == self._cycle - 1)
        for _ in range(max(1, (SEARCH_ITERATIONS - 1) // self._spread)):
            state = branch(searches, self._searched, state, level)

        explained = many & (state.rms < EXPLAINED * noise)
        fits = phase == self._fitting
        tries = unexplained & (state.elapsed > SEARCH_TIME) & fits
        number = state.spawned
        begins = tries & (number % RIPPLE_ITERATIONS == 0)
        members = branch(begins, self.fit.challenged, state.members, number)
        state = state._replace(members=members, spawned=number + tries)
        iterates = state.fitted & (~explained | (state.passed >= ITERATION_INTERVAL))
        state = _by_size(fits & iterates, self._continued, state, level)
        used = np.where(fits, self._trusted(state), state.used & state.fitted)
        return state._replace(used=used)

    def _searched(self, state: CalibrationState, noise: FloatArray) -> CalibrationState:
        """Return the state after a further iteration of all members."""
        frames = self._in_use(state)
        variance = _floor(noise)
        members, _ = self.fit.iterated(state.members, frames, state.lateness, variance)
        return state._replace(members=members)

    def _after_move(self, state: CalibrationState) -> CalibrationState:
        """Return the state after a move of the camera: arms stay as they are, of the frames the last ones."""
        members = state.members
        damping = np.full_like(members.damping, FIRST_DAMPING)
        arms = members._replace(damping=damping, centre=members.theta)
        frames = last(state.frames, MOVED_FRAMES)
        state = state._replace(frames=frames, members=arms)
        begun = np.full_like(state.begun, -1)
        unknown = np.full_like(state.errors, np.nan)
        return state._replace(begun=begun, errors=unknown)

    def _joints(self, rows: FloatArray) -> FloatArray:
        """Return joint positions alone, (..., n), of rows (..., 2n) of the history."""
        return rows[..., : self._n]

    def _path(self, history: FloatArray, late: FloatArray | None) -> FloatArray:
        """Return rows of the history up to `late` (...) [s] ago, (..., J, 2n), the newest last."""
        stride = self.fit.stride
        if late is None:
            return history[..., : self._periods : stride, :][..., ::-1, :]
        ago = late[..., None] / self._period + stride * np.arange(self.fit.rows)
        return rows_ago(history, ago)[..., ::-1, :]

    def _in_use(self, state: CalibrationState) -> Frames:
        """Return the frames, without rows that are empty in all lanes of a size (`_by_size`)."""
        most = np.max(np.where(state.frames.number > KEPT, FRAMES, KEPT))
        return first(state.frames, min(most, self._most_frames(state.elapsed)))

    def _begun(self, state: CalibrationState, delay: FloatArray) -> CalibrationState:
        """Return the state in which members begin for the first time, or anew after a move of the camera."""
        late = np.broadcast_to(delay[..., None], state.share.shape)
        members = state.members._replace(latency=late)
        members = self.fit.begun(members, self._in_use(state), _floor(state.noise))
        return state._replace(members=members, begun=np.zeros_like(state.begun))

    def _annealed(self, state: CalibrationState, noise: FloatArray) -> CalibrationState:
        """Return the state after an iteration of members that begin."""
        frames = self._in_use(state)
        floor = _floor(noise)
        members = self.fit.annealed(state.members, state.begun, frames, state.lateness, floor)
        return state._replace(members=members, begun=state.begun + 1)

    def _continued(self, state: CalibrationState, noise: FloatArray) -> CalibrationState:
        """Return the state after an iteration, with weights, biases and the noise of frames that members imply."""
        frames = self._in_use(state)
        variance = _floor(noise)
        members, fitted = self.fit.iterated(state.members, frames, state.lateness, variance)
        cost = members.cost
        best = cost.argmin(axis=-1)
        excess = cost - np.minimum.reduce(cost, axis=-1)[..., None]
        likelihood = np.exp(np.maximum(-0.5 * excess, MIN_EXPONENT))
        share = likelihood / np.add.reduce(likelihood, axis=-1)[..., None]
        state = state._replace(members=members, share=share)
        residual, _ = whitened(without_rates(fitted), state.lateness, variance)
        there = np.maximum.reduce(frames.weight, axis=-1) > 0.0
        square = squared(residual)
        own = pick(square, best)
        rms = np.sqrt(_median_of(own, there) / MEDIAN_SQUARE)
        level = np.minimum(noise, 1.5 * rms + 0.2e-3)
        bias = self._bias(residual, square, frames, state.elapsed, level, noise)
        passed = np.zeros_like(state.passed)
        state = state._replace(rms=rms, bias=bias, passed=passed)
        return self._lateness(state, fitted, best, there)

    def _bias(
        self,
        residual: FloatArray,
        square: FloatArray,
        frames: Frames,
        elapsed: float,
        level: FloatArray,
        noise: FloatArray,
    ) -> FloatArray:
        """Return the mean residual of members, (..., E, m), shrunk to 0 where noise explains it."""
        past = np.maximum((frames.time - elapsed) / BIAS_TIME, MIN_EXPONENT)
        age = np.exp(past) * frames.weight[..., 0]
        inlier = square < 30.0 * np.square(level)[..., None, None]
        weight = age[..., None, :] * inlier + 1e-9
        total = np.add.reduce(weight, axis=-1)
        count = total * total / np.add.reduce(weight * weight, axis=-1)
        sums = np.add.reduce(weight[..., None, :] * residual, axis=-1)
        mean = sums / total[..., None]
        expected = 3.0 * np.square(np.maximum(noise, 1e-4))[..., None] / count
        significance = np.vecdot(mean, mean) / expected
        kept = np.clip(1.0 - 2.0 / np.maximum(significance, 1e-9), 0.0, 1.0)
        return mean * kept[..., None]

    def _lateness(
        self, state: CalibrationState, fitted: Fitted, best: IntArray, there: BoolArray
    ) -> CalibrationState:
        """Return the state with the lateness of frames by the spread of residuals along their motion."""
        residual = pick(fitted.residual, best)
        motion = pick(fitted.motion, best)
        square = squared(motion)
        speed = np.sqrt(square)
        fast = (speed > FAST) & there
        unit = motion / np.maximum(speed, 1e-9)[..., None, :]
        along = np.add.reduce(unit * residual, axis=-2)
        side = squared(residual - along[..., None, :] * unit)
        enough = np.add.reduce(fast, axis=-1) > 12
        across = _median_of(side, fast) / 1.386
        fine = fast & (side < 12.0 * across[..., None])
        ratio = (along * along - across[..., None]) / np.maximum(square, FAST**2)
        middle = np.maximum(_median_of(ratio, fine), 0.0)
        capped = np.minimum(ratio, 8.0 * middle[..., None]) * fine
        number = np.maximum(np.add.reduce(fine, axis=-1), 1)
        mean = np.add.reduce(capped, axis=-1) / number
        lateness = np.sqrt(np.maximum(mean, 0.0))
        lateness = np.where(lateness > LEAST_LATENESS, lateness, 0.0)
        return state._replace(
            lateness=np.where(enough, lateness, state.lateness),
            across=np.where(enough, np.sqrt(across), state.across),
        )

    def _judged(
        self,
        state: CalibrationState,
        y: FloatArray,
        path: FloatArray,
        instant: FloatArray,
        delay: FloatArray,
        past: Past,
    ) -> tuple[CalibrationState, BoolArray]:
        """Judge the predictions of a frame by what was known `HORIZON` frames before.

        Returns:
            The state with the errors of regression and arm, and whether the arm misses the frame, (...): by more than
            noise and all of the feature's way along the path, the most by which a late frame can be off.
        """
        known = past[0]
        fit = self.fit
        members = known.members
        q = fit.exposed(members, path[..., None, :])
        turn = (members.turning * instant[..., None])[..., None]
        found = fit.feature(members, q, turn)
        seen = found[..., 0, :] / fit.scale
        by_arm = np.vecmat(known.share, seen + known.bias)
        moved = np.matvec(known.jacobian, self._exposed(path, delay) - known.exposed)
        by_regression = known.feature + moved
        errors = np.stack([y - by_regression, y - by_arm], axis=-2)
        most = np.square(MAX_ERROR * state.noise)[..., None]
        squares = np.minimum(np.vecdot(errors, errors), most)
        memory = np.where(state.frames.number < MANY_FRAMES, *MEMORIES)[..., None]
        mean = memory * state.errors + (1.0 - memory) * squares
        mean = np.where(np.isnan(state.errors), squares, mean)
        comparable = known.fitted & (known.moves == state.moves)
        steps = self._joints(np.diff(path, axis=-2))
        ways = np.matvec(known.jacobian[..., None, :, :], steps)
        way = np.add.reduce(norm(ways), axis=-1)
        missed = norm(errors[..., 1, :]) > MOVE_ERROR * state.noise + way
        new = state._replace(errors=np.where(comparable[..., None], mean, state.errors))
        return new, np.asarray(known.fitted & missed)

    def _exposed(self, path: FloatArray, delay: FloatArray) -> FloatArray:
        """Return joint positions, (..., n) [rad], a delay (...) [s] before the end of a path (..., J, 2n)."""
        exposed, _ = at_latency(path[..., None, :], delay[..., None], self.fit.grid)
        return self._joints(exposed[..., 0, 0, :])

    def _trusted(self, state: CalibrationState) -> BoolArray:
        gate = GATE * np.where(state.used, HYSTERESIS[1], HYSTERESIS[0])
        count = state.frames.number
        explained = (
            (count >= MANY_FRAMES)
            & (state.travel > MIN_TRAVEL)
            & (state.rms < EXPLAINED * state.noise)
        )
        gate = np.where(explained, KNOWN_GATE * gate, gate)
        better = state.errors[..., 1] < gate * state.errors[..., 0]
        return np.asarray(state.fitted & better)

    def _refreshed(
        self, state: CalibrationState, delay: FloatArray, noise: FloatArray
    ) -> CalibrationState:
        """Return the state with the best of many new members, before any iteration, for the worst ones."""
        most = SCREENING_WORK // self._most_frames(state.elapsed)
        parts = math.ceil((self._spread - self._searching) / self._cycle)
        count = math.ceil(min(max(most, CANDIDATES), SCREENED) / parts)
        better = math.ceil(CANDIDATES / parts)
        new = self.fit.spawned(state.travel.shape, state.spawned, count, delay)
        coarse = SCREENING * _floor(noise)
        new = self.fit.screened(new, self._in_use(state), coarse, better)
        kept = self._reduced(state, state.share.shape[-1] - better)
        return self._together(kept._replace(spawned=state.spawned + count), new)

    def _together(self, state: CalibrationState, new: Members) -> CalibrationState:
        """Return the state with new members beside the old ones."""
        nothing = np.zeros_like(new.cost)
        share = np.concatenate([state.share, nothing], axis=-1)
        no_bias = np.zeros((*nothing.shape, self._m))
        bias = np.concatenate([state.bias, no_bias], axis=state.travel.ndim)
        return state._replace(members=state.members.beside(new), share=share, bias=bias)

    def _reduced(self, state: CalibrationState, size: int) -> CalibrationState:
        """Return the state with the best members alone, as many as `size`."""
        kept = state.members.best(size)
        return _picked(state, kept)

    def _remembered(
        self,
        past: Past,
        state: CalibrationState,
        due: BoolArray,
        regression: Regressed,
    ) -> Past:
        """Return what is known at the last frames, with this one where it is due."""
        # Members become fewer at the same time in all lanes, whether a frame is due or not.
        same_size = bool(past) and past[-1].share.shape == state.share.shape
        fits = state.phase == self._fitting
        if same_size and not np.any(due | fits):
            return past
        new = Known(
            state.members,
            state.share,
            state.bias,
            regression.feature,
            regression.jacobian,
            self._exposed(self._path(state.history, None), regression.delay),
            state.fitted,
            regression.moves,
        )
        if not past:
            return (new,) * HORIZON
        if past[-1].share.shape != new.share.shape:
            past = tuple(_trimmed(each, new.share.shape[-1]) for each in past)
        *earlier, newest = (choose(due, *each) for each in zip((*past[1:], new), past, strict=True))
        # Members that are fitted to the frame a period later count as known at it.
        fitted = newest._replace(members=new.members, share=new.share, bias=new.bias)
        fitted = fitted._replace(fitted=new.fitted)
        return (*earlier, choose(fits, fitted, newest))

    def jacobian(self, state: CalibrationState) -> FloatArray:
        """Return the Jacobian at the joint position of the last observation, (..., m, n)."""
        q = self._joints(state.history[..., 0, :])
        return self.ahead(state, q, np.zeros(q.shape[:-1])).jacobian

    def ahead(self, state: CalibrationState, bound: FloatArray, lead: FloatArray) -> Ahead:
        """Return the prediction for joints that are bound to reach `bound` (..., n) after `lead` (...) periods."""
        fit = self.fit
        members = state.members
        row = fit.next_row(members, state.share, state.history[..., 0, :], bound)
        q = fit.geared(members, row[..., None, None, :])
        ahead = lead[..., None] * self._period
        since = state.elapsed + ahead + members.latency
        turn = (members.turning * since)[..., None]
        found = fit.derivatives(members, q, turn)
        feature = found.feature[..., 0, :] / fit.scale
        by_turn = found.by_parameter[..., 0, :, fit.first_turn] / fit.scale
        drift = by_turn * (members.turning * self._period)[..., None]
        by_joint = found.by_joint * fit.slope(members, q)[..., None, :]
        jacobian = by_joint[..., 0, :, :] / fit.scale
        return Ahead(
            feature=np.vecmat(state.share, feature + state.bias),
            jacobian=np.vecmat(state.share[..., None, :], np.swapaxes(jacobian, -3, -2)),
            drift=np.vecmat(state.share, drift),
        )

    def diagnostics(self, state: CalibrationState) -> Diagnostics:
        """Return the stage's own numbers."""
        members = state.members
        latency = np.vecdot(state.share, members.latency)
        turning = np.vecdot(state.share, members.turning)
        gears = np.vecmat(state.share, members.theta)[..., -len(GEARS) :]
        errors = np.sqrt(state.errors)
        return {
            "calibrated": np.asarray(state.used, dtype=np.float64),
            "calibration_rms": state.rms,
            "calibration_latency": latency,
            "calibration_turning": turning,
            "calibration_play": gears[..., 0],
            "calibration_ripple": gears[..., 1],
            "lateness": state.lateness,
            "regression_error": errors[..., 0],
            "arm_error": errors[..., 1],
        }


def _by_size(
    chosen: BoolArray,
    function: Callable[..., CalibrationState],
    state: CalibrationState,
    *arguments: FloatArray,
) -> CalibrationState:
    """Return the result of `branch`, in which lanes that keep many frames do not meet those that do not."""
    many = state.frames.number > KEPT
    state = branch(chosen & ~many, function, state, *arguments)
    return branch(chosen & many, function, state, *arguments)


def _floor(noise: FloatArray) -> FloatArray:
    """Return the variance of residuals that are but noise, (..., 1)."""
    variance = np.square(noise) + FLOOR**2
    return variance[..., None]


def _picked(known: Holder, kept: IntArray) -> Holder:
    """Return what is known of the members of indices `kept` (..., k) alone, whose weights sum to 1 again."""
    own = pick(known.share, kept, axes=1)
    total = np.maximum(np.add.reduce(own, axis=-1), MIN_TOTAL)
    return known._replace(
        members=known.members.picked(kept),
        share=own / total[..., None],
        bias=pick(known.bias, kept, axes=1),
    )


def _trimmed(known: Known, size: int) -> Known:
    """Return what was known, with the best members alone."""
    kept = np.argsort(-known.share, axis=-1)[..., :size]
    return _picked(known, kept)


def _median_of(values: FloatArray, chosen: BoolArray) -> FloatArray:
    """Return the median of the chosen values, (...), of (..., k); 0 where none is chosen."""
    count = np.add.reduce(chosen, axis=-1)
    ordered = np.sort(np.where(chosen, values, np.inf), axis=-1)
    low = pick(ordered, np.maximum(count - 1, 0) // 2)
    high = pick(ordered, count // 2)
    return np.where(count > 0, 0.5 * (low + high), 0.0)
